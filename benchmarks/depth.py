"""Depth maps on the built-in room: starting points and loss of exact maps, and of maps as a poor network writes them.

    python benchmarks/depth.py [--only room,few] [--seeds 0,1,2] [--steps 1000] [--runs FOLDER]

All runs have the same steps and the same budget of primitives. Maps of the network are disparities with a scale and a
shift of each map's own and smooth errors; that run trains on a folder of `gsx prepare`. Finished runs are kept. Two
minutes a run on one core.
"""

import argparse
import statistics
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch.nn.functional import interpolate

from gsx.builtin import plugins
from gsx.core.data.scene import View
from gsx.core.files import read_json
from gsx.core.seeds import derived_seed
from gsx.experiments.runs.compose import compose
from gsx.experiments.runs.load_scene import load_scene
from measuring.machine import describe_machine, shown_command, told_load
from measuring.results import stamped, text_table, write_results
from measuring.runs import gsx, train

RESULTS = Path(__file__).parent / "results"
SCENES = {"room": ("scene=room",), "few": ("scene=room", "scene.train_views=12")}
"""The room from 100 places, and from 12."""
COMMON = (
    *("backbone.capacity=budget", "backbone.budget.primitives=50000", "backbone.density.reset_every=1000000"),
    *("training.cooldown=0.25", "training.supersampling.start=0.95", "rasterizer=compiled"),
)
ON = "training.depth.when=auto"
EVALUATION = ("eval.zoom=[1,2,4]", "eval.pairs=0", "eval.competitor=null", "eval.flight=false", "metrics.perceptual=[]")
AS_TRAINED = "eval.supersample=2"
"""Evaluation of a splat file as of a run that ends with supersampling (conf/preset/zoom.yaml)."""
ARMS = {
    "without": (),
    "loss": (ON, "training.depth.points=0"),
    "points": (ON, "training.depth.weight=0"),
    "points and loss": (ON,),
}
"""Settings of the runs with exact maps."""
NETWORK = "points and loss, poor maps"
ERROR, CELLS, SCALES, SHIFT = 0.1, (4, 5), (0.5, 2.0), 0.2
"""Of poor maps: standard deviation of relative errors of 1 / z, cells in which they vary, range of scales, and largest
shift, as a share of the mean."""
COLUMNS = [
    *(["scene", "scene"], ["arm", "maps"], ["seeds", "seeds"], ["x1", "x1, dB"], ["more1", "x1 - without"]),
    *(["x2", "x2, dB"], ["x4", "x4, dB"], ["more4", "x4 - without"], ["depth", "depth error, %"]),
    *(["primitives", "primitives"], ["seconds", "training, s"]),
]
Figures = dict[str, float]


def poor_map(view: View) -> np.ndarray:
    """A view's disparity with smooth errors, on a scale and with a shift of its own; 0 where unknown."""
    depth = view.depth_map() if view.depth_map else None
    assert depth is not None
    generator = torch.Generator().manual_seed(derived_seed("poor map", view.name))
    coarse = torch.randn(1, 1, *CELLS, generator=generator)
    smooth = 1 + ERROR * interpolate(coarse, depth.shape, mode="bicubic", align_corners=True)[0, 0]
    scale, shift = torch.rand(2, generator=generator).tolist()
    known = depth > 0
    disparity = torch.where(known, smooth.clamp_min(0.5) / depth, 0.0)
    moved = SCALES[0] * (SCALES[1] / SCALES[0]) ** scale * (disparity + SHIFT * shift * disparity[known].mean())
    return torch.where(known, moved, 0.0).numpy()


def folder_with_maps(scene: str, folder: Path) -> Path:
    """The training photos of a scene with poor maps."""
    if not folder.is_dir():
        gsx(["prepare", "--to", str(folder), *SCENES[scene]])
    if not (folder / "depths").is_dir():
        views = load_scene(compose([*SCENES[scene], "scene.depth_maps=true"], plugins())).train
        maps = {view.name: poor_map(view) for view in views}
        (folder / "depths").mkdir()
        for name, values in maps.items():
            np.save(folder / "depths" / f"{name}.npy", values)
    return folder


