"""The loops of the segment schedule, in plain torch, on the mathematics of kernels.py: few kernels of many blocks.

Blocks belong to one tile each, and pixels lie side by side: threads that follow each other read the same entry. What
varies from tile to tile is read by the tile's number.
"""

import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from gsx.core.compiling import WHOLE_LOOPS, sizes_free, with_last
from gsx.core.rasterizer.kernels import Rules, blended, entry_gradients, fade, make_rows, slopes, sums_of, thresholds
from gsx.core.shapes import Float, Int

SHARED_AFTER = 50
"""Operations after which the compiler shares an intermediate value: with more of them it computes weights twice."""


def light(
    rows: Float[Tensor, "B K F"],
    before: Float[Tensor, "B P"],
    x: Float[Tensor, "P"],
    y: Float[Tensor, "P"],
    rules: Rules,
) -> Float[Tensor, "B C_1 P"]:
    """What each block adds to the channels and, last, to the coverage."""
    _, sums = blended(rows, x, y, before, [0.0] * (rules.channels + 1), rules)
    return torch.stack(sums, 1)


def passing(
    rows: Float[Tensor, "B K F"], x: Float[Tensor, "P"], y: Float[Tensor, "P"], rules: Rules
) -> Float[Tensor, "B P"]:
    """Share of the light that passes each block."""
    return fade(rows, x, y, rules)


def own_picture(
    lights: Float[Tensor, "B C_1 P"],
    before: Float[Tensor, "B P"],
    tiles: Int[Tensor, "B"],
    gradient: Float[Tensor, "T C_1 P"],
    rules: Rules,
) -> Float[Tensor, "B P"]:
    """What each block shows by itself, as seen from before it, weighted by the gradient of the picture."""
    channels, by_channel = lights.unbind(1), gradient[tiles].unbind(1)
    shine = channels[0] * by_channel[0]
    for channel, by in zip(channels[1:], by_channel[1:], strict=True):
        shine = shine + channel * by
    return torch.where(before >= max(rules.stop, torch.finfo(before.dtype).tiny), shine / before, 0.0)


def entry_slopes(
    rows: Float[Tensor, "B K F"],
    before: Float[Tensor, "B P"],
    behind: Float[Tensor, "B P"],
    tiles: Int[Tensor, "B"],
    gradient: Float[Tensor, "T C_1 P"],
    x: Float[Tensor, "P"],
    y: Float[Tensor, "P"],
    rules: Rules,
) -> tuple[Float[Tensor, "B K P"], Float[Tensor, "B K P"]]:
    """`slopes` and weights of every entry at every pixel."""
    return slopes(rows, x, y, before, behind, list(gradient[tiles].unbind(1)), rules)[:2]


def entry_sums(
    rows: Float[Tensor, "B K F"],
    slope: Float[Tensor, "B K P"],
    weight: Float[Tensor, "B K P"],
    tiles: Int[Tensor, "B"],
    gradient: Float[Tensor, "T C_1 P"],
    x: Float[Tensor, "P"],
    y: Float[Tensor, "P"],
    products: Float[Tensor, "3 P"],
    rules: Rules,
) -> Float[Tensor, "B K V"]:
    """`sums_of` of them: apart, because a sum over pixels takes other threads than a walk through a block."""
    return sums_of(rows, slope, weight, x, y, products, list(gradient[tiles].unbind(1)), rules)


@dataclass(frozen=True, kw_only=True)
class SegmentKernels:
    """The compiled loops of one set of rules."""

    make_rows: Callable[..., Tensor]
    passing: Callable[..., Tensor]
    light: Callable[..., Tensor]
    own_picture: Callable[..., Tensor]
    entry_slopes: Callable[..., tuple[Tensor, Tensor]]
    entry_sums: Callable[..., Tensor]
    entry_gradients: Callable[..., Tensor]


VARYING: dict[Callable[..., Any], tuple[int, ...]] = {
    make_rows: (0, 1, 2),
    passing: (0,),
    light: (0, 1),
    own_picture: (0, 1, 2, 3),
    entry_slopes: (0, 1, 2, 3, 4),
    entry_sums: (0, 1, 2, 3, 4),
    entry_gradients: (0, 1),
}
"""Arguments whose number of rows varies: blocks, splats or tiles."""


@functools.lru_cache
def segment_kernels(rules: Rules) -> SegmentKernels:
    """Compiled loops for these rules; each compiles at its first call, for any number of blocks and tiles."""
    return SegmentKernels(**{loop.__name__: compiled(loop, rules) for loop in VARYING})


def compiled(loop: Callable[..., Any], rules: Rules) -> Callable[..., Any]:
    """`loop` of these rules through torch.compile."""
    options: dict[str, Any] = WHOLE_LOOPS | dict.fromkeys(thresholds(), SHARED_AFTER)
    places = VARYING[loop]

    def varying(arguments: tuple[Tensor, ...]) -> list[tuple[Tensor, int]]:
        return [(arguments[place], 0) for place in places]

    return sizes_free(torch.compile(with_last(loop, rules), fullgraph=True, options=options), varying)
