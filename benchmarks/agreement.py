"""Does gsx measure as nerfbaselines, and what does each rule of a protocol change? benchmarks/agreement.py RUN...

Renders the test views of each run, as floats. nerfbaselines' own `compute_metrics` and gsx with protocol=nerfbaselines
measure them; this table is left out without nerfbaselines (pip install --no-deps nerfbaselines==1.2.12). A second table
leads from its figures to those of 3D-GS (protocol=inria) term by term, and lists further terms. The committed runs:
gsx scene=colmap scene.path=fox scene.downscale=4 backbone=gs3d iterations=400 folder=fox
gsx scene=demo backbone=gs3d iterations=300 folder=demo
"""

import argparse
import io
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from statistics import fmean
from typing import Any

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from gsx.builtin import plugins
from gsx.core.data.camera import Camera
from gsx.core.data.masks import black_out
from gsx.core.data.scene import DerivedSource, View
from gsx.core.quality.metrics import decibel, psnr, quantise, ssim
from gsx.core.shapes import Bool, Float
from gsx.core.training.run import Run
from gsx.experiments.evaluation.evaluator import Evaluator
from gsx.experiments.runs.open import open_run
from measuring.machine import describe_machine, shown_command, told_load
from measuring.results import Section, stamped, text_table, write_results

RESULTS = Path(__file__).parent / "results"
AGREEMENT = [
    ["scene", "scene"],
    ["pictures", "pictures"],
    ["views", "views"],
    ["psnr", "nerfbaselines, dB"],
    ["own_psnr", "gsx, dB"],
    ["off_psnr", "largest difference of a view, dB"],
    ["ssim", "nerfbaselines, SSIM"],
    ["own_ssim", "gsx, SSIM"],
    ["off_ssim", "largest difference of a view, SSIM"],
]
TERMS = [
    ["rule", "rule"],
    ["psnr", "PSNR, dB"],
    ["ssim", "SSIM"],
    ["psnr_more", "change, dB"],
    ["ssim_more", "change, SSIM"],
]
CLOSER = 0.1
"""Share of their errors that renders keep where a model comes closer to the photos."""
QUALITY = 92
"""Of JPEG files: what ImageMagick takes where it knows no other."""
FILTERS = {
    "area": "scene.resize_filter=area",
    "Lanczos": "scene.resize_filter=lanczos",
    "bicubic in linear light": "scene.resize_light=linear",
}
"""Overrides for other truths by name."""
Picture = Float[Tensor, "3 H W"]
Figures = tuple[float, float]
"""PSNR, dB, and SSIM."""


def ellipse(width: int, height: int) -> Bool[Tensor, "height width"]:
    """Marks the pixels inside of a picture's inscribed ellipse."""
    x, y = (2 * (torch.arange(side) + 0.5) / side - 1 for side in (width, height))
    return x.square() + y.square()[:, None] < 1


@dataclass(frozen=True, eq=False, kw_only=True)
class Elliptic(DerivedSource):
    """Pixels outside of the picture's inscribed ellipse do not count."""

    def counted(self, camera: Camera) -> Bool[Tensor, "H W"]:
        """Marks the ellipse."""
        return ellipse(*camera.size)


@dataclass(frozen=True, eq=False, kw_only=True)
class Pair:
    """A render in floats and the photo, both without pixels that do not count."""

    render: Picture
    truth: Picture
    counted: Bool[Tensor, "H W"] | None


# -- agreement -------------------------------------------------------------------------------------------------------


def masked(run: Run) -> Run:
    """The run with test views of which an ellipse counts."""
    views = [replace(view, source=Elliptic(source=view.source)) for view in run.scene.test]
    run.views = replace(run.views, scene=replace(run.scene, test=views))
    return run


def opened(folder: Path, *words: str) -> tuple[Run, Evaluator]:
    """A run with these overrides, and its evaluator."""
    run, settings = open_run(folder, plugins(), list(words), evaluating=True)
    return run, Evaluator(run, settings.evaluation)


def pair_of(evaluator: Evaluator, view: View) -> Pair:
    """Renders a view."""
    counted = view.counted()
    return Pair(render=evaluator.renders.render(view).image, truth=view.image(), counted=counted)


