"""Short measurement before a plan: steps at two sizes, photos, and the evaluation of one view."""

import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from gsx.core.data.scene import Scene, View
from gsx.core.device import clock
from gsx.core.plugins import Plugins, load_plugins
from gsx.core.training.render import render
from gsx.core.training.run import Run
from gsx.core.training.trainer import train_step
from gsx.experiments.evaluation.chosen_views import evenly
from gsx.experiments.evaluation.evaluator import Evaluator
from gsx.experiments.minutes.cost import MILLION, Measurement, ProbeOptions
from gsx.experiments.reports.pictures import Pictures
from gsx.experiments.runs.build import build
from gsx.experiments.runs.evaluate import competitor_of
from gsx.experiments.runs.load_scene import load_scene
from gsx.experiments.runs.logs import quiet
from gsx.experiments.runs.rasterizer_path import warm_or_eager
from gsx.experiments.runs.settings import Settings, overridden
from gsx.scenes.stereo import SOURCES, depth_map, reduced

LENGTH = 30_000
"""Steps of the run that is measured: its schedules change nothing within the first steps."""
COARSE = 2
"""Reduction of the first, smaller views."""
SAMPLES = 3
"""Test views that are timed."""
LEAST = 0.1
"""Least share of a step's time that pixels are taken to cost: noise may hide their cost."""


def measure(
    settings: Settings, changes: Mapping[str, Any], options: ProbeOptions, loaded: Plugins
) -> tuple[Measurement, Scene]:
    """Trains a few steps of a run that is thrown away; returns seconds, and the scene at the measured size.

    Args:
        settings: Settings of the run to plan.
        changes: Values by dotted key that the measured run has as well.
        options: Extent of the measurement.
        loaded: Plugins.
    """
    until = (options.warm + options.steps) / LENGTH  # coarse views first, then the photos' size
    coarse = {"training.coarse_to_fine.factor": COARSE, "training.coarse_to_fine.until": until}
    probed = {"iterations": LENGTH, "training.supersampling.factor": 1, **coarse}
    short = replace(overridden(settings, dict(changes) | probed, loaded), augmenters={})
    scene = load_scene(short)
    with quiet():
        run = build(short, replace(scene, train=evenly(scene.train, options.steps)), Path(), training=True)
    warm_or_eager(run, settings.raster.path)
    photo = median_seconds(run, run.photos.of, run.scene.train)
    for view in run.views.at(1):
        run.photos.of(view)
    silent = load_plugins([], points=[])

    def median_step() -> float:
        times = [seconds_of(run, partial(train_step, run, silent)) for _ in range(options.warm + options.steps)]
        return statistics.median(times[options.warm :])

    small, large = median_step(), median_step()
    pixels = statistics.fmean(view.camera.width * view.camera.height for view in scene.train)
    megapixel = max(large - small, LEAST * large) / (pixels * (1 - COARSE**-2)) * MILLION
    drawn = getattr(short.scene.options, "random_points", 0) == len(scene.points)
    measurement = Measurement(
        base=max(0.0, large - megapixel * pixels / MILLION),
        megapixel=megapixel,
        pixels=pixels,
        downscale=getattr(short.scene.options, "downscale", 1),
        primitives=len(run.backbone.table),
        photo=photo,
        evaluate=evaluation_seconds(run, short),
        check=median_seconds(run, lambda view: render(run, view.camera), scene.test[:SAMPLES]),
        path=run.raster.path,
        device=run.device.type,
        random=drawn,
        stereo=0.0 if drawn else stereo_seconds(scene),
    )
    return measurement, scene


def stereo_seconds(scene: Scene) -> float:
    """Returns the seconds that depths by stereo take for a photo; 0 without points."""
    if not len(scene.points):
        return 0.0
    first, second = (reduced(view) for view in scene.train[:2])
    start = time.perf_counter()
    depth_map(first, [second] * SOURCES, scene.points)
    return time.perf_counter() - start


def seconds_of(run: Run, use: Callable[[], object]) -> float:
    """Returns the seconds of a call until the run's device is idle."""
    start = clock(run.device)
    use()
    return clock(run.device) - start


def median_seconds(run: Run, use: Callable[[View], object], views: Sequence[View]) -> float:
    """Returns the median seconds of a function of a view; 0 without views."""
    times = [seconds_of(run, partial(use, view)) for view in views]
    return statistics.median(times) if times else 0.0


def evaluation_seconds(run: Run, settings: Settings) -> float:
    """Returns the seconds to evaluate one test view at all zooms; 0 without test views."""
    if not run.scene.test:
        return 0.0
    with TemporaryDirectory() as folder, quiet():
        first = replace(run.scene, test=run.scene.test[:1])
        one = replace(run, views=replace(run.views, scene=first), folder=Path(folder))
        evaluator = Evaluator(one, settings.evaluation, competitor_of(one, settings))
        return seconds_of(run, lambda: evaluator.evaluate(Pictures(one.folder, one.step)))
