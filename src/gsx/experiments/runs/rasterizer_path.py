"""Rasterizer path of a training run, and compiling it before the first step."""

import logging
from collections.abc import Callable
from dataclasses import replace
from threading import Thread
from typing import Any

import torch

from gsx.core.errors import CompilerError, first_line
from gsx.core.gaussians.splats import Splats
from gsx.core.rasterizer import RasterSettings, rasterize_tiled
from gsx.core.rasterizer.compositor import Restricted
from gsx.core.training.backbone import Backbone, WithHarmonics
from gsx.core.training.run import Run
from gsx.engine.compile_ahead import Step, compile_ahead, warm_camera, warm_splats
from gsx.engine.compiling import available

logger = logging.getLogger(__name__)


def compiles(settings: RasterSettings, steps: int) -> bool:
    """Return True if a training run of `steps` compiles where it can."""
    return settings.path == "compiled" or (settings.path == "auto" and steps >= settings.auto_steps)


def decide(settings: RasterSettings, steps: int, device: torch.device) -> RasterSettings:
    """Replace path=auto for a training run of `steps` by eager or compiled, and log the reason."""
    if settings.path != "auto":
        compositor = settings.compositors.get(settings.compositor_name)
        if isinstance(compositor, Restricted):
            compositor.refuse(settings, device)
        return settings
    long_enough = compiles(settings, steps)
    compiled = long_enough and available(device.type)
    reason = f"{steps} steps" if compiled or not long_enough else "no working compiler"
    path = "compiled" if compiled else "eager"
    logger.info("rasterizer: %s path (%s; set rasterizer=eager or rasterizer=compiled to choose)", path, reason)
    return replace(settings, path=path)


def rules_of_step(backbone: Backbone[Any], raster: RasterSettings) -> Step:
    """Return what the code of a backbone's steps depends on."""
    degree = backbone.sh_degree if isinstance(backbone, WithHarmonics) else 0
    return Step(settings=raster, sh_degree=degree, absolute_gradient=backbone.absolute_gradient)


def warm(run: Run, helped: bool = True) -> None:
    """Compile rasterizer and loss before the first step, and log the time; `helped`: by a second process."""
    if not run.raster.backend.on(run.device.type).compiled:
        return
    logger.info("compiling the rasterizer once; later runs find it on disk ...")
    seconds = compile_ahead(rules_of_step(run.backbone, run.raster), run.device, helped, lambda: run.progress.stopping)
    if not run.progress.stopping:
        logger.info("compiled in %.0f s", seconds)


def warm_or_eager(run: Run, path: str) -> bool:
    """Compile what steps need; return True if that failed at the start of a run, which then draws by the eager path.

    Raises:
        CompilerError: it failed, and the settings name this `path`, or the run is at a later step or one of several.
    """
    try:
        warm(run)
    except CompilerError as error:
        chosen_by_gsx = path == "auto" and run.raster.path == "compiled"
        if not chosen_by_gsx or run.step > 0 or run.ranks.size > 1:
            raise
        logger.warning("%s; using the eager path, which is several times slower", error)
        run.raster = run.backbone.raster = replace(run.raster, path="eager")
        return True
    return False


def compile_in_background(
    settings: RasterSettings, device: torch.device, take: Callable[[RasterSettings], None]
) -> Thread:
    """Compile rendering in a thread, then call `take` with settings that use it, unless compiling fails."""
    compiled = replace(settings, path="compiled")

    def draw_one() -> None:
        splats = Splats(**{name: value.detach() for name, value in vars(warm_splats(device)).items()})
        try:
            if not available(device.type):
                return
            rasterize_tiled(splats, warm_camera(), compiled, background=torch.zeros(3, device=device))
        except Exception as error:  # of a compiler; the eager path still renders
            logger.info("rendering with the eager path (%s)", first_line(error))
        else:
            take(compiled)

    thread = Thread(target=draw_one, name="compiling", daemon=True)
    if settings.path in ("auto", "compiled"):
        thread.start()
    return thread
