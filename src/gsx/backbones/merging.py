"""Moment-preserving merges of two Gaussians, and the change of their field.

The weight of a Gaussian is its opacity times its surface, as visible area counts (splat-transform,
`--decimate-uniform`; NanoGS uses volumes). The merged one has the weighted mean of positions, colours and covariances,
plus the covariance of the two means, and the opacity that keeps the weight.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import normalize

from gsx.core.gaussians.quaternions import quaternions_of, rotation_matrices
from gsx.core.shapes import Float, Int

Rows = Mapping[str, Tensor]
"""Raw parameters of Gaussians, and other values per row, by name."""
PARAMETERS = ("means", "log_scales", "quats", "opacity_logits")
"""Parameters that a merge needs."""
POWER = 1.6075
"""Exponent of Thomsen's formula for the surface of an ellipsoid (error up to 1.1 %)."""
LEAST_VARIANCE = 1e-30
LEAST_RATIO = 1e-9
"""Least variance of a flat Gaussian over its trace, in integrals over space."""
LARGEST_OPACITY = 1 - 1e-4


def covariances(rows: Rows) -> Float[Tensor, "N 3 3"]:
    """Returns covariances of Gaussians by raw parameters, world units squared."""
    spread = rotation_matrices(rows["quats"]) * rows["log_scales"].exp()[:, None]
    return spread @ spread.mT


def principal_axes(covariance: Float[Tensor, "N 3 3"]) -> tuple[Float[Tensor, "N 3"], Float[Tensor, "N 4"]]:
    """Returns (variances along the axes, ascending; unit quaternions of the axes)."""
    variances, axes = torch.linalg.eigh(covariance)
    axes = axes * torch.linalg.det(axes).sign()[:, None, None]
    return variances, normalize(quaternions_of(axes), dim=1)


def surfaces(scales: Float[Tensor, "N 3"]) -> Float[Tensor, "N"]:
    """Returns surfaces of ellipsoids with these half axes (Thomsen's formula)."""
    a, b, c = (scales.double() ** POWER).unbind(1)
    return 4 * math.pi * ((a * b + a * c + b * c) / 3) ** (1 / POWER)


def weights_of(rows: Rows) -> Float[Tensor, "N"]:
    """Returns opacities times surfaces."""
    return rows["opacity_logits"].double().sigmoid() * surfaces(rows["log_scales"].double().exp())


def merged(rows: Rows, first: Int[Tensor, "P"], second: Int[Tensor, "P"]) -> dict[str, Tensor]:
    """Merges pairs of rows: weighted means of floats; integers come from the first."""
    weights = weights_of(rows)
    total = weights[first] + weights[second]
    share = weights[first] / total.clamp_min(torch.finfo(total.dtype).tiny)

    def mean(value: Tensor) -> Tensor:
        of_row = share.view(-1, *[1] * (value.dim() - 1))
        one, other = of_row * value[first].double(), (1 - of_row) * value[second].double()
        return torch.where(of_row > 0, one, 0.0) + torch.where(of_row < 1, other, 0.0)  # 0 x infinity is 0

    out = {name: mean(value) if value.is_floating_point() else value[first] for name, value in rows.items()}
    apart = (rows["means"][first].double() - rows["means"][second].double())[:, :, None]
    between = (share * (1 - share))[:, None, None] * apart @ apart.mT
    variances, quats = principal_axes(mean(covariances({name: rows[name].double() for name in PARAMETERS})) + between)
    scales = variances.clamp_min(LEAST_VARIANCE).sqrt()
    opacities = (total / surfaces(scales)).clamp_max(LARGEST_OPACITY)
    out |= {"log_scales": scales.log(), "quats": quats, "opacity_logits": torch.logit(opacities, eps=1e-12)}
    return {name: value.to(rows[name]) for name, value in out.items()}


# -- what changes ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False, kw_only=True)
class Densities:
    """N densities opacity * colour * exp(-x^T covariance^-1 x / 2), float64."""

    means: Float[Tensor, "N 3"]
    covariances: Float[Tensor, "N 3 3"]
    amplitudes: Float[Tensor, "N C"]

    def at(self, index: Int[Tensor, "P"]) -> "Densities":
        """Returns the densities of some rows."""
        return Densities(**{name: value[index] for name, value in vars(self).items()})


def densities(rows: Rows, colours: Float[Tensor, "N 3"]) -> Densities:
    """Returns densities of Gaussians with these colours and a channel of 1, because dark ones cover too."""
    opacities = rows["opacity_logits"].double().sigmoid()[:, None]
    channels = torch.cat([colours.double(), torch.ones_like(opacities)], 1)
    double = {name: rows[name].double() for name in PARAMETERS}
    spread = covariances(double)
    least = LEAST_RATIO * spread.diagonal(dim1=1, dim2=2).sum(1) + LEAST_VARIANCE
    solid = spread + least[:, None, None] * torch.eye(3, dtype=spread.dtype, device=spread.device)
    return Densities(means=double["means"], covariances=solid, amplitudes=opacities * channels)


def products(a: Densities, b: Densities) -> Float[Tensor, "P"]:
    """Integrates products of densities over space, summed over channels.

    (2 pi)^1.5 |A|^.5 |B|^.5 |A + B|^-.5 exp(-d^T (A + B)^-1 d / 2), d the difference of the means.
    """
    both, apart = a.covariances + b.covariances, (a.means - b.means)[:, :, None]
    exponent = (apart.mT @ torch.linalg.solve(both, apart))[:, 0, 0]
    volumes = (torch.linalg.det(a.covariances) * torch.linalg.det(b.covariances) / torch.linalg.det(both)).sqrt()
    return (a.amplitudes * b.amplitudes).sum(1) * (2 * math.pi) ** 1.5 * volumes * torch.exp(-exponent / 2)


def changes(a: Densities, b: Densities, whole: Densities) -> Float[Tensor, "P"]:
    """Returns the integral of (a + b - whole)^2 over that of (a + b)^2."""
    before = products(a, a) + products(b, b) + 2 * products(a, b)
    difference = before + products(whole, whole) - 2 * products(a, whole) - 2 * products(b, whole)
    return difference.clamp_min(0) / before.clamp_min(torch.finfo(before.dtype).tiny)
