"""Which Gaussians touch the picture at all, without drawing it."""

import torch
from torch import Tensor

from gsx.core.camera import Camera
from gsx.core.rasterizer.pairs import on_raster, published_radii, published_windows
from gsx.core.rasterizer.projection import drawable, project
from gsx.core.rasterizer.settings import RasterSettings
from gsx.core.shapes import Bool, Float
from gsx.core.splats import Splats


@torch.no_grad()
def touches(
    means: Float[Tensor, "N 3"],
    scales: Float[Tensor, "N 3"],
    quats: Float[Tensor, "N 4"],
    camera: Camera,
    settings: RasterSettings,
) -> Bool[Tensor, "N"]:
    """Gaussians in front of the camera whose published 3-sigma square's tiles touch its raster (spec 3.1).

    Those that have no such square, because something is out of range, are not held back either: the render counts them.
    """
    opaque = Splats(
        means=means, scales=scales, quats=quats, log_opacities=torch.zeros_like(means[:, 0]), colours=means[:, :0]
    )
    screen = project(opaque, camera, settings)
    first, last = published_windows(screen.means, published_radii(screen.covariances), camera.frame)
    mask = torch.zeros(len(means), dtype=torch.bool, device=means.device)
    mask.index_fill_(0, screen.ids[on_raster(first, last, camera)], True)
    return mask | ~drawable(opaque, camera, settings) if screen.dropped else mask
