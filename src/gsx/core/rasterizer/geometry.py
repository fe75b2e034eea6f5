"""The differentiable mathematics of the projection, eager or compiled (docs/numerics.md; 3D-GS section 3.2)."""

import torch
from torch import Tensor

from gsx.core.shapes import Float


def rotate_back(quats: Float[Tensor, "M 4"], vectors: Float[Tensor, "M V 3"]) -> Float[Tensor, "M V 3"]:
    """R(q)^T v for quaternions (w, x, y, z) of any length; a zero quaternion is the identity."""
    # the largest part first: the square of a long quaternion would overflow. q / max(|q|, 1e-12) in the end
    largest = quats.detach().abs().amax(1, keepdim=True).clamp_min(1e-12)
    unit = torch.nn.functional.normalize(quats / largest, dim=1, eps=1.0)[:, None, :].expand(-1, vectors.shape[1], -1)
    w, axis = unit[..., :1], unit[..., 1:]
    twice_cross = 2 * torch.linalg.cross(axis, vectors)
    return vectors - w * twice_cross + torch.linalg.cross(axis, twice_cross)


def clamped_slopes(
    camera_points: Float[Tensor, "M 3"], low: Float[Tensor, "2"], high: Float[Tensor, "2"]
) -> tuple[Float[Tensor, "M"], Float[Tensor, "M"]]:
    """x/z and y/z, clamped to [low, high]."""
    x, y = (camera_points[:, :2] / camera_points[:, 2:]).clamp(low, high).unbind(1)
    return x, y


def screen_axes(
    camera_points: Float[Tensor, "M 3"],
    scales: Float[Tensor, "M 3"],
    quats: Float[Tensor, "M 4"],
    rotation: Float[Tensor, "3 3"],
    lens: Float[Tensor, "4"],
    low: Float[Tensor, "2"],
    high: Float[Tensor, "2"],
) -> Float[Tensor, "M 2 3"]:
    """Rows p, q of J W R diag(s), px; s is measured in px at the splat's depth first, so that nothing overflows."""
    slope_x, slope_y = clamped_slopes(camera_points, low, high)
    longest = lens[:2].detach().amax()
    stretch_x, stretch_y = (lens[:2] / longest).to(camera_points)
    row_x = stretch_x * (rotation[0] - slope_x[:, None] * rotation[2])
    row_y = stretch_y * (rotation[1] - slope_y[:, None] * rotation[2])
    sizes = scales * (longest.to(camera_points) / camera_points[:, 2:])
    return rotate_back(quats, torch.stack([row_x, row_y], 1)) * sizes[:, None, :]


def covariance_and_factor(
    axes: Float[Tensor, "M 2 3"], dilation: float
) -> tuple[Float[Tensor, "M 3"], Float[Tensor, "M 3"]]:
    """Dilated covariance (xx, xy, yy) = P P^T + d I and its factor U, where p, q are the rows of P.

    Its determinant is |p x q|^2 + d (|p|^2 + |q|^2) + d^2 by Lagrange's identity: no cancellation, never negative.
    """
    p, q = axes.unbind(1)
    pp, pq, qq = (p * p).sum(1), (p * q).sum(1), (q * q).sum(1)
    xx, yy = pp + dilation, qq + dilation
    area = torch.linalg.cross(p, q) * yy.rsqrt()[:, None]  # p x q / sqrt(yy)
    remainder = area.square().sum(1) + dilation * (pp / yy + 1)  # determinant / yy: squares of px, not fourth powers
    u0 = (2 * remainder).rsqrt()
    return torch.stack([xx, pq, yy], 1), torch.stack([u0, -pq / yy * u0, (2 * yy).rsqrt()], 1)


def geometry(
    points: Float[Tensor, "M 3"],
    scales: Float[Tensor, "M 3"],
    quats: Float[Tensor, "M 4"],
    rotation: Float[Tensor, "3 3"],
    lens: Float[Tensor, "4"],
    low: Float[Tensor, "2"],
    high: Float[Tensor, "2"],
    dilation: float,
) -> tuple[Float[Tensor, "M 2"], Float[Tensor, "M 3"], Float[Tensor, "M 3"]]:
    """Screen means (px of the frame), dilated covariances and factors of splats at `points` of the camera's frame.

    `points` and `lens` (fx, fy, cx, cy) are float64; `low` and `high` bound the slopes in the Jacobian.
    """
    means = points[:, :2] / points[:, 2:] * lens[:2] + lens[2:]
    axes = screen_axes(points.to(scales), scales, quats, rotation, lens, low, high)
    covariances, factors = covariance_and_factor(axes, dilation)
    return means.to(scales), covariances, factors
