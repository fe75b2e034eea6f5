"""Measure how many primitives a scene needs: published, budgeted and adaptive growth (docs/benchmarks/capacity.md).

    python benchmarks/capacity.py [--scenes FOLDER] [--what growth,compact] [--only fox,lego] [--backbones gs3d]

FOLDER holds `fox` (COLMAP), `lego` (NeRF-Synthetic), `castle` (photographs alone); without it only the built-in scene
is measured. `growth`: every scene is trained as published, adaptively, and with a budget of as many primitives as
published ends with, and of fewer, beside published growth held at that cap and MCMC; the same steps. `compact`:
the published runs made smaller by `gsx compact`. `bands`: adaptive runs in which each Gaussian keeps the SH bands worth
their numbers, beside adaptive runs that keep all. `evidence`: what share of adaptive runs goes into judging.
`cooldown`: published runs in which learning rates go down to nothing at the end, beside published ones. `plateau`:
longer runs that leave out steps which gain too little, beside such that take them all. `cells`: levels of detail whose
coarsest cells are pixels, grown as published and adaptively, beside published ones. `flat`: adaptive runs of
photographs of one colour alone, made here. Finished runs below --runs are not trained again.
A quarter of an hour of two cores for a scene, a backbone and a seed.
"""

import argparse
import math
import shutil
import statistics
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch

from gsx.api import train as train_here
from gsx.backbones.sh_degrees import numbers_of
from gsx.core.data.camera import look_at
from gsx.core.data.images import write_image
from gsx.core.files import read_json, write_json
from gsx.core.training.importance import Probe
from gsx.experiments.runs.progress import read_curves
from measuring.machine import describe_machine, shown_command, told_load
from measuring.results import read_sections, stamped, text_table, write_results
from measuring.runs import gsx, train
from zoom import over_seeds, shared_arguments, steps_among, told

RESULTS = Path(__file__).parent / "results"
SUBJECTS = {
    "fox": ("scene=colmap", "scene.downscale=8", "iterations=1000"),
    "fox_4": ("scene=colmap", "scene.downscale=4", "iterations=1500"),
    "lego": ("scene=blender", "scene.downscale=4", "iterations=1200"),
    "castle": ("scene=photos", "scene.downscale=8", "iterations=800"),
    "demo": ("scene=demo", "iterations=900"),
    "room": ("scene=room", "iterations=1500"),
}
BUILT_IN = ("demo", "room")
FROM_RANDOM = ("lego",)
"""Scenes without points: models start from more random ones than they end with."""
FEWER = {"fox": 25000, "fox_4": 40000, "lego": 5000, "castle": 40000, "demo": 20000, "room": 10000}
"""Primitives of the smaller budget."""
ARMS = (
    *("published", "adaptive", "budget as published", "budget of fewer", "published, held at fewer"),
    *("mcmc as published", "mcmc of fewer"),
)
PUBLISHED, ADAPTIVE = "backbone.capacity=published", "backbone.capacity=adaptive"
ZOOMS = ("1", "2", "4")


def arguments(words: Sequence[str]) -> argparse.Namespace:
    """The command line."""
    parser = shared_arguments(__doc__, "fox,fox_4,lego,castle,demo", "outputs/capacity")
    parser.add_argument(
        "--what",
        default="growth,compact",
        help="tables: growth, compact, bands, evidence, cooldown, plateau, cells, flat",
    )
    parser.add_argument("--backbones", default="gs3d", help="free Gaussians, by commas")
    parser.add_argument("--arms", default=";".join(ARMS), help="rows beside the published one, by semicolons")
    parser.add_argument("--prices", default="1", help="of a doubling of the steps, dB, by commas")
    parser.add_argument("--cooldowns", default="0.2", help="shares of the steps, by commas")
    parser.add_argument("--label", default="", help="of tables over other scenes, seeds or rows: added to their names")
    return parser.parse_args(words)


def overrides_of(arm: str, scene: str, published: dict[str, Any]) -> list[str]:
    """What makes an arm; `published`: evaluation of the published arm with the same seed."""
    number = published["primitives"] if arm.endswith("as published") else FEWER[scene]
    capacity = arm.split()[0]
    own = [f"backbone.capacity={capacity}", f"backbone.{capacity}.primitives={number}"]
    fewer = [f"scene.random_points={number}"] if capacity == "mcmc" and scene in FROM_RANDOM else []  # it removes none
    return {
        "published": [PUBLISHED],
        "adaptive": [ADAPTIVE],
        "published, held at fewer": [PUBLISHED, f"backbone.max_primitives={number}"],
    }.get(arm, [*own, *fewer])


