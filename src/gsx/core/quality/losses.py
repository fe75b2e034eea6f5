"""The photometric loss: 0.8 L1 + 0.2 (1 - SSIM) with the zero-padded SSIM of 3D-GS (3D-GS, loss_utils.py)."""

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable
from torch.nn.functional import pad

from gsx.core.backend import EAGER, Backend
from gsx.core.quality.similarity import (
    WINDOW,
    correlate,
    loss_slopes,
    similarity,
    ssim_slopes,
)
from gsx.core.shapes import Float

PADDING = WINDOW // 2
"""Zeros on each side that keep the size of a blurred picture."""


def blur(maps: Float[Tensor, "M H W"], padding: int, backend: Backend = EAGER) -> Float[Tensor, "M h w"]:
    """Applies the separable Gaussian window to each map, zero-padded by `padding`."""
    if backend.compiled:
        return backend.kernel(correlate, 1)(backend.kernel(correlate, 2)(pad(maps, (padding,) * 4)))
    rows = correlate(pad(maps, (padding, padding)), 2)
    return correlate(pad(rows, (0, 0, padding, padding)), 1)


def ssim_map(
    image: Float[Tensor, "C H W"], target: Float[Tensor, "C H W"], padding: int = PADDING, backend: Backend = EAGER
) -> Float[Tensor, "C h w"]:
    """Returns SSIM per channel and pixel, with biased variances; `padding`: 5 (3D-GS) or 0 for whole windows only."""
    luminance, structure, *_ = similarity(*blurred(image, target, padding, backend))
    return luminance * structure


def blurred(
    image: Float[Tensor, "C H W"],
    target: Float[Tensor, "C H W"],
    padding: int,
    backend: Backend = EAGER,
    target_moments: tuple[Tensor, Tensor] | None = None,
) -> tuple[Tensor, ...]:
    """Returns blurred image, target, image^2, target^2 and image target, each [C h w]."""
    x, xx, xy = (blur(each, padding, backend) for each in (image, image * image, image * target))
    y, yy = moments_of(target, padding, backend) if target_moments is None else target_moments
    return x, y, xx, yy, xy


def moments_of(
    target: Float[Tensor, "C H W"], padding: int = PADDING, backend: Backend = EAGER
) -> tuple[Float[Tensor, "C h w"], Float[Tensor, "C h w"]]:
    """Returns blurred target and target^2, the terms of SSIM that depend on the target alone."""
    return blur(target, padding, backend), blur(target * target, padding, backend)


def volume_loss(scales: Float[Tensor, "N 3"], weight: float) -> Float[Tensor, ""]:
    """Returns `weight` times the mean product of the three scales; 0 without splats (Scaffold-GS, train.py)."""
    volumes = scales.prod(1)
    return weight * volumes.sum() / max(1, len(volumes))


def photometric_and_gradient(
    image: Float[Tensor, "C H W"],
    target: Float[Tensor, "C H W"],
    ssim_weight: float,
    backend: Backend = EAGER,
    target_moments: tuple[Tensor, Tensor] | None = None,
) -> tuple[Float[Tensor, ""], Float[Tensor, "C H W"]]:
    """Returns the loss and its gradient by the image; the blur, symmetric and zero-padded, is its own adjoint."""
    parts = blurred(image, target, PADDING, backend, target_moments)
    ssim, *slopes = backend.kernel(ssim_slopes)(*(part.flatten() for part in parts))
    back = [blur(slope.view(image.shape), PADDING, backend).flatten() for slope in slopes]
    combine = backend.kernel(loss_slopes, ssim_weight)
    value, slope = combine(image.flatten(), target.flatten(), ssim, *back)
    return value.mean(), slope.view(image.shape) / image.numel()


class Photometric(torch.autograd.Function):
    """Autograd function of the photometric loss; the forward pass computes the gradient."""

    @staticmethod
    def forward(ctx, image, target, ssim_weight, backend, target_moments):
        image, target = image.detach(), target.detach()
        if backend.compiled and image.device.type != "cpu":  # launches cost: all of it at once
            loss, gradient = backend.kernel(photometric_and_gradient, ssim_weight, EAGER, None)(image, target)
        else:
            loss, gradient = photometric_and_gradient(image, target, ssim_weight, backend, target_moments)
        ctx.save_for_backward(gradient)
        return loss

    @staticmethod
    @once_differentiable
    def backward(ctx, by_loss):
        (gradient,) = ctx.saved_tensors
        return by_loss * gradient, None, None, None, None


def photometric(
    image: Float[Tensor, "C H W"],
    target: Float[Tensor, "C H W"],
    ssim_weight: float,
    backend: Backend = EAGER,
    target_moments: tuple[Tensor, Tensor] | None = None,
) -> Float[Tensor, ""]:
    """Returns (1 - w) mean |I - G| + w (1 - SSIM) over pixels and channels; differentiable once, in the image.

    Args:
        image: Render I, display values.
        target: Photo G, display values.
        ssim_weight: w, in [0, 1].
        backend: `RasterSettings.backend.on(device, learning=True)`.
        target_moments: Cached `moments_of` the target; unused by compiled code on a GPU.
    """
    return Photometric.apply(image, target, ssim_weight, backend, target_moments)
