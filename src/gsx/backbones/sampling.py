"""Samples of Gaussians, and quantiles."""

import math

import torch
from torch import Tensor

from gsx.core.gaussians.quaternions import rotation_matrices
from gsx.core.shapes import Float


def sampled_means(rows: dict[str, Tensor], generator: torch.Generator) -> Float[Tensor, "M 3"]:
    """Draws one position from each Gaussian of raw `means`, `quats` and `log_scales`."""
    noise = torch.randn(rows["means"].shape, generator=generator).to(rows["means"])
    offset = rotation_matrices(rows["quats"]) @ (noise * rows["log_scales"].exp())[:, :, None]
    return rows["means"] + offset[:, :, 0]


def quantile(values: Float[Tensor, "M"], fraction: float) -> float:
    """Returns a linearly interpolated quantile (torch.quantile is limited to 2^24 values)."""
    place = fraction * (len(values) - 1)
    low, high = (float(values.kthvalue(rank + 1).values) for rank in (math.floor(place), math.ceil(place)))
    return low + (high - low) * (place - math.floor(place))
