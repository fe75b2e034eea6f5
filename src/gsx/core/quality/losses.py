"""The photometric loss: 0.8 L1 + 0.2 (1 - SSIM) with the zero-padded SSIM of 3D-GS (3D-GS, loss_utils.py)."""

import functools
import math
from collections.abc import Callable

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable
from torch.nn.functional import pad

from gsx.core.compiling import compiled_once, with_last
from gsx.core.quality.similarity import compiled_slopes, similarity, ssim_slopes
from gsx.core.shapes import Float

WINDOW, SIGMA = 11, 1.5
"""SSIM window edge and standard deviation, px (Wang et al. 2004; 3D-GS, loss_utils.py)."""
GAUSSIAN = [math.exp(-((i - WINDOW // 2) ** 2) / (2 * SIGMA**2)) for i in range(WINDOW)]
WEIGHTS = [value / sum(GAUSSIAN) for value in GAUSSIAN]
"""The window along one axis, sum 1."""
PADDING = WINDOW // 2
"""With so many zeros around it the blurred picture has its size."""


def correlate(maps: Float[Tensor, "M H W"], axis: int) -> Float[Tensor, "M h w"]:
    """The window along one axis, where it fits. Shifted sums are 3 x faster than a grouped convolution on a CPU."""
    size = maps.shape[axis] - WINDOW + 1
    first, *others = WEIGHTS
    total = maps.narrow(axis, 0, size) * first
    for shift, weight in enumerate(others, 1):
        total.add_(maps.narrow(axis, shift, size), alpha=weight)
    return total


def blur(maps: Float[Tensor, "M H W"], padding: int) -> Float[Tensor, "M h w"]:
    """Separable Gaussian window over each map, zero-padded by `padding`."""
    rows = correlate(pad(maps, (padding, padding)), 2)
    return correlate(pad(rows, (0, 0, padding, padding)), 1)


def ssim_map(
    image: Float[Tensor, "C H W"], target: Float[Tensor, "C H W"], padding: int = PADDING
) -> Float[Tensor, "C h w"]:
    """Structural similarity per channel and pixel; biased variances.

    `padding` is 5 for INRIA's zero-padded windows, 0 for whole windows only.
    """
    luminance, structure, *_ = similarity(*blurred(image, target, padding))
    return luminance * structure


def blurred(image: Float[Tensor, "C H W"], target: Float[Tensor, "C H W"], padding: int) -> tuple[Tensor, ...]:
    """Blurred image, target, image^2, target^2 and image target, each [C h w]."""
    return tuple(blur(maps, padding) for maps in (image, target, image * image, target * target, image * target))


def volume_loss(scales: Float[Tensor, "N 3"], weight: float) -> Float[Tensor, ""]:
    """`weight` times the mean product of the three scales; 0 for no splat (Scaffold-GS, train.py)."""
    volumes = scales.prod(1)
    return weight * volumes.sum() / max(1, len(volumes))


def photometric_and_gradient(
    image: Float[Tensor, "C H W"], target: Float[Tensor, "C H W"], ssim_weight: float, compiled: bool
) -> tuple[Float[Tensor, ""], Float[Tensor, "C H W"]]:
    """The photometric loss and its gradient by the image. The blur is its own adjoint: the window is symmetric and the
    padding zero."""
    parts, slopes_of = blurred(image, target, PADDING), compiled_slopes() if compiled else ssim_slopes
    ssim, *slopes = (found.view(image.shape) for found in slopes_of(*(part.flatten() for part in parts)))
    by_x, by_xx, by_xy = (blur(slope, PADDING) for slope in slopes)
    by_ssim, difference = by_x + 2 * image * by_xx + target * by_xy, image - target
    loss = (1 - ssim_weight) * difference.abs().mean() + ssim_weight * (1 - ssim.mean())
    return loss, ((1 - ssim_weight) * difference.sign() - ssim_weight * by_ssim) / image.numel()


@functools.lru_cache
def compiled_photometric(ssim_weight: float) -> Callable[..., tuple[Tensor, Tensor]]:
    """`photometric_and_gradient` through torch.compile, for pictures of any size."""

    def varying(arguments: tuple[Tensor, ...]) -> list[tuple[Tensor, int]]:
        return [(picture, axis) for picture in arguments for axis in (1, 2)]

    return compiled_once(with_last(photometric_and_gradient, ssim_weight, False), varying)


class Photometric(torch.autograd.Function):
    """The loss, with its gradient found on the way forward."""

    @staticmethod
    def forward(ctx, image, target, ssim_weight, compiled):
        if compiled and image.device.type != "cpu":  # launches cost; on a CPU the blur is as fast as it stands
            loss, gradient = compiled_photometric(ssim_weight)(image, target)
        else:
            loss, gradient = photometric_and_gradient(image, target, ssim_weight, compiled)
        ctx.save_for_backward(gradient)
        return loss

    @staticmethod
    @once_differentiable
    def backward(ctx, by_loss):
        (gradient,) = ctx.saved_tensors
        return by_loss * gradient, None, None, None


def photometric(
    image: Float[Tensor, "C H W"], target: Float[Tensor, "C H W"], ssim_weight: float, compiled: bool = False
) -> Float[Tensor, ""]:
    """(1 - w) mean |I - G| + w (1 - SSIM), a mean over pixels and channels; differentiable once, in the image."""
    return Photometric.apply(image, target, ssim_weight, compiled)
