"""Points where structure from motion finds none: plain walls, sky between leaves, places in few photographs.

Depths are interpolated from points nearby in the same picture.
"""

import math
from dataclasses import replace

import torch
from torch import Tensor

from gsx.core.data.camera import Camera
from gsx.core.data.scene import PointCloud, Scene, View
from gsx.core.shapes import Bool, Float, Int

NEIGHBOURS = 3  # points from which a depth is interpolated
COVERED = 8  # neighbours in the picture that may hide a point
BEHIND = 1.3  # a point this many times as far as the nearest of them is hidden
MOST_DISTANCES = 1 << 28  # between points of a picture, at a time: 1 GB
TRIES = 8  # pixels for each point to add
FEWEST = 16  # points in a picture from which depths can be interpolated


def fill_gaps(scene: Scene, count: int, generator: torch.Generator) -> Scene:
    """Add up to `count` points to a scene, equally many from each training view, and a note."""
    share = math.ceil(TRIES * count / len(scene.train))
    clouds = [found for view in scene.train if (found := gaps_of(view, scene.points, share, generator)) is not None]
    if not clouds:
        return scene
    positions, colours = (torch.cat(parts) for parts in zip(*clouds, strict=True))
    chosen = torch.randperm(len(positions), generator=generator)[:count]
    points = scene.points.joined(positions[chosen], colours[chosen])
    note = f"{len(chosen):,} points added to {len(scene.points):,} where training views show none (scene.fill)"
    return replace(scene, points=points, notes=[*scene.notes, note])


def gaps_of(
    view: View, points: PointCloud, count: int, generator: torch.Generator
) -> tuple[Float[Tensor, "P 3"], Tensor] | None:
    """Return (positions, colours) of random pixels of a view that are farther from its points than their mean distance.

    None: the view has too few points.
    """
    camera = view.camera
    pixels, depths = in_view(camera, points.positions)
    if len(pixels) < FEWEST:
        return None
    visible = in_front(pixels, depths)
    pixels, depths = pixels[visible], depths[visible]
    size = torch.tensor(camera.size, dtype=torch.float32)
    places = torch.rand(count, 2, generator=generator) * size
    apart, nearest = nearest_of(places, pixels, min(NEIGHBOURS, len(pixels)))
    gaps = apart[:, 0] > math.sqrt(camera.width * camera.height / len(pixels))
    counted = view.counted()
    column, row = places.long().unbind(1)
    if counted is not None:
        gaps &= counted[row, column]
    weights = 1 / apart.clamp_min(1)
    log_depth = (weights * depths.log()[nearest]).sum(1) / weights.sum(1)
    colours = (view.image()[:, row, column].T * 255).round().byte()
    return camera.unproject(places, log_depth.exp())[gaps], colours[gaps]


def in_view(camera: Camera, positions: Float[Tensor, "P 3"]) -> tuple[Float[Tensor, "M 2"], Float[Tensor, "M"]]:
    """Return pixel positions and depths of the points in a camera's raster, beyond its near plane."""
    pixels, depths = camera.project(positions)
    inside = camera.shows(pixels, depths)
    return pixels[inside], depths[inside]


def in_front(pixels: Float[Tensor, "M 2"], depths: Float[Tensor, "M"], behind: float = BEHIND) -> Bool[Tensor, "M"]:
    """Return which points are not hidden: less than `behind` times as far as their neighbours in the picture."""
    _, nearest = nearest_of(pixels, pixels, min(COVERED, len(pixels)))
    return depths <= behind * depths[nearest].amin(1)


def nearest_of(
    places: Float[Tensor, "P 2"], pixels: Float[Tensor, "M 2"], count: int
) -> tuple[Float[Tensor, "P count"], Int[Tensor, "P count"]]:
    """Return distances and numbers of the pixels nearest to each place."""
    parts = places.split(max(1, MOST_DISTANCES // max(1, len(pixels))))
    found = [torch.cdist(part, pixels).topk(count, largest=False) for part in parts]
    return torch.cat([distances for distances, _ in found]), torch.cat([which for _, which in found])
