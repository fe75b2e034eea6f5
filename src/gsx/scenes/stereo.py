"""Starting points by stereo: depths of training photos, measured by comparing each with its neighbours.

Structure from motion places corners, and a model has to find the surfaces between them by growth. Here each reduced
photo is compared with neighbours at a ladder of depths, evenly spaced in 1/z (plane sweep, Collins 1996). A pixel takes
the depth at which patches around it correlate best. It becomes a point if the depths of other photos agree.
"""

import logging
import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, grid_sample, normalize, pad

from gsx.core.data.camera import Camera, centres_of
from gsx.core.data.scene import PointCloud, Scene, View
from gsx.core.shapes import Bool, Float, Int, UInt8

logger = logging.getLogger(__name__)

PIXELS = 20_000
"""Most pixels of a reduced photo."""
SOURCES = 4
"""Photos that each photo is compared with."""
BEST = 2
"""Sources whose correlations count at a depth: the others may not show the place."""
DEPTHS, BLOCK = 96, 16
"""Depths of the ladder; number of them at a time, so that pictures stay in the processor's cache."""
PATCH = 7
"""Sides of a patch, px of a reduced photo."""
MIN_CORRELATION, MIN_CONTRAST = 0.6, 0.01
"""Least correlation of a depth; least standard deviation in a patch, display values."""
AGREEING, TOLERANCE = 2, 0.02
"""Other photos whose depths agree with a point, and their largest relative difference."""
ANGLE, NARROW, WIDE = 5.0, 2.0, 10.0
"""Best angle between two rays to a point, and the widths of its weight below and above, degrees (after MVSNet, Yao et
al. 2018)."""
FEWEST = 16
"""Fewest points in a photo from which its range of depths is known."""
QUANTILES, BEYOND = (0.02, 0.98), (0.6, 1.6)
"""Range of depths: quantiles of the points' depths in a photo, times these."""


@dataclass(frozen=True, eq=False)
class Reduced:
    """A training photo at the size of stereo."""

    camera: Camera
    image: Float[Tensor, "3 h w"]
    counted: Bool[Tensor, "h w"]
    """False: part of the pixel is masked."""

    @property
    def grey(self) -> Float[Tensor, "h w"]:
        """Brightness around its mean, for exact sums."""
        grey = self.image.mean(0)
        return grey - grey.mean()


@dataclass(frozen=True, eq=False)
class DepthMap:
    """Depths of a reduced photo."""

    depths: Float[Tensor, "h w"]
    measured: Bool[Tensor, "h w"]
    """True: the correlation decides the depth."""


def add_stereo_points(scene: Scene, count: int, generator: torch.Generator) -> Scene:
    """Adds up to `count` points measured by stereo to a scene, at random, with a note."""
    start = time.perf_counter()
    photos = [reduced(view) for view in scene.train]
    sources = neighbours([photo.camera for photo in photos], scene.points.positions.float())
    maps = [
        depth_map(photo, [photos[i] for i in near], scene.points) for photo, near in zip(photos, sources, strict=True)
    ]
    clouds = [confirmed(index, photos, maps, sources) for index in range(len(photos))]
    found = PointCloud(*(torch.cat(parts) for parts in zip(*((c.positions, c.colours) for c in clouds), strict=True)))
    chosen = torch.randperm(len(found), generator=generator)[:count]
    logger.info("stereo: %d points from %d photos in %.1f s", len(found), len(photos), time.perf_counter() - start)
    note = (
        f"{len(chosen):,} of {len(found):,} points measured by stereo are added to {len(scene.points):,} (scene.stereo)"
    )
    points = scene.points.joined(found.positions[chosen], found.colours[chosen])
    return replace(scene, points=points, notes=[*scene.notes, note])


# -- photos ------------------------------------------------------------------------------------------------------------


def reduced(view: View) -> Reduced:
    """Reduces a photo by the least whole factor that leaves at most PIXELS."""
    width, height = view.camera.size
    times = math.ceil(math.sqrt(width * height / PIXELS))
    across, down = width // times, height // times
    camera = replace(view.camera, width=across * times, height=down * times).resize(across, down)
    image, counted = view.image()[:, : down * times, : across * times], view.counted()
    masked = torch.zeros(height, width) if counted is None else (~counted).float()
    masked = avg_pool2d(masked[None, : down * times, : across * times], times)[0]
    return Reduced(camera=camera, image=avg_pool2d(image, times), counted=masked == 0)


