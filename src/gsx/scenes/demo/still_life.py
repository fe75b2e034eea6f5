"""The arrangement: a garden with a brick wall, a potted tree, a reading chart, a crate, a tin and two balls.

Light does not depend on the direction of view (but for one mild highlight on the beach ball): a sun with soft shadows,
an even sky, and darkening where things stand close together.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import torch
from torch import Tensor

from gsx.core.shapes import Float, Int
from gsx.scenes.demo import textures
from gsx.scenes.demo.solids import Solid, box, cylinder, dot, double, neighbours, normalise, smoothstep, sphere
from gsx.scenes.demo.textures import Kit, make_kit

Texture = Callable[[Tensor, Tensor, Kit], Tensor]

DOME = 20.0  # radius of the sky, scene units: far, yet within reach of splats
SUN = (-0.28, -0.68, 0.66)  # towards the sun
SUNLIGHT, SKYLIGHT = 0.60, 0.60  # brightness of a white surface facing the sun, and of the open sky
PENUMBRA = 0.12  # a shadow is full where the light would cross this much of a solid, scene units
CONTACT_REACH = 0.30  # surfaces nearer than this to another solid are darkened, scene units
CONTACT_DEPTH = 0.45  # by this fraction where they touch
HIGHLIGHT = 0.35  # strength of the highlight on the beach ball
SEED = 20  # of the textures' noise: the published picture


@dataclass(frozen=True, eq=False)
class Thing:
    """A solid, its texture, and the other solids near enough to darken it or to stand in its light."""

    solid: Solid
    texture: Texture
    shine: float = 0.0
    near: tuple[Solid, ...] = ()
    shading: tuple[Solid, ...] = ()


@dataclass(frozen=True, eq=False)
class StillLife:
    """All things of a scene."""

    things: tuple[Thing, ...]
    kit: Kit

    @property
    def solids(self) -> tuple[Solid, ...]:
        """Return the solids; their index is their number in a trace."""
        return tuple(thing.solid for thing in self.things)

    @property
    def standing(self) -> tuple[Solid, ...]:
        """Return the solids near enough to the ground to darken it."""
        return tuple(solid for solid in self.solids if float(solid.centre[2] - solid.half[2]) < CONTACT_REACH)


def furniture() -> list[Thing]:
    """Return the things of the garden; z = 0 is the ground, units are about metres."""
    return [
        Thing(box("wall", (-0.10, 0.85, 0.42), (1.90, 0.26, 0.84), 6.0), textures.bricks),
        Thing(box("coping", (-0.10, 0.85, 0.875), (1.98, 0.34, 0.07), 6.0), textures.coping),
        Thing(cylinder("pot", (-0.95, 0.05, 0.20), 0.25, 0.40), partial(textures.pot, half_height=0.20)),
        Thing(cylinder("trunk", (-0.95, 0.05, 0.60), 0.045, 0.46), textures.bark),
        Thing(sphere("crown", (-0.95, 0.05, 1.12), 0.40), textures.foliage),
        Thing(box("board", (0.78, 0.08, 0.80), (1.04, 0.05, 0.70), 24.0), partial(textures.sign, half=(0.52, 0.35))),
        Thing(box("post", (0.78, 0.08, 0.225), (0.08, 0.08, 0.45), 24.0), textures.post),
        Thing(box("crate", (-0.22, -0.55, 0.26), (0.52, 0.52, 0.52), -28.0), partial(textures.crate, half=0.26)),
        Thing(cylinder("tin", (-0.25, -0.50, 0.65), 0.11, 0.26, -75.0), partial(textures.tin, radius=0.11)),
        Thing(sphere("beach ball", (0.52, -0.80, 0.23), 0.23, 20.0), textures.beach_ball, HIGHLIGHT),
        Thing(sphere("marble", (0.35, 1.38, 0.20), 0.20), textures.marble),
    ]


def shading(solid: Solid, others: Sequence[Solid]) -> tuple[Solid, ...]:
    """Return the other solids whose bounding sphere lies between this one's and the sun."""
    sun = normalise(double(SUN))
    found = []
    for other in others:
        offset = other.centre - solid.centre
        along, reach = float(dot(offset, sun)), solid.reach + other.reach
        if other is not solid and along > -reach and float(dot(offset, offset)) - along**2 < reach**2:
            found.append(other)
    return tuple(found)


