"""PSNR and SSIM as published (3D-GS, metrics.py). Images are display values in [0, 1]."""

import math

import torch
from torch import Tensor
from torch.nn.functional import pad

from gsx.core.backend import EAGER, Backend
from gsx.core.quality.losses import ssim_map
from gsx.core.quality.similarity import WINDOW
from gsx.core.shapes import Bool, Float

SSIM_VARIANTS = ("inria", "torchmetrics", "valid")
ROUNDINGS = ("nearest", "down")
STRIP_PIXELS = 1 << 16
"""Pixels per strip of SSIM; nine maps of a strip take 2.4 MB."""


def quantise(image: Float[Tensor, "C H W"], rounding: str = "nearest") -> Float[Tensor, "C H W"]:
    """Rounds to 8 bits: x 255, + 0.5 if `nearest` (torchvision's PNGs), clamped, truncated; `down` as nerfbaselines."""
    return (image * 255 + (0.5 if rounding == "nearest" else 0.0)).clamp(0, 255).floor() / 255


def psnr(
    image: Float[Tensor, "C H W"], target: Float[Tensor, "C H W"], counted: Bool[Tensor, "H W"] | None = None
) -> float:
    """Returns the PSNR of the pixels that count (None: all), dB; inf for equal images, nan for no pixels."""
    squares = image.detach().to(torch.float64, copy=True).sub_(target).square_()
    return decibel(float((squares if counted is None else squares[:, counted.to(squares.device)]).mean()))


def decibel(mean_square: float) -> float:
    """Returns -10 log10(mean square), dB; inf for 0, nan for nan."""
    return math.inf if mean_square == 0 else -10 * math.log10(mean_square)


def ssim(
    image: Float[Tensor, "C H W"],
    target: Float[Tensor, "C H W"],
    variant: str,
    counted: Bool[Tensor, "H W"] | None = None,
    backend: Backend = EAGER,
) -> float:
    """Returns the mean SSIM, in [-1, 1], over windows around pixels that count (None: all); nan for no pixels.

    Variants differ at borders. `inria`: zero padding, as 3D-GS. `torchmetrics`: reflected borders (repeated in narrow
    images), as torchmetrics since 1.4.2. `valid`: only windows inside the image, as the original SSIM.
    """
    if variant not in SSIM_VARIANTS:
        raise ValueError(f"SSIM variant '{variant}' is unknown; choose from {', '.join(SSIM_VARIANTS)}")
    half = WINDOW // 2
    if variant == "valid":
        return whole_windows(image, target, None if counted is None else counted[half:-half, half:-half], backend)
    reflected = "reflect" if min(image.shape[1:]) > half else "replicate"
    mode = "constant" if variant == "inria" else reflected
    image, target = (pad(picture, (half,) * 4, mode=mode) for picture in (image, target))
    return whole_windows(image, target, counted, backend)


def whole_windows(
    image: Float[Tensor, "C H W"],
    target: Float[Tensor, "C H W"],
    counted: Bool[Tensor, "h w"] | None,
    backend: Backend,
) -> float:
    """Returns the mean SSIM over whole windows whose middle counts, in strips of rows that fit the CPU's cache.

    Pictures smaller than a window are extended by their border, and then count everywhere.
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
    """Resizes by antialiased cubic interpolation, clamped to [0, 1]: the simplest baseline of a zoomed render."""
    larger = torch.nn.functional.interpolate(image[None], size=(height, width), mode="bicubic", antialias=True)
    return larger[0].clamp(0, 1)
