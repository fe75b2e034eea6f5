"""Which pixels of a pseudo view count: those photographs do not show better, those that agree with what is known."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TypeAlias

import torch
from torch import Tensor

from gsx.core.data.camera import Camera
from gsx.core.data.reduction import Reduction, as_blocks
from gsx.core.gaussians.splats import Splats
from gsx.core.rasterizer import RasterSettings, rasterize, undilated_radii
from gsx.core.shapes import Float, Int, UInt8

WeightMap: TypeAlias = Callable[[Splats, Camera, Sequence[Camera], int, RasterSettings], Tensor]
"""(splats, camera of the pseudo view, cameras of the photographs, which of them it was made from, rules to draw by) ->
weights of pixels, [h, w]."""
BETTER, SOFTNESS = 1.1, 0.05
"""SplatSuRe (2512.02172): sampled 1.1 times as finely is finer, over a soft edge."""
LEAST_VIEWS = 3
"""SplatSuRe: of splats that fewer photographs see nothing is sure."""
LEAST_PEAK = 0.9
"""SplatSuRe: weights that reach less high anywhere in a photograph are stretched to [0, 1]."""


@torch.no_grad()
def splatsure(
    splats: Splats, camera: Camera, photographs: Sequence[Camera], number: int, raster: RasterSettings
) -> Float[Tensor, "h w"]:
    """SplatSuRe's weights (2512.02172): low where another photograph than this one shows a surface more finely, since
    it gives the detail; high in the one that shows it most finely, and where all show it alike or nothing is seen.

    Ours: drawn for the pseudo view itself instead of drawn for the photograph and enlarged.
    """
    score, finest = sampling_scores(splats, photographs, raster)
    own = (finest == number).to(score)
    whole = uncertain(score, own, splats, photographs[number], raster)
    return stretched(uncertain(score, own, splats, camera, raster), float(whole.min()), float(whole.max()))


def sampling_scores(
    splats: Splats, photographs: Sequence[Camera], raster: RasterSettings
) -> tuple[Float[Tensor, "N"], Int[Tensor, "N"]]:
    """(how sure it is that a photograph shows a splat's detail, which of them does so most finely) from its largest
    over its smallest radius on their screens; 0 for splats that fewer than three see, whose finest may be -1."""
    largest, smallest = torch.zeros_like(splats.scales[:, 0]), torch.full_like(splats.scales[:, 0], torch.inf)
    finest, views = torch.full_like(largest, -1, dtype=torch.long), torch.zeros_like(largest)
    for number, camera in enumerate(photographs):
        radii = undilated_radii(splats.means, splats.scales, splats.quats, camera, raster)
        seen = radii >= 0
        finest[radii > largest] = number
        largest, smallest = largest.maximum(radii), torch.where(seen, smallest.minimum(radii), smallest)
        views += seen
    score = torch.sigmoid((largest / smallest - BETTER) / SOFTNESS)
    return torch.where(views < LEAST_VIEWS, 0.0, score), finest


def uncertain(
    score: Float[Tensor, "N"], own: Float[Tensor, "N"], splats: Splats, camera: Camera, raster: RasterSettings
) -> Float[Tensor, "h w"]:
    """1 - the drawn score, + where splats are drawn that this photograph shows most finely."""
    return 1 + blended(own - score, splats, camera, raster)


def stretched(weights: Float[Tensor, "h w"], least: float, most: float) -> Float[Tensor, "h w"]:
    """In [0, 1]; from `least` to `most` of the whole picture where that does not reach high enough."""
    if least < most < LEAST_PEAK:
        weights = (weights - least) / (most - least)
    return weights.clamp(0, 1)


def blended(values: Float[Tensor, "N"], splats: Splats, camera: Camera, raster: RasterSettings) -> Float[Tensor, "h w"]:
    """Values of splats, drawn in place of their colours on black."""
    counted = replace(splats, colours=values[:, None].expand(-1, 3).contiguous())
    return rasterize(counted, camera, raster).image[0]


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
    splats: Splats, camera: Camera, photographs: Sequence[Camera], number: int, raster: RasterSettings
) -> Float[Tensor, "h w"]:
    """Ours: 1 where a camera sees surfaces more finely than every photograph does, 0 where it does not; blended like
    colour.

    Occlusion is left aside: a photograph counts for what lies in its field of view. Unseen by all counts as 1.
    """
    means = splats.means.detach()
    own, best = camera.fx / camera.project(means)[1].clamp_min(camera.near), best_densities(means, photographs)
    ratio = torch.where(best > 0, own / best.clamp_min(1e-30), torch.inf)
    score = torch.sigmoid((ratio - BETTER) / SOFTNESS)
    return blended(score, splats, camera, raster).clamp(0, 1)


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
