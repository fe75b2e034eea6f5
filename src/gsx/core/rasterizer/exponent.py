"""Three ways to write ln alpha over the pixels of a tile, each with its gradient (docs/numerics.md).

Half the inverse covariance is U^T U with U = [[u0, u1], [0, u2]], so with d = pixel - mean

    ln alpha = ln o - s^2 - r^2,    s = u0 dx + u1 dy,    r = u2 dy.

`squares` writes s and r as affine functions of tile-centred pixel coordinates: two matrix products, never above ln o.
`direct` forms d first, in full precision, for each row and column of the tile: the most accurate in 16 bits.
`expanded` multiplies out to a quadratic polynomial: one matrix product, but large terms cancel.

Shapes: S blocks of K list entries in tables, B of them at a time; P pixels of a tile, T x T of them, row by row.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from gsx.core.shapes import Float


@dataclass(frozen=True, kw_only=True)
class Exponent:
    """One of the three forms. `kept` is what its evaluation leaves for its gradients."""

    rows: Callable[[Tensor, Tensor, Tensor], Tensor]
    """(offset of the mean from the tile's centre [S, K, 2], factor [S, K, 3], ln o [S, K]) -> rows [S, K, V]."""
    basis: Callable[[Tensor], Tensor]
    """(x, y, 1) at the pixels [3, P] -> what the rows are multiplied with."""
    log_alphas: Callable[[Tensor, Tensor], tuple[Tensor, tuple[Tensor, ...]]]
    """(rows [B, K, V], basis) -> ln alpha [B, K, P] in the dtype of the basis, and `kept`."""
    gradient: Callable[[Tensor, tuple[Tensor, ...], Tensor, Tensor], Tensor]
    """(slope [B, K, P], kept, rows, basis) -> gradient [B, K, 6] of the numbers that `by_splat` takes."""
    absolute: Callable[[Tensor, tuple[Tensor, ...], Tensor, Tensor], Tensor]
    """(slope, kept, rows, basis) -> sum over pixels of |gradient of the mean| in px, per axis [B, K, 2]."""
    by_splat: Callable[[Tensor, Tensor, Tensor], Tensor]
    """(that gradient [S, K, 6], rows, offsets) -> gradient of (mean x, mean y, u0, u1, u2, ln o) [S, K, 6]."""


# -- two affine squares --------------------------------------------------------------------------------------------


def squares_rows(
    offsets: Float[Tensor, "S K 2"], conic_factors: Float[Tensor, "S K 3"], log_opacities: Float[Tensor, "S K"]
) -> Float[Tensor, "S K 7"]:
    """(u0, u1, k0, 0, u2, k1, ln o)."""
    u0, u1, u2 = conic_factors.unbind(-1)
    x, y = offsets.unbind(-1)
    return torch.stack([u0, u1, -(u0 * x + u1 * y), torch.zeros_like(u0), u2, -u2 * y, log_opacities], -1)


def squares_log_alphas(
    rows: Float[Tensor, "B K 7"], basis: Float[Tensor, "3 P"]
) -> tuple[Float[Tensor, "B K P"], tuple[Tensor, ...]]:
    """ln o - s^2 - r^2, keeping s and r."""
    rows = rows.to(basis.dtype)
    flat = rows.view(-1, 7)
    shape = (*rows.shape[:2], basis.shape[1])
    s, r = (flat[:, :3] @ basis).view(shape), (flat[:, 4:6] @ basis[1:]).view(shape)
    return torch.addcmul(rows[:, :, 6:], s, s, value=-1).addcmul_(r, r, value=-1), (s, r)


def squares_gradient(
    slope: Float[Tensor, "B K P"], kept: tuple[Tensor, ...], rows: Float[Tensor, "B K 7"], basis: Float[Tensor, "3 P"]
) -> Float[Tensor, "B K 6"]:
    """Gradient of (u0, u1, k0, u2, k1, ln o): d/ds = -2 s slope, d/dr = -2 r slope."""
    s, r = kept
    flat, columns = (-1, slope.shape[2]), -2 * basis.T.to(slope.dtype)
    by_s = (slope * s).view(flat) @ columns
    by_r = (slope * r).view(flat) @ columns[:, 1:]
    parts = torch.cat([by_s, by_r, slope.view(flat).sum(1, keepdim=True)], 1)
    return parts.view(*slope.shape[:2], 6)


def squares_absolute(
    slope: Float[Tensor, "B K P"], kept: tuple[Tensor, ...], rows: Float[Tensor, "B K 7"], basis: Float[Tensor, "3 P"]
) -> Float[Tensor, "B K 2"]:
    """s and r fall by (u0, u1) and (0, u2) per pixel of mean."""
    s, r = kept
    u0, u1, u2 = rows[:, :, 0, None], rows[:, :, 1, None], rows[:, :, 4, None]
    by_x = 2 * (slope * s * u0).abs_().sum(2)
    by_y = 2 * (slope * (s * u1 + r * u2)).abs_().sum(2)
    return torch.stack([by_x, by_y], 2)


def squares_by_splat(
    gradient: Float[Tensor, "S K 6"], rows: Float[Tensor, "S K 7"], offsets: Float[Tensor, "S K 2"]
) -> Float[Tensor, "S K 6"]:
    """Through k0 = -(u0 x + u1 y) and k1 = -u2 y."""
    by_u0, by_u1, by_k0, by_u2, by_k1, by_opacity = gradient.unbind(-1)
    x, y = offsets.unbind(-1)
    u0, u1, u2 = rows[..., 0], rows[..., 1], rows[..., 4]
    by_mean = [-u0 * by_k0, -u1 * by_k0 - u2 * by_k1]
    return torch.stack([*by_mean, by_u0 - x * by_k0, by_u1 - y * by_k0, by_u2 - y * by_k1, by_opacity], -1)


# -- offsets to the mean -------------------------------------------------------------------------------------------


def direct_rows(
    offsets: Float[Tensor, "S K 2"], conic_factors: Float[Tensor, "S K 3"], log_opacities: Float[Tensor, "S K"]
) -> Float[Tensor, "S K 6"]:
    """(mean x, mean y, u0, u1, u2, ln o)."""
    return torch.cat([offsets, conic_factors, log_opacities[..., None]], -1)


def direct_log_alphas(
    rows: Float[Tensor, "B K 6"], basis: Float[Tensor, "3 P"]
) -> tuple[Float[Tensor, "B K P"], tuple[Tensor, ...]]:
    """(ln o - r^2) - s^2, where r belongs to a row of pixels; all but the last sum and square in the rows' dtype.

    Keeps s at pixels, dx at columns, dy and r at rows.
    """
    side = math.isqrt(basis.shape[1])
    axis = basis[0, :side]  # of the columns, and as well of the rows: tiles are square and centred
    x, y, u0, u1, u2, log_opacity = rows[..., None].unbind(2)
    dx, dy = axis - x, axis - y
    r = u2 * dy
    s = (u0 * dx).to(basis.dtype)[:, :, None, :] + (u1 * dy).to(basis.dtype)[:, :, :, None]
    row = (log_opacity - r * r).to(basis.dtype)[..., None]
    return torch.addcmul(row, s, s, value=-1).flatten(2), (s.flatten(2), dx, dy, r)


def direct_gradient(
    slope: Float[Tensor, "B K P"], kept: tuple[Tensor, ...], rows: Float[Tensor, "B K 6"], basis: Float[Tensor, "3 P"]
) -> Float[Tensor, "B K 6"]:
    """Gradient of (mean x, mean y, u0, u1, u2, ln o), from sums over columns and rows of pixels."""
    s, dx, dy, r = kept
    tile = (*slope.shape[:2], dy.shape[2], dx.shape[2])
    by_s = -2 * (slope * s).view(tile)
    by_column, by_row = by_s.sum(2), by_s.sum(3)
    by_r, total = -2 * slope.view(tile).sum(3) * r, by_row.sum(2)
    u0, u1, u2 = rows[:, :, 2:5].unbind(2)
    by_mean = [-u0 * total, -u1 * total - u2 * by_r.sum(2)]
    by_factor = [(by_column * dx).sum(2), (by_row * dy).sum(2), (by_r * dy).sum(2)]
    return torch.stack([*by_mean, *by_factor, slope.sum(2)], 2)


def direct_absolute(
    slope: Float[Tensor, "B K P"], kept: tuple[Tensor, ...], rows: Float[Tensor, "B K 6"], basis: Float[Tensor, "3 P"]
) -> Float[Tensor, "B K 2"]:
    """As with squares; r is the same at all pixels of a row."""
    s, dx, _, r = kept
    u0, u1, u2 = rows[:, :, 2:5, None].unbind(2)
    by_x = 2 * (slope * s * u0).abs_().sum(2)
    by_y = 2 * (slope * (s * u1 + (r * u2).repeat_interleave(dx.shape[2], 2))).abs_().sum(2)
    return torch.stack([by_x, by_y], 2)


# -- the polynomial ------------------------------------------------------------------------------------------------


def expanded_rows(
    offsets: Float[Tensor, "S K 2"], conic_factors: Float[Tensor, "S K 3"], log_opacities: Float[Tensor, "S K"]
) -> Float[Tensor, "S K 9"]:
    """Coefficients of (1, x, y, x^2, xy, y^2), then (u0, u1, u2)."""
    u0, u1, u2 = conic_factors.unbind(-1)
    x, y = offsets.unbind(-1)
    k0, k1 = -(u0 * x + u1 * y), -u2 * y
    constant, by_x, by_y = log_opacities - k0 * k0 - k1 * k1, -2 * u0 * k0, -2 * (u1 * k0 + u2 * k1)
    return torch.stack([constant, by_x, by_y, -u0 * u0, -2 * u0 * u1, -(u1 * u1 + u2 * u2), u0, u1, u2], -1)


def monomials(basis: Float[Tensor, "3 P"]) -> Float[Tensor, "6 P"]:
    """1, x, y, x^2, xy, y^2."""
    x, y, one = basis
    return torch.stack([one, x, y, x * x, x * y, y * y])


def expanded_log_alphas(
    rows: Float[Tensor, "B K 9"], basis: Float[Tensor, "6 P"]
) -> tuple[Float[Tensor, "B K P"], tuple[Tensor, ...]]:
    """The polynomial, held at 0: rounding alone can lift it above."""
    flat = rows.view(-1, 9)[:, :6].to(basis.dtype)
    return (flat @ basis).view(*rows.shape[:2], basis.shape[1]).clamp_(max=0.0), ()


def expanded_gradient(
    slope: Float[Tensor, "B K P"], kept: tuple[Tensor, ...], rows: Float[Tensor, "B K 9"], basis: Float[Tensor, "6 P"]
) -> Float[Tensor, "B K 6"]:
    """Gradient of the coefficients."""
    return (slope.view(-1, slope.shape[2]) @ basis.T.to(slope.dtype)).view(*slope.shape[:2], 6)


def expanded_absolute(
    slope: Float[Tensor, "B K P"], kept: tuple[Tensor, ...], rows: Float[Tensor, "B K 9"], basis: Float[Tensor, "6 P"]
) -> Float[Tensor, "B K 2"]:
    """The gradient of the mean is minus that of the pixel: (c_x + 2 c_xx x + c_xy y, c_y + c_xy x + 2 c_yy y)."""
    _, c_x, c_y, c_xx, c_xy, c_yy = rows[:, :, :6].unbind(2)
    planes = torch.stack([c_x, 2 * c_xx, c_xy, c_y, c_xy, 2 * c_yy], 2).view(*c_x.shape, 2, 3).to(basis.dtype)
    by_x, by_y = (planes @ basis[:3]).unbind(2)
    return torch.stack([(slope * by_x).abs_().sum(2), (slope * by_y).abs_().sum(2)], 2)


def expanded_by_splat(
    gradient: Float[Tensor, "S K 6"], rows: Float[Tensor, "S K 9"], offsets: Float[Tensor, "S K 2"]
) -> Float[Tensor, "S K 6"]:
    """Through ln alpha = ln o - a dx^2 - 2 b dx dy - c dy^2 with (a, b, c) = (u0^2, u0 u1, u1^2 + u2^2)."""
    g, g_x, g_y, g_xx, g_xy, g_yy = gradient.unbind(-1)
    x, y = offsets.unbind(-1)
    u0, u1, u2 = rows[..., 6:].unbind(-1)
    a, b, c = u0 * u0, u0 * u1, u1 * u1 + u2 * u2
    by_a = -(g_xx - 2 * x * g_x + x * x * g)
    by_b = -2 * (g_xy - y * g_x - x * g_y + x * y * g)
    by_c = -(g_yy - 2 * y * g_y + y * y * g)
    about_x, about_y = g_x - x * g, g_y - y * g
    by_mean = [2 * (a * about_x + b * about_y), 2 * (b * about_x + c * about_y)]
    by_factor = [2 * u0 * by_a + u1 * by_b, u0 * by_b + 2 * u1 * by_c, 2 * u2 * by_c]
    return torch.stack([*by_mean, *by_factor, g], -1)


EXPONENTS = {
    "squares": Exponent(
        rows=squares_rows,
        basis=lambda basis: basis,
        log_alphas=squares_log_alphas,
        gradient=squares_gradient,
        absolute=squares_absolute,
        by_splat=squares_by_splat,
    ),
    "direct": Exponent(
        rows=direct_rows,
        basis=lambda basis: basis,
        log_alphas=direct_log_alphas,
        gradient=direct_gradient,
        absolute=direct_absolute,
        by_splat=lambda gradient, rows, offsets: gradient,
    ),
    "expanded": Exponent(
        rows=expanded_rows,
        basis=monomials,
        log_alphas=expanded_log_alphas,
        gradient=expanded_gradient,
        absolute=expanded_absolute,
        by_splat=expanded_by_splat,
    ),
}