def folder_of(arm: str, scene: str, backbone: str, seed: int, given: argparse.Namespace) -> Path:
    """Where a run is kept."""
    return given.runs / "_".join([backbone, scene, arm.replace(",", "").replace(" ", "_"), str(seed)])


def evaluation_of(arm: str, scene: str, backbone: str, seed: int, given: argparse.Namespace) -> dict[str, Any]:
    """Of the run of an arm, which is trained unless it is there."""
    published = {} if arm in ("published", "adaptive") else evaluation_of("published", scene, backbone, seed, given)
    wish = overrides_of(arm, scene, published or {"primitives": 0})
    return trained(folder_of(arm, scene, backbone, seed, given), words_of(wish, scene, backbone, seed, given), given)


def words_of(wish: Sequence[str], scene: str, backbone: str, seed: int, given: argparse.Namespace) -> list[str]:
    """The whole composition of a run that differs from the published one by a wish."""
    where = [] if scene in BUILT_IN else [f"scene.path={given.scenes / scene.split('_')[0]}"]
    judged = f"eval.zoom=[{','.join(ZOOMS)}]", "eval.competitor=null"
    return [f"backbone={backbone}", *wish, *SUBJECTS[scene], *where, f"seed={seed}", *judged]


def trained(folder: Path, words: Sequence[str], given: argparse.Namespace) -> dict[str, Any]:
    """Evaluation of the run in a folder, which is trained unless it is there."""
    print(time.strftime("%H:%M"), folder.name, flush=True)
    threads = {"OMP_NUM_THREADS": "1"} if given.jobs > 1 else {}
    return train(folder, words, threads, folder.with_name(f"{folder.name}.log"))


def scenes_of(given: argparse.Namespace) -> list[str]:
    """Those asked for that are there."""
    return [scene for scene in given.only.split(",") if scene in BUILT_IN or given.scenes]


