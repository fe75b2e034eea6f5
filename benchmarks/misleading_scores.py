"""Do scores prefer the worse picture? python benchmarks/misleading_scores.py

Makes pairs of pictures of the built-in scenes' test views from the exact truth, has `gsx judge` measure both, and lists
which figures prefer the worse picture, and which the other (docs/explanation/misleading-scores.md).
Nothing is trained. --folder keeps pictures and pages; --strips also writes the pictures of the page.
"""

import argparse
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import pad

from gsx.builtin import plugins
from gsx.core.data.camera import Camera
from gsx.core.data.images import read_image, write_image
from gsx.core.data.resize import to_uint8
from gsx.core.data.scene import Scene
from gsx.core.data.window import Window
from gsx.core.files import read_json
from gsx.core.gaussians.splats import Gaussians
from gsx.core.shapes import UInt8
from gsx.experiments.runs.compose import compose
from gsx.experiments.runs.load_scene import load_scene
from gsx.formats.splat_files import write_gaussians
from gsx.scenes.demo.still_life import StillLife
from gsx.scenes.demo.tracing import points_at
from gsx.scenes.demo.views import DemoSource
from measuring.machine import ROOT, describe_machine, shown_command, told_load
from measuring.results import stamped, text_table, write_results
from measuring.runs import gsx
from measuring.spoilt import (
    Picture,
    blurred,
    brighter,
    enlarged,
    framed,
    reduced,
    shifted,
    textured,
    with_floater,
    with_gaps,
)
from zoom_picture import label_bar

RESULTS, STRIPS = Path(__file__).parent / "results", ROOT / "docs" / "explanation"
SCENES = ("demo", "room")
WIDTH, HEIGHT, ZOOM, VIEWS = 192, 144, 4, 3
"""Of x1 pictures, px; the zoom; test views. Each of demo's shows what another shows, from another height."""
FLICKER = (1.06, 0.94, 1.06)
"""Exposure of the views."""
SHOWN, CROP = "demo", Window(312, 252, 168, 126)
"""Scene in strips, and the window of its x4 pictures, px."""
Pictures = dict[str, list[Picture]]
"""By folder, such as `soft/x4`, one for each view."""
Protocols = tuple[str, ...]


@dataclass(frozen=True, kw_only=True)
class Case:
    """A pair: `worse` is further from the truth in a way that its user sees; names of methods."""

    name: str
    worse: str
    better: str
    zooms: tuple[int, ...] = (ZOOM,)
    protocols: Protocols = ("",)
    """Named protocols; empty: the settings as they are."""


CASES = [
    Case(name="aliasing", worse="unfiltered", better="soft"),
    Case(name="invented texture", worse="invented", better="enlarged"),
    Case(name="displaced detail", worse="enlarged", better="displaced"),
    Case(name="exposure", worse="blurred", better="brighter"),
    Case(name="gaps at x4", worse="gaps", better="smooth", zooms=(1, ZOOM)),
    Case(name="one bad view", worse="floater", better="blurred"),
    Case(name="black border", worse="border", better="hazy", zooms=(1,), protocols=("inria", "nerfbaselines")),
    Case(name="flicker", worse="flicker", better="steady"),
]
LABELS = {
    "unfiltered": "one ray a pixel",
    "soft": "filtered, blurred",
    "invented": "invented texture",
    "enlarged": "x1 enlarged",
    "displaced": "1/2 px aside",
    "blurred": "blurred",
    "brighter": "7 % brighter",
    "gaps": "gaps",
    "smooth": "smooth",
    "floater": "floater, a view",
    "border": "black border",
    "hazy": "slight blur",
    "flicker": "flicker",
    "steady": "all brighter",
}
"""Labels in strips."""
FIGURES = {
    "psnr": ("PSNR", 2, 1),
    "lowest": ("PSNR of the worst view", 2, 1),
    "ssim": ("SSIM", 4, 1),
    "niqe": ("NIQE", 2, -1),
    "st_lpips_alex": ("ST-LPIPS", 4, -1),
    "explained_detail": ("detail", 3, 1),
    "consistency": ("consistency", 2, 1),
    "agreeing": ("agreeing detail", 3, 1),
}
"""Heading, decimals, and 1 where more is better."""
COLUMNS = [
    ["case", "case"],
    ["scene", "scene"],
    ["zoom", "zoom"],
    ["protocol", "protocol"],
    ["worse", "worse"],
    ["better", "better"],
    *([key, f"{name}: worse, better"] for key, (name, _, _) in FIGURES.items()),
    ["misled", "prefer the worse"],
    ["right", "prefer the better"],
]
NOTES = [
    f"Test views of {WIDTH} x {HEIGHT} px at x1 and {ZOOM * WIDTH} x {ZOOM * HEIGHT} px at x{ZOOM}, {VIEWS} of each "
    "scene, 8 bits; means over views. Pictures are made from the exact truth; `worse` and `better` name what they are.",
    "Agreeing detail: correlation of the detail of neighbouring views. NIQE, ST-LPIPS: less is better; others: more.",
]