def their_figures(pair: Pair) -> Figures:
    """Figures of one view by nerfbaselines, from the float render to the mean; without LPIPS, whose weights lack."""
    from nerfbaselines import evaluation, utils

    evaluation.metrics.lpips = lambda one, other: np.zeros(len(one))
    render, truth = (picture.permute(1, 2, 0).numpy() for picture in (pair.render, pair.truth))
    bytes_of = [utils.image_to_srgb(picture, np.uint8, color_space="srgb") for picture in (render, truth)]
    floats = [utils.convert_image_dtype(picture, np.float32)[None] for picture in bytes_of]
    mask = None if pair.counted is None else pair.counted.numpy()[None]
    found = evaluation.compute_metrics(*floats, mask=mask)
    return found["psnr"], found["ssim"]


def agreement_row(folder: Path, pictures: str, ellipse: bool) -> dict[str, Any]:
    """Both programs' figures of a run."""
    run, evaluator = opened(folder, "protocol=nerfbaselines")
    run = masked(run) if ellipse else run
    own = [(view["psnr"], view["ssim"]) for view in evaluator.views()]
    theirs = [their_figures(pair_of(evaluator, view)) for view in run.scene.test]
    off = [max(abs(a[part] - b[part]) for a, b in zip(own, theirs, strict=True)) for part in (0, 1)]
    return {
        "scene": run.scene.name,
        "pictures": pictures,
        "views": len(own),
        "psnr": fmean(one[0] for one in theirs),
        "own_psnr": fmean(one[0] for one in own),
        "off_psnr": off[0],
        "ssim": fmean(one[1] for one in theirs),
        "own_ssim": fmean(one[1] for one in own),
        "off_ssim": off[1],
    }


# -- terms -----------------------------------------------------------------------------------------------------------


def means(pairs: Sequence[Pair], variant: str, to_bytes: Callable[[Picture], Picture] = quantise) -> Figures:
    """Mean figures of float renders that `to_bytes` converts."""
    figures = [
        (psnr(picture, pair.truth, pair.counted), ssim(picture, pair.truth, variant, pair.counted))
        for pair in pairs
        for picture in [to_bytes(pair.render)]
    ]
    return fmean(one[0] for one in figures), fmean(one[1] for one in figures)


def truncated(image: Picture) -> Picture:
    """Bytes as nerfbaselines has them."""
    return quantise(image, "down")


def unchanged(image: Picture) -> Picture:
    """Floats within the display's range."""
    return image.clamp(0, 1)


def errors(pairs: Sequence[Pair]) -> list[Float[Tensor, "3"]]:
    """Mean squared error of each channel, for each view."""
    return [(quantise(pair.render).double() - pair.truth.double()).square().mean((1, 2)) for pair in pairs]


def jpeg(image: Picture) -> Picture:
    """A picture that was a JPEG file."""
    memory = io.BytesIO()
    levels = (image * 255).round().to(torch.uint8).permute(1, 2, 0).numpy()
    Image.fromarray(levels).save(memory, "JPEG", quality=QUALITY)
    return torch.from_numpy(np.asarray(Image.open(memory)).copy()).permute(2, 0, 1).float() / 255


def blackened(pairs: Sequence[Pair], black: bool) -> list[Pair]:
    """Pairs of which an ellipse counts, or all of both with the rest black."""
    out = []
    for pair in pairs:
        inside = ellipse(pair.truth.shape[2], pair.truth.shape[1])
        render, truth = (black_out(picture, inside) for picture in (pair.render, pair.truth))
        out.append(Pair(render=render, truth=truth, counted=None if black else inside))
    return out


def chain(pairs: Sequence[Pair]) -> Iterator[tuple[str, Figures]]:
    """Figures from nerfbaselines' rules to those of 3D-GS."""
    yield "nerfbaselines: truncated bytes, whole windows", means(pairs, "valid", truncated)
    yield "bytes rounded to the nearest", means(pairs, "valid")
    yield "windows padded with zeros: 3D-GS", means(pairs, "inria")


def others(pairs: Sequence[Pair], filtered: Mapping[str, Sequence[Pair]]) -> Iterator[tuple[str, Figures]]:
    """Figures of 3D-GS's rules with one other rule."""
    plain, squares = means(pairs, "inria"), errors(pairs)
    yield "no bytes (nerfstudio, gsplat)", means(pairs, "inria", unchanged)
    yield "reflected windows (gsplat)", means(pairs, "torchmetrics")
    yield "PSNR of the mean error of all views", (decibel(fmean(float(one.mean()) for one in squares)), plain[1])
    yield (
        "mean of three channels' PSNR (3D-GS's log)",
        (fmean(decibel(float(c)) for one in squares for c in one), plain[1]),
    )
    yield f"truth saved as JPEG, quality {QUALITY}", means([replace(p, truth=jpeg(p.truth)) for p in pairs], "inria")
    for name, other in filtered.items():
        yield f"truth reduced by {name}", means(other, "inria")


