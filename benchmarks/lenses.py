"""Train through a fisheye and on undistorted photos: python benchmarks/lenses.py [--seeds 0,1,2] [--steps 800]

    python benchmarks/lenses.py --timed 60      # times steps of the native runs instead

The photos are those of the built-in room or demo through a fisheye, ray traced through the lens. Both arms take the
same steps. Held-out photos are divided into three parts with as many pixels each, by the angle off the axis. Native:
renders through the lens. Undistorted: the same model through the lens, and as a pinhole at the same angles, which is
how it was trained. Finished runs below --runs are not trained again. Two minutes of one core for a run. Timed steps
start from the last state of a run; the kernels of the lens run eagerly or compiled, in turns, all others compiled.
"""

import argparse
import statistics
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace
from pathlib import Path
from unittest.mock import patch

import torch
from torch import Tensor

from gsx.api import load_run
from gsx.builtin import plugins
from gsx.core.backend import EAGER
from gsx.core.data.camera import Camera
from gsx.core.data.scene import View
from gsx.core.training.render import render
from gsx.core.training.run import Run
from gsx.core.training.trainer import train_step
from gsx.experiments.runs.open import open_run
from gsx.lenses import Distortion
from measuring.machine import describe_machine, shown_command, told_load
from measuring.results import Section, ratios_told, stamped, text_table, write_results
from measuring.runs import train

RESULTS = Path(__file__).parent / "results"
THIRDS = ("middle", "ring", "border")
SETTINGS = (
    "scene.train_views=60",
    "scene.test_views=8",
    "eval.zoom=[1,2]",
    "eval.competitor=null",
    "rasterizer=compiled",
)
LENS = {"native": "scene.lens=native", "undistort": "scene.lens=undistort"}
"""Arms."""
COLUMNS = [
    *(["scene", "scene"], ["seed", "seed"], ["model", "trained"], ["drawn", "drawn as"], ["whole", "whole photo, dB"]),
    *([third, f"{third} third, dB"] for third in THIRDS),
    *(["x1", "own evaluation, x1"], ["x2", "x2"], ["seconds", "training, s"]),
]
STEP_COLUMNS = [
    *(["scene", "scene"], ["seed", "seed"], ["primitives", "primitives"], ["eager", "lens eager, ms"]),
    *(["compiled", "lens compiled, ms"], ["ratio", "eager / compiled"]),
]
STEP_NOTE = (
    "Median over training steps of the whole step; both kinds in turns in one process, on the same views. Ratios: the "
    "median, and the range, over pairs of steps."
)
UNTIMED, VIEWS = 3, 10
"""Pairs of steps before the clock starts, which compile; training views that steps walk through."""
NOTE = (
    "PSNR of held-out photos, means over views; thirds of the photo's pixels by the angle off its axis. A pinhole "
    "shows less of the border third than the photo has: its figure there is of what it shows. Own evaluations measure "
    "other pixels: photos of the lens, or undistorted ones."
)
Row = dict[str, object]


def words_for(scene: str, arm: str, seed: int, options: argparse.Namespace) -> list[str]:
    """The settings of a run."""
    subject = (f"scene={scene}", f"scene.fisheye={options.degrees}", LENS[arm], *SETTINGS)
    return [*subject, f"seed={seed}", f"iterations={options.steps}"]


def folder_of(scene: str, arm: str, seed: int, options: argparse.Namespace) -> Path:
    """The folder of a run."""
    return options.runs / f"{scene}_{options.degrees}_{options.steps}_{arm}_{seed}"


def tangents(camera: Camera) -> Tensor:
    """Tangents of the angle off the axis of all pixels, [H, W]; NaN where a lens has no ray."""
    y, x = torch.meshgrid(torch.arange(camera.height) + 0.5, torch.arange(camera.width) + 0.5, indexing="ij")
    return camera.slopes(torch.stack([x.flatten(), y.flatten()], 1)).norm(dim=1).view(camera.height, camera.width)


def borders_of(photo: Camera) -> list[float]:
    """Tangents between the thirds of a photo, with its ends."""
    values = tangents(photo)
    return [0.0, *values[values.isfinite()].quantile(torch.tensor([1 / 3, 2 / 3])).tolist(), float("inf")]


def levels(run: Run, views: Sequence[View], borders: Sequence[float]) -> Row:
    """PSNR of renders of views, on the whole and within the borders."""
    per_view = [levels_of(run, view, borders) for view in views]
    return {name: statistics.fmean(one[name] for one in per_view) for name in ("whole", *THIRDS)}


@torch.no_grad()
def levels_of(run: Run, view: View, borders: Sequence[float]) -> dict[str, float]:
    """PSNR of the render of a view, on the whole and within the borders."""
    squares = (render(run, view.camera).image.clamp(0, 1) - view.image()).square().mean(0)
    angle, psnr = tangents(view.camera), decibels(squares)
    inside = {third: (angle >= borders[n]) & (angle < borders[n + 1]) for n, third in enumerate(THIRDS)}
    return {"whole": psnr(angle.isfinite()), **{third: psnr(where) for third, where in inside.items()}}


