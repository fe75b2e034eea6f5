"""Blocks of a large scene: each is trained alone, and `gsx merge` joins their models.

Training cameras are halved across the longest side of their box, and the halves again, into blocks of equal numbers.
The cuts bound the cell of each block; cells on the outside have no end. A block trains on the cameras in its cell and
around it, and on others that show much of its points, as VastGaussian (Lin et al. 2024) chooses its cameras.
"""

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from gsx.core.data.camera import centres_of
from gsx.core.data.scene import PointCloud, Scene, View, extent_of
from gsx.core.errors import ConfigError
from gsx.core.shapes import Bool, Float, Int
from gsx.scenes.filling import in_front

LEAST_VIEWS = 8
"""Fewest training cameras in the cell of a block."""
MOST_POINTS = 5000
"""Points, evenly over all, by which cameras outside of a cell are chosen."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Cell:
    """Box of a block, infinite towards the outside, and the cameras in it."""

    low: Float[Tensor, "3"]
    high: Float[Tensor, "3"]
    cameras: Int[Tensor, "K"]
    """Numbers of the training cameras in it."""

    def holds(self, positions: Float[Tensor, "N 3"], margin: Float[Tensor, "3"] | float = 0.0) -> Bool[Tensor, "N"]:
        """Marks the positions in the cell, or at most a margin outside of it; cells without margin do not overlap."""
        low, high = (side.to(positions) for side in (self.low - margin, self.high + margin))
        return ((positions >= low) & (positions < high)).all(1)


@dataclass(frozen=True, kw_only=True)
class BlockChoice:
    """Block to train on."""

    number: int
    """Number of the block, from 1."""
    count: int
    margin: float
    """Width of the zone around the cell whose cameras are used, as a share of the box of the cell's own cameras."""
    share: float
    """Share of the cell's points that a camera outside of that zone must show to be used."""


def parsed_block(word: str) -> tuple[int, int]:
    """Returns number and count of a word such as 2/3; ConfigError: it is none."""
    found = re.fullmatch(r"(\d{1,4})/(\d{1,4})", word)
    number, count = (int(part) for part in found.groups()) if found else (0, 0)
    if not 1 <= number <= count:
        raise ConfigError(f"scene.block is '{word}': give NUMBER/COUNT, such as 1/3 for the first of three blocks")
    return number, count


def cells_of(centres: Float[Tensor, "N 3"], count: int) -> list[Cell]:
    """Cuts space into cells with equal numbers of camera centres.

    Raises:
        ConfigError: there are too few cameras for so many blocks.
    """
    if len(centres) < LEAST_VIEWS * count:
        raise ConfigError(
            f"{len(centres)} training views are too few for {count} blocks: give at most "
            f"{max(1, len(centres) // LEAST_VIEWS)}, with {LEAST_VIEWS} views in each"
        )
    everywhere = centres.new_full((3,), math.inf)
    return halved(centres, Cell(low=-everywhere, high=everywhere, cameras=torch.arange(len(centres))), count)


def halved(centres: Float[Tensor, "N 3"], cell: Cell, count: int) -> list[Cell]:
    """Cuts a cell into `count` cells."""
    if count == 1:
        return [cell]
    own = centres[cell.cameras]
    axis = int((own.amax(0) - own.amin(0)).argmax())
    order = own[:, axis].argsort(stable=True)
    first = len(own) * (count // 2) // count
    place = float(own[order[first - 1 : first + 1], axis].mean())
    below, above = cell.high.clone(), cell.low.clone()
    below[axis] = above[axis] = place
    left = replace(cell, high=below, cameras=cell.cameras[own[:, axis] < place])
    right = replace(cell, low=above, cameras=cell.cameras[own[:, axis] >= place])
    return [*halved(centres, left, count // 2), *halved(centres, right, count - count // 2)]


def scene_cells(scene: Scene, count: int) -> list[Cell]:
    """Returns the cells of a whole scene; ConfigError: see `cells_of`."""
    return cells_of(centres_of([view.camera for view in scene.train]), count)


def block_of(scene: Scene, choice: BlockChoice) -> Scene:
    """Returns the part of a scene on which a block is trained, with a note.

    Its test views are those in the cell, or the nearest one.

    Raises:
        ConfigError: there are too few cameras for so many blocks.
    """
    cell = scene_cells(scene, choice.count)[choice.number - 1]
    train = [view for view, used in zip(scene.train, used_views(scene, cell, choice), strict=True) if used]
    test = tested_views(scene.test, cell)
    note = (
        f"block {choice.number} of {choice.count}: {len(train)} of {len(scene.train)} training views, "
        f"{len(cell.cameras)} of them in its cell"
    )
    return replace(
        scene,
        train=train,
        test=test,
        points=points_in_views(scene.points, train),
        extent=extent_of([view.camera for view in train]),
        notes=[*scene.notes, note],
        provenance=scene.provenance | {"block": [choice.number, choice.count]},
    )


def used_views(scene: Scene, cell: Cell, choice: BlockChoice) -> Bool[Tensor, "N"]:
    """Marks the training views of a block."""
    centres = centres_of([view.camera for view in scene.train])
    own = centres[cell.cameras]
    near = cell.holds(centres, choice.margin * (own.amax(0) - own.amin(0)))
    step = 1 + len(scene.points) // MOST_POINTS
    points = scene.points.positions[::step]
    inside = cell.holds(points)
    shares = torch.tensor([float(visible_points(view, points)[inside].double().mean()) for view in scene.train])
    return near | (shares >= choice.share)  # of no points: nan, which is not


def tested_views(views: Sequence[View], cell: Cell) -> list[View]:
    """Returns the test views in a cell, or the one nearest to its cameras' side; empty: there are none."""
    if not views:
        return []
    centres = centres_of([view.camera for view in views])
    inside = cell.holds(centres)
    if not bool(inside.any()):
        outside = (cell.low - centres).clamp_min(0) + (centres - cell.high).clamp_min(0)
        inside[int(outside.square().sum(1).argmin())] = True
    return [view for view, used in zip(views, inside, strict=True) if used]


def visible_points(view: View, positions: Float[Tensor, "P 3"]) -> Bool[Tensor, "P"]:
    """Marks the points in the picture of a view, except those that others hide."""
    pixels, depths = view.camera.project(positions)
    marks = view.camera.shows(pixels, depths)
    if bool(marks.any()):
        marks[marks.clone()] = in_front(pixels[marks], depths[marks])
    return marks


def points_in_views(points: PointCloud, views: Sequence[View]) -> PointCloud:
    """Returns the points in the picture of some view."""
    found = torch.zeros(len(points), dtype=torch.bool)
    for view in views:
        found |= view.camera.shows(*view.camera.project(points.positions))
    return PointCloud(points.positions[found], points.colours[found])
