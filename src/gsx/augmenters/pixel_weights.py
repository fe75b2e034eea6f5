"""Weights of a pseudo view's pixels: by the resolution of the photos, and by agreement with the input."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TypeAlias

import torch
from torch import Tensor

from gsx.core.data.camera import Camera
from gsx.core.data.reduction import Reduction, as_blocks
from gsx.core.gaussians.splats import Splats
from gsx.core.rasterizer import RasterSettings, on_screen, rasterize, without_colours
from gsx.core.rasterizer.boxes import three_sigma
from gsx.core.shapes import Bool, Float, Int, UInt8
from gsx.core.training.backbone import Drawn

Draw: TypeAlias = Callable[[Camera], Drawn]
"""Returns the splats that a camera draws."""
WeightMap: TypeAlias = Callable[[Draw, Camera, Sequence[Camera], int, RasterSettings], Tensor]
"""(model, camera of the pseudo view, cameras of the photos, number of its photo, rules) -> pixel weights [h, w]."""
BETTER, SOFTNESS = 1.1, 0.05
"""Resolution ratio above which sampling is finer, and width of the soft edge (SplatSuRe, 2512.02172, scripts)."""
MUCH_BETTER = 1.7
"""The same ratio where the scripts state none (SplatSuRe, weight_maps.py)."""
LEAST_VIEWS = 3
"""Least photos that show a splat with a score (SplatSuRe)."""
LEAST_PEAK = 0.9
"""Largest weight of a photo below which weights are min-max normalised (SplatSuRe)."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Sampling:
    """Scores of splats by their radii in photos, and what they were computed from."""

    splats: Splats
    photographs: Sequence[Camera]
    score: Float[Tensor, "N"]
    finest: Int[Tensor, "N"]
    """Number of the photo with the largest radius; -1: no photo shows the splat."""

    def holds_for(self, splats: Splats, photographs: Sequence[Camera]) -> bool:
        """Returns whether scores of these splats in these photos are the same; colours do not count."""
        shapes = ((getattr(self.splats, name), getattr(splats, name)) for name in SHAPE)
        same = len(photographs) == len(self.photographs) and all(torch.equal(a, b) for a, b in shapes)
        return same and all(a.draws_as(b) for a, b in zip(self.photographs, photographs, strict=True))


SHAPE = ("means", "scales", "quats", "log_opacities")
"""Fields of splats that decide radii and occlusion."""


class SplatSuRe:
    """SplatSuRe's weights (2512.02172): low where another photo shows a surface more finely, else high.

    Ours: rendered for the pseudo view instead of rendered for the photo and enlarged. Scores are kept while splats and
    photos stay, as they do in an event. `better`: ratio above which sampling is finer.
    """

    def __init__(self, better: float = BETTER) -> None:
        self.better = better
        self.latest: Sampling | None = None

    @torch.no_grad()
    def __call__(
        self, draw: Draw, camera: Camera, photographs: Sequence[Camera], number: int, raster: RasterSettings
    ) -> Float[Tensor, "h w"]:
        """Returns pixel weights of a pseudo view of photo `number`."""
        own, whole = (
            self.unscaled(draw(one), one, photographs, number, raster) for one in (camera, photographs[number])
        )
        return normalised(own, float(whole.min()), float(whole.max()))

    def unscaled(
        self, drawn: Drawn, camera: Camera, photographs: Sequence[Camera], number: int, raster: RasterSettings
    ) -> Float[Tensor, "h w"]:
        """Renders 1 - score, plus 1 for splats that photo `number` shows most finely."""
        sampling = self.sampling(drawn, photographs, raster)
        values = (sampling.finest == number).to(sampling.score) - sampling.score
        return 1 + blended(values, drawn.splats, camera, raster)

    def sampling(self, drawn: Drawn, photographs: Sequence[Camera], raster: RasterSettings) -> Sampling:
        """Returns scores; hidden splats count as visible if each camera draws other splats (`rows`).

        They would cost a render of every photo for each pseudo view.
        """
        latest, splats = self.latest, drawn.splats
        if latest is None or not latest.holds_for(splats, photographs):
            score, finest = sampling_scores(splats, photographs, raster, self.better, occlusion=drawn.rows is None)
            copies = {name: getattr(splats, name).detach().clone() for name in SHAPE}  # training changes them in place
            latest = Sampling(splats=replace(splats, **copies), photographs=photographs, score=score, finest=finest)
            self.latest = latest
        return latest


def normalised(weights: Float[Tensor, "h w"], least: float, most: float) -> Float[Tensor, "h w"]:
    """Clamps weights to [0, 1], after min-max normalisation if the photo's `most` is below LEAST_PEAK."""
    if least < most < LEAST_PEAK:
        weights = (weights - least) / (most - least)
    return weights.clamp(0, 1)


