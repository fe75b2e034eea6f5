"""Compiles the kernels of core: its table says how each of them is compiled."""

from collections.abc import Callable
from functools import cache, partial
from typing import Any, TypeAlias

import torch
from torch import Tensor

from gsx.core.backend import EAGER, Backend
from gsx.core.gaussians.bands import contraction, contraction_slopes, harmonics_along
from gsx.core.quality.losses import photometric_and_gradient
from gsx.core.quality.similarity import correlate, loss_slopes, ssim_slopes
from gsx.core.rasterizer.boxes import boxes, spans
from gsx.core.rasterizer.geometry import geometry
from gsx.core.rasterizer.intersections import in_order, pair_tiles
from gsx.core.rasterizer.selection import select
from gsx.engine.compiling import (
    IN_VECTORS,
    OWN_INDICES,
    ROWS_ALIKE,
    WHOLE_LOOPS,
    available,
    compile_rows,
    compiled_once,
    fused,
    with_last,
)
from gsx.engine.pixel_windows import behind_splat
from gsx.lenses.unscented import project_through_lens, select_through_lens

Kernel: TypeAlias = Callable[..., Any]


def compile_sides(
    axes: tuple[int, ...], function: Callable[..., Any], *last: Any, **options: Any
) -> Callable[..., Any]:
    """Compiles a function once for all sizes of its arguments along some axes."""

    def varying(arguments: tuple[Tensor, ...]) -> list[tuple[Tensor, int]]:
        return [(tensor, axis) for tensor in arguments for axis in axes]

    return compiled_once(with_last(function, *last), varying, **options)


HOW: dict[Kernel, Callable[..., Kernel]] = {
    select: compile_rows,
    geometry: partial(compile_rows, options=IN_VECTORS),
    select_through_lens: compile_rows,
    project_through_lens: partial(compile_rows, options=IN_VECTORS),
    boxes: partial(compile_rows, options=IN_VECTORS),
    spans: partial(compile_sides, (0,), options=OWN_INDICES | ROWS_ALIKE),
    in_order: fused,
    pair_tiles: fused,
    harmonics_along: partial(compile_rows, options=IN_VECTORS),
    contraction: partial(compile_rows, options=WHOLE_LOOPS),
    contraction_slopes: partial(compile_rows, options=WHOLE_LOOPS),
    correlate: partial(compile_sides, (1, 2)),
    behind_splat: compile_rows,
    ssim_slopes: compile_rows,
    loss_slopes: compile_rows,
    photometric_and_gradient: partial(compile_sides, (1, 2)),
}
"""Compilation of each kernel; all others run uncompiled."""


@cache
def compiled_kernel(
    function: Callable[..., Any], last: tuple[Any, ...], variant: tuple[Any, ...]
) -> Callable[..., Any]:
    """Compiles a kernel, once for these values of its last arguments."""
    return HOW.get(function, EAGER.kernel)(function, *last)


class CompiledBackend(Backend):
    """The backend that runs kernels through torch.compile; without a working compiler they run uncompiled."""

    compiled = True

    def available(self, device: str) -> bool:
        """Returns whether a compiler works for a kind of device."""
        return available(device)

    def on(self, device: str, learning: bool = False) -> Backend:
        """Returns the eager backend where nothing compiles; on a CPU also for `learning` kernels without gradients."""
        ready = available(device) and (not learning or device != "cpu" or torch.is_grad_enabled())
        return self if ready else EAGER

    def kernel(self, function: Kernel, *last: Any, variant: tuple[Any, ...] = ()) -> Kernel:
        """Returns a compiled kernel."""
        return compiled_kernel(function, last, variant)


COMPILED = CompiledBackend()
