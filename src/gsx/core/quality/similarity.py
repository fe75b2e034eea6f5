"""SSIM of blurred pictures, pixel by pixel, and its slopes (Wang et al. 2004)."""

import functools
from collections.abc import Callable

from torch import Tensor

from gsx.core.compiling import compile_rows

C1, C2 = 0.01**2, 0.03**2
"""SSIM constants for values in [0, 1]."""


def similarity(x: Tensor, y: Tensor, xx: Tensor, yy: Tensor, xy: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """SSIM's two factors, of means and of spreads, and their denominators, from what `blurred` returns."""
    means, spreads = x**2 + y**2 + C1, xx - x**2 + yy - y**2 + C2
    return (2 * x * y + C1) / means, (2 * (xy - x * y) + C2) / spreads, means, spreads


def ssim_slopes(x: Tensor, y: Tensor, xx: Tensor, yy: Tensor, xy: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """(SSIM, its slopes by the blurred image, image^2 and image target) from what `blurred` returns, of any shape."""
    luminance, structure, means, spreads = similarity(x, y, xx, yy, xy)
    ssim = luminance * structure
    by_xx, by_xy = -ssim / spreads, 2 * luminance / spreads
    by_x = 2 * (y * structure - x * ssim) / means - 2 * x * by_xx - y * by_xy
    return ssim, by_x, by_xx, by_xy


@functools.lru_cache
def compiled_slopes() -> Callable[..., tuple[Tensor, ...]]:
    """`ssim_slopes` through torch.compile, for any number of pixels."""
    return compile_rows(ssim_slopes)
