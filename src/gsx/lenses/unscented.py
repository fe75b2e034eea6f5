"""Projection of Gaussians through a lens by the unscented transform (3DGUT, Wu et al. 2025, section 3.2).

Seven sigma points, the mean and two on each axis, go through the lens; their images give mean and covariance on the
screen. In half differences d and half second differences e of each pair, the covariance is

    sum (d d^T + e e^T) / c^2 + (beta - alpha^2) m m^T,  m = sum e / c^2,  c^2 = alpha^2 (3 + kappa),

a sum of squares without the transform's large weights of both signs (docs/explanation/numerics.md).
"""

import math

import torch
from torch import Tensor

from gsx.core.rasterizer.geometry import Columns, rotate_back, shape_of, unit
from gsx.core.shapes import Bool, Float

ALPHA, BETA, KAPPA = 0.1, 2.0, 0.0
"""gsplat 1.5 (UnscentedTransformParameters). 3DGUT's alpha is 1, whose points on the axes of large splats pass behind
the camera."""
REACH = ALPHA * math.sqrt(3 + KAPPA)
"""Distance of sigma points from the mean, standard deviations."""
OUTSIDE = 2.0
"""Largest distance of a projected mean from the frame's middle, by that of the bounds of its slopes."""


class Unscented:
    """Lens that projects Gaussians by its `bend`."""

    def bend(self, points: Float[Tensor, "P 3"]) -> Float[Tensor, "P 2"]:
        """Return distorted slopes of points in camera coordinates; NaN where the lens shows none."""
        raise NotImplementedError

    @torch.no_grad()
    def visible(
        self,
        points: Float[Tensor, "N 3"],
        scales: Float[Tensor, "N 3"],
        quats: Float[Tensor, "N 4"],
        rotation: Float[Tensor, "3 3"],
        low: Float[Tensor, "2"],
        high: Float[Tensor, "2"],
    ) -> Bool[Tensor, "N"]:
        """Mark Gaussians whose sigma points the lens shows, with a mean within `OUTSIDE` of the frame."""
        middle, half = (low + high) / 2, (high - low) / 2
        near = ((self.bend(points) - middle).abs() <= OUTSIDE * half).all(1)  # false for NaN
        rows = near.nonzero()[:, 0]
        images = self.images(points[rows], scales[rows], quats[rows], rotation)
        return near.index_put((rows,), images.isfinite().all(2).all(0))

    def geometry(
        self,
        points: Float[Tensor, "M 3"],
        scales: Float[Tensor, "M 3"],
        quats: Float[Tensor, "M 4"],
        rotation: Float[Tensor, "3 3"],
        intrinsics: Float[Tensor, "4"],
        low: Float[Tensor, "2"],
        high: Float[Tensor, "2"],
        dilation: Float[Tensor, "1"],
        compensate: bool,
        drawn: Float[Tensor, "1"] | None = None,
    ) -> tuple[Float[Tensor, "M 2"], Float[Tensor, "M 3"], Float[Tensor, "M 3"], Float[Tensor, "M"] | None]:
        """Project Gaussians (`gsx.core.rasterizer.geometry.geometry`); computed in float64, as positions there."""
        focal, centre = intrinsics[:2], intrinsics[2:]
        mean, across, down = moments(self.images(points, scales, quats, rotation))
        p, q = (tuple((f * part).to(scales) for part in row) for f, row in zip(focal, (across, down), strict=True))
        return (mean * focal + centre).to(scales), *shape_of(p, q, dilation, compensate, drawn)

    def images(
        self,
        points: Float[Tensor, "M 3"],
        scales: Float[Tensor, "M 3"],
        quats: Float[Tensor, "M 4"],
        rotation: Float[Tensor, "3 3"],
    ) -> Float[Tensor, "7 M 2"]:
        """Return distorted slopes of the sigma points: the mean, three on one side of it, three on the other."""
        steps = REACH * axes_of(scales, quats, rotation).double()
        sigma = torch.cat([points[None], points + steps, points - steps])
        return self.bend(sigma.flatten(0, 1)).view(7, -1, 2)


def axes_of(
    scales: Float[Tensor, "M 3"], quats: Float[Tensor, "M 4"], rotation: Float[Tensor, "3 3"]
) -> Float[Tensor, "3 M 3"]:
    """Return the three axes of each Gaussian in camera coordinates, one standard deviation long."""
    rows = [torch.stack(rotate_back(unit(quats), row.unbind())) for row in rotation]
    return torch.stack(rows, 2) * scales.T[:, :, None]


def moments(images: Float[Tensor, "7 M 2"]) -> tuple[Float[Tensor, "M 2"], Columns, Columns]:
    """Return means, and the rows p, q with the covariance p.p, p.q, q.q, of images of sigma points."""
    middle, before, after = images[0], images[1:4], images[4:]
    first, second = (before - after) / (2 * REACH), ((before + after) / 2 - middle) / REACH
    shift = second.sum(0) / REACH
    columns = torch.cat([first, second, math.sqrt(BETA - ALPHA**2) * shift[None]])
    return middle + shift, columns[..., 0].unbind(), columns[..., 1].unbind()
