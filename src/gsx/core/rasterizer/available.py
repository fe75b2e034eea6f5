"""Whether anything can be compiled on this machine, and compiling for any number of rows."""

import functools
import logging
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

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


def compile_rows(function: Callable[..., Any]) -> Callable[..., Any]:
    """`function` through torch.compile, once for any number of rows.

    Tensors with as many rows as the first argument are taken to vary in number; every other size is a constant of the
    compiled code, which is faster and compiles sooner than leaving all sizes open. There must be more than one row.
    """
    compiled = torch.compile(function)
    marked: list[bool] = []

    def call(*arguments: Any) -> Any:
        # the sizes of parameters are constants to torch.compile, those of views are not
        views = [a.view_as(a) if isinstance(a, torch.nn.Parameter) else a for a in arguments]
        if not marked:
            marked.append(True)
            for view in views:
                if isinstance(view, Tensor) and view.dim() and len(view) == len(views[0]):
                    torch._dynamo.maybe_mark_dynamic(view, 0)
        return compiled(*views)

    return call
