"""Whether anything can be compiled on this machine."""

import functools
import logging

import torch

logger = logging.getLogger(__name__)


@functools.lru_cache
def complaint(device: str) -> str:
    """Why nothing can be compiled for this device; empty where it can. Asked by compiling two operations."""
    try:
        torch.compile(lambda x: 2 * x + 1, fullgraph=True)(torch.zeros(32, device=device))
    except Exception as error:  # a missing compiler, a broken one, a read-only cache: all mean eager
        return (str(error).strip().splitlines() or [type(error).__name__])[0]
    return ""


def available(device: str = "cpu") -> bool:
    """Whether the compiled path works on this machine."""
    return not complaint(device)


@functools.lru_cache
def warn_once(device: str) -> None:
    """Say why the eager path is taken instead."""
    logger.warning(
        "rasterizer.path=compiled: nothing can be compiled here (%s); going on with the eager path, which is several "
        "times slower. Install a C++ compiler (g++ or clang++), or choose rasterizer=eager",
        complaint(device),
    )
