"""Times whole training steps, eager and compiled in turn, on the same views of the same model."""

from dataclasses import replace
from itertools import cycle
from pathlib import Path

from gsx.builtin import plugins
from gsx.core.plugins import Plugins
from gsx.core.rasterizer import RasterSettings
from gsx.core.training.run import Run
from gsx.core.training.trainer import train_step
from gsx.experiments.runs.build import build
from gsx.experiments.runs.compose import compose
from gsx.experiments.runs.load_scene import load_scene
from gsx.experiments.runs.open import open_run
from measuring.adapter import settings_of
from measuring.bench import Bench, Row, section
from measuring.results import Section
from measuring.watches import Job, Patience, Timing, Watch, take_turns

VIEWS = 10
"""Training views that the steps walk through."""
SYNTHETIC = (
    "backbone=gs3d",
    "scene=demo",
    "scene.points=60000",
    f"scene.train_views={VIEWS}",
    "scene.test_views=1",
    "iterations=30000",
)
TINY = ("scene.width=48", "scene.height=36", "scene.points=300", "scene.train_views=2", "scene.samples=1")
STEPS, QUICK_STEPS = 40, 2
"""Steps of each path."""


def a_run(bench: Bench, loaded: Plugins) -> Run:
    """The run folder asked for, as its checkpoint left it, or the built-in scene at step 0; nothing is written."""
    device = f"device={bench.device.type}"
    if bench.run is not None:
        return open_run(bench.run, loaded, [device])[0]
    settings = compose([*SYNTHETIC, *bench.pick((), TINY), device], loaded)
    return build(settings, load_scene(settings), Path())


def raster_of(run: Run, path: str) -> RasterSettings:
    """The run's rules with the path's way of working."""
    shipped = settings_of(path)
    return replace(run.raster, path=shipped.path, chunk=shipped.chunk, batch_values=shipped.batch_values)


def stepping(run: Run, loaded: Plugins, raster: RasterSettings) -> Job:
    """A job that takes the next training step; every such job walks through the same views."""
    views = cycle(range(min(VIEWS, len(run.scene.train))))

    def job(watch: Watch) -> None:
        run.raster = raster
        run.sampler.order.append(next(views))
        watch.begin()
        train_step(run, loaded)
        watch.lap("step")

    return job


def step_section(bench: Bench) -> Section:
    """Steps per second."""
    loaded = plugins()
    run = a_run(bench, loaded)
    begun, primitives = run.step, len(run.backbone.table)
    for view in run.scene.train[:VIEWS]:
        view.image()  # decoded now, not in the first path's turn
    jobs = {path: stepping(run, loaded, raster_of(run, path)) for path in bench.paths}
    patience = Patience(bench.pick(STEPS, QUICK_STEPS), 4 * bench.patience.seconds)
    rows = step_rows(take_turns(jobs, bench.device, patience))
    name = run.scene.name if bench.run is None else f"{run.scene.name}, run {bench.run.name}"
    width, height = run.scene.train[0].camera.size
    columns = [
        ["path", "path"],
        ["step_ms", "step ms"],
        ["rate", "steps/s"],
        ["eager_ratio", "eager / this"],
        ["steps", "steps"],
        ["first_s", "first call s"],
    ]
    return section(
        bench,
        "Training step",
        columns,
        rows,
        f"Scene {name}, {width}x{height} px, from step {begun} on, {primitives:,} to {len(run.backbone.table):,} "
        "primitives. Median of whole steps: render, loss, backward, density control, Adam; paths in turn on the "
        "same views.",
    )


def step_rows(timings: dict[str, Timing]) -> list[Row]:
    """Steps per second of each path."""
    rows = []
    for path, timing in timings.items():
        row = {"path": path, "step_ms": timing.total, "rate": 1e3 / timing.total, "steps": len(timing.rounds)}
        if path != "eager" and "eager" in timings:
            row["eager_ratio"] = timings["eager"].total / timing.total
        rows.append(row | {"first_s": timing.first / 1e3})
    return rows
