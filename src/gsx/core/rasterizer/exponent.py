"""ln alpha at the pixels of a tile, and its gradient (docs/explanation/numerics.md).

Half the inverse covariance is U^T U with U = [[u0, u1], [0, u2]], so with d = pixel - mean

    ln alpha = ln o - s^2 - r^2,    s = u0 dx + u1 dy,    r = u2 dy.

s and r are affine functions of tile-centred pixel coordinates: two matrix products, and ln alpha never exceeds ln o.

Shapes: S blocks of K list entries in tables, B of them at a time; P pixels of a tile, T x T of them, row by row.
"""

import torch
from torch import Tensor

from gsx.core.shapes import Float


def exponent_rows(
    offsets: Float[Tensor, "S K 2"], conic_factors: Float[Tensor, "S K 3"], log_opacities: Float[Tensor, "S K"]
) -> Float[Tensor, "S K 7"]:
    """Returns (u0, u1, k0, 0, u2, k1, ln o), where s = u0 x + u1 y + k0 and r = u2 y + k1; `offsets`: mean, px."""
    u0, u1, u2 = conic_factors.unbind(-1)
    x, y = offsets.unbind(-1)
    return torch.stack([u0, u1, -(u0 * x + u1 * y), torch.zeros_like(u0), u2, -u2 * y, log_opacities], -1)


def log_alphas(
    rows: Float[Tensor, "B K 7"], basis: Float[Tensor, "3 P"]
) -> tuple[Float[Tensor, "B K P"], tuple[Tensor, Tensor]]:
    """Returns ln alpha in the dtype of `basis`, (x, y, 1) at the pixels, and (s, r) for the gradients."""
    rows = rows.to(basis.dtype)
    flat = rows.view(-1, 7)
    shape = (*rows.shape[:2], basis.shape[1])
    s, r = (flat[:, :3] @ basis).view(shape), (flat[:, 4:6] @ basis[1:]).view(shape)
    return torch.addcmul(rows[:, :, 6:], s, s, value=-1).addcmul_(r, r, value=-1), (s, r)


def row_gradient(
    slope: Float[Tensor, "B K P"], kept: tuple[Tensor, Tensor], basis: Float[Tensor, "3 P"]
) -> Float[Tensor, "B K 6"]:
    """Returns the gradient of (u0, u1, k0, u2, k1, ln o): d/ds = -2 s slope, d/dr = -2 r slope."""
    s, r = kept
    flat, columns = (-1, slope.shape[2]), -2 * basis.T.to(slope.dtype)
    by_s = (slope * s).view(flat) @ columns
    by_r = (slope * r).view(flat) @ columns[:, 1:]
    parts = torch.cat([by_s, by_r, slope.view(flat).sum(1, keepdim=True)], 1)
    return parts.view(*slope.shape[:2], 6)


def absolute_gradient(
    slope: Float[Tensor, "B K P"], kept: tuple[Tensor, Tensor], rows: Float[Tensor, "B K 7"]
) -> Float[Tensor, "B K 2"]:
    """Sums |gradient of the mean| over pixels, per axis: s and r fall by (u0, u1) and (0, u2) per pixel of mean."""
    s, r = kept
    u0, u1, u2 = rows[:, :, 0, None], rows[:, :, 1, None], rows[:, :, 4, None]
    by_x = 2 * (slope * s * u0).abs_().sum(2)
    by_y = 2 * (slope * (s * u1 + r * u2)).abs_().sum(2)
    return torch.stack([by_x, by_y], 2)


def gradient_by_splat(
    gradient: Float[Tensor, "S K 6"], rows: Float[Tensor, "S K 7"], offsets: Float[Tensor, "S K 2"]
) -> Float[Tensor, "S K 6"]:
    """Returns the gradient of (mean x, mean y, u0, u1, u2, ln o), through k0 = -(u0 x + u1 y) and k1 = -u2 y."""
    by_u0, by_u1, by_k0, by_u2, by_k1, by_opacity = gradient.unbind(-1)
    x, y = offsets.unbind(-1)
    u0, u1, u2 = rows[..., 0], rows[..., 1], rows[..., 4]
    by_mean = [-u0 * by_k0, -u1 * by_k0 - u2 * by_k1]
    return torch.stack([*by_mean, by_u0 - x * by_k0, by_u1 - y * by_k0, by_u2 - y * by_k1, by_opacity], -1)
