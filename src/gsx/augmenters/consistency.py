"""8-bit pictures that reduce exactly to their input: the paper's interpolation flexibility, guaranteed for box
averages."""

import torch
from torch import Tensor

from gsx.core.data.reduction import Reduction, projected
from gsx.core.data.resize import to_uint8
from gsx.core.shapes import Bool, Float, Int, UInt8

BOX = Reduction()
REPAIRS = 50
"""Most rounds that spread rounding errors back, for overlapping blocks."""


def exactly_consistent(
    image: Float[Tensor, "3 H W"], low: UInt8[Tensor, "3 h w"], factor: int, reduction: Reduction
) -> UInt8[Tensor, "3 H W"]:
    """Returns the 8-bit picture near `image` that reduces to `low`: exactly for box averages, else in nearly all
    pixels."""
    near = projected(image.float(), low.float() / 255, factor, reduction)
    return repaired(near, low, factor) if reduction == BOX else settled(near, low, factor, reduction)


def settled(
    near: Float[Tensor, "3 H W"], low: UInt8[Tensor, "3 h w"], factor: int, reduction: Reduction
) -> UInt8[Tensor, "3 H W"]:
    """Rounds a picture, and spreads remaining differences from `low` over its pixels."""
    known = low.float() / 255
    for _ in range(REPAIRS):
        off = known - reduction.reduce(to_uint8(near).float() / 255, factor)
        wrong = torch.where(off.abs() * 255 > 0.5, off, 0)
        if not bool(wrong.any()):
            break
        near = near + factor**2 * reduction.adjoint(wrong, factor)
    return to_uint8(near)


def repaired(near: Float[Tensor, "3 H W"], low: UInt8[Tensor, "3 h w"], factor: int) -> UInt8[Tensor, "3 H W"]:
    """Rounds such that a^2 (low - 1/2) <= sum of each block < a^2 (low + 1/2), at the least cost.

    Moves values by one level at a time, first those that rounding moved most the other way.
    """
    values = blocks(to_uint8(near).long(), factor)
    exact = blocks(near * 255, factor)
    area = factor * factor
    lowest = -(-(2 * low.long() - 1) * area // 2).flatten()
    highest = ((2 * low.long() + 1) * area - 1).div(2, rounding_mode="floor").flatten()
    while True:
        sums = values.sum(1)
        step = (sums < lowest).long() - (sums > highest).long()
        if not bool(step.any()):
            return unblocked(values, low.shape, factor).to(torch.uint8)
        values = values + moves(values, exact, step)


def moves(values: Int[Tensor, "B a"], exact: Float[Tensor, "B a"], step: Int[Tensor, "B"]) -> Int[Tensor, "B a"]:
    """Returns one level more or less for the value of least cost in each block, within 0..255."""
    gain = (exact - values) * step[:, None]
    allowed = ((values + step[:, None]) >= 0) & ((values + step[:, None]) <= 255)
    chosen = torch.where(allowed, gain, -torch.inf).argmax(1)
    return torch.zeros_like(values).scatter_(1, chosen[:, None], step[:, None])


def blocks(image: Tensor, factor: int) -> Tensor:
    """Returns the pixels of each block, [3 h w, a^2]."""
    parts = image.unfold(1, factor, factor).unfold(2, factor, factor)
    return parts.reshape(-1, factor * factor)


def unblocked(values: Int[Tensor, "B a"], shape: torch.Size, factor: int) -> Int[Tensor, "3 H W"]:
    """Returns the image of `blocks`; `shape`: of the box average."""
    channels, height, width = shape
    parts = values.view(channels, height, width, factor, factor).permute(0, 1, 3, 2, 4)
    return parts.reshape(channels, height * factor, width * factor)


def consistent_pixels(
    image: UInt8[Tensor, "3 H W"], low: UInt8[Tensor, "3 h w"], factor: int, reduction: Reduction
) -> Bool[Tensor, "h w"]:
    """Marks pixels of `low` that the image reduces to in 8 bits, in all channels."""
    if reduction == BOX:
        sums = blocks(image.long(), factor).sum(1).view(low.shape)
        back = ((2 * sums + factor * factor) // (2 * factor * factor)).to(torch.uint8)
    else:
        back = to_uint8(reduction.reduce(image.float() / 255, factor))
    return (back == low).all(0)