def neighbours(cameras: Sequence[Camera], positions: Float[Tensor, "P 3"]) -> list[list[int]]:
    """Returns for each camera those to compare it with: by common points, weighted by the angle of their rays."""
    visible = torch.stack([camera.shows(*camera.project(positions)) for camera in cameras])
    centres = centres_of(cameras)
    rays = normalize(positions.double() - centres[:, None], dim=2)
    return [best_partners(index, rays, visible) for index in range(len(cameras))]


def best_partners(index: int, rays: Float[Tensor, "N P 3"], visible: Bool[Tensor, "N P"]) -> list[int]:
    """Returns the cameras that share most points with one, at useful angles."""
    angles = torch.rad2deg((rays * rays[index]).sum(2).clamp(-1, 1).acos())
    width = torch.where(angles < ANGLE, NARROW, WIDE)
    scores = ((-((angles - ANGLE) / width).square() / 2).exp() * (visible & visible[index])).sum(1)
    scores[index] = 0
    best = scores.topk(min(SOURCES, len(scores)))
    return [number for number, score in zip(best.indices.tolist(), best.values.tolist(), strict=True) if score > 0]


def depth_range(camera: Camera, points: PointCloud) -> tuple[float, float] | None:
    """Returns the smallest and the largest depth to search; None: the photo shows too few points."""
    pixels, depths = camera.project(points.positions.float())
    depths = depths[camera.shows(pixels, depths)]
    if len(depths) < FEWEST:
        return None
    low, high = torch.quantile(depths.double(), torch.tensor(QUANTILES, dtype=torch.float64)).tolist()
    return max(camera.near, BEYOND[0] * low), BEYOND[1] * high


# -- depths ------------------------------------------------------------------------------------------------------------


def patch_means(values: Float[Tensor, "D h w"]) -> Float[Tensor, "D h w"]:
    """Returns means over patches, which are cut off at the borders."""
    for axis in (1, 2):
        values = window_means(values.movedim(axis, -1)).movedim(-1, axis)
    return values


