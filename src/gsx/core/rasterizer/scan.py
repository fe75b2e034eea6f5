"""Associative scans over the chunks of every group, in log2(chunks) steps: what lets all blocks be blended at once."""

from itertools import pairwise
from typing import TypeAlias

import torch
from torch import Tensor

from gsx.core.compiling import fused
from gsx.core.rasterizer.lanes import Lanes
from gsx.core.shapes import Bool, Float, Int


def parts(total: int, size: int) -> list[slice]:
    """Slices of about `size` that cover `total`; none has a single element unless there is only one."""
    edges = [*range(0, max(total - 1, 1), size), total]
    return [slice(a, b) for a, b in pairwise(edges)]


Neighbours: TypeAlias = tuple[Int[Tensor, "S"], Bool[Tensor, "S"]]
"""Of every block another one of its group, and whether there is that one."""


def neighbours(lanes: Lanes, direction: int) -> list[Neighbours]:
    """Blocks of the same group 1, 2, 4, ... chunks later (direction 1) or earlier (-1), below the number of chunks; at
    least those next to each."""
    count = max(1, (len(lanes.active) - 1).bit_length())
    distances = direction * 2 ** torch.arange(count, device=lanes.table.device)
    return list(zip(*blocks_at(distances, lanes.chunks, lanes.groups, lanes.table), strict=True))


@fused
def blocks_at(
    distances: Int[Tensor, "D"], chunks: Int[Tensor, "S"], groups: Int[Tensor, "S"], table: Int[Tensor, "2 N"]
) -> tuple[Int[Tensor, "D S"], Bool[Tensor, "D S"]]:
    """Blocks of the same group so many chunks later, and whether there are such."""
    active, bases = table.unbind()
    chunk = chunks + distances[:, None]
    near = chunk.clamp(0, table.shape[1] - 1)
    there = (near == chunk) & (groups < active[near])
    return torch.where(there, bases[near] + groups, 0), there


def before_blocks(
    passed: Float[Tensor, "S P L"], inside: Float[Tensor, "G P L"], lanes: Lanes
) -> Float[Tensor, "S P L"]:
    """Transmittance in front of every block: the product of what the blocks before it let pass."""
    product, earlier = passed, neighbours(lanes, -1)
    for neighbour in earlier if len(lanes.active) > 1 else ():
        product = with_earlier(product, *neighbour)
    index, there = earlier[0]
    return inside[lanes.groups] * torch.where(there[:, None, None], product[index], 1.0)


@fused
def with_earlier(product: Float[Tensor, "S P L"], index: Int[Tensor, "S"], there: Bool[Tensor, "S"]) -> Tensor:
    """Products over twice as many blocks."""
    return torch.where(there[:, None, None], product * product[index], product)


@fused
def with_later(
    own: Float[Tensor, "S P L"], passed: Float[Tensor, "S P L"], index: Int[Tensor, "S"], there: Bool[Tensor, "S"]
) -> tuple[Tensor, Tensor]:
    """(pictures of twice as many blocks, the share of light that passes them)."""
    there = there[:, None, None]
    return torch.where(there, own + passed * own[index], own), torch.where(there, passed * passed[index], passed)


def behind_blocks(passed: Float[Tensor, "S P L"], own: Float[Tensor, "S P L"], lanes: Lanes) -> Float[Tensor, "S P L"]:
    """The picture behind every block as seen from there; `own` is each block's by itself.

    (own a, passed a) before (own b, passed b) is (own a + passed a own b, passed a passed b): associative.
    """
    later = neighbours(lanes, 1)
    for neighbour in later if len(lanes.active) > 1 else ():
        own, passed = with_later(own, passed, *neighbour)
    index, there = later[0]
    return torch.where(there[:, None, None], own[index], 0.0)
