"""PSNR and SSIM by their published definitions (3D-GS, metrics.py). Images are display values in [0, 1]."""

import math

import torch
from torch import Tensor
from torch.nn.functional import pad

from gsx.core.backend import EAGER, Backend
from gsx.core.quality.losses import ssim_map
from gsx.core.quality.similarity import WINDOW
from gsx.core.shapes import Bool, Float

SSIM_VARIANTS = ("inria", "torchmetrics", "valid")
STRIP_PIXELS = 1 << 16
"""Pixels whose SSIM is taken at once: nine maps of them are 2.4 MB."""


def quantise(image: Float[Tensor, "C H W"]) -> Float[Tensor, "C H W"]:
    """Rounded to 8 bits as a saved PNG would be: x 255, + 0.5, clamp, truncate."""
    return (image * 255 + 0.5).clamp(0, 255).floor() / 255


def psnr(
    image: Float[Tensor, "C H W"], target: Float[Tensor, "C H W"], counted: Bool[Tensor, "H W"] | None = None
) -> float:
    """20 log10(1 / sqrt(MSE)) over all channels of the pixels that count (None: all), dB; inf for equal images, nan
    where none counts."""
    squares = (image.double() - target.double()).square()
    return decibel(float((squares if counted is None else squares[:, counted.to(squares.device)]).mean()))


def decibel(mean_square: float) -> float:
    """20 log10(1 / sqrt(mean square)), dB; inf for 0, nan for nan."""
    return math.inf if mean_square == 0 else -10 * math.log10(mean_square)


def ssim(
    image: Float[Tensor, "C H W"],
    target: Float[Tensor, "C H W"],
    variant: str,
    counted: Bool[Tensor, "H W"] | None = None,
    backend: Backend = EAGER,
) -> float:
    """Structural similarity in [-1, 1], a mean over windows around pixels that count (None: all); nan where none does.

    They differ near borders. `inria`: zero-padded windows, mean over the whole map, as in the 3D-GS release.
    `torchmetrics`: the same with reflected borders (repeated, where too narrow), as torchmetrics since 1.5. `valid`:
    mean over the pixels whose window lies inside, as the original SSIM and pytorch-msssim. `backend`: of the loops.
    """
    if variant == "inria":
        return whole_windows(pad(image, (WINDOW // 2,) * 4), pad(target, (WINDOW // 2,) * 4), counted, backend)
    if variant == "torchmetrics":
        half, mode = WINDOW // 2, "reflect" if min(image.shape[1:]) > WINDOW // 2 else "replicate"
        padded_image, padded_target = (pad(picture, (half,) * 4, mode=mode) for picture in (image, target))
        return whole_windows(padded_image, padded_target, counted, backend)
    if variant == "valid":
        inner = slice(WINDOW // 2, -(WINDOW // 2))
        return whole_windows(image, target, None if counted is None else counted[inner, inner], backend)
    raise ValueError(f"SSIM variant '{variant}' is unknown; choose from {', '.join(SSIM_VARIANTS)}")


def whole_windows(
    image: Float[Tensor, "C H W"],
    target: Float[Tensor, "C H W"],
    counted: Bool[Tensor, "h w"] | None,
    backend: Backend,
) -> float:
    """Mean SSIM where the window fits, its middle counts; pictures smaller than a window are extended by their border
    first, and then count everywhere.

    In strips of rows, so that its maps stay in the CPU's cache.
    """
    if counted is not None and not counted.any():
        return math.nan
    missing = [max(0, WINDOW - size) for size in (image.shape[2], image.shape[1])]
    margin = [half for size in missing for half in (size // 2, size - size // 2)]
    if any(missing):
        image, target = (pad(picture, margin, mode="replicate") for picture in (image, target))
        counted = None
    count, rows = image.shape[1] - WINDOW + 1, max(1, STRIP_PIXELS // image.shape[2])
    weights = torch.ones(count, image.shape[2] - WINDOW + 1) if counted is None else counted
    weights, total = weights.to(image.device).double(), 0.0
    for top in range(0, count, rows):
        strip = slice(top, min(top + rows, count) + WINDOW - 1)
        found = ssim_map(image[:, strip], target[:, strip], padding=0, backend=backend)
        total += float((found * weights[top : top + rows]).sum())
    return total / (len(image) * float(weights.sum()))


def bicubic(image: Float[Tensor, "C H W"], width: int, height: int) -> Float[Tensor, "C height width"]:
    """Resized by Keys' cubic interpolation, antialiased, clamped to [0, 1]: the naive competitor of a zoomed render."""
    larger = torch.nn.functional.interpolate(image[None], size=(height, width), mode="bicubic", antialias=True)
    return larger[0].clamp(0, 1)