def closer(pairs: Sequence[Pair]) -> Iterator[tuple[str, Figures]]:
    """Figures of renders with a tenth of their errors."""
    near = [replace(pair, render=pair.truth + CLOSER * (pair.render - pair.truth)) for pair in pairs]
    yield "errors reduced to a tenth", means(near, "inria")
    yield "the same, truncated bytes", means(near, "inria", truncated)


def masking(pairs: Sequence[Pair]) -> Iterator[tuple[str, Figures]]:
    """Figures of an ellipse, and of a black picture with that ellipse in it."""
    yield "an ellipse alone counts", means(blackened(pairs, black=False), "inria")
    yield "the rest is black and counts (nerfbaselines)", means(blackened(pairs, black=True), "inria")


def with_changes(figures: Iterator[tuple[str, Figures]], before: Figures | None = None) -> list[dict[str, Any]]:
    """Rows with the change against `before`, or against the row before where that is None."""
    rows, last = [], before
    for rule, (level, likeness) in figures:
        more = {} if last is None else {"psnr_more": level - last[0], "ssim_more": likeness - last[1]}
        rows.append({"rule": rule, "psnr": level, "ssim": likeness, **more})
        last = (level, likeness) if before is None else before
    return rows


def term_rows(folder: Path) -> tuple[str, list[dict[str, Any]]]:
    """A run's scene and all its rows."""
    run, evaluator = opened(folder, "protocol=inria")
    pairs = [pair_of(evaluator, view) for view in run.scene.test]
    filtered = {name: other_truths(folder, pairs, word) for name, word in FILTERS.items() if reduced(run)}
    rows = with_changes(chain(pairs)) + with_changes(others(pairs, filtered), means(pairs, "inria"))
    return run.scene.name, rows + with_changes(closer(pairs)) + with_changes(masking(pairs))


def reduced(run: Run) -> bool:
    """Whether photos are larger than they are used."""
    view = run.scene.test[0]
    return view.file is not None and view.source.max_zoom(view.camera) > 1


def other_truths(folder: Path, pairs: Sequence[Pair], word: str) -> list[Pair]:
    """The pairs with photos that are reduced otherwise."""
    run, _ = opened(folder, "protocol=inria", word)
    return [replace(pair, truth=view.image()) for pair, view in zip(pairs, run.scene.test, strict=True)]


# -- tables ----------------------------------------------------------------------------------------------------------


def theirs() -> str:
    """The version of nerfbaselines; empty where it is not installed."""
    try:
        return version("nerfbaselines")
    except PackageNotFoundError:
        return ""


def agreement_section(folders: Sequence[Path], load: float, command: str) -> Section:
    """The first table."""
    rows = [
        agreement_row(folder, pictures, ellipse)
        for folder in folders
        for pictures, ellipse in (("float renders", False), ("an ellipse counts", True))
    ]
    note = f"nerfbaselines {theirs()}: image_to_srgb and compute_metrics; gsx: protocol=nerfbaselines. Same renders."
    return stamped("The same renders by nerfbaselines and by gsx", AGREEMENT, rows, [note], load, command)


def terms_section(folder: Path, load: float, command: str) -> tuple[str, Section]:
    """The table of a run, with the name of its section."""
    scene, rows = term_rows(folder)
    note = (
        "Means over test views. The second and third row, and the second of each of the last two pairs, change against "
        "the row before; the others change 3D-GS's rules in one point. LPIPS is not measured: its weights are not here."
    )
    return f"terms_{scene}", stamped(
        f"What each rule of a protocol changes: {scene}", TERMS, rows, [note], load, command
    )


def main(words: Sequence[str]) -> None:
    """Measure, print and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", type=Path, nargs="+", metavar="RUN", help="run folder of a scene with test views")
    parser.add_argument("--to", type=Path, default=RESULTS, help="folder of the results")
    options, load = parser.parse_args(words), told_load()
    command = shown_command(words, "benchmarks/agreement.py")
    sections = {"agreement": agreement_section(options.runs, load, command)} if theirs() else {}
    sections |= dict(terms_section(folder, load, command) for folder in options.runs)
    for section in sections.values():
        sys.stdout.write(text_table(section))
    write_results(options.to, "agreement_cpu", describe_machine(torch.device("cpu")), sections)


if __name__ == "__main__":
    main(sys.argv[1:])
