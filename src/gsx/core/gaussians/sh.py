"""Real spherical harmonics of bands 0..3 with the signs of 3D-GS (3D-GS, sh_utils.py)."""

import torch
from torch import Tensor

from gsx.core.shapes import Float

BAND_0 = 0.28209479177387814
BAND_1 = 0.4886025119029199
BAND_2 = (1.0925484305920792, 0.31539156525252005, 0.5462742152960396)
BAND_3 = (0.5900435899266435, 2.890611442640554, 0.4570457994644658, 0.3731763325901154, 1.445305721320277)


def harmonics(directions: Float[Tensor, "N 3"], degree: int) -> Float[Tensor, "N B"]:
    """Y_1 .. Y_B of unit directions, B = (degree + 1)^2 - 1: everything but the constant band. `degree` is 1..3."""
    x, y, z = directions.unbind(1)
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
    return torch.stack(values, 1)


class Contraction(torch.autograd.Function):
    """sum over b of basis[n, b] rest[n, b, c]: no product of all three indices on the way, forward or backward."""

    @staticmethod
    def forward(ctx, basis, rest):
        ctx.save_for_backward(basis, rest)
        return (basis[:, None] @ rest)[:, 0]

    @staticmethod
    def backward(ctx, gradient):
        basis, rest = ctx.saved_tensors
        by_rest = basis[:, :, None] * gradient[:, None] if ctx.needs_input_grad[1] else None
        return (rest @ gradient[:, :, None])[:, :, 0], by_rest


def colours_of(
    constant: Float[Tensor, "N 1 3"],
    rest: Float[Tensor, "N B 3"],
    offsets: Float[Tensor, "N 3"],
    degree: int,
) -> Float[Tensor, "N 3"]:
    """max(0, 0.5 + SH): colours seen along `offsets` (splat minus camera centre, any length) up to `degree`."""
    colours = 0.5 + BAND_0 * constant[:, 0]
    if degree > 0:
        basis = harmonics(torch.nn.functional.normalize(offsets, dim=1), degree).to(rest)
        colours = colours + Contraction.apply(basis, rest[:, : basis.shape[1]])
    return colours.clamp_min(0)


def constant_from_colour(colour: Float[Tensor, "N 3"]) -> Float[Tensor, "N 3"]:
    """Coefficient of the constant band that shows `colour` (display RGB in [0, 1])."""
    return (colour - 0.5) / BAND_0
