"""Kernels of SSIM (Wang et al. 2004) and of the photometric loss."""

import math

from torch import Tensor

from gsx.core.shapes import Float

WINDOW, SIGMA = 11, 1.5
"""Edge and standard deviation of the SSIM window, px (Wang et al. 2004; 3D-GS, loss_utils.py)."""
GAUSSIAN = [math.exp(-((i - WINDOW // 2) ** 2) / (2 * SIGMA**2)) for i in range(WINDOW)]
WEIGHTS = [value / sum(GAUSSIAN) for value in GAUSSIAN]
"""The window along one axis, sum 1."""
C1, C2 = 0.01**2, 0.03**2
"""SSIM constants for values in [0, 1]."""


def correlate(maps: Float[Tensor, "M H W"], axis: int) -> Float[Tensor, "M h w"]:
    """Applies the window along one axis, without padding, by shifted sums: on a CPU 3 x faster than a convolution."""
    size = maps.shape[axis] - WINDOW + 1
    first, *others = WEIGHTS
    total = maps.narrow(axis, 0, size) * first
    for shift, weight in enumerate(others, 1):
        total.add_(maps.narrow(axis, shift, size), alpha=weight)
    return total


def similarity(x: Tensor, y: Tensor, xx: Tensor, yy: Tensor, xy: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Returns SSIM's factors of means and of variances, and their denominators, from `blurred` values."""
    means, spreads = x**2 + y**2 + C1, xx - x**2 + yy - y**2 + C2
    return (2 * x * y + C1) / means, (2 * (xy - x * y) + C2) / spreads, means, spreads


def ssim_slopes(x: Tensor, y: Tensor, xx: Tensor, yy: Tensor, xy: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Returns SSIM and its slopes by blurred image, image^2 and image target, from `blurred` values of any shape."""
    luminance, structure, means, spreads = similarity(x, y, xx, yy, xy)
    ssim = luminance * structure
    by_xx, by_xy = -ssim / spreads, 2 * luminance / spreads
    by_x = 2 * (y * structure - x * ssim) / means - 2 * x * by_xx - y * by_xy
    return ssim, by_x, by_xx, by_xy


def loss_slopes(
    image: Tensor, target: Tensor, ssim: Tensor, by_x: Tensor, by_xx: Tensor, by_xy: Tensor, ssim_weight: float
) -> tuple[Tensor, Tensor]:
    """Returns each value's photometric loss, and its slope times the number of values, from blurred SSIM slopes."""
    difference, by_ssim = image - target, by_x + 2 * image * by_xx + target * by_xy
    value = (1 - ssim_weight) * difference.abs() + ssim_weight * (1 - ssim)
    return value, (1 - ssim_weight) * difference.sign() - ssim_weight * by_ssim