def sampling_scores(
    splats: Splats,
    photographs: Sequence[Camera],
    raster: RasterSettings,
    better: float = BETTER,
    occlusion: bool = True,
) -> tuple[Float[Tensor, "N"], Int[Tensor, "N"]]:
    """Returns (scores, number of the photo with the largest radius or -1) of splats, by their radii on the screens.

    A score is near 1 if one photo shows the splat more finely than another, 0 if fewer than LEAST_VIEWS show it.
    `occlusion`: a photo shows only splats that add to its render, as published.
    """
    largest, smallest = torch.zeros_like(splats.scales[:, 0]), torch.full_like(splats.scales[:, 0], torch.inf)
    finest, views = torch.full_like(largest, -1, dtype=torch.long), torch.zeros_like(largest)
    for number, camera in enumerate(photographs):
        radii = undilated_radii(splats, camera, raster)
        visible = (radii >= 0) & (contributes(splats, camera, raster) if occlusion else True)
        finest[visible & (radii > largest)] = number
        largest = torch.where(visible, largest.maximum(radii), largest)
        smallest = torch.where(visible, smallest.minimum(radii), smallest)
        views += visible
    score = torch.sigmoid((largest / smallest - better) / SOFTNESS)
    return torch.where(views < LEAST_VIEWS, 0.0, score), finest


def contributes(splats: Splats, camera: Camera, raster: RasterSettings) -> Bool[Tensor, "N"]:
    """Marks splats with a blending weight in a pixel of a render."""
    screen = rasterize(splats, camera, raster, max_weight=True).screen
    weights = torch.zeros_like(splats.log_opacities)
    if screen.max_weights is not None:
        weights[screen.ids] = screen.max_weights.to(weights)
    return weights > 0


def blended(values: Float[Tensor, "N"], splats: Splats, camera: Camera, raster: RasterSettings) -> Float[Tensor, "h w"]:
    """Renders values of splats in place of their colours, on black."""
    counted = replace(splats, colours=values[:, None].expand(-1, 3).contiguous())
    return rasterize(counted, camera, raster).image[0]


def best_densities(points: Float[Tensor, "N 3"], cameras: Sequence[Camera]) -> Float[Tensor, "N"]:
    """Returns the largest pixel density of any camera at each point, px per scene unit; 0 if no camera shows it."""
    best = torch.zeros_like(points[:, 0])
    for camera in cameras:
        places, depth = camera.project(points)
        visible = camera.shows(places, depth)
        best = best.maximum(torch.where(visible, camera.fx / depth.clamp_min(camera.near), 0.0))
    return best


@torch.no_grad()
def sampled_better(
    draw: Draw, camera: Camera, photographs: Sequence[Camera], number: int, raster: RasterSettings
) -> Float[Tensor, "h w"]:
    """Renders weights of 1 for surfaces that the camera shows more finely than every photo, else 0 (ours).

    Occlusion is ignored: a photo shows all splats in its field of view. Splats in no photo have weight 1.
    """
    splats = draw(camera).splats
    means = splats.means.detach()
    own, best = camera.fx / camera.project(means)[1].clamp_min(camera.near), best_densities(means, photographs)
    ratio = torch.where(best > 0, own / best.clamp_min(1e-30), torch.inf)
    score = torch.sigmoid((ratio - BETTER) / SOFTNESS)
    return blended(score, splats, camera, raster).clamp(0, 1)


def agreeing(
    result: Float[Tensor, "3 H W"], source: Float[Tensor, "3 h w"], scale: int, reduction: Reduction, levels: float
) -> Float[Tensor, "H W"]:
    """Returns 1 in blocks where the reduced result is within `levels` of 255 of its source in all channels, else 0."""
    off = (reduction.reduce(result.clamp(0, 1), scale) - source).abs().amax(0) * 255
    return as_blocks((off <= levels).float(), scale)


def in_bytes(weights: Float[Tensor, "h w"]) -> UInt8[Tensor, "h w"]:
    """Quantises weights in [0, 1] to bytes."""
    return (weights * 255 + 0.5).clamp(0, 255).to(torch.uint8)


@torch.no_grad()
def undilated_radii(splats: Splats, camera: Camera, settings: RasterSettings) -> Float[Tensor, "N"]:
    """Returns three standard deviations on the screen before dilation, px, not rounded; -1: outside the raster.

    Source: 3D-GS, forward.cu, whose floor makes all splats much thinner than a pixel alike.
    """
    screen, on = on_screen(without_colours(splats.means, splats.scales, splats.quats), camera, settings)
    dilation, _ = settings.dilation_at(camera.focal)
    undilated = screen.covariances[on] - dilation * splats.means.new_tensor([1, 0, 1])
    return torch.full_like(splats.means[:, 0], -1).index_copy_(0, screen.ids[on], three_sigma(*undilated.unbind(1)))
