"""Gaussians behind all that structure from motion has found: sky, and backgrounds too far away to move.

A pixel is open where none of the scene's points is beside it in the picture, and none above it. Directions that open
pixels look in become points on a sphere, as far away as to stand still for cameras that walk, in the colours that
photos show there: an environment behind the scene. Where something near turns out to hide it, it stays hidden.
Density control leaves these Gaussians alone.
"""

import logging
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from gsx.core.data.camera import Camera, offsets_from
from gsx.core.data.scene import PointCloud, Scene, View
from gsx.core.shapes import Bool, Float, Int
from gsx.core.training.parameter_table import ParameterTable

logger = logging.getLogger(__name__)

WHEN = ("never", "auto", "always")
"""Choices of `sky`."""
PIXELS = 4000
"""Pixels of a picture that are examined, in rows and columns."""
FEWEST = 16
"""Points that a picture has to show before it tells what lies behind them."""
GAP = 1.5
"""Side of the squares in which points are looked for, in mean spacings of a picture's points."""
CELLS = 8000
"""Directions of the whole sphere: 2.3 degrees apart."""
LEAST_PIXELS = 2
"""Pixels that have to look in a direction."""
DISTANCE = 200.0
"""Radius of the sphere, times the scene's extent: walking from one side of the cameras to the other moves it by half a
degree."""
BEYOND = 2.0
"""And at least so many times the distance within which nearly all of the scene's points lie."""
NEARLY_ALL = 0.99
SKY_OPACITY = 0.98
"""Initial opacity: nothing near has to be made up in its place."""
WIDEST = 1.5
"""Largest initial size, in spacings of directions: a Gaussian with far neighbours would cover what is beside it."""
OPEN = 0.01
"""`sky=auto`: share of the pixels that look past the scene, from which on something stands behind it."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Sky:
    """A part of a sphere around the training cameras."""

    points: PointCloud
    """One for each direction that is open."""
    spacing: float
    """Distance of neighbouring directions, scene units."""
    share: float
    """Share of the pixels of training views that are open."""


NOTHING = Sky(points=PointCloud(torch.zeros(0, 3), torch.zeros(0, 3, dtype=torch.uint8)), spacing=1.0, share=0.0)


def sky_behind(scene: Scene, when: str) -> Sky:
    """Returns what stands behind a scene; with `auto` nothing where photos hardly look past it."""
    sky = sky_of(scene)
    behind = when == "always" or sky.share >= OPEN
    verdict = f"{len(sky.points):,} Gaussians far away stand behind it" if behind else "nothing stands behind it"
    logger.info("sky: %.1f %% of the pixels of training views look past the scene: %s", 100 * sky.share, verdict)
    return sky if behind else NOTHING


def not_sky(table: ParameterTable) -> Bool[Tensor, "N"]:
    """Marks rows of the scene itself: density control neither splits sky nor prunes it for its size."""
    if "sky" in table.columns:
        return table["sky"] == 0
    return torch.ones(len(table), dtype=torch.bool, device=table.device)


def far_away(positions: Float[Tensor, "N 3"], scene: Scene) -> Bool[Tensor, "N"]:
    """Marks positions that lie where a sky does: no camera of the scene can tell how far away that is."""
    return offsets_from(positions, centre_of(scene.train)).norm(dim=1) > DISTANCE / 2 * scene.extent


# -- open pixels -------------------------------------------------------------------------------------------------------


def sky_of(scene: Scene) -> Sky:
    """Returns the directions that open pixels of training views look in, with the colours they show."""
    up, cells = upwards(scene.train), directions(CELLS)
    count, colour, total = torch.zeros(CELLS), torch.zeros(CELLS, 3), 0
    for cell, values, pixels in open_views(scene, up, cells):
        count.index_add_(0, cell, torch.ones(len(cell)))
        colour.index_add_(0, cell, values)
        total += pixels
    open_cells = count >= LEAST_PIXELS
    centre, radius = centre_of(scene.train), radius_of(scene)
    colours = (255 * colour[open_cells] / count[open_cells, None]).round().byte()
    points = PointCloud((centre + radius * cells[open_cells].double()).float(), colours)
    spacing = radius * math.sqrt(4 * math.pi / CELLS)
    return Sky(points=points, spacing=spacing, share=float(count.sum()) / max(1, total))


def open_views(
    scene: Scene, up: Float[Tensor, "3"], cells: Float[Tensor, "C 3"]
) -> Iterator[tuple[Int[Tensor, "P"], Float[Tensor, "P 3"], int]]:
    """Yields for each training view (cells that its open pixels look in, their colours, number of pixels examined)."""
    for view in scene.train:
        pixels = pixel_grid(view)
        chosen = pixels[open_pixels(view, pixels, scene.points, up)]
        column, row = chosen.long().unbind(1)
        yield (rays_of(view.camera, chosen) @ cells.T).argmax(1), view.image()[:, row, column].T, len(pixels)


def pixel_grid(view: View) -> Float[Tensor, "P 2"]:
    """Returns centres of pixels in rows and columns, at most PIXELS in a square picture."""
    step = max(1, math.ceil(math.sqrt(view.camera.width * view.camera.height / PIXELS)))
    columns, rows = (torch.arange(min(step // 2, side - 1), side, step) + 0.5 for side in view.camera.size)
    return torch.cartesian_prod(columns, rows)


def open_pixels(
    view: View, pixels: Float[Tensor, "P 2"], points: PointCloud, up: Float[Tensor, "3"]
) -> Bool[Tensor, "P"]:
    """Marks pixels that count, show more than the background of a cut-out picture, and have no point beside or above.

    None where a picture shows too few points.
    """
    camera = view.camera
    places, depths = camera.project(points.positions)
    places = places[camera.shows(places, depths)]
    if len(places) < FEWEST:
        return torch.zeros(len(pixels), dtype=torch.bool)
    square = GAP * math.sqrt(camera.width * camera.height / len(places))
    open_ = none_above(pixels, places, upwards_in(view, up), square)
    column, row = pixels.long().unbind(1)
    for mask, required in ((view.counted(), True), (view.transparent(), False)):
        if mask is not None:
            open_ &= mask[row, column] == required
    return open_


def none_above(
    pixels: Float[Tensor, "P 2"], points: Float[Tensor, "M 2"], up: Float[Tensor, "2"], square: float
) -> Bool[Tensor, "P"]:
    """Marks pixels that are at least two squares above the highest point in their column of squares and its neighbours.

    A square's sides are `square` px long; columns go upwards in the picture.
    """
    axes = torch.stack([torch.stack([-up[1], up[0]]), up])
    of_pixels, of_points = ((places @ axes.T / square).floor().long() for places in (pixels, points))
    first = min(int(of_pixels[:, 0].min()), int(of_points[:, 0].min())) - 1
    columns = max(int(of_pixels[:, 0].max()), int(of_points[:, 0].max())) - first + 2
    highest = torch.full((columns,), -(2**40)).scatter_reduce_(0, of_points[:, 0] - first, of_points[:, 1], "amax")
    column = of_pixels[:, 0] - first
    neighbours = torch.stack([highest[column + side] for side in (-1, 0, 1)]).amax(0)
    return of_pixels[:, 1] > neighbours + 1


# -- cameras and directions --------------------------------------------------------------------------------------------


def upwards(views: Sequence[View]) -> Float[Tensor, "3"]:
    """Returns the direction in the world that is up in most pictures."""
    mean = -torch.stack([view.camera.rotation.float()[1] for view in views]).mean(0)
    return mean / mean.norm().clamp_min(1e-9)


def upwards_in(view: View, up: Float[Tensor, "3"]) -> Float[Tensor, "2"]:
    """Returns the direction in a camera's picture in which the world's `up` points."""
    along = (view.camera.rotation.float() @ up)[:2]
    return along / along.norm().clamp_min(1e-9)


def rays_of(camera: Camera, pixels: Float[Tensor, "P 2"]) -> Float[Tensor, "P 3"]:
    """Returns directions in the world in which pixels look, at a depth of 1."""
    x, y = (pixels[:, 0] - camera.cx) / camera.fx, (pixels[:, 1] - camera.cy) / camera.fy
    return torch.stack([x, y, torch.ones_like(x)], 1) @ camera.rotation.float()


def centre_of(views: Sequence[View]) -> Float[Tensor, "3"]:
    """Returns the mean of the cameras' places, float64."""
    return torch.stack([view.camera.centre.double() for view in views]).mean(0)


def radius_of(scene: Scene) -> float:
    """Returns the radius of a sphere around all of the scene."""
    distances = offsets_from(scene.points.positions.float(), centre_of(scene.train)).norm(dim=1)
    last = max(1, round(NEARLY_ALL * len(distances)))
    within = float(distances.kthvalue(last).values) if len(distances) else 0.0
    return max(DISTANCE * scene.extent, BEYOND * within)


def directions(count: int) -> Float[Tensor, "C 3"]:
    """Returns `count` unit vectors, evenly over the sphere (Fibonacci's spiral)."""
    place = torch.arange(count, dtype=torch.float64) + 0.5
    z, turn = 1 - 2 * place / count, math.pi * (1 + math.sqrt(5)) * place
    flat = (1 - z.square()).sqrt()
    return torch.stack([flat * turn.cos(), flat * turn.sin(), z], 1).float()