def decibels(squares: Tensor) -> Callable[[Tensor], float]:
    """Returns the function from marked pixels to the PSNR there."""
    return lambda where: float(-10 * torch.log10(squares[where].mean()))


def measure(scene: str, seed: int, options: argparse.Namespace) -> list[Row]:
    """Trains both arms; returns the figures of both, and of the undistorted one as a pinhole."""
    folders = {arm: folder_of(scene, arm, seed, options) for arm in LENS}
    found = {arm: train(folder, words_for(scene, arm, seed, options)) for arm, folder in folders.items()}
    runs = {arm: load_run(folder).run for arm, folder in folders.items()}
    photos = runs["native"].scene.test
    borders = borders_of(photos[0].camera)
    drawn = [
        ("native", "lens", photos),
        ("undistort", "pinhole", runs["undistort"].scene.test),
        ("undistort", "lens", photos),
    ]
    return [
        {"scene": scene, "seed": seed, "model": arm, "drawn": how}
        | levels(runs[arm], views, borders)
        | ({} if arm != "native" and how == "lens" else own_figures(found[arm]))
        for arm, how, views in drawn
    ]


def uncompiled() -> AbstractContextManager[object]:
    """Runs the kernels of lenses eagerly in the context."""
    select, project = Distortion.selection, Distortion.projection
    return patch.multiple(
        Distortion,
        selection=lambda lens, backend: select(lens, EAGER),
        projection=lambda lens, backend, variant: project(lens, EAGER, variant),
    )


def time_steps(scene: str, seed: int, options: argparse.Namespace) -> Row:
    """Times steps of the native run with eager and compiled kernels of the lens."""
    folder = folder_of(scene, "native", seed, options)
    train(folder, words_for(scene, "native", seed, options))
    loaded = plugins()
    run = open_run(folder, loaded, ["device=cpu"])[0]
    run.raster = run.backbone.raster = replace(run.raster, path="compiled")
    spent: dict[str, list[float]] = {"eager": [], "compiled": []}
    start = run.step
    for number in range(UNTIMED + options.timed):
        for arm, seconds in spent.items():
            run.sampler.order.append(number % VIEWS)
            run.step = start  # density control, which comes now and then, is left out
            with uncompiled() if arm == "eager" else nullcontext():
                begun = time.perf_counter()
                train_step(run, loaded)
                seconds.append(1e3 * (time.perf_counter() - begun))
    timed = {arm: milliseconds[UNTIMED:] for arm, milliseconds in spent.items()}
    medians = {arm: statistics.median(milliseconds) for arm, milliseconds in timed.items()}
    counts = {"primitives": len(run.backbone.table), "ratio": ratios_told(timed["eager"], timed["compiled"])}
    return {"scene": scene, "seed": seed} | medians | counts


def own_figures(evaluation: dict) -> Row:
    """The figures of a run's own evaluation."""
    levels = {f"x{factor}": evaluation["zoom"][factor]["psnr"] for factor in ("1", "2")}
    return levels | {"seconds": evaluation["train_seconds"]}


def main(words: Sequence[str]) -> None:
    """Trains, measures and writes the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", default="room,demo", help="scenes, by commas (room,demo)")
    parser.add_argument("--seeds", default="0,1,2", help="by commas (0,1,2)")
    parser.add_argument("--steps", type=int, default=800, help="steps of a run (800)")
    parser.add_argument("--degrees", type=int, default=120, help="horizontal angle of view (120)")
    parser.add_argument("--timed", type=int, default=0, help="pairs of steps to time (0: trains and compares)")
    parser.add_argument("--runs", type=Path, default=Path("outputs/lenses"), help="folder of the runs")
    parser.add_argument("--to", type=Path, default=RESULTS, help="folder of the results")
    options, load = parser.parse_args(words), told_load()
    pairs = [(scene, int(seed)) for scene in options.only.split(",") for seed in options.seeds.split(",")]
    title, command = f"A fisheye of {options.degrees} degrees", shown_command(words, "benchmarks/lenses.py")
    if options.timed:
        rows = [time_steps(scene, seed, options) for scene, seed in pairs]
        table: dict[str, Section] = {
            "steps": stamped(f"{title}: steps", STEP_COLUMNS, rows, [STEP_NOTE], load, command)
        }
    else:
        rows = [row for scene, seed in pairs for row in measure(scene, seed, options)]
        table = {"lenses": stamped(title, COLUMNS, rows, [NOTE], load, command)}
    write_results(options.to, "lenses_cpu", describe_machine(torch.device("cpu")), table)
    print(*map(text_table, table.values()))


if __name__ == "__main__":
    main(sys.argv[1:])
