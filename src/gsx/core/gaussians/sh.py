"""Real spherical harmonics of bands 0..3, and colours from them (3D-GS, sh_utils.py)."""

import functools

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from gsx.core.backend import EAGER, Backend
from gsx.core.gaussians.bands import BAND_0, bands, contraction, contraction_slopes, harmonics_along
from gsx.core.shapes import Float


def degree_of(coefficients: int) -> int:
    """Returns the degree of harmonics with that number of coefficients after the constant one."""
    return round((coefficients + 1) ** 0.5) - 1


def harmonics(directions: Float[Tensor, "N 3"], degree: int) -> Float[Tensor, "N B"]:
    """Returns Y_1 .. Y_B of unit directions, without the constant band; B = (degree + 1)^2 - 1, degree 1..3."""
    x, y, z = directions.unbind(1)
    return torch.stack(bands(x, y, z, degree), 1)


class Contraction(torch.autograd.Function):
    """Autograd function of sum_b basis[b, n] rest[n, b, c]."""

    @staticmethod
    def forward(ctx, basis, rest, backend):
        ctx.save_for_backward(basis, rest)
        ctx.backend = backend
        contract = backend.kernel(contraction, variant=(len(basis),)) if backend.compiled else spread_contraction
        return contract(rest[:], basis)  # always a view: torch compiles again for other tensors

    @staticmethod
    @once_differentiable
    def backward(ctx, gradient):
        basis, rest = ctx.saved_tensors
        compiled = ctx.backend.compiled
        slopes_of = ctx.backend.kernel(contraction_slopes, variant=(len(basis),)) if compiled else spread_slopes
        by_rest, by_basis = slopes_of(gradient.contiguous(), rest[:], basis)
        return by_basis, by_rest, None


def spread_contraction(rest: Float[Tensor, "N B 3"], basis: Float[Tensor, "B N"]) -> Float[Tensor, "N 3"]:
    """Returns `contraction` by two products with matrices of zeros and ones, fast in eager torch."""
    by_band, by_channel = spreads(rest.shape[1], rest.dtype, rest.device)
    return (basis.T @ by_band).mul_(rest.flatten(1)) @ by_channel.T


def spread_slopes(
    gradient: Float[Tensor, "N 3"], rest: Float[Tensor, "N B 3"], basis: Float[Tensor, "B N"]
) -> tuple[Float[Tensor, "N B 3"], Float[Tensor, "B N"]]:
    """Returns `contraction_slopes` in the same way."""
    by_band, by_channel = spreads(rest.shape[1], rest.dtype, rest.device)
    by_coefficient = gradient @ by_channel
    by_rest = (basis.T @ by_band).mul_(by_coefficient).view(rest.shape)
    return by_rest, by_band @ by_coefficient.mul_(rest.flatten(1)).T


@functools.lru_cache
def spreads(
    count: int, dtype: torch.dtype, device: torch.device
) -> tuple[Float[Tensor, "B B_3"], Float[Tensor, "3 B_3"]]:
    """Returns matrices that copy values of bands, and of channels, to their coefficients."""
    bands_, channels = (torch.eye(n, dtype=dtype, device=device) for n in (count, 3))
    return bands_.repeat_interleave(3, 1), channels.repeat(1, count)


def colours_of(
    constant: Float[Tensor, "N 1 3"],
    rest: Float[Tensor, "N B 3"],
    offsets: Float[Tensor, "N 3"],
    degree: int,
    backend: Backend = EAGER,
) -> Float[Tensor, "N 3"]:
    """Returns colours max(0, 0.5 + SH) along `offsets` (splat minus camera centre, any length) up to `degree`."""
    colours = colour_of_constant(constant[:, 0])
    if degree == 0:
        return colours.clamp_min(0)
    count = (degree + 1) ** 2 - 1
    if not backend.compiled or len(offsets) < 2:
        basis = harmonics_along(offsets, degree).to(rest)
        return (colours + Contraction.apply(basis, rest[:, :count], EAGER)).clamp_min(0)
    basis = backend.kernel(harmonics_along, degree_of(rest.shape[1]))(offsets).to(rest)  # all bands: compiled once
    if count < len(basis):
        basis = torch.cat([basis[:count], torch.zeros_like(basis[count:])])
    return (colours + Contraction.apply(basis, rest, backend)).clamp_min(0)


def constant_from_colour(colour: Float[Tensor, "N 3"]) -> Float[Tensor, "N 3"]:
    """Returns the constant coefficient of a colour (display RGB in [0, 1])."""
    return (colour - 0.5) / BAND_0


def colour_of_constant(constant: Float[Tensor, "N 3"]) -> Float[Tensor, "N 3"]:
    """Returns the colour of the constant coefficient alone."""
    return 0.5 + BAND_0 * constant
