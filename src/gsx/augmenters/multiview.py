"""Trust in a picture by what neighbouring photographs show of the same places (ours)."""

from collections.abc import Sequence

import torch
from torch import Tensor
from torch.nn.functional import grid_sample

from gsx.augmenters.pixel_weights import Draw, blended
from gsx.core.data.camera import Camera
from gsx.core.data.scene import View
from gsx.core.rasterizer import RasterSettings
from gsx.core.shapes import Float

NEIGHBOURS = 4
"""Photographs that are looked at."""
FEWEST = 2
"""Of them must show a place."""
SAME_DEPTH = 0.02
"""Depths of one surface may differ by this share of their sum."""
COVERED = 0.9
"""Alpha from which on a depth is one."""
SCATTER = 0.03
"""Difference of display values at which trust has fallen to 1/e."""


@torch.no_grad()
def agreement_of_neighbours(
    drawn: Draw, camera: Camera, known: Float[Tensor, "3 h w"], views: Sequence[View], own: int, raster: RasterSettings
) -> Float[Tensor, "h w"]:
    """exp(-median |difference| / SCATTER) between the known pixels of a camera and what neighbouring photographs show
    at the places that the model has there; 0 where fewer than two of them see those."""
    depth, alpha = depth_of(drawn, camera, raster)
    points, values = unprojected(depth, camera), known.flatten(1)
    others = nearest_views(camera, views, own)
    off = torch.stack([differences(drawn, view, points, values, raster) for view in others])
    enough = (off.isfinite().sum(0) >= FEWEST) & (alpha.flatten() > COVERED)
    return torch.where(enough, torch.exp(-off.nanmedian(0).values / SCATTER), 0.0).view_as(depth)


def nearest_views(camera: Camera, views: Sequence[View], own: int) -> list[View]:
    """Photographs beside number `own`, those first whose cameras are near and look the same way."""

    def unlike(view: View) -> float:
        turned = 1 - float(view.camera.rotation[2] @ camera.rotation[2])
        return float((view.camera.centre - camera.centre).norm()) * (1 + 10 * turned)

    return sorted((view for number, view in enumerate(views) if number != own), key=unlike)[:NEIGHBOURS]


def depth_of(drawn: Draw, camera: Camera, raster: RasterSettings) -> tuple[Float[Tensor, "h w"], Float[Tensor, "h w"]]:
    """(mean depth in scene units, alpha) of what a camera sees."""
    splats = drawn(camera)
    depths = camera.to_camera(splats.means)[:, 2].to(splats.means)
    alpha = blended(torch.ones_like(depths), splats, camera, raster)
    return blended(depths, splats, camera, raster) / alpha.clamp_min(1e-6), alpha


def unprojected(depth: Float[Tensor, "h w"], camera: Camera) -> Float[Tensor, "P 3"]:
    """World points at the middles of pixels, row by row."""
    height, width = depth.shape
    row, column = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    rays = torch.stack([(column - camera.cx) / camera.fx, (row - camera.cy) / camera.fy, torch.ones_like(row)], -1)
    local = (rays.to(depth) * depth[..., None]).view(-1, 3).double()
    return ((local - camera.translation.to(local)) @ camera.rotation.to(local)).to(depth)


def differences(
    drawn: Draw, view: View, points: Float[Tensor, "P 3"], values: Float[Tensor, "3 P"], raster: RasterSettings
) -> Float[Tensor, "P"]:
    """Mean |difference| of values at points from what a photograph shows there; nan where it does not see them."""
    places, depth = view.camera.project(points)
    seen, cover = sampled(torch.stack(depth_of(drawn, view.camera, raster)), places)
    inside = ((places >= 0.5) & (places <= places.new_tensor(view.camera.size) - 0.5)).all(1)
    same = (seen - depth).abs() <= SAME_DEPTH * (seen + depth)
    off = (sampled(view.image().to(values), places) - values).abs().mean(0)
    return torch.where(inside & same & (cover > COVERED), off, torch.nan)


def sampled(image: Float[Tensor, "C h w"], places: Float[Tensor, "P 2"]) -> Float[Tensor, "C P"]:
    """Bicubic values at pixel positions."""
    grid = places / places.new_tensor(image.shape[:0:-1]) * 2 - 1
    return grid_sample(image[None], grid[None, None], "bicubic", "border", align_corners=False)[0, :, 0]