def from_folder(scene: str, words: Sequence[str], base: Path) -> Figures:
    """Figures of a run on poor maps: its splats on the test views of the scene."""
    photos = folder_with_maps(scene, base.parent / f"{scene}_photos")
    background = compose(SCENES[scene], plugins()).scene.options.background
    own = (f"scene.path={photos}", "scene=colmap", "scene.split=none", "scene.depth_values=disparity")
    colour = f"scene.background=[{','.join(map(str, background))}]"
    trained = train(base / "network", [*own, colour, *words, ON])
    told = base / "network_evaluation"
    if not (told / "evaluation.json").is_file():
        gsx(
            [
                "eval",
                str(base / "network" / "point_cloud.ply"),
                *SCENES[scene],
                *EVALUATION,
                AS_TRAINED,
                f"folder={told}",
            ]
        )
    return figures(read_json(told / "evaluation.json")) | {"seconds": trained["train_seconds"]}


def figures(found: dict[str, Any]) -> Figures:
    """The figures of an evaluation."""
    zooms = {f"x{zoom}": found["zoom"][str(zoom)]["psnr"] for zoom in (1, 2, 4)}
    depth = {"depth": 100 * found["depth"]["relative"], "primitives": found["primitives"]}
    return zooms | depth | {"seconds": found.get("train_seconds") or 0.0}


def measure(scene: str, seed: int, options: argparse.Namespace) -> dict[str, Figures]:
    """Figures of all runs on a scene with a seed."""
    base = options.runs / f"{scene}_{options.steps}" / str(seed)
    words = [*COMMON, f"seed={seed}", f"iterations={options.steps}"]
    exact = [*SCENES[scene], "scene.depth_maps=true", *EVALUATION, *words]
    found = {arm: figures(train(base / arm.replace(" ", "_"), [*exact, *more])) for arm, more in ARMS.items()}
    return found | {NETWORK: from_folder(scene, words, base)}


def rows_of(scene: str, found: Sequence[dict[str, Figures]]) -> list[dict[str, Any]]:
    """A row for each arm, over seeds."""
    return [
        {"scene": scene, "arm": arm, "seeds": len(found)}
        | {key: spread([one[arm][key] for one in found], ".2f") for key in ("x1", "x2", "x4", "depth")}
        | {f"more{z}": spread([one[arm][f"x{z}"] - one["without"][f"x{z}"] for one in found], "+.2f") for z in (1, 4)}
        | {key: round(statistics.fmean(one[arm][key] for one in found)) for key in ("primitives", "seconds")}
        for arm in found[0]
    ]


def spread(values: Sequence[float], form: str) -> str:
    """Mean and half the range."""
    half = f" ± {(max(values) - min(values)) / 2:.2f}" if len(values) > 1 else ""
    return f"{statistics.fmean(values):{form}}{half}"


def main(words: Sequence[str]) -> None:
    """Trains and writes the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", default=",".join(SCENES), help="scenes, by commas")
    parser.add_argument("--seeds", default="0,1,2", help="by commas (0,1,2)")
    parser.add_argument("--steps", type=int, default=1000, help="steps of a run (1000)")
    parser.add_argument("--runs", type=Path, default=Path("outputs/depth"), help="folder of the runs")
    parser.add_argument("--to", type=Path, default=RESULTS, help="folder of the results")
    options, load = parser.parse_args(words), told_load()
    seeds = [int(seed) for seed in options.seeds.split(",")]
    rows = [
        row
        for scene in options.only.split(",")
        for row in rows_of(scene, [measure(scene, seed, options) for seed in seeds])
    ]
    notes = [
        f"Held-out views of the built-in room from 100 places, and from 12 (few), {options.steps:,} steps; means over "
        "seeds ± half their range, differences seed by seed. Poor maps: disparity with smooth errors of "
        f"{ERROR:.0%} and a scale and shift of each map's own; these runs read photos and maps from a folder."
    ]
    command = shown_command(words, "benchmarks/depth.py")
    section = stamped("Runs with and without depth maps", COLUMNS, rows, notes, load, command)
    write_results(options.to, "depth_cpu", describe_machine(torch.device("cpu")), {"depth": section})
    print(text_table(section))


if __name__ == "__main__":
    main(sys.argv[1:])