def arrange(things: Sequence[Thing], kit: Kit) -> StillLife:
    """Return a scene of things that darken each other."""
    solids = [thing.solid for thing in things]
    lit = (
        replace(thing, near=neighbours(solid, solids, CONTACT_REACH), shading=shading(solid, solids))
        for thing, solid in zip(things, solids, strict=True)
    )
    return StillLife(tuple(lit), kit)


def make_still_life() -> StillLife:
    """Arrange the garden with its textures."""
    return arrange(furniture(), make_kit(torch.Generator().manual_seed(SEED)))


def sunlight(points: Float[Tensor, "3 points"], shading: tuple[Solid, ...]) -> Float[Tensor, "points"]:
    """Return the part of the sun that reaches world points: a solid takes more, the more of it the light crosses."""
    frame = sun_frame()
    across, down = (dot(axis[:, None], points) for axis in frame[:2].float())
    light = torch.ones_like(across)
    for solid in shading:
        x, y, _ = (frame @ solid.centre).tolist()
        chosen = within(across - x, down - y, solid.reach)
        if len(chosen):
            enter, leave = solid.interval(points.index_select(1, chosen), frame[2].float()[:, None])
            crossed = (leave - enter.clamp(min=0.0)).nan_to_num(0.0)
            light.index_copy_(0, chosen, light.index_select(0, chosen) * (1.0 - smoothstep(crossed / PENUMBRA)))
    return light


def within(x: Float[Tensor, "points"], y: Float[Tensor, "points"], radius: float) -> Int[Tensor, "chosen"]:
    """Return the numbers of the points in a circle around the origin."""
    return (x * x + y * y < radius**2).nonzero()[:, 0]


def sun_frame() -> Float[Tensor, "3 3"]:
    """Return two axes across the sunlight and one towards the sun, as rows, float64."""
    sun = normalise(double(SUN))
    across = normalise(torch.linalg.cross(sun, double((0.0, 0.0, 1.0))))
    return torch.stack([across, torch.linalg.cross(sun, across), sun])


def openness(points: Float[Tensor, "3 points"], near: tuple[Solid, ...]) -> Float[Tensor, "points"]:
    """Return 1 in the open, less where world points lie close to other solids."""
    light = torch.ones_like(points[0])
    for solid in near:
        x, y, _ = solid.centre.tolist()
        chosen = within(points[0] - x, points[1] - y, solid.reach + CONTACT_REACH)
        if len(chosen):
            closed = contact(solid.distance(points.index_select(1, chosen)))
            light.index_copy_(0, chosen, light.index_select(0, chosen) * closed)
    return light


def contact(distance: Float[Tensor, "points"]) -> Float[Tensor, "points"]:
    """Return the darkening at a distance from something large, smooth and 1 beyond CONTACT_REACH."""
    closeness = (1.0 - distance / CONTACT_REACH).clamp(0.0, 1.0)
    return 1.0 - CONTACT_DEPTH * closeness * closeness


def thing_colour(
    thing: Thing, kit: Kit, points: Float[Tensor, "3 points"], directions: Float[Tensor, "3 points"]
) -> Float[Tensor, "3 points"]:
    """Return the display colour of surface points (world) of one thing, viewed along unit directions."""
    local = thing.solid.local(points)
    normal = thing.solid.normal(local)
    albedo = thing.texture(local, normal, kit)
    world_normal = thing.solid.world_direction(normal)
    sun = sun_frame()[2].float()[:, None]
    facing = dot(world_normal, sun).clamp(min=0.0)
    sunny = facing * sunlight(points, thing.shading)
    open_sky = (0.80 + 0.20 * world_normal[2]) * openness(points, thing.near) * contact(points[2])
    colour = albedo * (SUNLIGHT * sunny + SKYLIGHT * open_sky)
    if thing.shine:
        colour = colour + thing.shine * sunny * textures.specular(world_normal, normalise(sun - directions))
    return colour


def ground_colour(life: StillLife, points: Float[Tensor, "3 points"]) -> Float[Tensor, "3 points"]:
    """Return the display colour of ground points; light and shadow give way to the haze far out."""
    facing = float(sun_frame()[2, 2])
    shade = SUNLIGHT * facing * sunlight(points, life.solids) + SKYLIGHT * openness(points, life.standing)
    radius = (points[0] * points[0] + points[1] * points[1]).sqrt()
    haze = smoothstep((radius - textures.HAZE[0]) / (textures.HAZE[1] - textures.HAZE[0]))
    return textures.ground(points, life.kit) * (shade + (1.0 - shade) * haze)
