"""SSIM with each treatment of borders, from one pass over the picture's interior."""

import torch
from torch import Tensor
from torch.nn.functional import pad

from gsx.core.backend import EAGER, Backend
from gsx.core.quality.losses import ssim_map
from gsx.core.quality.metrics import SSIM_VARIANTS, STRIP_PIXELS, ssim
from gsx.core.quality.similarity import WINDOW
from gsx.core.shapes import Bool, Float

HALF = WINDOW // 2
"""Width of the border whose windows reach outside the picture, px."""
PADDED = {"inria": "constant", "torchmetrics": "reflect"}
"""Filling outside the picture, as in `ssim`, by variant."""
assert {*PADDED, "valid"} <= set(SSIM_VARIANTS)


def all_ssim(
    image: Float[Tensor, "C H W"],
    target: Float[Tensor, "C H W"],
    counted: Bool[Tensor, "H W"] | None = None,
    backend: Backend = EAGER,
) -> dict[str, float]:
    """Returns the mean SSIM by variant, as `ssim`; windows inside of the picture, equal in all, are computed once."""
    if min(image.shape[1:]) < 2 * WINDOW:
        return {name: ssim(image, target, name, counted, backend) for name in (*PADDED, "valid")}
    weights = torch.ones(image.shape[1:], dtype=torch.float64) if counted is None else counted.double().cpu()
    inner = weights[HALF:-HALF, HALF:-HALF]
    inside = inner_sum(image, target, inner, backend)
    found = {"valid": mean_of(inside, inner, len(image))}
    for name, mode in PADDED.items():
        border = border_sum(image, target, weights, mode, backend)
        found[name] = mean_of(inside + border, weights, len(image))
    return found


def mean_of(total: float, weights: Float[Tensor, "h w"], channels: int) -> float:
    """Returns a weighted mean over pixels and channels; nan for no pixels."""
    whole = float(weights.sum()) * channels
    return total / whole if whole else float("nan")


def inner_sum(
    image: Float[Tensor, "C H W"], target: Float[Tensor, "C H W"], weights: Float[Tensor, "h w"], backend: Backend
) -> float:
    """Sums SSIM over windows inside the picture, in strips of rows that fit the CPU's cache."""
    count, rows, total = weights.shape[0], max(1, STRIP_PIXELS // image.shape[2]), 0.0
    for top in range(0, count, rows):
        strip = slice(top, min(top + rows, count) + WINDOW - 1)
        found = ssim_map(image[:, strip], target[:, strip], padding=0, backend=backend)
        total += weighted_sum(found, weights[top : top + rows])
    return total


def border_sum(
    image: Float[Tensor, "C H W"],
    target: Float[Tensor, "C H W"],
    weights: Float[Tensor, "H W"],
    mode: str,
    backend: Backend,
) -> float:
    """Sums SSIM over windows that reach outside the picture, filled there by `mode`."""
    one, other = (pad(picture, (HALF,) * 4, mode=mode) for picture in (image, target))
    total = 0.0
    for rows, columns, pixels in borders():
        part = ssim_map(one[:, rows, columns], other[:, rows, columns], padding=0, backend=backend)
        total += weighted_sum(part, weights[pixels])
    return total


def borders() -> list[tuple[slice, slice, tuple[slice, slice]]]:
    """Returns the four strips of a border: rows and columns of the filled picture, and pixels of the picture."""
    first, last, whole = slice(None, WINDOW - 1 + HALF), slice(-(WINDOW - 1 + HALF), None), slice(None)
    inner, near, far = slice(HALF, -HALF), slice(None, HALF), slice(-HALF, None)
    return [
        (first, whole, (near, whole)),
        (last, whole, (far, whole)),
        (inner, first, (inner, near)),
        (inner, last, (inner, far)),
    ]


def weighted_sum(found: Float[Tensor, "C h w"], weights: Float[Tensor, "h w"]) -> float:
    """Sums a map over channels and pixels by weight, in float64."""
    return float((found.cpu().sum(0, dtype=torch.float64) * weights).sum())
