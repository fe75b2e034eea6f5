"""What lies behind all that structure from motion has found: sky, and backgrounds too far away to move.

A pixel is open where none of the scene's points is beside it in the picture, and none above it. Directions that open
pixels look in become points on a sphere, as far away as to stand still for cameras that walk, in the colours that
photographs show there: an environment behind the scene. Where something near turns out to hide it, it stays hidden.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from gsx.core.data.camera import Camera, offsets_from
from gsx.core.data.filling import FEWEST, in_view
from gsx.core.data.scene import PointCloud, Scene, View
from gsx.core.shapes import Bool, Float, Int

PIXELS = 4000
"""Pixels of a picture that are looked at, in rows and columns."""
GAP = 1.5
"""Side of the squares in which points are looked for, in mean spacings of a picture's points."""
CELLS = 8000
"""Directions of the whole sphere: 2.3 degrees apart."""
SEEN = 2
"""Pixels that have to look in a direction."""
DISTANCE = 200.0
"""Radius of the sphere, times the scene's extent: walking from one side of the cameras to the other moves it by half a
degree."""
BEYOND = 2.0
"""And at least so many times the distance within which nearly all of the scene's points lie."""
NEARLY_ALL = 0.99


@dataclass(frozen=True, eq=False, kw_only=True)
class Sky:
    """A part of a sphere around the training cameras."""

    points: PointCloud
    """One for each direction that is open."""
    spacing: float
    """Between neighbouring directions, scene units."""
    share: float
    """Of the pixels of training views that are open."""


def sky_of(scene: Scene) -> Sky:
    """What the photographs show behind the scene."""
    up, cells = upwards(scene.train), directions(CELLS)
    count, colour, looked = torch.zeros(CELLS), torch.zeros(CELLS, 3), 0
    for cell, shown, pixels in open_views(scene, up, cells):
        count.index_add_(0, cell, torch.ones(len(cell)))
        colour.index_add_(0, cell, shown)
        looked += pixels
    seen = count >= SEEN
    centre, radius = centre_of(scene.train), radius_of(scene)
    colours = (255 * colour[seen] / count[seen, None]).round().byte()
    points = PointCloud((centre + radius * cells[seen].double()).float(), colours)
    return Sky(
        points=points, spacing=radius * math.sqrt(4 * math.pi / CELLS), share=float(count.sum()) / max(1, looked)
    )


def open_views(
    scene: Scene, up: Float[Tensor, "3"], cells: Float[Tensor, "C 3"]
) -> Iterator[tuple[Int[Tensor, "P"], Float[Tensor, "P 3"], int]]:
    """Of each training view (cells that its open pixels look in, their colours, how many pixels were looked at)."""
    for view in scene.train:
        pixels = grid(view)
        found = pixels[open_pixels(view, pixels, scene.points, up)]
        column, row = found.long().unbind(1)
        yield (rays_of(view.camera, found) @ cells.T).argmax(1), view.image()[:, row, column].T, len(pixels)


def grid(view: View) -> Float[Tensor, "P 2"]:
    """Centres of pixels in rows and columns, of which at most PIXELS are looked at in a square picture."""
    step = max(1, math.ceil(math.sqrt(view.camera.width * view.camera.height / PIXELS)))
    columns, rows = (torch.arange(min(step // 2, side - 1), side, step) + 0.5 for side in view.camera.size)
    return torch.cartesian_prod(columns, rows)


def open_pixels(
    view: View, pixels: Float[Tensor, "P 2"], points: PointCloud, up: Float[Tensor, "3"]
) -> Bool[Tensor, "P"]:
    """Which pixels count, show more than the background of a cut-out picture, and have no point beside or above; none
    where a picture shows too few points."""
    camera = view.camera
    shown, _ = in_view(camera, points.positions)
    if len(shown) < FEWEST:
        return torch.zeros(len(pixels), dtype=torch.bool)
    square = GAP * math.sqrt(camera.width * camera.height / len(shown))
    open_ = none_above(pixels, shown, upwards_in(view, up), square)
    column, row = pixels.long().unbind(1)
    for left, wanted in ((view.counted(), True), (view.transparent(), False)):
        if left is not None:
            open_ &= left[row, column] == wanted
    return open_


def none_above(
    pixels: Float[Tensor, "P 2"], points: Float[Tensor, "M 2"], up: Float[Tensor, "2"], square: float
) -> Bool[Tensor, "P"]:
    """Pixels that are at least two squares above the highest point in their own column of squares and in the two beside
    it. The sides of a square are so many px, its columns go upwards in the picture."""
    axes = torch.stack([torch.stack([-up[1], up[0]]), up])
    ours, theirs = ((places @ axes.T / square).floor().long() for places in (pixels, points))
    first = min(int(ours[:, 0].min()), int(theirs[:, 0].min())) - 1
    columns = max(int(ours[:, 0].max()), int(theirs[:, 0].max())) - first + 2
    highest = torch.full((columns,), -(2**40)).scatter_reduce_(0, theirs[:, 0] - first, theirs[:, 1], "amax")
    column = ours[:, 0] - first
    beside = torch.stack([highest[column + side] for side in (-1, 0, 1)]).amax(0)
    return ours[:, 1] > beside + 1


# -- cameras and directions --------------------------------------------------------------------------------------------


def upwards(views: Sequence[View]) -> Float[Tensor, "3"]:
    """The direction in the world that is up in most pictures."""
    mean = -torch.stack([view.camera.rotation.float()[1] for view in views]).mean(0)
    return mean / mean.norm().clamp_min(1e-9)


def upwards_in(view: View, up: Float[Tensor, "3"]) -> Float[Tensor, "2"]:
    """The direction in the picture of a camera in which the world's is."""
    along = (view.camera.rotation.float() @ up)[:2]
    return along / along.norm().clamp_min(1e-9)


def far_away(positions: Float[Tensor, "N 3"], scene: Scene) -> Bool[Tensor, "N"]:
    """Which positions lie where a sky does: no camera of the scene can tell how far away that is."""
    return offsets_from(positions, centre_of(scene.train)).norm(dim=1) > DISTANCE / 2 * scene.extent


def rays_of(camera: Camera, pixels: Float[Tensor, "P 2"]) -> Float[Tensor, "P 3"]:
    """Directions in the world in which pixels look, at a depth of 1."""
    x, y = (pixels[:, 0] - camera.cx) / camera.fx, (pixels[:, 1] - camera.cy) / camera.fy
    return torch.stack([x, y, torch.ones_like(x)], 1) @ camera.rotation.float()


def centre_of(views: Sequence[View]) -> Float[Tensor, "3"]:
    """Mean of the cameras' places, float64."""
    return torch.stack([view.camera.centre.double() for view in views]).mean(0)


def radius_of(scene: Scene) -> float:
    """Of a sphere around all of the scene."""
    distances = offsets_from(scene.points.positions.float(), centre_of(scene.train)).norm(dim=1)
    last = max(1, round(NEARLY_ALL * len(distances)))
    within = float(distances.kthvalue(last).values) if len(distances) else 0.0
    return max(DISTANCE * scene.extent, BEYOND * within)


def directions(count: int) -> Float[Tensor, "C 3"]:
    """So many unit vectors, evenly over the sphere (Fibonacci's spiral)."""
    place = torch.arange(count, dtype=torch.float64) + 0.5
    z, turn = 1 - 2 * place / count, math.pi * (1 + math.sqrt(5)) * place
    flat = (1 - z.square()).sqrt()
    return torch.stack([flat * turn.cos(), flat * turn.sin(), z], 1).float()