def row_of(scene: str, arm: str, own: Sequence[dict[str, Any]], first: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Means over seeds, and what is different from the published arm, seed by seed."""
    pairs = list(zip(own, first, strict=True))
    row = {"scene": scene, "arm": arm, "seeds": len(own)}
    for factor in ZOOMS:
        row[f"x{factor}"] = told([run["zoom"][factor]["psnr"] for run in own], ".2f")
        row[f"more{factor}"] = told([a["zoom"][factor]["psnr"] - b["zoom"][factor]["psnr"] for a, b in pairs], "+.2f")
    row["primitives"] = round(statistics.mean(run["primitives"] for run in own))
    row["share"] = f"{statistics.mean(a['primitives'] / b['primitives'] for a, b in pairs):.2f}"
    row["seconds"] = round(statistics.median(run["train_seconds"] for run in own))
    row["times"] = f"{statistics.median(a['train_seconds'] / b['train_seconds'] for a, b in pairs):.2f}"
    return row


COLUMNS = [
    *(["scene", "scene"], ["arm", "growth"], ["seeds", "seeds"]),
    *(column for f in ZOOMS for column in ([f"x{f}", f"x{f}"], [f"more{f}", f"x{f} - published"])),
    *(["primitives", "primitives"], ["share", "of published"], ["seconds", "training s"], ["times", "of published"]),
]
NOTE = (
    "PSNR on held-out views, dB, means over seeds ± half their range; differences and shares seed by seed, times are "
    "medians. The same steps. Fewer: {fewer}."
)


def measured(backbone: str, given: argparse.Namespace) -> list[dict[str, Any]]:
    """Rows of a backbone."""
    scenes = scenes_of(given)
    arms = [arm for arm in ARMS if arm in ("published", *given.arms.split(";"))]

    def look(scene: str, seed: int) -> dict[Any, Any]:
        return {arm: evaluation_of(arm, scene, backbone, seed, given) for arm in arms}

    found = over_seeds(look, scenes, given)
    return [
        row_of(scene, arm, [one[arm] for one in found[scene]], [one["published"] for one in found[scene]])
        for scene in scenes
        for arm in arms
    ]


# -- learning rates at the end -----------------------------------------------------------------------------------------

COOLDOWN_COLUMNS = [[key, "cooldown" if key == "arm" else label] for key, label in COLUMNS]
COOLDOWN_NOTE = (
    "`training.cooldown`: over that share of the steps, the last ones, learning rates go down to nothing; 0: as "
    "published. "
    "PSNR on held-out views, dB, means over seeds ± half their range; differences and shares seed by seed, times are "
    "medians. The same steps."
)


def cooled(scene: str, share: float, backbone: str, seed: int, given: argparse.Namespace) -> dict[str, Any]:
    """Evaluation of a run whose learning rates go down over a share of its steps."""
    folder = given.runs / f"{backbone}_{scene}_cooldown_{share}_{seed}"
    wish = [PUBLISHED, f"training.cooldown={share}"]
    return trained(folder, words_of(wish, scene, backbone, seed, given), given)


def cooled_rows(backbone: str, given: argparse.Namespace) -> list[dict[str, Any]]:
    """Rows of a backbone."""
    scenes, shares = scenes_of(given), [float(share) for share in given.cooldowns.split(",")]

    def look(scene: str, seed: int) -> dict[float, Any]:
        return {share: cooled(scene, share, backbone, seed, given) for share in (0.0, *shares)}

    found = over_seeds(look, scenes, given)
    return [
        row_of(scene, f"{share:g}", [one[share] for one in found[scene]], [one[0.0] for one in found[scene]])
        for scene in scenes
        for share in (0.0, *shares)
    ]


# -- steps that gain too little ----------------------------------------------------------------------------------------

TIMES_AS_MANY = 3
"""Steps of these runs, over those of the others."""
PLATEAU_COLUMNS = [
    *([key, "price" if key == "arm" else label.replace("published", "all steps")] for key, label in COLUMNS[:-2]),
    *(["left", "steps left out"], ["seconds", "training s"], ["times", "of all steps"]),
]
PLATEAU_NOTE = (
    "`training.plateau.price`: dB that a doubling of the steps has to bring in validation windows, or the run goes on "
    f"with its last fifth; 0: all steps are taken. {TIMES_AS_MANY} times the steps of the other tables. PSNR on held-"
    "out views, dB, means over seeds ± half their range; differences and shares seed by seed, times are medians."
)


def patient(scene: str, price: float, backbone: str, seed: int, given: argparse.Namespace) -> dict[str, Any]:
    """Evaluation of a longer run, with how many steps it has left out."""
    folder = given.runs / f"{backbone}_{scene}_plateau_{price:g}_{seed}"
    words = words_of([PUBLISHED, f"training.plateau.price={price:g}"], scene, backbone, seed, given)
    steps = TIMES_AS_MANY * steps_among(words)
    words = [word for word in words if not word.startswith("iterations=")]
    found = trained(folder, [*words, f"iterations={steps}"], given)
    lines = read_curves(folder)
    return found | {"left": sum(line.get("steps_left_out", 0) for line in lines) / steps}


def patient_rows(backbone: str, given: argparse.Namespace) -> list[dict[str, Any]]:
    """Rows of a backbone."""
    scenes, prices = scenes_of(given), [0.0, *(float(price) for price in given.prices.split(","))]

    def look(scene: str, seed: int) -> dict[float, Any]:
        return {price: patient(scene, price, backbone, seed, given) for price in prices}

    found, rows = over_seeds(look, scenes, given), []
    for scene in scenes:
        for price in prices:
            own, first = ([one[which] for one in found[scene]] for which in (price, 0.0))
            row = row_of(scene, f"{price:g}", own, first)
            rows.append(row | {"left": f"{statistics.mean(run['left'] for run in own):.2f}"})
    return rows


# -- cells of levels of detail -----------------------------------------------------------------------------------------

CELLS = {
    "published": (PUBLISHED,),
    "cells of a pixel": (PUBLISHED, "backbone.levels.cell_pixels=1"),
    "cells of a pixel, adaptive": (ADAPTIVE, "backbone.levels.cell_pixels=1"),
}
CELLS_COLUMNS = [[key, "cells and growth" if key == "arm" else label] for key, label in COLUMNS]
CELLS_NOTE = (
    "`backbone.levels.cell_pixels=1`: the base layer has as many forks as leave a cell a pixel where its level is "
    "drawn from the farthest, but no more than published. PSNR on held-out views, dB, means over seeds ± half their "
    "range; differences and shares seed by seed, times are medians. The same steps."
)


def cells_rows(backbone: str, given: argparse.Namespace) -> list[dict[str, Any]]:
    """Rows of a backbone."""
    scenes = scenes_of(given)

    def look(scene: str, seed: int) -> dict[str, Any]:
        found = {}
        for arm, wish in CELLS.items():
            folder = folder_of(f"cells_{arm}", scene, backbone, seed, given)
            found[arm] = trained(folder, words_of(wish, scene, backbone, seed, given), given)
        return found

    found = over_seeds(look, scenes, given)
    return [
        row_of(scene, arm, [one[arm] for one in found[scene]], [one["published"] for one in found[scene]])
        for scene in scenes
        for arm in CELLS
    ]


# -- bands of colour ---------------------------------------------------------------------------------------------------

BANDS_FROM, PRICES = 0.8, (0.05, 0.2, 0.8)
"""Share of the run after which they are judged; dB per doubling of all numbers."""
BANDS_COLUMNS = [
    *(["scene", "scene"], ["price", "dB a doubling"], ["seeds", "seeds"]),
    *(column for f in ZOOMS for column in ([f"x{f}", f"x{f}"], [f"more{f}", f"x{f} - all bands"])),
    *(["primitives", "primitives"], ["degrees", "of degree 0 / 1 / 2 / 3"]),
    *(["numbers", "of all numbers"], ["spz", ".spz, of its bytes"]),
]
BANDS_NOTE = (
    "`backbone.capacity=adaptive`; at four fifths of the steps each Gaussian keeps the SH bands that are worth their "
    "numbers. PSNR on held-out views, dB, means over seeds ± half their range; differences seed by seed. Numbers: of "
    "what the Gaussians are with all bands."
)


def spz_bytes(folder: Path) -> int:
    """Of the model of a run."""
    path = folder.with_name(f"{folder.name}.spz")
    if not path.is_file():
        gsx(["export", str(folder), str(path)], log=folder.with_name(f"{folder.name}.spz.log"))
    return path.stat().st_size


def degrees_of(folder: Path) -> list[int]:
    """How many Gaussians have each SH degree, from 0 to 3."""
    line = next(line for line in read_curves(folder) if "degree_0" in line)
    return [line[f"degree_{degree}"] for degree in range(4)]


def judged_evaluation(scene: str, price: float, backbone: str, seed: int, given: argparse.Namespace) -> dict[str, Any]:
    """Of a run at that price, with how many Gaussians have each degree."""
    folder = given.runs / f"{backbone}_{scene}_bands_{price}_{seed}"
    wish = [ADAPTIVE, f"backbone.sh_judged={BANDS_FROM}", f"backbone.sh_price={price}"]
    found = trained(folder, words_of(wish, scene, backbone, seed, given), given)
    return found | {"degrees": degrees_of(folder), "spz": spz_bytes(folder)}


def bands_row(scene: str, price: float, own: Sequence[dict[str, Any]], first: Sequence[dict[str, Any]]) -> dict:
    """Means over seeds, and what is different from runs with all bands, seed by seed."""
    row = row_of(scene, "adaptive", own, first) | {"price": price}
    counts = [statistics.mean(column) for column in zip(*(run["degrees"] for run in own), strict=True)]
    sizes = numbers_of(3, other=11).tolist()
    kept = sum(count * size for count, size in zip(counts, sizes, strict=True)) / (sizes[-1] * sum(counts))
    shares = " / ".join(f"{count / sum(counts):.2f}" for count in counts)
    bytes_left = statistics.mean(a["spz"] / b["spz"] for a, b in zip(own, first, strict=True))
    row |= {"degrees": shares, "numbers": f"{kept:.2f}", "spz": f"{bytes_left:.2f}"}
    return {name: row[name] for name, _ in BANDS_COLUMNS}


def bands_judged(backbone: str, given: argparse.Namespace) -> list[dict[str, Any]]:
    """Rows of a backbone."""
    scenes = scenes_of(given)

    def look(scene: str, seed: int) -> dict[float, Any]:
        whole = evaluation_of("adaptive", scene, backbone, seed, given)
        all_bands = {0.0: whole | {"spz": spz_bytes(folder_of("adaptive", scene, backbone, seed, given))}}
        return all_bands | {price: judged_evaluation(scene, price, backbone, seed, given) for price in PRICES}

    found = over_seeds(look, scenes, given)
    return [
        bands_row(scene, price, [one[price] for one in found[scene]], [one[0.0] for one in found[scene]])
        for scene in scenes
        for price in PRICES
    ]


# -- a scene of one colour ---------------------------------------------------------------------------------------------

FLAT = (
    *("scene=blender", "scene.random_points=10000", "iterations=600", "eval.zoom=[1]", ADAPTIVE),
    f"backbone.sh_judged={BANDS_FROM}",
)
SIDE, COLOUR = 96, (184, 122, 61)
"""Of its photographs, px; 8 bits."""
FLAT_COLUMNS = [
    *(["seeds", "seeds"], ["points", "points"], ["primitives", "primitives"], ["least", "fewest"], ["most", "most"]),
    *(["degrees", "of degree 0 / 1 / 2 / 3"], ["x1", "x1"]),
]
FLAT_NOTE = (
    f"`backbone.capacity=adaptive backbone.sh_judged={BANDS_FROM}`: 24 photographs of {SIDE} px, all of one colour, "
    "from all around; random points. PSNR on four held-out views, dB, mean over seeds ± half the range."
)


def frames_around(folder: Path, split: str, count: int) -> list[dict[str, Any]]:
    """Photographs of one colour from all around the origin, as transforms_*.json lists them. Those that judge are
    larger: gsx refuses photographs that are trained on, byte for byte."""
    side = SIDE + (8 if split == "test" else 0)
    frames, picture = [], torch.tensor(COLOUR, dtype=torch.uint8)[:, None, None].expand(3, side, side).contiguous()
    to_opengl = torch.diag(torch.tensor([1.0, -1, -1, 1], dtype=torch.float64))
    for index in range(count):
        angle = 2 * math.pi * (index + 0.5 * (split == "test")) / count
        eye = (4 * math.cos(angle), 4 * math.sin(angle), 1 + math.sin(3 * angle))
        camera = look_at(eye, (0, 0, 0), fov_x=0.69, width=side, height=side)
        pose = torch.eye(4, dtype=torch.float64)
        pose[:3, :3], pose[:3, 3] = camera.rotation.T, torch.tensor(eye)
        write_image(folder / split / f"r_{index}.png", picture)
        frames.append({"file_path": f"./{split}/r_{index}", "transform_matrix": (pose @ to_opengl).tolist()})
    return frames


def flat_scene(folder: Path) -> Path:
    """A NeRF-Synthetic folder of photographs of one colour."""
    for split, count in (("train", 24), ("test", 4)):
        (folder / split).mkdir(parents=True, exist_ok=True)
        frames = frames_around(folder, split, count)
        write_json(folder / f"transforms_{split}.json", {"camera_angle_x": 0.69, "frames": frames})
    return folder


def flat_rows(backbone: str, given: argparse.Namespace) -> list[dict[str, Any]]:
    """One row."""
    scene = flat_scene(given.runs / "scene_of_one_colour")

    def look(_: str, seed: int) -> dict[str, Any]:
        folder = given.runs / f"{backbone}_flat_{seed}"
        found = trained(folder, [f"backbone={backbone}", *FLAT, f"scene.path={scene}", f"seed={seed}"], given)
        return found | {"degrees": degrees_of(folder)}

    found = over_seeds(look, ["flat"], given)["flat"]
    counts = [run["primitives"] for run in found]
    degrees = [statistics.mean(column) for column in zip(*(run["degrees"] for run in found), strict=True)]
    row = {"seeds": len(found), "points": 10000, "primitives": round(statistics.mean(counts))}
    row |= {"least": min(counts), "most": max(counts), "degrees": " / ".join(f"{count:.1f}" for count in degrees)}
    return [row | {"x1": told([run["psnr"] for run in found], ".2f")}]


# -- what the evidence costs -------------------------------------------------------------------------------------------

EVIDENCE = {
    "windows": (Probe, "window_errors"),
    "removals": (Probe, "removal"),
    "errors": (Probe, "row_errors"),
}
"""What adaptive growth finds out, and where it asks for it."""
EVIDENCE_COLUMNS = [
    *(["scene", "scene"], ["seeds", "seeds"], ["seconds", "training s"], ["windows", "validation windows"]),
    *(["removals", "what is not worth its price"], ["errors", "who draws the error"], ["share", "together"]),
]
EVIDENCE_NOTE = "Adaptive runs, in this process; shares of the training's seconds, medians over seeds."


@contextmanager
def clocked() -> Iterator[dict[str, float]]:
    """Seconds spent on each kind of evidence inside the block."""
    spent, own = dict.fromkeys(EVIDENCE, 0.0), {name: getattr(*place) for name, place in EVIDENCE.items()}

    def timed(name: str) -> Callable[..., Any]:
        def call(*given: Any) -> Any:
            begun = time.perf_counter()
            found = own[name](*given)
            spent[name] += time.perf_counter() - begun
            return found

        return call

    for name, place in EVIDENCE.items():
        setattr(*place, timed(name))
    try:
        yield spent
    finally:
        for name, place in EVIDENCE.items():
            setattr(*place, own[name])


def evidence_shares(scene: str, backbone: str, seed: int, given: argparse.Namespace) -> dict[str, float]:
    """Of the training time of a run."""
    folder = given.runs / f"{backbone}_{scene}_clocked_{seed}"
    shutil.rmtree(folder, ignore_errors=True)
    with clocked() as spent:
        train_here(*words_of([ADAPTIVE], scene, backbone, seed, given), f"folder={folder}")
    seconds = read_json(folder / "evaluation.json")["train_seconds"]
    return {"seconds": seconds, **{name: value / seconds for name, value in spent.items()}}


def evidence_rows(backbone: str, given: argparse.Namespace) -> list[dict[str, Any]]:
    """Rows of a backbone."""
    rows = []
    for scene in scenes_of(given):
        found = [evidence_shares(scene, backbone, seed, given) for seed in given.seeds]
        middle = {name: statistics.median(one[name] for one in found) for name in found[0]}
        share = statistics.median(sum(one[name] for name in EVIDENCE) for one in found)
        shares = {name: f"{100 * middle[name]:.1f} %" for name in EVIDENCE} | {"share": f"{100 * share:.1f} %"}
        rows.append({"scene": scene, "seeds": len(found), "seconds": round(middle["seconds"]), **shares})
    return rows


# -- made smaller afterwards -------------------------------------------------------------------------------------------

PROMISE = 0.1
"""dB that may be lost."""
COMPACT_COLUMNS = [
    *(["scene", "scene"], ["seeds", "seeds"], ["primitives", "primitives"], ["left", "left"]),
    *(["ply", "PLY, of its bytes"], ["smallest", "smallest file"], ["file", "of the PLY's bytes"]),
    ["judged", "lost in views that judge, dB"],
    *([f"lost{factor}", f"in test views at x{factor}, dB"] for factor in ZOOMS),
]
COMPACT_NOTE = (
    f"`gsx compact RUN --max-drop-db {PROMISE}` of published runs, means over seeds ± half their range. Losses: those "
    "of the model and its PLY. The smallest file is quantised, and in views that judge it keeps the promise, too."
)


def compacted(scene: str, backbone: str, seed: int, given: argparse.Namespace) -> dict[str, Any]:
    """compact.json of a published run made smaller, its evaluations before (`was`) and after (`is`), bytes before."""
    evaluation = evaluation_of("published", scene, backbone, seed, given)
    folder = folder_of("published", scene, backbone, seed, given)
    to = folder.with_name(f"{folder.name}_compact")
    if not (to / "compact.json").is_file():
        print(time.strftime("%H:%M"), to.name, flush=True)
        shutil.rmtree(to, ignore_errors=True)
        words = ["compact", str(folder), "--max-drop-db", str(PROMISE), "--to", str(to)]
        gsx(words, {"OMP_NUM_THREADS": "1"} if given.jobs > 1 else {}, to.with_name(f"{to.name}.log"))
    after = {"was": evaluation, "is": read_json(to / "evaluation.json")}
    return read_json(to / "compact.json") | after | {"bytes": (folder / "point_cloud.ply").stat().st_size}


def smallest_file(found: dict[str, Any]) -> str:
    """Suffix of the smallest file that was kept."""
    kept = {suffix: facts["bytes"] for suffix, facts in found["formats"].items() if facts["kept"]}
    return min(kept, key=lambda suffix: kept[suffix])


def share_of_bytes(found: Sequence[dict[str, Any]], suffixes: Sequence[str]) -> float:
    """Mean size of files, over that of the PLY before."""
    return statistics.mean(one["formats"][s]["bytes"] / one["bytes"] for one, s in zip(found, suffixes, strict=True))


def compact_row(scene: str, found: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Means over seeds."""
    files = [smallest_file(one) for one in found]
    row = {
        "scene": scene,
        "seeds": len(found),
        "primitives": round(statistics.mean(one["was"]["primitives"] for one in found)),
        "left": f"{statistics.mean(one['is']['primitives'] / one['was']['primitives'] for one in found):.2f}",
        "ply": f"{share_of_bytes(found, ['.ply'] * len(found)):.2f}",
        "smallest": ", ".join(sorted(set(files))),
        "file": f"{share_of_bytes(found, files):.3f}",
        "judged": told([one["chosen"]["drop"] for one in found], ".2f"),
    }
    for factor in ZOOMS:
        lost = [one["was"]["zoom"][factor]["psnr"] - one["is"]["zoom"][factor]["psnr"] for one in found]
        row[f"lost{factor}"] = told(lost, ".2f")
    return row


def made_smaller(backbone: str, given: argparse.Namespace) -> list[dict[str, Any]]:
    """Rows of a backbone."""
    scenes = scenes_of(given)
    found = over_seeds(lambda scene, seed: compacted(scene, backbone, seed, given), scenes, given)
    return [compact_row(scene, found[scene]) for scene in scenes]


def main(words: Sequence[str]) -> None:
    """Train and write the tables."""
    given = arguments(words)
    machine, load = describe_machine(torch.device("cpu")), told_load()
    machine |= {"threads": 1} if given.jobs > 1 else {}
    read_sections(given.to / "capacity_cpu.json")  # what cannot be added to is refused before training
    note = NOTE.format(fewer=", ".join(f"{scene} {count:,}" for scene, count in FEWER.items()))
    command = shown_command(words, "benchmarks/capacity.py")
    for backbone in given.backbones.split(","):
        tables = {}
        if "growth" in given.what:
            rows = measured(backbone, given)
            tables[backbone] = stamped(f"Growth of {backbone}", COLUMNS, rows, [note], load, command)
        if "bands" in given.what:
            rows = bands_judged(backbone, given)
            title = f"{backbone} with the bands of colour that are worth their numbers"
            tables[f"{backbone}_bands"] = stamped(title, BANDS_COLUMNS, rows, [BANDS_NOTE], load, command)
        if "evidence" in given.what:
            title, rows = f"What adaptive growth of {backbone} asks costs", evidence_rows(backbone, given)
            tables[f"{backbone}_evidence"] = stamped(title, EVIDENCE_COLUMNS, rows, [EVIDENCE_NOTE], load, command)
        if "cooldown" in given.what:
            title, rows = f"Learning rates of {backbone} that go down at the end", cooled_rows(backbone, given)
            tables[f"{backbone}_cooldown"] = stamped(title, COOLDOWN_COLUMNS, rows, [COOLDOWN_NOTE], load, command)
        if "plateau" in given.what:
            title, rows = f"Steps of {backbone} that gain too little", patient_rows(backbone, given)
            tables[f"{backbone}_plateau"] = stamped(title, PLATEAU_COLUMNS, rows, [PLATEAU_NOTE], load, command)
        if "cells" in given.what:
            title, rows = f"Cells of {backbone}", cells_rows(backbone, given)
            tables[f"{backbone}_cells"] = stamped(title, CELLS_COLUMNS, rows, [CELLS_NOTE], load, command)
        if "flat" in given.what:
            title, rows = f"{backbone} of a scene of one colour", flat_rows(backbone, given)
            tables[f"{backbone}_flat"] = stamped(title, FLAT_COLUMNS, rows, [FLAT_NOTE], load, command)
        if "compact" in given.what:
            title, rows = f"Published {backbone} made smaller", made_smaller(backbone, given)
            tables[f"{backbone}_compact"] = stamped(title, COMPACT_COLUMNS, rows, [COMPACT_NOTE], load, command)
        write_results(given.to, "capacity_cpu", machine, {name + given.label: table for name, table in tables.items()})
        print(*map(text_table, tables.values()), sep="\n")


if __name__ == "__main__":
    main(sys.argv[1:])