def window_means(values: Float[Tensor, "*S n"]) -> Float[Tensor, "*S n"]:
    """Returns means of PATCH neighbours along the last axis."""
    places = torch.arange(values.shape[-1])
    first, end = (places - PATCH // 2).clamp_min(0), (places + PATCH // 2 + 1).clamp_max(len(places))
    sums = pad(values.cumsum(-1), (1, 0))
    return (sums[..., end] - sums[..., first]) / (end - first)


def correlations(reference: Reduced, source: Reduced, depths: Float[Tensor, "D"]) -> Float[Tensor, "D h w"]:
    """Returns the correlation of patches with a source at each depth; -1 outside the source."""
    places, inside = projected_at(reference.camera, source.camera, depths)
    grey, other = reference.grey[None], source.grey[None, None]
    warped = grid_sample(other, places[None], padding_mode="border", align_corners=False)[0].reshape(inside.shape)
    means, warped_means = patch_means(grey), patch_means(warped)
    variance = (patch_means(grey.square()) - means.square()).clamp_min(1e-6)
    warped_variance = (patch_means(warped.square()) - warped_means.square()).clamp_min(1e-6)
    covariance = patch_means(warped * grey) - warped_means * means
    return torch.where(inside, covariance / (variance * warped_variance).sqrt(), -1.0).clamp(-1, 1)


def projected_at(
    camera: Camera, other: Camera, depths: Float[Tensor, "D"]
) -> tuple[Float[Tensor, "Dh w 2"], Bool[Tensor, "D h w"]]:
    """Returns where another camera sees each pixel at each depth, in [-1, 1], and which of them it shows."""
    width, height = camera.size
    rays = camera_rays(camera)
    turn = other.rotation.double() @ camera.rotation.double().T
    move = other.translation.double() - turn @ camera.translation.double()
    x, y, z = ((turn @ rays).float() * depths[:, None, None] + move.float()[:, None]).unbind(1)
    if other.lens is None:
        right, below = (side / z.clamp_min(1e-6) for side in (x, y))
    else:
        right, below = other.lens.bend(torch.stack([x, y, z], -1).flatten(0, -2)).T.reshape(2, *x.shape)
    across = 2 * (right * other.fx + other.cx) / other.width - 1
    down = 2 * (below * other.fy + other.cy) / other.height - 1
    inside = (across.abs() < 1) & (down.abs() < 1) & (z > other.near)
    places = torch.stack([across, down], -1).nan_to_num(2.0).clamp(-2, 2)
    return places.reshape(-1, width, 2), inside.reshape(-1, height, width)


def camera_rays(camera: Camera) -> Float[Tensor, "3 P"]:
    """Returns the directions of pixels at depth 1, camera coordinates, float64."""
    x, y = camera.slopes(pixel_centres(camera).double()).T
    return torch.stack([x, y, torch.ones_like(x)])


def pixel_centres(camera: Camera) -> Float[Tensor, "P 2"]:
    """Returns the centres of all pixels, row by row."""
    y, x = torch.meshgrid(torch.arange(camera.height) + 0.5, torch.arange(camera.width) + 0.5, indexing="ij")
    return torch.stack([x, y], -1).reshape(-1, 2)


def depth_map(photo: Reduced, sources: Sequence[Reduced], points: PointCloud) -> DepthMap | None:
    """Measures the depths of a photo; None: no source shows its points, or it shows too few."""
    limits = depth_range(photo.camera, points)
    if limits is None or not sources:
        return None
    inverse = torch.linspace(1 / limits[1], 1 / limits[0], DEPTHS)
    scores = torch.cat([mean_of_best(photo, sources, 1 / part) for part in inverse.split(BLOCK)])
    best, index = scores.max(0)
    contrast = (patch_means(photo.grey[None].square()) - patch_means(photo.grey[None]).square())[0]
    inner = (index > 0) & (index < DEPTHS - 1)
    measured = inner & (best > MIN_CORRELATION) & (contrast > MIN_CONTRAST**2) & photo.counted
    step = float(inverse[1] - inverse[0])
    return DepthMap(depths=1 / (inverse[index] + step * peak(scores, index)), measured=measured)


def mean_of_best(photo: Reduced, sources: Sequence[Reduced], depths: Float[Tensor, "D"]) -> Float[Tensor, "D h w"]:
    """Returns the mean of the best correlations at each depth."""
    each = torch.stack([correlations(photo, source, depths) for source in sources])
    return each.topk(min(BEST, len(sources)), dim=0).values.mean(0)


def peak(scores: Float[Tensor, "D h w"], index: Int[Tensor, "h w"]) -> Float[Tensor, "h w"]:
    """Returns the offset of the maximum from its index, by a parabola through its neighbours; 0 at the ends."""
    inner = index.clamp(1, len(scores) - 2)
    low, middle, high = (scores.gather(0, (inner + offset)[None])[0] for offset in (-1, 0, 1))
    curvature = low - 2 * middle + high
    offset = torch.where(curvature < -1e-6, (low - high) / 2 / curvature.clamp_max(-1e-6), 0.0).clamp(-0.5, 0.5)
    return torch.where(inner == index, offset, 0.0)


# -- points ------------------------------------------------------------------------------------------------------------


def confirmed(
    index: int, photos: Sequence[Reduced], maps: Sequence[DepthMap | None], sources: Sequence[Sequence[int]]
) -> PointCloud:
    """Returns the points of a photo with which the depths of other photos agree."""
    photo, own = photos[index], maps[index]
    if own is None:
        return PointCloud(torch.zeros(0, 3), torch.zeros(0, 3, dtype=torch.uint8))
    places = own.measured.flatten()
    positions = photo.camera.unproject(pixel_centres(photo.camera)[places], own.depths.flatten()[places])
    partners = {*sources[index], *(other for other, near in enumerate(sources) if index in near)}
    pairs = ((photos[other].camera, maps[other]) for other in sorted(partners))
    agreeing = sum(agrees(camera, depths, positions) for camera, depths in pairs if depths is not None)
    kept = agreeing >= AGREEING
    return PointCloud(positions[kept], colours_of(photo, places)[kept])


def agrees(camera: Camera, other: DepthMap, positions: Float[Tensor, "P 3"]) -> Int[Tensor, "P"]:
    """Returns 1 for points at the depth that another photo has measured in their place, else 0."""
    pixels, depths = camera.project(positions)
    visible = camera.shows(pixels, depths)
    column, row = (pixels.nan_to_num(0.0).long().clamp_min(0)).unbind(1)
    place = row.clamp_max(camera.height - 1), column.clamp_max(camera.width - 1)
    return (visible & other.measured[place] & ((other.depths[place] - depths).abs() < TOLERANCE * depths)).int()


def colours_of(photo: Reduced, places: Bool[Tensor, "P"]) -> UInt8[Tensor, "M 3"]:
    """Returns the display colours of some pixels, 8 bits."""
    return (photo.image.flatten(1).T[places] * 255).round().byte()
