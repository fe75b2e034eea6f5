"""Which pixels of a pseudo view count: those no photograph shows better, those that agree with what is known."""

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from gsx.core.camera import Camera
from gsx.core.rasterizer import RasterSettings, rasterize
from gsx.core.regenerator import as_blocks, box_average
from gsx.core.shapes import Float, UInt8
from gsx.core.splats import Splats

BETTER, SOFTNESS = 1.1, 0.05
"""SplatSuRe (2512.02172): a region counts from 1.1 times the sampling of the best photograph on, over a soft edge."""


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
    """1 where a camera sees surfaces more finely than every photograph does, 0 where it does not; blended like colour.

    Occlusion is left aside: a photograph counts for what lies in its field of view. Unseen by all counts as 1.
    """
    means = splats.means.detach()
    own, best = camera.fx / camera.project(means)[1].clamp_min(camera.near), best_densities(means, photographs)
    ratio = torch.where(best > 0, own / best.clamp_min(1e-30), torch.inf)
    score = torch.sigmoid((ratio - BETTER) / SOFTNESS)
    counted = replace(splats, colours=score[:, None].expand(-1, 3).contiguous())
    return rasterize(counted, camera, raster).image[0].clamp(0, 1)


def agreeing(
    result: Float[Tensor, "3 H W"], given: Float[Tensor, "3 h w"], scale: int, levels: float
) -> Float[Tensor, "H W"]:
    """1 where the result, box-averaged, is within `levels` of 255 of what it was made from in all channels, else 0."""
    off = (box_average(result.clamp(0, 1), scale) - given).abs().amax(0) * 255
    return as_blocks((off <= levels).float(), scale)


def in_bytes(trust: Float[Tensor, "h w"]) -> UInt8[Tensor, "h w"]:
    """Weights from 0 to 1 as 0 to 255."""
    return (trust * 255 + 0.5).clamp(0, 255).to(torch.uint8)
