"""Detail above the Nyquist frequency of the training pictures: how much of it a zoomed picture has, or invents.

PSNR at x4 depends mostly on what the picture at x1 already holds. An orthonormal DCT-II of the difference and of the
truth splits both at the frequency where the training pictures end, 1/2 cycle per training px.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import torch
from torch import Tensor

from gsx.core.quality.metrics import decibel
from gsx.core.shapes import Float

BORDER_PIXELS, BORDER_SHARE = 8, 0.02
"""Left out along each border: so many training px, or this share of the side if that is more."""
RECOVERABLE = 1.5
"""Reduced photos hold something up to this many times their Nyquist frequency (3/4 cycle per training px)."""


@dataclass(frozen=True, kw_only=True)
class Detail:
    """Mean squares of a picture's difference from the truth, and of the truth, by band; means over channels."""

    low: float
    """Difference below the Nyquist frequency of training."""
    high: float
    """Difference above it; both add up to the MSE of the window."""
    recoverable: float
    """Part of `high` up to RECOVERABLE times that frequency."""
    truth_high: float
    truth_recoverable: float


Details: TypeAlias = dict[str, Detail]
"""By picture."""


def dct(values: Float[Tensor, "*shape N"]) -> Float[Tensor, "*shape N"]:
    """Computes the orthonormal DCT-II along the last axis by an FFT of even, then reversed odd samples.

    Source: Makhoul 1980; a real signal's half spectrum has the first coefficients as real, the last as imaginary parts.
    """
    size = values.shape[-1]
    half = torch.fft.rfft(torch.cat([values[..., ::2], values[..., 1::2].flip(-1)], -1))
    turn = torch.exp(-0.5j * math.pi * torch.arange(half.shape[-1], dtype=values.dtype) / size) * math.sqrt(2 / size)
    turned = torch.view_as_real(half.mul_(turn))
    out = torch.cat([turned[..., 0], -turned[..., 1 : (size + 1) // 2, 1].flip(-1)], -1)
    out[..., 0] /= math.sqrt(2)
    return out


def powers(picture: Float[Tensor, "C H W"], corners: Sequence[tuple[int, int]]) -> list[float]:
    """Returns the mean square over pixels and channels of a picture's lowest (down, across) frequencies per corner."""
    square = picture.new_zeros(picture.shape[2], picture.shape[1])
    for channel in picture:  # one at a time, for memory
        square += dct(dct(channel).mT).square_()
    sums = [square[:across, :down].sum(dtype=torch.float64) for down, across in corners]
    return [float(power) / picture.numel() for power in sums]


def details_of(images: Mapping[str, Float[Tensor, "3 H W"]], truth: Float[Tensor, "3 H W"], factor: float) -> Details:
    """Compares pictures with the truth, `factor` times as fine as training, by name.

    Empty where no pixel lies within the borders or no frequency above those of training.
    """
    window = interior(truth.shape[1], factor), interior(truth.shape[2], factor)
    exact = truth[:, *window]
    if min(exact.shape[1:]) < 2 or factor <= 1:
        return {}
    corners = [corner(exact.shape[1], exact.shape[2], factor, end) for end in (1, RECOVERABLE, math.inf)]
    _, truth_high, truth_recoverable = by_band(exact, corners)
    out = {}
    for name, image in images.items():
        low, high, recoverable = by_band(image[:, *window].to(exact) - exact, corners)
        out[name] = Detail(
            low=low, high=high, recoverable=recoverable, truth_high=truth_high, truth_recoverable=truth_recoverable
        )
    return out


def by_band(picture: Float[Tensor, "C H W"], corners: Sequence[tuple[int, int]]) -> tuple[float, float, float]:
    """Returns the mean square of a picture in the first corner, outside of it, and in the rest of the second."""
    below, up_to, whole = powers(picture, corners)
    return below, max(0.0, whole - below), max(0.0, up_to - below)


def corner(height: int, width: int, factor: float, end: float) -> tuple[int, int]:
    """Counts the frequencies down and across below `end` times the Nyquist frequency of training."""
    rows, columns = (torch.arange(side, dtype=torch.float64) / side * factor for side in (height, width))
    return int((rows < end).sum()), int((columns < end).sum())


def interior(size: int, factor: float) -> slice:
    """Returns the pixels of a side without its borders."""
    border = math.ceil(max(BORDER_PIXELS * factor, BORDER_SHARE * size))
    return slice(border, max(border, size - border))


def explained(details: Sequence[Detail]) -> dict[str, float]:
    """Sums up views: PSNR below and above the Nyquist frequency of training, dB, and the explained shares.

    `explained` is 1 - sum(high) / sum(truth_high): 1 for the truth, 0 without detail, negative for invented detail.
    """
    low, high, band, truth, truth_band = (
        math.fsum(getattr(detail, name) for detail in details)
        for name in ("low", "high", "recoverable", "truth_high", "truth_recoverable")
    )
    return {
        "psnr_low": decibel(low / len(details)),
        "psnr_high": decibel(high / len(details)),
        "explained": 1 - high / truth if truth > 0 else math.nan,
        "recoverable": 1 - band / truth_band if truth_band > 0 else math.nan,
    }
