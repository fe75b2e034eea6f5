"""Gaussians behind the points of structure from motion: sky and distant background.

A pixel is open if no point of the scene projects near it or above it. The directions of open pixels become points on a
distant sphere, without visible parallax, in the mean colour of the photos. Density control does not change them.
"""

import logging
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from gsx.core.data.camera import Camera, centres_of, offsets_from
from gsx.core.data.scene import PointCloud, Scene, View
from gsx.core.shapes import Bool, Float, Int
from gsx.core.training.parameter_table import ParameterTable
from gsx.formats.turned import spread_directions

logger = logging.getLogger(__name__)

WHEN = ("never", "auto", "always")
"""Choices of `sky`."""
PIXELS = 4000
"""Most pixels of a picture that are examined, on a regular grid."""
FEWEST = 16
"""Least points in a picture with open pixels."""
GAP = 1.5
"""Side of the squares in which points are searched, in mean spacings of a picture's points."""
CELLS = 8000
"""Directions on the whole sphere, 2.3 degrees apart."""
LEAST_PIXELS = 2
"""Least open pixels of a direction."""
DISTANCE = 200.0
"""Least radius of the sphere, in extents of the scene: walking across all cameras moves it by half a degree."""
BEYOND = 2.0
"""Least radius over the distance that contains `NEARLY_ALL` points of the scene."""
NEARLY_ALL = 0.99
SKY_OPACITY = 0.98
"""Initial opacity: high, so that no near Gaussians grow in its place."""
WIDEST = 1.5
"""Largest initial size, in spacings of directions: a larger Gaussian would cover its neighbours."""
OPEN = 0.01
"""Least share of open pixels for a sky, with `sky=auto`."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Sky:
    """Points on a sphere around the training cameras."""

    points: PointCloud
    """One point for each open direction."""
    spacing: float
    """Distance of neighbouring points, scene units."""
    share: float
    """Share of open pixels in training views."""


NOTHING = Sky(points=PointCloud(torch.zeros(0, 3), torch.zeros(0, 3, dtype=torch.uint8)), spacing=1.0, share=0.0)


def sky_behind(scene: Scene, when: str) -> Sky:
    """Returns the sky of a scene; with `auto` none if few pixels are open."""
    sky = sky_of(scene)
    behind = when == "always" or sky.share >= OPEN
    verdict = f"adding {len(sky.points):,} distant Gaussians" if behind else "adding none"
    sign = ">=" if sky.share >= OPEN else "<"
    logger.info("sky: open pixels of training views %.1f %% %s %g %%, %s", 100 * sky.share, sign, 100 * OPEN, verdict)
    return sky if behind else NOTHING


def not_sky(table: ParameterTable) -> Bool[Tensor, "N"]:
    """Marks rows of the scene itself, which density control may change."""
    if "sky" in table.columns:
        return table["sky"] == 0
    return torch.ones(len(table), dtype=torch.bool, device=table.device)


def far_away(positions: Float[Tensor, "N 3"], scene: Scene) -> Bool[Tensor, "N"]:
    """Marks positions as far away as a sky, without visible parallax."""
    return offsets_from(positions, centre_of(scene.train)).norm(dim=1) > DISTANCE / 2 * scene.extent


# -- open pixels -------------------------------------------------------------------------------------------------------


def sky_of(scene: Scene) -> Sky:
    """Returns the directions of open pixels of training views, with their mean colours."""
    up, cells = upwards(scene.train), spread_directions(CELLS).float()
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
    """Yields for each training view (directions of its open pixels, their colours, number of examined pixels)."""
    for view in scene.train:
        pixels = pixel_grid(view)
        chosen = pixels[open_pixels(view, pixels, scene.points, up)]
        column, row = chosen.long().unbind(1)
        yield (rays_of(view.camera, chosen) @ cells.T).argmax(1), view.image()[:, row, column].T, len(pixels)


def pixel_grid(view: View) -> Float[Tensor, "P 2"]:
    """Returns centres of pixels on a regular grid, about PIXELS of them."""
    step = max(1, math.ceil(math.sqrt(view.camera.width * view.camera.height / PIXELS)))
    columns, rows = (torch.arange(min(step // 2, side - 1), side, step) + 0.5 for side in view.camera.size)
    return torch.cartesian_prod(columns, rows)


def open_pixels(
    view: View, pixels: Float[Tensor, "P 2"], points: PointCloud, up: Float[Tensor, "3"]
) -> Bool[Tensor, "P"]:
    """Marks pixels that count, are not transparent, and have no point near or above; none with too few points."""
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
    """Marks pixels at least two squares above the highest point in their column of squares and its neighbours.

    Squares have sides of `square` px; columns run along `up`.
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
    """Returns the world's mean up direction of all pictures."""
    mean = -torch.stack([view.camera.rotation.float()[1] for view in views]).mean(0)
    return mean / mean.norm().clamp_min(1e-9)


def upwards_in(view: View, up: Float[Tensor, "3"]) -> Float[Tensor, "2"]:
    """Returns the direction of the world's `up` in a picture."""
    along = (view.camera.rotation.float() @ up)[:2]
    return along / along.norm().clamp_min(1e-9)


def rays_of(camera: Camera, pixels: Float[Tensor, "P 2"]) -> Float[Tensor, "P 3"]:
    """Returns world directions of pixels, at depth 1."""
    slopes = camera.slopes(pixels)
    return torch.cat([slopes, torch.ones_like(slopes[:, :1])], 1) @ camera.rotation.float()


def centre_of(views: Sequence[View]) -> Float[Tensor, "3"]:
    """Returns the mean camera centre, float64."""
    return centres_of([view.camera for view in views]).mean(0)


def radius_of(scene: Scene) -> float:
    """Returns the radius of the sky's sphere, scene units."""
    distances = offsets_from(scene.points.positions.float(), centre_of(scene.train)).norm(dim=1)
    last = max(1, round(NEARLY_ALL * len(distances)))
    within = float(distances.kthvalue(last).values) if len(distances) else 0.0
    return max(DISTANCE * scene.extent, BEYOND * within)
