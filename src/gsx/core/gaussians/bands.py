"""Kernels of spherical harmonics, with the signs of 3D-GS (3D-GS, sh_utils.py)."""

from collections.abc import Sequence

import torch
from torch import Tensor

from gsx.core.shapes import Float

BAND_0 = 0.28209479177387814
BAND_1 = 0.4886025119029199
BAND_2 = (1.0925484305920792, 0.31539156525252005, 0.5462742152960396)
BAND_3 = (0.5900435899266435, 2.890611442640554, 0.4570457994644658, 0.3731763325901154, 1.445305721320277)


def bands(x: Tensor, y: Tensor, z: Tensor, degree: int) -> list[Tensor]:
    """Returns Y_1 .. Y_B of unit directions (x, y, z), B = (degree + 1)^2 - 1."""
    values = [-BAND_1 * y, BAND_1 * z, -BAND_1 * x]
    if degree >= 2:
        a, b, c = BAND_2
        values += [a * x * y, -a * y * z, b * (2 * z * z - x * x - y * y), -a * x * z, c * (x * x - y * y)]
    if degree >= 3:
        a, b, c, d, e = BAND_3
        xx, yy, zz = x * x, y * y, z * z
        values += [-a * y * (3 * xx - yy), b * x * y * z, -c * y * (4 * zz - xx - yy)]
        values += [d * z * (2 * zz - 3 * xx - 3 * yy)]
        values += [-c * x * (4 * zz - xx - yy), e * z * (xx - yy), -a * x * (xx - 3 * yy)]
    return values


def harmonics_along(offsets: Float[Tensor, "N 3"], degree: int) -> Float[Tensor, "B N"]:
    """Returns `harmonics` of offsets of any length, a row for each band."""
    x, y, z = offsets.unbind(1)
    shrink = (x * x + y * y + z * z).clamp_min(1e-24).rsqrt()
    return torch.stack(bands(x * shrink, y * shrink, z * shrink, degree))


def contraction(rest: Float[Tensor, "N B 3"], basis: Float[Tensor, "B N"]) -> Float[Tensor, "N 3"]:
    """Returns sum_b basis[b, n] rest[n, b, c], one loop over splats when compiled."""
    coefficients = rest.flatten(1).unbind(1)
    return torch.stack([sum_of_products(basis.unbind(), coefficients[channel::3]) for channel in range(3)], 1)


def sum_of_products(left: Sequence[Tensor], right: Sequence[Tensor]) -> Tensor:
    """Returns left[0] right[0] + left[1] right[1] + ..."""
    total = left[0] * right[0]
    for one, other in zip(left[1:], right[1:], strict=True):
        total = total + one * other
    return total


def contraction_slopes(
    gradient: Float[Tensor, "N 3"], rest: Float[Tensor, "N B 3"], basis: Float[Tensor, "B N"]
) -> tuple[Float[Tensor, "N B 3"], Float[Tensor, "B N"]]:
    """Returns the gradients of `rest` and `basis` from that of their contraction."""
    channels, coefficients = gradient.unbind(1), rest.flatten(1).unbind(1)
    by_rest = torch.stack([band * channel for band in basis for channel in channels], 1)
    by_basis = [sum_of_products(channels, coefficients[3 * band : 3 * band + 3]) for band in range(len(basis))]
    return by_rest.view(rest.shape), torch.stack(by_basis)
