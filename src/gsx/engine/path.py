"""Whether the compiled path is taken."""

import functools
import logging

import torch

from gsx.core.rasterizer.settings import RasterSettings
from gsx.engine.compiling import available, complaint

logger = logging.getLogger(__name__)


def compiles(settings: RasterSettings, device: str) -> bool:
    """Whether the settings ask for the compiled path and it works here."""
    return settings.path == "compiled" and available(device)


def goes_compiled(settings: RasterSettings, device: str) -> bool:
    """Whether what is computed now goes the compiled way; on a CPU not without gradients, for which it would compile
    once more."""
    return (torch.is_grad_enabled() or device != "cpu") and compiles(settings, device)


@functools.lru_cache
def warn_once(device: str) -> None:
    """Say why the eager path is taken instead."""
    logger.warning(
        "rasterizer.path=compiled: nothing can be compiled here (%s); going on with the eager path, which is several "
        "times slower. Install a C++ compiler (g++ or clang++), or choose rasterizer=eager",
        complaint(device),
    )
