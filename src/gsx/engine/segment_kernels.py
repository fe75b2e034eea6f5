"""The loops of the segment schedule, in plain torch, on the mathematics of kernels.py: few kernels of many blocks.

Blocks belong to one tile each, and pixels lie side by side: threads that follow each other read the same entry. What
varies from tile to tile is read by the tile's number.
"""

import functools
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from gsx.core.shapes import Float, Int
from gsx.engine.kernels import (
    Rules,
    blended,
    compiled,
    entry_gradients,
    fade,
    make_rows,
    seen_from_front,
    slopes,
    sums_of,
)


def light(
    rows: Float[Tensor, "B K F"],
    before: Float[Tensor, "B P"],
    x: Float[Tensor, "P"],
    y: Float[Tensor, "P"],
    rules: Rules,
) -> list[Float[Tensor, "B P"]]:
    """What each block adds to each channel and, last, to the coverage."""
    return blended(rows, x, y, before, [0.0] * (rules.channels + 1), rules)[1]


def own_picture(
    lights: list[Float[Tensor, "B P"]],
    before: Float[Tensor, "B P"],
    tiles: Int[Tensor, "B"],
    gradient: Float[Tensor, "T C_1 P"],
    rules: Rules,
) -> Float[Tensor, "B P"]:
    """What each block shows by itself, as seen from before it, weighted by the gradient of the picture."""
    return seen_from_front(lights, gradient[tiles].unbind(1), before, rules)


def entry_slopes(
    rows: Float[Tensor, "B K F"],
    before: Float[Tensor, "B P"],
    behind: Float[Tensor, "B P"],
    tiles: Int[Tensor, "B"],
    gradient: Float[Tensor, "T C_1 P"],
    x: Float[Tensor, "P"],
    y: Float[Tensor, "P"],
    rules: Rules,
) -> Float[Tensor, "B 2_K P"]:
    """`slopes` of every entry at every pixel, then the weights.

    In one tensor: of few entries the compiler would keep what they are made from, and find each in a second walk.
    """
    slope, weight, _ = slopes(rows, x, y, before, behind, list(gradient[tiles].unbind(1)), rules)
    return torch.stack([*slope, *weight], 1)


def entry_sums(
    rows: Float[Tensor, "B K F"],
    found: Float[Tensor, "B 2_K P"],
    tiles: Int[Tensor, "B"],
    gradient: Float[Tensor, "T C_1 P"],
    x: Float[Tensor, "P"],
    y: Float[Tensor, "P"],
    products: Float[Tensor, "3 P"],
    rules: Rules,
) -> Float[Tensor, "B K V"]:
    """`sums_of` of what `entry_slopes` found: a sum over pixels takes other threads than a walk through a block."""
    slope, weight = found.chunk(2, 1)
    return sums_of(rows, slope, weight, x, y, products, list(gradient[tiles].unbind(1)), rules)


@dataclass(frozen=True, kw_only=True)
class SegmentKernels:
    """The compiled loops of one set of rules."""

    make_rows: Callable[..., Tensor]
    fade: Callable[..., Tensor]
    light: Callable[..., list[Tensor]]
    own_picture: Callable[..., Tensor]
    entry_slopes: Callable[..., Tensor]
    entry_sums: Callable[..., Tensor]
    entry_gradients: Callable[..., Tensor]


LOOPS = (make_rows, fade, light, own_picture, entry_slopes, entry_sums, entry_gradients)


@functools.lru_cache
def segment_kernels(rules: Rules) -> SegmentKernels:
    """Compiled loops for these rules; each compiles at its first call, for any number of blocks and tiles."""
    return SegmentKernels(**{loop.__name__: compiled(loop, rules) for loop in LOOPS})
