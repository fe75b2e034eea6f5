"""Visibility and screen size of Gaussians, without a render."""

import torch
from torch import Tensor

from gsx.core.data.camera import Camera
from gsx.core.gaussians.splats import Splats
from gsx.core.rasterizer.intersections import boxes_of
from gsx.core.rasterizer.projection import ScreenSplats, drawable, project
from gsx.core.rasterizer.settings import RasterSettings
from gsx.core.shapes import Bool, Float


@torch.no_grad()
def touches(
    means: Float[Tensor, "N 3"],
    scales: Float[Tensor, "N 3"],
    quats: Float[Tensor, "N 4"],
    camera: Camera,
    settings: RasterSettings,
) -> Bool[Tensor, "N"]:
    """Marks Gaussians whose published 3-sigma square has tiles on the camera's raster (3D-GS, forward.cu).

    Gaussians with values out of range are marked as well; the render counts them.
    """
    opaque = without_colours(means, scales, quats)
    screen, on = on_screen(opaque, camera, settings)
    mask = torch.zeros(len(means), dtype=torch.bool, device=means.device)
    mask.index_copy_(0, screen.ids, on)
    return mask | ~drawable(opaque, camera, settings) if screen.dropped else mask


def without_colours(means: Float[Tensor, "N 3"], scales: Float[Tensor, "N 3"], quats: Float[Tensor, "N 4"]) -> Splats:
    """Returns opaque Gaussians without channels."""
    return Splats(
        means=means, scales=scales, quats=quats, log_opacities=torch.zeros_like(means[:, 0]), colours=means[:, :0]
    )


def on_screen(splats: Splats, camera: Camera, settings: RasterSettings) -> tuple[ScreenSplats, Bool[Tensor, "M"]]:
    """Returns splats near the raster, and marks those whose published square has tiles on it."""
    screen = project(splats, camera, settings)
    return screen, boxes_of(screen, camera, settings).radii > 0
