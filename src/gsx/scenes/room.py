"""The built-in room: plain plaster, thin legs, a few things with pattern; cameras that walk around in it.

`rooms=3` puts more of them in a row, with doorways between. As in photographs of rooms, structure from motion finds
points where there is pattern, and none on the walls. Solids, textures and light are those of the built-in garden;
sunlight comes in from above, as there is no ceiling.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Annotated

import torch
from torch import Tensor

from gsx.core.data.camera import Camera, look_at
from gsx.core.data.scene import PointCloud, Scene
from gsx.core.ranges import Range
from gsx.core.shapes import Float
from gsx.scenes.demo import textures
from gsx.scenes.demo.cameras import even_cameras
from gsx.scenes.demo.noise import blend
from gsx.scenes.demo.solids import box, cylinder, double, sphere
from gsx.scenes.demo.still_life import SEED, StillLife, Thing, arrange
from gsx.scenes.demo.textures import Kit, between, edge_distance, make_kit, parity, plain, rgb, smoothstep
from gsx.scenes.demo.tracing import colours_of, points_at
from gsx.scenes.demo.views import RayCastOptions, check, random_places, scene_of, size_of

HALF = (2.5, 2.0)  # of the floor, scene units: about metres
HEIGHT, THICK = 2.4, 0.1  # of the walls
FLOOR = 0.3  # above the garden's ground
FIELD_OF_VIEW = math.radians(62.0)  # horizontal
ROUNDS = 3  # of the walk
PITCH = 2 * HALF[0] + THICK  # between the middles of neighbouring rooms
DOOR = (1.0, 2.0)  # width and height of a doorway
CHART = (0.52, 0.35)  # half sizes of the picture on the wall
PLASTER = (0.87, 0.85, 0.81)
BOARD = 0.16  # width of a floor board
CONTRAST = 0.04  # of display values between neighbouring pixels: where structure from motion finds points
TRIES = 5  # rays for each point
VERSION = "7491cb90a50661ce"  # of the pictures, in protocols and the cache: give another where a pixel changes


def boards(p: Float[Tensor, "3 points"], n: Float[Tensor, "3 points"], kit: Kit) -> Float[Tensor, "3 points"]:
    """Draw floor boards with ends that do not meet, little contrast."""
    row = (p[1] / BOARD).floor()
    along = p[0] / 1.3 + 0.5 * parity(row)
    tone = 0.5 + 0.5 * kit.noise.at(along.floor() + 9.0, row + 30.0)
    grain = 1.0 + 0.05 * kit.noise.grain(p[0] * 4.0, p[1] * 60.0, 4)
    joint = torch.minimum(edge_distance(p[1] / BOARD, BOARD), edge_distance(along, 1.3))
    wood = between((0.55, 0.42, 0.29), (0.63, 0.50, 0.36), tone) * grain
    return blend(rgb((0.30, 0.23, 0.16)), wood, smoothstep(joint / 0.004))


def walls() -> list[Thing]:
    """Return floor and four walls."""
    (x, y), z = HALF, HEIGHT / 2
    plaster = partial(plain, colour=PLASTER)
    return [
        Thing(box("floor", (0.0, 0.0, 0.01), (2 * x, 2 * y, 0.02)), boards),
        Thing(box("north", (0.0, y + THICK / 2, z), (2 * x + 2 * THICK, THICK, HEIGHT)), plaster),
        Thing(box("south", (0.0, -y - THICK / 2, z), (2 * x + 2 * THICK, THICK, HEIGHT)), plaster),
        Thing(box("east", (x + THICK / 2, 0.0, z), (THICK, 2 * y, HEIGHT)), plaster),
        Thing(box("west", (-x - THICK / 2, 0.0, z), (THICK, 2 * y, HEIGHT)), plaster),
    ]


def on_legs(
    name: str, centre: tuple[float, float], size: tuple[float, float], height: float, leg: float
) -> list[Thing]:
    """Return a table top or a seat on four thin legs."""
    (x, y), (width, depth) = centre, size
    top = Thing(box(f"{name} top", (x, y, height - 0.02), (width, depth, 0.04)), textures.post)
    corners = [(x + i * (width / 2 - 0.05), y + j * (depth / 2 - 0.05)) for i in (-1, 1) for j in (-1, 1)]
    legs = [cylinder(f"{name} leg", (*corner, (height - 0.04) / 2), leg, height - 0.04) for corner in corners]
    return [top, *(Thing(one, textures.bark) for one in legs)]


def furniture() -> list[Thing]:
    """Return everything in the room."""
    x, y = HALF
    picture = box("picture", (0.3, y - 0.02, 1.45), (2 * CHART[0], 0.04, 2 * CHART[1]))
    return [
        *walls(),
        Thing(picture, partial(textures.sign, half=CHART)),
        Thing(box("chimney", (-x + 0.15, -0.9, 0.65), (0.30, 0.9, 1.3)), textures.bricks),
        *on_legs("table", (0.35, 0.15), (1.2, 0.7), 0.74, 0.02),
        *on_legs("chair", (-0.75, 0.75), (0.42, 0.42), 0.46, 0.014),
        Thing(box("back", (-0.75, 0.95, 0.78), (0.42, 0.03, 0.24)), textures.post),
        Thing(cylinder("tin", (0.1, 0.2, 0.74 + 0.13), 0.11, 0.26, -75.0), partial(textures.tin, radius=0.11)),
        Thing(sphere("marble", (0.62, 0.05, 0.74 + 0.12), 0.12), textures.marble),
        Thing(box("crate", (1.9, -1.35, 0.26), (0.52, 0.52, 0.52), 12.0), partial(textures.crate, half=0.26)),
        Thing(sphere("ball", (-1.2, -0.5, 0.23), 0.23, 20.0), textures.beach_ball, 0.35),
        Thing(cylinder("pot", (2.0, 1.5, 0.2), 0.25, 0.40), partial(textures.pot, half_height=0.2)),
        Thing(cylinder("trunk", (2.0, 1.5, 0.6), 0.045, 0.46), textures.bark),
        Thing(sphere("crown", (2.0, 1.5, 1.12), 0.40), textures.foliage),
        Thing(cylinder("lamp", (-1.9, 1.5, 0.75), 0.012, 1.5), textures.bark),
        Thing(sphere("shade", (-1.9, 1.5, 1.55), 0.16), textures.coping),
    ]


def doorway() -> list[Thing]:
    """Return the wall towards the next room, which has a doorway in its middle."""
    (x, y), (width, height) = HALF, DOOR
    side, over = y - width / 2, HEIGHT - height
    plaster = partial(plain, colour=PLASTER)
    pillars = [
        box(f"door {place}", (x + THICK / 2, place * (y + width / 2) / 2, HEIGHT / 2), (THICK, side, HEIGHT))
        for place in (-1, 1)
    ]
    lintel = box("lintel", (x + THICK / 2, 0.0, height + over / 2), (THICK, width, over))
    return [Thing(one, plaster) for one in (*pillars, lintel)]


def room_in_row(number: int, rooms: int) -> list[Thing]:
    """Return everything in one of several rooms; every second one is turned over from left to right."""
    last = number == rooms - 1
    left_out = ("west", "east")[number == 0 : 2 - last]  # of the walls between rooms
    things = [one for one in furniture() if one.solid.name not in left_out]
    return [placed(one, number) for one in [*things, *([] if last else doorway())]]


def placed(thing: Thing, number: int) -> Thing:
    """Return a thing above the garden's ground in the room of that number."""
    turned = double((1.0, -1.0 if number % 2 else 1.0, 1.0))
    centre = turned * thing.solid.centre + double((PITCH * number, 0.0, FLOOR))
    return replace(thing, solid=replace(thing.solid, centre=centre))


