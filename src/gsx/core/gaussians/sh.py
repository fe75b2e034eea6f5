"""Real spherical harmonics of bands 0..3 with the signs of 3D-GS (3D-GS, sh_utils.py)."""

import functools

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from gsx.core.backend import EAGER, Backend
from gsx.core.gaussians.bands import BAND_0, bands, contraction, contraction_slopes, harmonics_along
from gsx.core.shapes import Float


def degree_of(coefficients: int) -> int:
    """Return the degree of spherical harmonics that have `coefficients` besides the constant one."""
    return round((coefficients + 1) ** 0.5) - 1


def harmonics(directions: Float[Tensor, "N 3"], degree: int) -> Float[Tensor, "N B"]:
    """Y_1 .. Y_B of unit directions, B = (degree + 1)^2 - 1: everything but the constant band. `degree` is 1..3."""
    x, y, z = directions.unbind(1)
    return torch.stack(bands(x, y, z, degree), 1)


class Contraction(torch.autograd.Function):
    """sum over b of basis[b, n] rest[n, b, c]."""

    @staticmethod
    def forward(ctx, basis, rest, backend):
        ctx.save_for_backward(basis, rest)
        ctx.backend = backend
        contract = backend.kernel(contraction, variant=(len(basis),)) if backend.compiled else spread_contraction
        return contract(rest[:], basis)  # a view, or torch would compile once more where others are none

    @staticmethod
    @once_differentiable
    def backward(ctx, gradient):
        basis, rest = ctx.saved_tensors
        compiled = ctx.backend.compiled
        slopes_of = ctx.backend.kernel(contraction_slopes, variant=(len(basis),)) if compiled else spread_slopes
        by_rest, by_basis = slopes_of(gradient.contiguous(), rest[:], basis)
        return by_basis, by_rest, None


def spread_contraction(rest: Float[Tensor, "N B 3"], basis: Float[Tensor, "B N"]) -> Float[Tensor, "N 3"]:
    """`contraction` in few operations: rows of B x 3 coefficients are multiplied as they lie in memory; matrices of
    zeros and ones spread what belongs to a band or to a channel over them, and gather it."""
    by_band, by_channel = spreads(rest.shape[1], rest.dtype, rest.device)
    return (basis.T @ by_band).mul_(rest.flatten(1)) @ by_channel.T


def spread_slopes(
    gradient: Float[Tensor, "N 3"], rest: Float[Tensor, "N B 3"], basis: Float[Tensor, "B N"]
) -> tuple[Float[Tensor, "N B 3"], Float[Tensor, "B N"]]:
    """`contraction_slopes` in the same way."""
    by_band, by_channel = spreads(rest.shape[1], rest.dtype, rest.device)
    seen = gradient @ by_channel
    by_rest = (basis.T @ by_band).mul_(seen).view(rest.shape)
    return by_rest, by_band @ seen.mul_(rest.flatten(1)).T


@functools.lru_cache
def spreads(
    count: int, dtype: torch.dtype, device: torch.device
) -> tuple[Float[Tensor, "B B_3"], Float[Tensor, "3 B_3"]]:
    """Matrices that copy the value of each of so many bands, and of each channel, to the coefficients that belong to
    it."""
    bands_, channels = (torch.eye(n, dtype=dtype, device=device) for n in (count, 3))
    return bands_.repeat_interleave(3, 1), channels.repeat(1, count)


def colours_of(
    constant: Float[Tensor, "N 1 3"],
    rest: Float[Tensor, "N B 3"],
    offsets: Float[Tensor, "N 3"],
    degree: int,
    backend: Backend = EAGER,
) -> Float[Tensor, "N 3"]:
    """max(0, 0.5 + SH): colours seen along `offsets` (splat minus camera centre, any length) up to `degree`."""
    colours = colour_of_constant(constant[:, 0])
    if degree == 0:
        return colours.clamp_min(0)
    count = (degree + 1) ** 2 - 1
    if not backend.compiled or len(offsets) < 2:
        basis = harmonics_along(offsets, degree).to(rest)
        return (colours + Contraction.apply(basis, rest[:, :count], EAGER)).clamp_min(0)
    basis = backend.kernel(harmonics_along, degree_of(rest.shape[1]))(offsets).to(rest)  # of all bands: compiled once
    if count < len(basis):
        basis = torch.cat([basis[:count], torch.zeros_like(basis[count:])])
    return (colours + Contraction.apply(basis, rest, backend)).clamp_min(0)


def constant_from_colour(colour: Float[Tensor, "N 3"]) -> Float[Tensor, "N 3"]:
    """Coefficient of the constant band that shows `colour` (display RGB in [0, 1])."""
    return (colour - 0.5) / BAND_0


def colour_of_constant(constant: Float[Tensor, "N 3"]) -> Float[Tensor, "N 3"]:
    """The colour that coefficients of the constant band show by themselves."""
    return 0.5 + BAND_0 * constant
