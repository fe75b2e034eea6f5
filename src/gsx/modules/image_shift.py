"""Translation between a render and a photo, px, whatever their exposures.

Source: Lucas and Kanade 1981, coarse to fine, with robust weights.
"""

import math
from typing import TypeAlias

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, grid_sample

from gsx.core.shapes import Bool, Float

Grey: TypeAlias = Float[Tensor, "H W"]
Mask: TypeAlias = Bool[Tensor, "H W"]
Shift: TypeAlias = Float[Tensor, "2"]
"""To the right and down, px."""

ROUNDS, MIN_SIDE = 8, 24
"""Iterations at each size; smallest side of an image that is searched, px."""
BORDER = 4
"""Width of the border that is ignored, besides the shift itself, px."""
NEGLIGIBLE = 1e-3
"""Differences of display values up to which a fit is as good as another: a quarter of a step of 8 bits."""
MIN_PIXELS = 64
"""Fewest pixels for an estimate."""
MIN_SLOPE, MIN_SLOPED_SHARE = 1 / 255, 0.05
"""Display values per px above which a pixel has structure; share of all pixels below which those do not count alone."""
MIN_EIGENVALUE = 1e-5
"""Smallest eigenvalue of normal equations, of columns of length 1, that determine a shift."""


def estimate_shift(
    render: Float[Tensor, "3 H W"], photo: Float[Tensor, "3 H W"], mask: Mask | None
) -> tuple[float, float] | None:
    """Estimates the shift of a photo from a render to the right and down, px; `mask`: pixels that count.

    It minimises their difference up to a gain and an offset. Returns None where pixels do not determine it, or where it
    is no better than no shift.
    """
    source, target = smoothed_grey(render), smoothed_grey(photo)
    inside = torch.ones_like(source, dtype=torch.bool) if mask is None else mask.to(source.device)
    shift = coarse_to_fine(source, target, inside)
    if shift is None:
        return None
    still = mismatch(source, target, inside, 0 * shift)
    if mismatch(source, target, inside, shift) > still + NEGLIGIBLE:
        return None
    return float(shift[0]), float(shift[1])


def coarse_to_fine(source: Grey, target: Grey, inside: Mask) -> Shift | None:
    """Estimates the shift at half the size first, where images are large enough."""
    start = None
    if min(source.shape) >= 2 * MIN_SIDE:
        start = coarse_to_fine(halve(source), halve(target), halve(inside) == 1)
    return refine(source, target, inside, source.new_zeros(2) if start is None else 2 * start)


def refine(source: Grey, target: Grey, inside: Mask, shift: Shift) -> Shift | None:
    """Refines a shift; None where pixels do not determine it, or it diverges."""
    residual = None
    for _ in range(ROUNDS):
        moved, valid = translate(source, shift), inside & interior(source, float(shift.abs().max()))
        columns = torch.stack([slope(moved, 1), slope(moved, 0), moved, torch.ones_like(moved)])[:, valid]
        residual = median_residual(moved, target, valid) if residual is None else residual
        fit = least_squares(columns, target[valid], robust_weights(residual[valid], structured(columns)))
        if fit is None:
            return None
        residual = target - fit[2] * moved - fit[3]
        shift = shift - fit[:2] / fit[2]
        if not bool(shift.abs().max() < min(source.shape) / 4):
            return None
    return shift


def mismatch(source: Grey, target: Grey, inside: Mask, shift: Shift) -> float:
    """Returns the median difference after a shift, up to a gain and an offset; infinite without a fit."""
    moved, valid = translate(source, shift), inside & interior(source, float(shift.abs().max()))
    weights = robust_weights(median_residual(moved, target, valid)[valid])
    fit = least_squares(torch.stack([moved, torch.ones_like(moved)])[:, valid], target[valid], weights)
    return math.inf if fit is None else float((target - fit[0] * moved - fit[1])[valid].abs().median())


def median_residual(
    image: Float[Tensor, "*S"], target: Float[Tensor, "*S"], valid: Bool[Tensor, "*S"]
) -> Float[Tensor, "*S"]:
    """Returns target - image, the image scaled to the same median over valid pixels."""
    if not valid.any():
        return target - image
    return target - image * (target[valid].median() / image[valid].median().clamp_min(1e-6))


def robust_weights(residual: Float[Tensor, "P"], usual: Bool[Tensor, "P"] | None = None) -> Float[Tensor, "P"]:
    """Returns Cauchy weights of pixels, scaled by the median residual of `usual` pixels, or of all if these are few."""
    few = usual is None or int(usual.sum()) < max(MIN_PIXELS, MIN_SLOPED_SHARE * len(residual))
    scale = (residual if few else residual[usual]).abs().median()
    return 1 / (1 + (residual / (scale + 1e-4)).square())


def structured(columns: Float[Tensor, "C P"]) -> Bool[Tensor, "P"]:
    """Returns the pixels with structure, by their first two values: slopes along the axes."""
    return columns[:2].abs().amax(0) > MIN_SLOPE


def smoothed_grey(image: Float[Tensor, "3 H W"]) -> Grey:
    """Returns the mean of the channels, smoothed over 3 x 3 px so that slopes hold over a pixel or two; float64."""
    return avg_pool2d(image.double().mean(0)[None], 3, stride=1, padding=1, count_include_pad=False)[0]


def halve(values: Float[Tensor, "H W"] | Mask) -> Grey:
    """Returns means of 2 x 2 pixels, float64."""
    return avg_pool2d(values[None].double(), 2)[0]


def translate(image: Grey, shift: Shift) -> Grey:
    """Translates an image to the right and down, px."""
    height, width = image.shape
    y, x = torch.meshgrid(*(torch.arange(n, device=image.device).double() + 0.5 for n in image.shape), indexing="ij")
    places = torch.stack([2 * (x - shift[0]) / width - 1, 2 * (y - shift[1]) / height - 1], -1)[None]
    return grid_sample(image[None, None], places, mode="bicubic", padding_mode="border", align_corners=False)[0, 0]


def slope(image: Grey, axis: int) -> Grey:
    """Returns central differences along an axis."""
    return (image.roll(-1, axis) - image.roll(1, axis)) / 2


def interior(image: Grey, shift: float) -> Mask:
    """Returns the pixels away from the border."""
    edge = BORDER + math.ceil(shift)
    out = torch.zeros_like(image, dtype=torch.bool)
    out[edge : image.shape[0] - edge, edge : image.shape[1] - edge] = True
    return out


def least_squares(
    columns: Float[Tensor, "C P"], target: Float[Tensor, "P"], weights: Float[Tensor, "P"]
) -> Float[Tensor, "C"] | None:
    """Returns the coefficients of columns that fit the target; None where it does not determine them."""
    if columns.shape[1] < MIN_PIXELS:
        return None
    scale = columns.square().mean(1).sqrt()
    if not bool((scale > 1e-6).all()):
        return None
    unit = columns / scale[:, None]
    system = (unit * weights) @ unit.T / weights.sum()
    if not bool(torch.linalg.eigvalsh(system)[0] > MIN_EIGENVALUE):
        return None
    return torch.linalg.solve(system, (unit * weights) @ target / weights.sum()) / scale
