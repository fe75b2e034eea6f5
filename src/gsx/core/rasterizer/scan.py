"""Associative scans over the chunks of every group, in log2(chunks) steps: what lets all blocks be blended at once."""

from itertools import pairwise

import torch
from torch import Tensor

from gsx.core.rasterizer.lanes import Lanes
from gsx.core.shapes import Bool, Float, Int


def parts(total: int, size: int) -> list[slice]:
    """Slices of about `size` that cover `total`; none has a single element unless there is only one."""
    edges = [*range(0, max(total - 1, 1), size), total]
    return [slice(a, b) for a, b in pairwise(edges)]


def neighbour(lanes: Lanes, distance: int) -> tuple[Int[Tensor, "S"], Bool[Tensor, "S"]]:
    """Block of the same group `distance` chunks later (earlier, if negative), and whether there is one."""
    bases = torch.tensor(lanes.bases, device=lanes.chunks.device)
    active = torch.tensor(lanes.active, device=lanes.chunks.device)
    chunk = lanes.chunks + distance
    there = (chunk >= 0) & (chunk < len(bases))
    chunk = chunk.clamp(0, len(bases) - 1)
    there &= lanes.groups < active[chunk]
    return torch.where(there, bases[chunk] + lanes.groups, 0), there


def strides(lanes: Lanes) -> list[int]:
    """1, 2, 4, ... below the number of chunks."""
    return [1 << i for i in range((len(lanes.active) - 1).bit_length())]


def before_blocks(
    passed: Float[Tensor, "S P L"], inside: Float[Tensor, "G P L"], lanes: Lanes
) -> Float[Tensor, "S P L"]:
    """Transmittance in front of every block: the product of what the blocks before it let pass."""
    product = passed
    for distance in strides(lanes):
        index, there = neighbour(lanes, -distance)
        product = torch.where(there[:, None, None], product * product[index], product)
    index, there = neighbour(lanes, -1)
    return inside[lanes.groups] * torch.where(there[:, None, None], product[index], 1.0)


def behind_blocks(passed: Float[Tensor, "S P L"], own: Float[Tensor, "S P L"], lanes: Lanes) -> Float[Tensor, "S P L"]:
    """The picture behind every block as seen from there; `own` is each block's by itself.

    (own a, passed a) before (own b, passed b) is (own a + passed a own b, passed a passed b): associative.
    """
    for distance in strides(lanes):
        index, there = neighbour(lanes, distance)
        there = there[:, None, None]
        own = torch.where(there, own + passed * own[index], own)
        passed = torch.where(there, passed * passed[index], passed)
    index, there = neighbour(lanes, 1)
    return torch.where(there[:, None, None], own[index], 0.0)