def make_room(rooms: int = 1) -> StillLife:
    """Arrange rooms in a row above the garden's ground, which darkens near things."""
    things = [thing for number in range(rooms) for thing in room_in_row(number, rooms)]
    return arrange(things, make_kit(torch.Generator().manual_seed(SEED)))


def touring_camera(place: float, width: int, height: int, rooms: int) -> Camera:
    """Return the camera at `place` in [0, 1) of walks in all rooms, one after the other."""
    number = int(rooms * place)
    camera = walking_camera(rooms * place - number, width, height)
    if not number:
        return camera
    return replace(camera, translation=camera.translation - PITCH * number * camera.rotation[:, 0])


def walking_camera(place: float, width: int, height: int) -> Camera:
    """Return the camera at `place` in [0, 1) of a walk around the table, at changing heights.

    It looks across the room, in the second round at the walls nearby.
    """
    turn = 2 * math.pi * ROUNDS * place
    outward = 1 <= ROUNDS * place < 2
    eye = (1.55 * math.cos(turn) - 0.1, 1.2 * math.sin(turn) - 0.1, FLOOR + 1.3 + 0.25 * math.sin(2.7 * turn))
    ahead = turn + (0.9 if outward else math.pi + 0.5 * math.sin(1.3 * turn))
    reach = 2.2 if outward else 1.0
    target = (reach * math.cos(ahead), reach * math.sin(ahead), FLOOR + 0.75)
    return look_at(eye, target, fov_x=FIELD_OF_VIEW, width=width, height=height)


def found_points(room: StillLife, cameras: Sequence[Camera], count: int, generator: torch.Generator) -> PointCloud:
    """Return points where pictures have pattern, as structure from motion finds them; `count` at most."""
    share = math.ceil(TRIES * count / len(cameras))
    places = [random_places(camera, share, generator) for camera in cameras]
    hits = [points_at(room, cameras, places, shift) for shift in ((0.0, 0.0), (1.0, 0.0), (0.0, 1.0))]
    colours, right, below = (colours_of(room, one) for one in hits)
    pattern = torch.maximum((right - colours).abs().amax(0), (below - colours).abs().amax(0)) > CONTRAST
    positions, colours = hits[0].points[:, pattern].T, colours[:, pattern].T
    chosen = torch.randperm(len(positions), generator=generator)[:count]
    return PointCloud(positions[chosen].contiguous(), (colours[chosen] * 255.0 + 0.5).to(torch.uint8))


@dataclass(frozen=True, kw_only=True)
class RoomOptions(RayCastOptions):
    """Options of `conf/scene/room.yaml`."""

    rooms: Annotated[int, Range(1, 100)] = 1
    """Rooms in a row, with doorways between. The default: runs older than this option."""


def load(options: RoomOptions) -> Scene:
    """Return the room, whose pictures are rendered at first use; ConfigError: see `check`."""
    check(options)
    path, views = partial(touring_camera, rooms=options.rooms), (options.train_views, options.test_views)
    cameras = even_cameras(path, "a walk", *views, size_of(options))
    version = VERSION if options.rooms == 1 else f"{VERSION} {options.rooms}"
    return scene_of(options, make_room(options.rooms), cameras, found_points, "room", version, floor=FLOOR)
