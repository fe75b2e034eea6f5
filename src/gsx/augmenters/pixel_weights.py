"""Which pixels of a pseudo view count: those photographs do not show better, those that agree with what is known."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TypeAlias

import torch
from torch import Tensor

from gsx.core.data.camera import Camera
from gsx.core.data.reduction import Reduction, as_blocks
from gsx.core.gaussians.splats import Splats
from gsx.core.rasterizer import RasterSettings, rasterize, screen_radii
from gsx.core.shapes import Float, UInt8

WeightMap: TypeAlias = Callable[[Splats, Camera, Sequence[Camera], RasterSettings], Tensor]
"""(splats, camera of the pseudo view, cameras of the photographs, rules to draw by) -> weights of pixels, [h, w]."""
BETTER, SOFTNESS = 1.1, 0.05
"""SplatSuRe (2512.02172): sampled 1.1 times as finely is finer, over a soft edge."""


def sampling_ratios(splats: Splats, photographs: Sequence[Camera], raster: RasterSettings) -> Float[Tensor, "N"]:
    """Largest over smallest size of each splat on the screens of the cameras that see it, without dilation; 1 for those
    that at most one sees."""
    largest, smallest = torch.zeros_like(splats.scales[:, 0]), torch.full_like(splats.scales[:, 0], torch.inf)
    for camera in photographs:
        radii = screen_radii(splats.means, splats.scales, splats.quats, camera, raster)
        largest = largest.maximum(radii)
        smallest = torch.where(radii >= 0, smallest.minimum(radii), smallest)
    seen = torch.isfinite(smallest) & (largest > 0)
    return torch.where(seen, largest / smallest, 1.0)


@torch.no_grad()
def seen_alike(
    splats: Splats, camera: Camera, photographs: Sequence[Camera], raster: RasterSettings
) -> Float[Tensor, "h w"]:
    """SplatSuRe's weights: low where some photograph shows a surface more finely than another does, since
    it gives the detail; high where all show it alike; blended like colour.
    """
    score = torch.sigmoid((sampling_ratios(splats, photographs, raster) - BETTER) / SOFTNESS)
    return blended(1 - score, splats, camera, raster)


def blended(values: Float[Tensor, "N"], splats: Splats, camera: Camera, raster: RasterSettings) -> Float[Tensor, "h w"]:
    """Values of splats, drawn in place of their colours on black."""
    counted = replace(splats, colours=values[:, None].expand(-1, 3).contiguous())
    return rasterize(counted, camera, raster).image[0].clamp(0, 1)


def densities(points: Float[Tensor, "N 3"], camera: Camera) -> Float[Tensor, "N"]:
    """Pixels per scene unit at each point, facing the camera; 0 where it does not see the point."""
    places, depth = camera.project(points)
    inside = ((places >= 0) & (places < places.new_tensor([camera.width, camera.height]))).all(1)
    seen = (depth > camera.near) & inside
    return torch.where(seen, camera.fx / depth.clamp_min(camera.near), 0.0)


def best_densities(points: Float[Tensor, "N 3"], cameras: Sequence[Camera]) -> Float[Tensor, "N"]:
    """The most that any of the cameras has."""
    best = torch.zeros_like(points[:, 0])
    for camera in cameras:
        best = best.maximum(densities(points, camera))
    return best


@torch.no_grad()
def sampled_better(
    splats: Splats, camera: Camera, photographs: Sequence[Camera], raster: RasterSettings
) -> Float[Tensor, "h w"]:
    """Ours: 1 where a camera sees surfaces more finely than every photograph does, 0 where it does not; blended like
    colour.

    Occlusion is left aside: a photograph counts for what lies in its field of view. Unseen by all counts as 1.
    """
    means = splats.means.detach()
    own, best = camera.fx / camera.project(means)[1].clamp_min(camera.near), best_densities(means, photographs)
    ratio = torch.where(best > 0, own / best.clamp_min(1e-30), torch.inf)
    score = torch.sigmoid((ratio - BETTER) / SOFTNESS)
    return blended(score, splats, camera, raster)


def agreeing(
    result: Float[Tensor, "3 H W"], given: Float[Tensor, "3 h w"], scale: int, reduction: Reduction, levels: float
) -> Float[Tensor, "H W"]:
    """1 in blocks where the result, reduced, is within `levels` of 255 of what it was made from in all channels, else
    0."""
    off = (reduction.reduce(result.clamp(0, 1), scale) - given).abs().amax(0) * 255
    return as_blocks((off <= levels).float(), scale)


def in_bytes(weights: Float[Tensor, "h w"]) -> UInt8[Tensor, "h w"]:
    """Weights from 0 to 1 as 0 to 255."""
    return (weights * 255 + 0.5).clamp(0, 255).to(torch.uint8)
