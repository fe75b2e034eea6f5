"""Rays, what they hit, and pictures made of them."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from gsx.core.data.camera import Camera
from gsx.core.shapes import Float, Int, UInt8
from gsx.scenes.demo import textures
from gsx.scenes.demo.solids import SPHERE, column, dot, normalise, shape_interval, sum_of, window
from gsx.scenes.demo.still_life import DOME, StillLife, ground_colour, thing_colour

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
    """First hits of rays."""

    depth: Float[Tensor, "*rays"]
    """Distance along the ray, scene units."""
    owner: Int[Tensor, "*rays"]
    """Number of the solid, GROUND or SKY."""


@dataclass(frozen=True, eq=False)
class HitPoints:
    """First hits of rays as points."""

    points: Float[Tensor, "3 points"]
    """World coordinates, scene units."""
    directions: Float[Tensor, "3 points"]
    """Directions of the rays."""
    owner: Int[Tensor, "points"]
    """Number of the solid, GROUND or SKY."""


def camera_rays(camera: Camera, samples: int) -> Rays:
    """Return rays through the same `samples` places of every pixel, as a [3, samples, H, W] raster."""
    across, down = lattice(samples)
    columns, rows = (torch.arange(count, dtype=torch.float64) for count in camera.size)
    return rays_through(camera, columns + across[:, None, None], rows[:, None] + down[:, None, None])


def lattice(count: int) -> Float[Tensor, "2 count"]:
    """Return places in the unit square on a golden-ratio (for 1, 2, 3, 5, 8, 13: Fibonacci) lattice, float64.

    Projected on either axis they are evenly spaced, so edges at any slope get nearly `count` grey levels.
    """
    place = torch.arange(count, dtype=torch.float64)
    step = round(count * GOLDEN)
    return torch.stack([place + 0.5, place * step % count + 0.5]) / count


def rays_through(camera: Camera, u: Float[Tensor, "*#rays"], v: Float[Tensor, "*#rays"]) -> Rays:
    """Return rays through raster positions (u, v) in pixels, float64."""
    x, y = slopes(u, camera.cx, camera.fx), slopes(v, camera.cy, camera.fy)
    if camera.lens is not None:
        bent = torch.stack(torch.broadcast_tensors(x, y), -1)
        x, y = camera.lens.straighten(bent.flatten(0, -2)).view(bent.shape).unbind(-1)
    directions = torch.stack([axis[0] * x + axis[1] * y + axis[2] for axis in camera.rotation.T.tolist()])
    return Rays(camera.centre.double(), normalise(directions))


def slopes(position: Float[Tensor, "*rays"], principal: float, focal: float) -> Float[Tensor, "*rays"]:
    """Return x/z or y/z of rays at positions along one axis of the raster, rounded to float32 last."""
    return ((position - round(principal * SUBPIXEL) / SUBPIXEL) / focal).float()


def meet_backdrop(rays: Rays) -> Hits:
    """Return the hits with the ground within the dome, and with the dome elsewhere."""
    origin = column(rays.origin, rays.directions)
    dome = shape_interval(origin / DOME, rays.directions / DOME, SPHERE)[1].nan_to_num(DOME)
    floor = -origin[2] / rays.directions[2]
    grounded = (floor > 0) & (floor < dome)
    owner = torch.where(grounded, GROUND, SKY).to(torch.int8)
    return Hits(torch.where(grounded, floor, dome), owner)


def trace(life: StillLife, rays: Rays, camera: Camera | None = None) -> Hits:
    """Return the first hits of rays; `camera`, from which they come, limits each solid to its window of the raster."""
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
    """Flatten hits to a list of points."""
    directions = rays.directions.flatten(1)
    points = column(rays.origin, directions) + directions * hits.depth.flatten()
    return HitPoints(points, directions, hits.owner.flatten())


def points_at(
    life: StillLife,
    cameras: Sequence[Camera],
    places: Sequence[Float[Tensor, "2 _"]],
    shift: tuple[float, float] = (0.0, 0.0),
) -> HitPoints:
    """Return the hits at places (px, float64) of the cameras' pictures, shifted to the right and down."""
    bundles = [rays_through(camera, u + shift[0], v + shift[1]) for camera, (u, v) in zip(cameras, places, strict=True)]
    parts = [hit_points(rays, trace(life, rays)) for rays in bundles]
    points, directions = (torch.cat([getattr(part, name) for part in parts], 1) for name in ("points", "directions"))
    return HitPoints(points, directions, torch.cat([part.owner for part in parts]))


def colours_of(life: StillLife, hits: HitPoints) -> Float[Tensor, "3 points"]:
    """Return display colours of hits, in [0, 1]."""
    colour = torch.empty_like(hits.points)
    for number in hits.owner.unique().tolist():
        for chosen in (hits.owner == number).nonzero()[:, 0].split(BAND_RAYS):
            points, directions = (vectors.index_select(1, chosen) for vectors in (hits.points, hits.directions))
            if number == SKY:
                part = textures.sky(points / DOME, life.kit)
            elif number == GROUND:
                part = ground_colour(life, points)
            else:
                part = thing_colour(life.things[number], life.kit, points, directions)
            colour.index_copy_(1, chosen, part)
    return colour.clamp(0.0, 1.0)


def shade(life: StillLife, rays: Rays, hits: Hits) -> Float[Tensor, "3 *rays"]:
    """Return display colours of hits, in [0, 1], on the raster of the rays."""
    return colours_of(life, hit_points(rays, hits)).reshape(rays.directions.shape)


def depth_of(life: StillLife, camera: Camera) -> Float[Tensor, "H W"]:
    """Return camera z of the surface at each pixel's centre, scene units; infinite where only the sky is."""
    rays = camera_rays(camera, 1)
    hits = trace(life, rays, camera)
    ahead = dot(column(camera.rotation[2], rays.directions), rays.directions)
    return torch.where(hits.owner == SKY, torch.inf, ahead * hits.depth)[0]


def render(life: StillLife, camera: Camera, samples: int) -> UInt8[Tensor, "3 H W"]:
    """Render a camera's picture, `samples` rays per pixel; bands of rows bound the memory."""
    rows = max(1, BAND_RAYS // (camera.width * samples))
    bands = [camera.crop(0, top, camera.width, min(rows, camera.height - top)) for top in range(0, camera.height, rows)]
    return torch.cat([render_band(life, band, samples) for band in bands], dim=1)


def render_band(life: StillLife, camera: Camera, samples: int) -> UInt8[Tensor, "3 H W"]:
    """Render one band: means of each pixel's samples in display light, as splats are blended, in a fixed order."""
    rays = camera_rays(camera, samples)
    colours = shade(life, rays, trace(life, rays, camera))
    return (sum_of(list(colours.unbind(1))) / samples * 255.0 + 0.5).to(torch.uint8)
