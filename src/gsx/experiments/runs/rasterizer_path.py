"""Which path of the rasterizer a training run takes, and compiling for it before the first step."""

import logging
from collections.abc import Callable
from dataclasses import replace
from threading import Thread

import torch

from gsx.core.errors import first_line
from gsx.core.gaussians.splats import Splats
from gsx.core.rasterizer import RasterSettings, rasterize_tiled
from gsx.core.rasterizer.compositor import Restricted
from gsx.core.training.backbone import WithHarmonics
from gsx.core.training.run import Run
from gsx.engine.compile_ahead import Step, compile_ahead, warm_camera, warm_splats
from gsx.engine.compiling import available

logger = logging.getLogger(__name__)


def decide(settings: RasterSettings, steps: int, device: torch.device) -> RasterSettings:
    """Replaces path=auto for a training run of `steps` by eager or compiled, and logs the reason."""
    if settings.path != "auto":
        compositor = settings.compositors.get(settings.compositor_name)
        if isinstance(compositor, Restricted):
            compositor.refuse(settings, device)
        return settings
    long_enough = steps >= settings.auto_steps
    compiled = long_enough and available(device.type)
    reason = f"{steps} steps" if compiled or not long_enough else "no working compiler"
    path = "compiled" if compiled else "eager"
    logger.info("rasterizer: %s path (%s; rasterizer=eager or rasterizer=compiled decides otherwise)", path, reason)
    return replace(settings, path=path)


def warm(run: Run, helped: bool = True) -> None:
    """Compiles rasterizer and loss before the first step, and logs the time; `helped`: by a second process."""
    if not run.raster.backend.on(run.device.type).compiled:
        return
    logger.info("compiling the rasterizer once; later runs find it on disk ...")
    backbone = run.backbone
    degree = backbone.sh_degree if isinstance(backbone, WithHarmonics) else 0
    step = Step(settings=run.raster, sh_degree=degree, absolute_gradient=backbone.absolute_gradient)
    seconds = compile_ahead(step, run.device, helped, lambda: run.progress.stopping)
    if not run.progress.stopping:
        logger.info("compiled in %.0f s", seconds)


def compile_in_background(
    settings: RasterSettings, device: torch.device, take: Callable[[RasterSettings], None]
) -> Thread:
    """Compiles what draws pictures in a thread, then hands over settings that use it; until then the eager path draws.

    Nothing is handed over where nothing compiles.
    """
    compiled = replace(settings, path="compiled")

    def draw_one() -> None:
        splats = Splats(**{name: value.detach() for name, value in vars(warm_splats(device)).items()})
        try:
            if not available(device.type):
                return
            rasterize_tiled(splats, warm_camera(), compiled, background=torch.zeros(3, device=device))
        except Exception as error:  # a compiler's; pictures come all the same
            logger.info("pictures are drawn by the eager path (%s)", first_line(error))
        else:
            take(compiled)

    thread = Thread(target=draw_one, name="compiling", daemon=True)
    if settings.path in ("auto", "compiled"):
        thread.start()
    return thread
