"""Projection of Gaussians through a lens by the unscented transform (3DGUT, Wu et al. 2025, section 3.2).

Seven sigma points, the mean and two on each axis, go through the lens; their images give mean and covariance on the
screen. In half differences d and half second differences e of each pair, the covariance is

    sum (d d^T + e e^T) / c^2 + (beta - alpha^2) m m^T,  m = sum e / c^2,  c^2 = alpha^2 (3 + kappa),

a sum of squares without the transform's large weights of both signs (docs/explanation/numerics.md). Both kernels take
the lens as a tensor, so that compiled code serves all lenses of one form.
"""

import math

import torch
from torch import Tensor

from gsx.core.rasterizer.geometry import Columns, plus, rotate_back, scaled, shape_of, unit
from gsx.core.shapes import Bool, Float
from gsx.lenses.distortion import Coefficients, Form, bent, in_view

ALPHA, BETA, KAPPA = 0.1, 2.0, 0.0
"""gsplat 1.5 (UnscentedTransformParameters). 3DGUT's alpha is 1, whose points on the axes of large splats pass behind
the camera."""
REACH = ALPHA * math.sqrt(3 + KAPPA)
"""Distance of sigma points from the mean, standard deviations."""
OUTSIDE = 2.0
"""Largest distance of a projected mean from the frame's middle, by that of the bounds of its slopes."""


def select_through_lens(
    points: Float[Tensor, "N 3"],
    scales: Float[Tensor, "N 3"],
    quats: Float[Tensor, "N 4"],
    rotation: Float[Tensor, "3 3"],
    low: Float[Tensor, "2"],
    high: Float[Tensor, "2"],
    numbers: Float[Tensor, "16"],
    form: Form,
) -> Bool[Tensor, "N"]:
    """Marks Gaussians whose sigma points the lens shows, with a mean within `OUTSIDE` of the frame.

    `low`, `high`: bounds of distorted slopes on the frame.
    """
    lens = Coefficients.of(numbers)
    marked = torch.ones_like(points[:, 0], dtype=torch.bool)
    for point in sigma_points(points, scales, quats, rotation):
        marked = marked & in_view(lens, *point)
    for slope, least, most in zip(bent(lens, form, *points.unbind(1)), low, high, strict=True):
        marked = marked & ((slope - (least + most) / 2).abs() <= OUTSIDE * (most - least) / 2)
    return marked


def project_through_lens(
    points: Float[Tensor, "M 3"],
    scales: Float[Tensor, "M 3"],
    quats: Float[Tensor, "M 4"],
    rotation: Float[Tensor, "3 3"],
    intrinsics: Float[Tensor, "4"],
    dilation: Float[Tensor, "1"],
    compensate: bool,
    drawn: Float[Tensor, "1"] | None,
    numbers: Float[Tensor, "16"],
    form: Form,
) -> tuple[Float[Tensor, "M 2"], Float[Tensor, "M 3"], Float[Tensor, "M 3"], Float[Tensor, "M"] | None]:
    """Projects Gaussians (`gsx.core.rasterizer.geometry.geometry`); computed in float64, as positions there."""
    lens = Coefficients.of(numbers)
    stacked = (torch.stack(parts) for parts in zip(*sigma_points(points, scales, quats, rotation), strict=True))
    images = [side.unbind() for side in bent(lens, form, *stacked)]
    fx, fy, cx, cy = intrinsics
    means, rows = [], []
    for focal, centre, slopes in zip((fx, fy), (cx, cy), images, strict=True):
        mean, row = moments(slopes)
        means.append(mean * focal + centre)
        rows.append(tuple((focal * part).to(scales) for part in row))
    return torch.stack(means, 1).to(scales), *shape_of(rows[0], rows[1], dilation, compensate, drawn)


def sigma_points(
    points: Float[Tensor, "M 3"],
    scales: Float[Tensor, "M 3"],
    quats: Float[Tensor, "M 4"],
    rotation: Float[Tensor, "3 3"],
) -> list[Columns]:
    """Returns the sigma points of Gaussians: the mean, three on one side of it, three on the other."""
    turn, sizes = unit(quats), scales.unbind(1)
    rows = [scaled(rotate_back(turn, row.unbind()), sizes) for row in rotation]
    axes = [tuple(part.double() for part in axis) for axis in zip(*rows, strict=True)]
    middle = points.unbind(1)
    return [middle, *(plus(middle, side * REACH, axis) for side in (1, -1) for axis in axes)]


def moments(images: Columns) -> tuple[Float[Tensor, "M"], Columns]:
    """Returns means along x or y of images of sigma points, and rows whose products are the covariance."""
    middle, before, after = images[0], images[1:4], images[4:]
    first = [(a - b) / (2 * REACH) for a, b in zip(before, after, strict=True)]
    second = [((a + b) / 2 - middle) / REACH for a, b in zip(before, after, strict=True)]
    shift = (second[0] + second[1] + second[2]) / REACH
    return middle + shift, (*first, *second, math.sqrt(BETA - ALPHA**2) * shift)
