"""What a training run does about the compiled path before its first step."""

import logging
import time
from dataclasses import replace

import torch

from gsx.core.camera import look_at
from gsx.core.rasterizer.compiled import available
from gsx.core.rasterizer.render import rasterize
from gsx.core.rasterizer.settings import RasterSettings
from gsx.core.splats import Splats

logger = logging.getLogger(__name__)

WARM_SPLATS, WARM_SIZE = 2000, 128
"""Of the picture that has everything compiled: lists of several chunks in several groups."""


def prepare(settings: RasterSettings, steps: int, device: torch.device) -> RasterSettings:
    """Settings for a run of `steps`: `auto` decided, and the compiled path compiled, with a word about it."""
    if settings.path == "auto":
        long_enough = steps >= settings.auto_steps
        chosen = "compiled" if long_enough and available(device.type) else "eager"
        reason = f"{steps} steps" if available(device.type) or not long_enough else "no working compiler"
        logger.info("rasterizer: %s path (%s; rasterizer=eager or compiled decides otherwise)", chosen, reason)
        settings = replace(settings, path=chosen)
    if settings.path == "compiled" and available(device.type):
        logger.info("compiling the rasterizer once (later runs find it on disk) ...")
        logger.info("compiled in %.0f s", compile_now(settings, device))
    return settings


def compile_now(settings: RasterSettings, device: torch.device) -> float:
    """Draw a small picture forward and backward, so that all loops get compiled; returns the seconds it took."""
    begun = time.perf_counter()
    splats = warm_splats(device)
    camera = look_at((0, -3, 0), (0, 0, 0), fov_x=0.7, width=WARM_SIZE, height=WARM_SIZE)
    rasterize(splats, camera, settings).image.sum().backward()
    return time.perf_counter() - begun


def warm_splats(device: torch.device) -> Splats:
    """Faint splats before the camera; their own generator, so that a run's randomness is not touched."""
    generator = torch.Generator().manual_seed(0)
    means = torch.rand(WARM_SPLATS, 3, generator=generator) * 2 - 1
    return Splats(
        means=means.to(device).requires_grad_(),
        scales=torch.full_like(means, 0.05).to(device),
        quats=torch.nn.functional.one_hot(torch.zeros(WARM_SPLATS, dtype=torch.long), 4).float().to(device),
        log_opacities=torch.full((WARM_SPLATS,), -2.0, device=device),
        colours=torch.rand(WARM_SPLATS, 3, generator=generator).to(device),
    )
