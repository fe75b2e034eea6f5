"""Compilation of a new run in a second process, from before its scene is loaded."""

import logging
import os
import shutil
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace

import torch
from torch import Tensor

from gsx.core.data.camera import Camera
from gsx.core.data.scene import Scene, View
from gsx.core.errors import first_line
from gsx.core.shapes import UInt8
from gsx.core.training.backbone import BackboneContext
from gsx.core.training.training_views import TrainingViews
from gsx.engine.compile_ahead import Step, compiling_early, warm_camera
from gsx.engine.joined_ranks import current_ranks
from gsx.experiments.runs.build import choose_device, keep_compiled_code
from gsx.experiments.runs.logs import quiet
from gsx.experiments.runs.rasterizer_path import compiles, rules_of_step
from gsx.experiments.runs.settings import Settings
from gsx.experiments.runs.start_file import in_front_of, one_point

logger = logging.getLogger(__name__)


class NoImage:
    """Source of the placeholder view, which is never rendered."""

    def image(self, camera: Camera) -> UInt8[Tensor, "3 H W"]:
        """Return a black image."""
        width, height = camera.size
        return torch.zeros(3, height, width, dtype=torch.uint8)

    def max_zoom(self, camera: Camera) -> float:
        """Return 1: there is no finer image."""
        return 1.0


@contextmanager
def compiling_before(settings: Settings) -> Iterator[None]:
    """Compile during the context what a run's steps need, in a second process, if that is not on disk."""
    with ExitStack() as stack:
        if worthwhile(settings):
            keep_compiled_code()  # before the backbone: its optimiser imports torch's compiler
            if (step := early_step(settings)) is not None:
                stack.enter_context(compiling_early(step))
        yield


def worthwhile(settings: Settings) -> bool:
    """Return True for a run of one process that compiles on a CPU with a C++ compiler."""
    if current_ranks().size > 1 or choose_device(settings.general.device).type != "cpu":
        return False
    present = shutil.which(os.environ.get("CXX", "g++")) is not None
    return present and compiles(settings.raster, settings.general.iterations)


def early_step(settings: Settings) -> Step | None:
    """Return the rules of a run's steps, by its backbone on one point; None if that needs the true scene."""
    scene, general = placeholder_scene(), settings.general
    context = BackboneContext(
        scene=scene,
        iterations=general.iterations,
        device=torch.device("cpu"),
        raster=replace(settings.raster, path="compiled"),
        generator=torch.Generator().manual_seed(general.seed),
        views=TrainingViews(scene=scene),
        begins=False,
    )
    try:
        with torch.random.fork_rng(devices=[]), quiet(logging.CRITICAL):
            backbone = settings.backbone.component.factory(settings.backbone.options, context)
    except Exception as error:  # a plugin may need more than one point; a wrong option is refused later
        logger.info("compiling waits for the scene (%s)", first_line(error))
        return None
    return rules_of_step(backbone, backbone.raster)


def placeholder_scene() -> Scene:
    """Return a scene of one view and one point before it."""
    camera = warm_camera()
    view = View("placeholder", camera, NoImage())
    points = one_point(in_front_of(camera))
    return Scene(name="placeholder", train=[view], test=[], points=points, background=torch.zeros(3), extent=1.0)
