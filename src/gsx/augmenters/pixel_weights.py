"""Which pixels of a pseudo view count: those photographs do not show better, those that agree with what is known."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TypeAlias

import torch
from torch import Tensor

from gsx.core.data.camera import Camera
from gsx.core.data.reduction import Reduction, as_blocks
from gsx.core.gaussians.splats import Splats
from gsx.core.rasterizer import RasterSettings, on_screen, rasterize, without_colours
from gsx.core.rasterizer.boxes import three_sigma
from gsx.core.shapes import Float, Int, UInt8

Draw: TypeAlias = Callable[[Camera], Splats]
"""The splats of a camera."""
WeightMap: TypeAlias = Callable[[Draw, Camera, Sequence[Camera], int, RasterSettings], Tensor]
"""(the model, camera of the pseudo view, cameras of the photographs, which of them it was made from, rules to draw by)
-> weights of pixels, [h, w]."""
BETTER, SOFTNESS = 1.1, 0.05
"""SplatSuRe (2512.02172): sampled 1.1 times as finely is finer, over a soft edge."""
LEAST_VIEWS = 3
"""SplatSuRe: of splats that fewer photographs see nothing is sure."""
LEAST_PEAK = 0.9
"""SplatSuRe: weights that stay below it in a whole photograph are min-max normalised."""


@torch.no_grad()
def splatsure(
    drawn: Draw, camera: Camera, photographs: Sequence[Camera], number: int, raster: RasterSettings
) -> Float[Tensor, "h w"]:
    """SplatSuRe's weights (2512.02172): low where another photograph than this one shows a surface more finely, since
    it gives the detail; high in the one that shows it most finely, and where all show it alike or nothing is seen.

    Ours: drawn for the pseudo view itself instead of drawn for the photograph and enlarged.
    """
    own, whole = (
        unscaled_weights(drawn(one), one, photographs, number, raster) for one in (camera, photographs[number])
    )
    return normalised(own, float(whole.min()), float(whole.max()))


def unscaled_weights(
    splats: Splats, camera: Camera, photographs: Sequence[Camera], number: int, raster: RasterSettings
) -> Float[Tensor, "h w"]:
    """1 - the drawn score, + 1 where splats are drawn that photograph `number` shows most finely."""
    score, finest = sampling_scores(splats, photographs, raster)
    return 1 + blended((finest == number).to(score) - score, splats, camera, raster)


def normalised(weights: Float[Tensor, "h w"], least: float, most: float) -> Float[Tensor, "h w"]:
    """Weights in [0, 1]; from `least` to `most` of the whole photograph where its `most` is below LEAST_PEAK."""
    if least < most < LEAST_PEAK:
        weights = (weights - least) / (most - least)
    return weights.clamp(0, 1)


def sampling_scores(
    splats: Splats, photographs: Sequence[Camera], raster: RasterSettings
) -> tuple[Float[Tensor, "N"], Int[Tensor, "N"]]:
    """(score of each splat: near 1 where some photograph shows it more finely than another, 0 below three that see it;
    number of the photograph that shows it most finely, -1 for none) from largest and smallest radius on the screens."""
    largest, smallest = torch.zeros_like(splats.scales[:, 0]), torch.full_like(splats.scales[:, 0], torch.inf)
    finest, views = torch.full_like(largest, -1, dtype=torch.long), torch.zeros_like(largest)
    for number, camera in enumerate(photographs):
        radii = undilated_radii(splats.means, splats.scales, splats.quats, camera, raster)
        visible = radii >= 0
        finest[radii > largest] = number
        largest, smallest = largest.maximum(radii), torch.where(visible, smallest.minimum(radii), smallest)
        views += visible
    score = torch.sigmoid((largest / smallest - BETTER) / SOFTNESS)
    return torch.where(views < LEAST_VIEWS, 0.0, score), finest


def blended(values: Float[Tensor, "N"], splats: Splats, camera: Camera, raster: RasterSettings) -> Float[Tensor, "h w"]:
    """Values of splats, drawn in place of their colours on black."""
    counted = replace(splats, colours=values[:, None].expand(-1, 3).contiguous())
    return rasterize(counted, camera, raster).image[0]


def best_densities(points: Float[Tensor, "N 3"], cameras: Sequence[Camera]) -> Float[Tensor, "N"]:
    """Returns the most pixels per scene unit that any camera has at each point; 0 where none sees it."""
    best = torch.zeros_like(points[:, 0])
    for camera in cameras:
        places, depth = camera.project(points)
        inside = ((places >= 0) & (places < places.new_tensor([camera.width, camera.height]))).all(1)
        visible = (depth > camera.near) & inside
        best = best.maximum(torch.where(visible, camera.fx / depth.clamp_min(camera.near), 0.0))
    return best


@torch.no_grad()
def sampled_better(
    drawn: Draw, camera: Camera, photographs: Sequence[Camera], number: int, raster: RasterSettings
) -> Float[Tensor, "h w"]:
    """Ours: 1 where a camera sees surfaces more finely than every photograph does, 0 where it does not; blended like
    colour.

    Occlusion is left aside: a photograph counts for what lies in its field of view. Unseen by all counts as 1.
    """
    splats = drawn(camera)
    means = splats.means.detach()
    own, best = camera.fx / camera.project(means)[1].clamp_min(camera.near), best_densities(means, photographs)
    ratio = torch.where(best > 0, own / best.clamp_min(1e-30), torch.inf)
    score = torch.sigmoid((ratio - BETTER) / SOFTNESS)
    return blended(score, splats, camera, raster).clamp(0, 1)


def agreeing(
    result: Float[Tensor, "3 H W"], source: Float[Tensor, "3 h w"], scale: int, reduction: Reduction, levels: float
) -> Float[Tensor, "H W"]:
    """1 in blocks where the result, reduced, is within `levels` of 255 of what it was made from in all channels, else
    0."""
    off = (reduction.reduce(result.clamp(0, 1), scale) - source).abs().amax(0) * 255
    return as_blocks((off <= levels).float(), scale)


def in_bytes(weights: Float[Tensor, "h w"]) -> UInt8[Tensor, "h w"]:
    """Weights from 0 to 1 as 0 to 255."""
    return (weights * 255 + 0.5).clamp(0, 255).to(torch.uint8)


@torch.no_grad()
def undilated_radii(
    means: Float[Tensor, "N 3"],
    scales: Float[Tensor, "N 3"],
    quats: Float[Tensor, "N 4"],
    camera: Camera,
    settings: RasterSettings,
) -> Float[Tensor, "N"]:
    """Returns three standard deviations on the screen before dilation, px; -1: it does not touch the raster.

    3D-GS's formula (forward.cu), whose floor makes those much thinner than a pixel alike; not rounded up.
    """
    screen, on = on_screen(without_colours(means, scales, quats), camera, settings)
    dilation, _ = settings.dilation_at(camera.focal)
    undilated = screen.covariances[on] - dilation * means.new_tensor([1, 0, 1])
    return torch.full_like(means[:, 0], -1).index_copy_(0, screen.ids[on], three_sigma(*undilated.unbind(1)))