# -- pictures ----------------------------------------------------------------------------------------------------------


def words_of(scene: str, samples: int = 8) -> list[str]:
    """Returns the settings of a scene."""
    size = [f"scene={scene}", f"scene.width={WIDTH}", f"scene.height={HEIGHT}", f"scene.test_views={VIEWS}"]
    return [*size, "scene.train_views=40", f"scene.samples={samples}"]


def loaded(scene: str, samples: int = 8) -> Scene:
    """Loads a scene."""
    return load_scene(compose(words_of(scene, samples), plugins()))


def truths(scene: Scene, zoom: int) -> list[Picture]:
    """Returns the exact pictures of test views at a zoom."""
    finer = [view.zoom(zoom) for view in scene.test]
    return [view.image() for view in finer if view is not None]


def made(scene: str) -> Pictures:
    """Makes the pictures of all methods by folder."""
    exact = loaded(scene)
    first, fine, sparse = truths(exact, 1), truths(exact, ZOOM), truths(loaded(scene, samples=1), ZOOM)
    return spoilt(first, fine, sparse)


def spoilt(first: Sequence[Picture], fine: Sequence[Picture], sparse: Sequence[Picture]) -> Pictures:
    """Makes pictures from the truth at x1, the truth at x4, and x4 pictures of one ray a pixel."""
    generator = torch.Generator().manual_seed(0)
    larger = [enlarged(picture, ZOOM) for picture in first]
    gaps, smooth = [with_gaps(picture, ZOOM) for picture in fine], [blurred(picture, 2.0) for picture in fine]
    return {
        "unfiltered/x4": list(sparse),
        "soft/x4": [blurred(picture, 0.7) for picture in fine],
        "enlarged/x4": larger,
        "invented/x4": [textured(picture, 0.3, generator) for picture in larger],
        "displaced/x4": [shifted(picture, ZOOM // 2) for picture in fine],
        "blurred/x4": [blurred(picture, 1.0) for picture in fine],
        "brighter/x4": [brighter(picture, 1.07) for picture in fine],
        "gaps/x4": gaps,
        "gaps/x1": [reduced(picture, ZOOM) for picture in gaps],
        "smooth/x4": smooth,
        "smooth/x1": [reduced(picture, ZOOM) for picture in smooth],
        "floater/x4": [
            with_floater(picture, 0.6, 0.25) if index == 1 else blurred(picture, 0.4)
            for index, picture in enumerate(fine)
        ],
        "border/x1": [framed(picture, 3) for picture in first],
        "hazy/x1": [blurred(picture, 0.6) for picture in first],
        "flicker/x4": [brighter(picture, gain) for picture, gain in zip(fine, FLICKER, strict=True)],
        "steady/x4": [brighter(picture, 1.065) for picture in fine],
    }


def write_pictures(folder: Path, pictures: Pictures, names: Sequence[str]) -> None:
    """Writes a PNG for each view, named as it."""
    for place, own in pictures.items():
        (folder / place).mkdir(parents=True)
        for name, picture in zip(names, own, strict=True):
            write_image(folder / place / f"{name}.png", picture)


def surface_splats(life: StillLife, cameras: Sequence[Camera]) -> Gaussians:
    """Returns an opaque splat where the ray of each pixel meets a surface: their depth is the scene's."""
    places = [torch.cartesian_prod(*(torch.arange(side).double() + 0.5 for side in c.size)).mT for c in cameras]
    points = [points_at(life, [one], [place]).points.mT for one, place in zip(cameras, places, strict=True)]
    spacing = [(own - one.centre).norm(dim=1) / one.fx for own, one in zip(points, cameras, strict=True)]
    means, count = torch.cat(points), sum(map(len, points))
    return Gaussians(
        means=means,
        log_scales=(0.6 * torch.cat(spacing)).log()[:, None].expand(-1, 3),
        quats=torch.tensor([[1.0, 0, 0, 0]]).expand(count, -1),
        opacity_logits=torch.full((count,), 7.0),
        sh_dc=torch.zeros(count, 3),
        sh_rest=torch.zeros(count, 0, 3),
    )


def write_depth(path: Path, scene: Scene) -> None:
    """Writes the splat file of the test views' surfaces."""
    source = scene.test[0].source
    assert isinstance(source, DemoSource), "SCENES are ray-cast"
    write_gaussians(path, surface_splats(source.life, [view.camera for view in scene.test]))


# -- figures -----------------------------------------------------------------------------------------------------------


def measured(scene: str, folder: Path) -> dict[Protocols, Any]:
    """Makes and measures pictures of a scene; returns comparison.json by the protocols of a call of `gsx judge`."""
    names = [view.name for view in loaded(scene).test]
    write_pictures(folder, made(scene), names)
    write_depth(folder / "surfaces.ply", loaded(scene))
    depth = ["--depth", str(folder / "surfaces.ply")]
    protocols = dict.fromkeys(case.protocols for case in CASES)
    calls = {names: ["--protocols", ",".join(names)] if any(names) else depth for names in protocols}
    return {names: judged(scene, folder, names, more) for names, more in calls.items()}


def judged(scene: str, folder: Path, protocols: Protocols, more: Sequence[str]) -> dict[str, Any]:
    """Has `gsx judge` measure the methods of cases by protocols."""
    methods = dict.fromkeys(name for case in CASES if case.protocols == protocols for name in (case.worse, case.better))
    words = [f"{name}={folder / name}" for name in methods]
    page = folder / "_".join(["page", *filter(None, protocols)])
    scores = ["metrics.perceptual=[st_lpips_alex,niqe]", "eval.competitor=null"]
    gsx(["judge", *words, *words_of(scene), *scores, *more, "--to", str(page)])
    found: dict[str, Any] = read_json(page / "comparison.json")
    return found


def rows(scene: str, found: Mapping[Protocols, Any]) -> Iterator[dict[str, Any]]:
    """Yields a row for each case, zoom and protocol."""
    for case in CASES:
        content = found[case.protocols]
        for zoom, protocol in ((zoom, protocol) for zoom in case.zooms for protocol in case.protocols):
            pair = [figures_of(content, method, f"{zoom}", protocol) for method in (case.worse, case.better)]
            place = {"case": case.name, "scene": scene, "zoom": f"x{zoom}", "protocol": protocol or None}
            yield place | {"worse": LABELS[case.worse], "better": LABELS[case.better]} | compared(*pair)


def figures_of(content: Mapping[str, Any], method: str, zoom: str, protocol: str) -> dict[str, float]:
    """Returns the figures of a method's pictures, the PSNR of its worst view, the correlation of its views' detail."""
    place = {"method": method, "zoom": zoom, "protocol": protocol}
    row = next(row for row in content["rows"] if place.items() <= row.items())
    result = next(one for one in content["results"] if one["protocol_name"] == protocol)
    own = next(one for one in result["methods"] if one["name"] == method)
    lowest = min(view["zoom"][zoom]["psnr"] for view in own["views"].values())
    agreeing = own["zoom"][zoom].get("consistency", {}).get("detail", {})
    found = {key: row[key] for key in FIGURES if key in row} | {"lowest": lowest}
    return found | ({"agreeing": agreeing["render"]} if agreeing else {})


def compared(worse: Mapping[str, float], better: Mapping[str, float]) -> dict[str, Any]:
    """Returns both figures as text, and which of them prefer either picture."""
    out: dict[str, Any] = {}
    sides: dict[str, list[str]] = {"misled": [], "right": []}
    for key, (name, digits, sign) in FIGURES.items():
        if key not in worse or key not in better:
            continue
        one, other = round(worse[key], digits), round(better[key], digits)
        out[key] = f"{one:.{digits}f}, {other:.{digits}f}"
        if one != other:
            sides["misled" if sign * one > sign * other else "right"].append(name)
    return out | {side: ", ".join(names) for side, names in sides.items()}


# -- strips ------------------------------------------------------------------------------------------------------------


def write_strips(folder: Path, pictures: Path) -> None:
    """Writes a picture for each case, of the parts next to each other."""
    scene = loaded(SHOWN)
    for case in CASES:
        panels = [panel(label, picture) for label, picture in parts_of(case, scene, pictures)]
        write_image(folder / f"misleading_{case.name.replace(' ', '_')}.jpg", torch.cat(panels, 2)[..., :-4])


def parts_of(case: Case, scene: Scene, pictures: Path) -> list[tuple[str, UInt8[Tensor, "3 h w"]]]:
    """Returns truth, worse and better picture of a view with labels; of flicker, the worse pictures of all views."""
    zoom = max(case.zooms)

    def read(method: str, view: int) -> UInt8[Tensor, "3 h w"]:
        return read_image(pictures / method / f"x{zoom}" / f"{scene.test[view].name}.png")

    if case.name == "flicker":
        return [(f"view {view + 1}", to_uint8(reduced(read(case.worse, view) / 255, ZOOM))) for view in range(VIEWS)]
    view = 1 if case.worse == "floater" else 0
    truth = to_uint8(truths(scene, zoom)[view])
    return [("truth", truth), *((LABELS[method], read(method, view)) for method in (case.worse, case.better))]


def panel(label: str, picture: UInt8[Tensor, "3 h w"]) -> UInt8[Tensor, "3 h2 w2"]:
    """Cuts the window out of an x4 picture, or keeps an x1 picture; with its label above, a gap at the right."""
    cut = CROP.cut(picture) if picture.shape[2] > WIDTH else picture
    return pad(torch.cat([label_bar(label, cut.shape[2]), cut], 1), (0, 4), value=255)


def main(words: Sequence[str]) -> None:
    """Make pictures, measure, show and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--folder", type=Path, help="new folder for pictures and pages (a temporary one)")
    parser.add_argument("--strips", action="store_true", help="also write the pictures of the page")
    options, load = parser.parse_args(words), told_load()
    with tempfile.TemporaryDirectory() as temporary:
        folder = options.folder or Path(temporary)
        found = {scene: measured(scene, folder / scene) for scene in SCENES}
        if options.strips:
            write_strips(STRIPS, folder / SHOWN)
    lines = [row for scene in SCENES for row in rows(scene, found[scene])]
    command = shown_command(words, "benchmarks/misleading_scores.py")
    section = stamped("Scores that prefer the worse picture", COLUMNS, lines, NOTES, load, command)
    sys.stdout.write(text_table(section))
    write_results(RESULTS, "misleading_scores_cpu", describe_machine(torch.device("cpu")), {"cases": section})


if __name__ == "__main__":
    main(sys.argv[1:])
