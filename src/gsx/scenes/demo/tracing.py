"""Rays, what they hit, and pictures made of them."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from gsx.core.data.camera import Camera
from gsx.core.shapes import Float, Int, UInt8
from gsx.scenes.demo.solids import column, normalise, sphere_interval, sum_of, window
from gsx.scenes.demo.still_life import DOME, StillLife, ground_colour, sky_colour, thing_colour

BAND_RAYS = 1 << 17  # rays evaluated at once: about 50 MB of working memory
SUBPIXEL = 2.0**20  # principal points are rounded to 1/SUBPIXEL px, so that a crop's whole-pixel shift is exact
GOLDEN = (math.sqrt(5.0) - 1.0) / 2.0
GROUND, SKY = -1, -2  # owners of rays that hit no solid


@dataclass(frozen=True, eq=False)
class Rays:
    """Rays from one point."""

    origin: Float[Tensor, "3"]
    directions: Float[Tensor, "3 *rays"]
    """Unit vectors, world axes, float32."""


@dataclass(frozen=True, eq=False)
class Hits:
    """What rays meet first."""

    depth: Float[Tensor, "*rays"]
    """Distance along the ray, scene units."""
    owner: Int[Tensor, "*rays"]
    """Number of the solid, GROUND or SKY."""


@dataclass(frozen=True, eq=False)
class HitPoints:
    """Points that rays meet."""

    points: Float[Tensor, "3 points"]
    """World, scene units."""
    directions: Float[Tensor, "3 points"]
    """Of the rays."""
    owner: Int[Tensor, "points"]
    """Number of the solid, GROUND or SKY."""


def camera_rays(camera: Camera, samples: int) -> Rays:
    """Rays through the same `samples` places of every pixel, as a [3, samples, H, W] raster."""
    across, down = lattice(samples)
    columns, rows = (torch.arange(count, dtype=torch.float64) for count in camera.size)
    return rays_through(camera, columns + across[:, None, None], rows[:, None] + down[:, None, None])


def lattice(count: int) -> Float[Tensor, "2 count"]:
    """Places in the unit square on a golden-ratio (for 1, 2, 3, 5, 8, 13: Fibonacci) lattice, float64.

    Projected on either axis they are evenly spaced, so edges at any slope get nearly `count` grey levels.
    """
    place = torch.arange(count, dtype=torch.float64)
    step = round(count * GOLDEN)
    return torch.stack([place + 0.5, place * step % count + 0.5]) / count


def rays_through(camera: Camera, u: Float[Tensor, "*#rays"], v: Float[Tensor, "*#rays"]) -> Rays:
    """Rays through raster positions (u, v) in pixels, float64."""
    x, y = slopes(u, camera.cx, camera.fx), slopes(v, camera.cy, camera.fy)
    directions = torch.stack([axis[0] * x + axis[1] * y + axis[2] for axis in camera.rotation.T.tolist()])
    return Rays(camera.centre.double(), normalise(directions))


def slopes(position: Float[Tensor, "*rays"], principal: float, focal: float) -> Float[Tensor, "*rays"]:
    """x/z or y/z of rays at positions along one axis of the raster, rounded to float32 last."""
    return ((position - round(principal * SUBPIXEL) / SUBPIXEL) / focal).float()


def meet_backdrop(rays: Rays) -> Hits:
    """The ground within the dome, the dome elsewhere."""
    origin = column(rays.origin, rays.directions)
    dome = sphere_interval(origin / DOME, rays.directions / DOME)[1].nan_to_num(DOME)
    floor = -origin[2] / rays.directions[2]
    grounded = (floor > 0) & (floor < dome)
    owner = torch.where(grounded, GROUND, SKY).to(torch.int8)
    return Hits(torch.where(grounded, floor, dome), owner)


def trace(life: StillLife, rays: Rays, camera: Camera | None = None) -> Hits:
    """What the rays meet first; with the camera they come from, each solid is only sought where it can be seen."""
    hits = meet_backdrop(rays)
    for number, solid in enumerate(life.solids):
        part = window(solid, camera) if camera else ()
        if part is None:
            continue
        directions, depth, owner = (raster[..., *part] for raster in (rays.directions, hits.depth, hits.owner))
        enter, leave = solid.interval(column(rays.origin, directions), directions)
        first = (enter <= leave) & (enter > 0) & (enter < depth)
        depth.copy_(torch.where(first, enter, depth))
        owner.masked_fill_(first, number)
    return hits


def hit_points(rays: Rays, hits: Hits) -> HitPoints:
    """What rays meet, as a list."""
    directions = rays.directions.flatten(1)
    points = column(rays.origin, directions) + directions * hits.depth.flatten()
    return HitPoints(points, directions, hits.owner.flatten())


def joined(parts: Sequence[HitPoints]) -> HitPoints:
    """What several bundles of rays meet, one after another."""
    points, directions, owners = zip(*((part.points, part.directions, part.owner) for part in parts), strict=True)
    return HitPoints(torch.cat(points, 1), torch.cat(directions, 1), torch.cat(owners))


def seen_at(
    life: StillLife,
    cameras: Sequence[Camera],
    places: Sequence[Float[Tensor, "2 _"]],
    shift: tuple[float, float] = (0.0, 0.0),
) -> HitPoints:
    """What cameras see at places of their pictures, px, float64, moved to the right and down."""
    right, down = shift
    bundles = [rays_through(camera, u + right, v + down) for camera, (u, v) in zip(cameras, places, strict=True)]
    return joined([hit_points(rays, trace(life, rays)) for rays in bundles])


def colours_of(life: StillLife, seen: HitPoints) -> Float[Tensor, "3 points"]:
    """Display colours, in [0, 1]."""
    colour = torch.empty_like(seen.points)
    for number in seen.owner.unique().tolist():
        for chosen in (seen.owner == number).nonzero()[:, 0].split(BAND_RAYS):
            points, directions = (all_of.index_select(1, chosen) for all_of in (seen.points, seen.directions))
            colour.index_copy_(1, chosen, owner_colour(life, number, points, directions))
    return colour.clamp(0.0, 1.0)


def shade(life: StillLife, rays: Rays, hits: Hits) -> Float[Tensor, "3 *rays"]:
    """Display colours of what the rays meet, in [0, 1]."""
    return colours_of(life, hit_points(rays, hits)).reshape(rays.directions.shape)


def owner_colour(life: StillLife, number: int, points: Tensor, directions: Tensor) -> Float[Tensor, "3 points"]:
    """Display colour of points of one owner, seen along unit directions."""
    if number == SKY:
        return sky_colour(life, points)
    if number == GROUND:
        return ground_colour(life, points)
    return thing_colour(life.things[number], life.kit, points, directions)


def average(colours: Float[Tensor, "3 samples H W"]) -> Float[Tensor, "3 H W"]:
    """Mean over the samples of every pixel, in display light as splats are blended, added in a fixed order."""
    return sum_of(list(colours.unbind(1))) / colours.shape[1]


def render(life: StillLife, camera: Camera, samples: int) -> UInt8[Tensor, "3 H W"]:
    """The picture `camera` takes, `samples` rays per pixel; bands of rows bound the memory."""
    rows = max(1, BAND_RAYS // (camera.width * samples))
    bands = [camera.crop(0, top, camera.width, min(rows, camera.height - top)) for top in range(0, camera.height, rows)]
    return torch.cat([render_band(life, band, samples) for band in bands], dim=1)


def render_band(life: StillLife, camera: Camera, samples: int) -> UInt8[Tensor, "3 H W"]:
    """The picture of one band."""
    rays = camera_rays(camera, samples)
    colours = shade(life, rays, trace(life, rays, camera))
    return (average(colours) * 255.0 + 0.5).to(torch.uint8)
