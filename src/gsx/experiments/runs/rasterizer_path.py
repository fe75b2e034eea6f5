"""What a training run does about the compiled path before its first step."""

import logging
import time
from collections.abc import Callable
from dataclasses import replace
from threading import Thread

import torch

from gsx.core.compiling import available
from gsx.core.data.camera import Camera, look_at
from gsx.core.errors import first_line
from gsx.core.gaussians.splats import Splats
from gsx.core.quality.losses import photometric
from gsx.core.rasterizer import RasterSettings, rasterize, rasterize_tiled
from gsx.core.rasterizer.path import compiles

logger = logging.getLogger(__name__)

WARM_SPLATS, WARM_SIZE = 2000, 128
"""Of the picture that has everything compiled: lists of several chunks in several groups."""


def decide(settings: RasterSettings, steps: int, device: torch.device) -> RasterSettings:
    """Settings for a training run of `steps`: path=auto becomes eager or compiled, with a word about why."""
    if settings.path != "auto":
        return settings
    long_enough = steps >= settings.auto_steps
    compiled = long_enough and available(device.type)
    reason = f"{steps} steps" if compiled or not long_enough else "no working compiler"
    path = "compiled" if compiled else "eager"
    logger.info("rasterizer: %s path (%s; rasterizer=eager or rasterizer=compiled decides otherwise)", path, reason)
    return replace(settings, path=path)


def warm(settings: RasterSettings, device: torch.device) -> None:
    """Have the rasterizer and the loss compiled before the first step, and say so."""
    if compiles(settings, device.type):
        logger.info("compiling the rasterizer once; later runs find it on disk ...")
        logger.info("compiled in %.0f s", compile_now(settings, device))


def compile_now(settings: RasterSettings, device: torch.device) -> float:
    """Learn from a small picture, so that all loops get compiled; returns the seconds it took."""
    begun = time.perf_counter()
    as_training = replace(settings, training_focal=0.0)
    image = rasterize(warm_splats(device), warm_camera(), as_training).image
    photometric(image, torch.zeros_like(image), 0.2, compiled=True).backward()
    return time.perf_counter() - begun


def compile_beside(settings: RasterSettings, device: torch.device, take: Callable[[RasterSettings], None]) -> Thread:
    """Have what draws pictures compiled in a thread, and hand over the settings by which that is used; nothing where
    nothing compiles. Until then pictures are drawn by the eager path."""
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
    if settings.path != "eager":
        thread.start()
    return thread


def warm_camera() -> Camera:
    """What looks at them."""
    return look_at((0, -3, 0), (0, 0, 0), fov_x=0.7, width=WARM_SIZE, height=WARM_SIZE)


def warm_splats(device: torch.device) -> Splats:
    """Faint splats before the camera; their own generator, so that a run's randomness is not touched."""
    generator = torch.Generator().manual_seed(0)
    means = torch.rand(WARM_SPLATS, 3, generator=generator) * 2 - 1
    fields = {
        "means": means,
        "scales": torch.full_like(means, 0.05),
        "quats": torch.tensor([1.0, 0, 0, 0]).repeat(WARM_SPLATS, 1),
        "log_opacities": torch.full((WARM_SPLATS,), -2.0),
        "colours": torch.rand(WARM_SPLATS, 3, generator=generator),
    }
    return Splats(**{name: value.to(device).requires_grad_() for name, value in fields.items()})
