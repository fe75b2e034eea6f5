"""The 3D smoothing filter of Mip-Splatting (Yu et al. 2024, section 5.1) on scales and opacities."""

import math

import torch
from torch import Tensor
from torch.nn.functional import logsigmoid

from gsx.core.shapes import Float

LEAST_SHARE = 1e-30
"""Lower bound of a scale over the filtered scale, for finite gradients; such a primitive is invisible."""
LEAST_BEFORE, MOST_BEFORE = 0.1, 0.999
"""Least scale over the filter's size, and largest opacity, of `unsmoothed`."""


def smoothed(
    scales: Float[Tensor, "N 3"], log_opacities: Float[Tensor, "N"], sizes: Float[Tensor, "N"]
) -> tuple[Float[Tensor, "N 3"], Float[Tensor, "N"]]:
    """Returns scales and log-opacities after the 3D filter, differentiable (Mip-Splatting, get_scaling_with_3D_filter).

    The opacity changes by prod_k s_k / sqrt(s_k^2 + f^2), as a sum of logarithms: a product would underflow.
    """
    wide = torch.hypot(scales, sizes[:, None])
    return wide, log_opacities + (scales / wide).clamp_min(LEAST_SHARE).log().sum(1)


def smoothed_raw(
    log_scales: Float[Tensor, "N 3"], opacity_logits: Float[Tensor, "N"], sizes: Float[Tensor, "N"]
) -> tuple[Float[Tensor, "N 3"], Float[Tensor, "N"]]:
    """Applies `smoothed` to log-scales and logits."""
    scales, log_opacities = smoothed(log_scales.exp(), logsigmoid(opacity_logits), sizes)
    return scales.log(), logit_of_log(log_opacities)


def unsmoothed(
    log_scales: Float[Tensor, "N 3"], opacity_logits: Float[Tensor, "N"], sizes: Float[Tensor, "N"]
) -> tuple[Float[Tensor, "N 3"], Float[Tensor, "N"]]:
    """Inverts `smoothed_raw`; scales stay above a tenth of the filter (0 has no gradient), opacities below 1."""
    scales, sizes = log_scales.exp(), sizes[:, None]
    narrow = (scales.square() - sizes.square()).clamp_min(0).sqrt().maximum(LEAST_BEFORE * sizes)
    log_opacities = logsigmoid(opacity_logits) + (scales.maximum(sizes) / narrow).log().sum(1)
    return narrow.log(), logit_of_log(log_opacities.clamp_max(math.log(MOST_BEFORE)))


def logit_of_log(log_opacities: Float[Tensor, "N"]) -> Float[Tensor, "N"]:
    """Returns ln(o / (1 - o)) from ln o <= 0, accurate at both ends: the inverse of logsigmoid."""
    below = log_opacities.clamp_max(-torch.finfo(log_opacities.dtype).tiny)
    return below - torch.log(-torch.expm1(below))
