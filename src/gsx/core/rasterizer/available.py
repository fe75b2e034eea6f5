"""Whether anything can be compiled on this machine, and compiling for any number of rows."""

import functools
import logging
from collections.abc import Callable, Iterable
from typing import Any

import torch
from torch import Tensor

from gsx.core.rasterizer.settings import RasterSettings

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


def compiles(settings: RasterSettings, device: str) -> bool:
    """Whether the settings ask for the compiled path and it works here."""
    return settings.path == "compiled" and available(device)


@functools.lru_cache
def warn_once(device: str) -> None:
    """Say why the eager path is taken instead."""
    logger.warning(
        "rasterizer.path=compiled: nothing can be compiled here (%s); going on with the eager path, which is several "
        "times slower. Install a C++ compiler (g++ or clang++), or choose rasterizer=eager",
        complaint(device),
    )


def compile_rows(function: Callable[..., Any]) -> Callable[..., Any]:
    """`function` through torch.compile, once for any number of rows.

    Tensors with as many rows as the first argument are taken to vary in number; every other size is a constant of the
    compiled code, which is faster and compiles sooner than leaving all sizes open. There must be more than one row.
    """

    def varying(arguments: tuple[Any, ...]) -> list[Tensor]:
        rows = len(arguments[0])
        return [a for a in arguments if isinstance(a, Tensor) and a.dim() > 0 and len(a) == rows]

    return first_sizes_free(torch.compile(function), varying)


def first_sizes_free(
    compiled: Callable[..., Any], varying: Callable[[tuple[Any, ...]], Iterable[Tensor]]
) -> Callable[..., Any]:
    """Tells torch at the first call which arguments vary in their first size, so that one compilation serves all."""
    marked: list[bool] = []

    def call(*arguments: Any) -> Any:
        if not marked:
            marked.append(True)
            for tensor in varying(arguments):
                torch._dynamo.maybe_mark_dynamic(tensor, 0)
        return compiled(*arguments)

    return call
