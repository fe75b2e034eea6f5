"""Levels of detail over any representation (Octree-GS).

Level 0 is the coarsest; a camera at distance d draws all levels up to log_f(D / (s d)). Level L is a grid with cells of
v / f^L; levels do not point to each other.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from gsx.backbones.anchor_options import LevelOptions
from gsx.backbones.cells import new_cells
from gsx.backbones.density import quantile
from gsx.core.data.camera import Camera, centres_of, offsets_from
from gsx.core.shapes import Bool, Float, Int
from gsx.core.training.schedule import Schedule

BELOW_ONE = 0.9999
"""Largest fading weight of progressive mode (Octree-GS) and largest adaptive threshold."""
LEAST_DISTANCE = 1e-8
"""Lower bound of distances whose logarithm is taken, as a fraction of the farthest."""
MANY_LEVELS = 12
NEAR_RATIO = 1e-3
"""Nearest distance over the farthest below which points lie at cameras."""
FEW_ANCHORS = 100
MANY_ANCHORS = 5_000_000
FLOAT_STEP = 2.0**-23
"""Largest relative distance of neighbouring float32 numbers."""


def all_levels_from(options: LevelOptions, schedule: Schedule) -> int:
    """Returns the step at which all levels are in training, at most the last but one; 0: from the start."""
    return min(schedule.step(options.coarse_until), schedule.iterations - 1)


@dataclass(frozen=True, eq=False, kw_only=True)
class Viewpoints:
    """Positions and sampling coarseness of the training cameras."""

    centres: Float[Tensor, "V 3"]
    """World, float64."""
    coarseness: Float[Tensor, "V"]
    """s: largest focal length over this camera's; half the focal length acts as twice the distance."""
    focal: float
    """The largest focal length, px."""


def viewpoints_of(cameras: Sequence[Camera]) -> Viewpoints:
    """Returns positions and coarseness of the training cameras."""
    focal = max(camera.fx for camera in cameras)
    return Viewpoints(
        centres=centres_of(cameras),
        coarseness=torch.tensor([focal / camera.fx for camera in cameras]),
        focal=focal,
    )


@dataclass(frozen=True, eq=False, kw_only=True)
class Levels:
    """Parameters of a scene's levels."""

    count: int
    """K."""
    fork: int
    nearest: float
    """Low quantile of distances between cameras and points, scene units of the finest camera (Octree-GS, set_level)."""
    farthest: float
    """D: distance at which the finest camera draws only level 0."""
    origin: float
    """Each coordinate of node (0, 0, 0) of every grid."""
    extent: float
    """Edge of the box around the points, scene units; 0 if all coordinates are equal."""
    base_layer: int
    """Forks from the box to a cell of level 0."""
    first: int
    """Highest level in training at the start."""
    switches: tuple[int, ...]
    """Steps after which one more level is in training (Octree-GS, set_coarse_interval)."""
    threshold: float
    """Least fraction of cameras that must draw a primitive; see `LevelOptions.visible_threshold`."""
    mode: str
    half_cell: bool
    zoom: str
    views: Viewpoints

    @property
    def box(self) -> float:
        """Return the length that cells divide, scene units: the extent, or D if that is 0."""
        return self.extent or self.farthest

    @property
    def cell(self) -> float:
        """Return the cell length v of level 0, scene units (Octree-GS, octree_sample)."""
        return self.size(0)

    @property
    def pixels_per_cell(self) -> float:
        """Return the cell length of level 0 at distance D, px of the finest training camera."""
        return self.cell * self.views.focal / self.farthest

    def size(self, level: int) -> float:
        """Returns the cell length of one level, scene units."""
        return self.box / float(self.fork) ** (self.base_layer + level)

    def cell_of(self, levels: Int[Tensor, "M"]) -> Float[Tensor, "M"]:
        """Returns the cell length of each primitive's level, scene units."""
        return self.cell / float(self.fork) ** levels.float()

    def cells(self, positions: Float[Tensor, "M 3"], level: int) -> Int[Tensor, "M 3"]:
        """Returns the nearest nodes of a level's grid, halves to even."""
        return ((positions.double() - self.origin) / self.size(level)).round().long()

    def nodes(self, cells: Int[Tensor, "M 3"], level: int) -> Float[Tensor, "M 3"]:
        """Returns world positions of nodes, float32."""
        return (cells.double() * self.size(level) + self.origin).float()

    def highest(self, step: int) -> int:
        """Returns the highest level in training at a step (Octree-GS, set_coarse_interval)."""
        return min(self.count - 1, unlocked(self.switches, self.first, step))

    def coarseness(self, camera: Camera) -> float:
        """Returns the largest training focal length over this camera's; at least 1 if zoom is training."""
        ratio = self.views.focal / camera.fx
        return max(1.0, ratio) if self.zoom == "training" else ratio

    def ideal(self, distances: Float[Tensor, "M"], coarseness: float) -> Float[Tensor, "M"]:
        """Returns L* = log_f(D / (s d)), always finite (Octree-GS, set_anchor_mask)."""
        nearness = self.farthest / (coarseness * distances).clamp_min(LEAST_DISTANCE * self.farthest)
        return nearness.log2() / math.log2(self.fork)


def derive(points: Float[Tensor, "P 3"], cameras: Sequence[Camera], options: LevelOptions, until: int) -> Levels:
    """Derives a scene's levels (Octree-GS); `until`: step at which all are in training, 0: from the start."""
    points, views = points.unique(dim=0), viewpoints_of(cameras)
    near, far = distance_range(points, views, options.distance_quantile)
    count = level_count(near, far, options.fork) if options.count == -1 else options.count
    first = first_level(count, options.first, until)
    origin, extent = box_of(points, options.extend, options.extend_rule)
    farthest = far or 1.0
    levels = Levels(
        count=count,
        fork=options.fork,
        nearest=near,
        farthest=farthest,
        origin=origin,
        extent=extent,
        base_layer=base_layer(extent or farthest, count, options, views.focal / farthest),
        first=first,
        switches=switch_points(count, first, until, options.coarse_factor),
        threshold=options.visible_threshold,
        mode=options.mode,
        half_cell=bool(options.half_cell),
        zoom=options.zoom,
        views=views,
    )
    if options.visible_threshold >= 0:
        return levels
    positions, of, _ = all_nodes(points, levels)
    threshold = float(drawn_fraction(levels, positions, of).double().mean())
    return replace(levels, threshold=min(threshold, BELOW_ONE))


def distance_range(points: Float[Tensor, "P 3"], views: Viewpoints, fraction: float) -> tuple[float, float]:
    """Returns (near, far) distances between cameras and points, scaled to the finest camera (Octree-GS, set_level)."""
    listed = []
    for centre, coarseness in zip(views.centres, views.coarseness.tolist(), strict=True):
        distances = offsets_from(points, centre).norm(dim=1)
        listed += [coarseness * quantile(distances, q) for q in (fraction, 1 - fraction)]
    quantiles = torch.tensor(listed, dtype=torch.float64)
    return quantile(quantiles, 1 - fraction), quantile(quantiles, fraction)


def level_count(near: float, far: float, fork: int) -> int:
    """Returns the number of levels: forks in the range of distances, plus 1 (Octree-GS, set_level)."""
    if far == 0:
        return 1
    return round(math.log(far / max(near, LEAST_DISTANCE * far), fork)) + 1


def box_of(points: Float[Tensor, "P 3"], extend: float, rule: str) -> tuple[float, float]:
    """Returns (lowest coordinate, length) of the cube around the points (Octree-GS, octree_sample)."""
    low, high = float(points.min()), float(points.max())
    start = extend * low if rule == "reference" else low - (extend - 1) / 2 * (high - low)
    return start, extend * (high - low)


def first_level(count: int, first: int, until: int) -> int:
    """Returns the highest level at the start; -1: half of them (Octree-GS, set_level); the last if `until` is 0."""
    if until < 1:
        return count - 1
    return min(count // 2 if first == -1 else first, count - 1)


def base_layer(box: float, count: int, options: LevelOptions, pixels: float) -> int:
    """Returns forks from the box to a cell of level 0; -1: level K/2 - 1 has cells of `voxel` (Octree-GS).

    Cells keep at least `cell_pixels`; `pixels`: those of a unit of length at the farthest distance.
    """
    chosen = options.base_layer
    if chosen < 0:
        chosen = round(math.log(box / options.voxel, options.fork)) - count // 2 + 1
    if not options.cell_pixels:
        return chosen
    return min(chosen, max(0, math.floor(math.log(box * pixels / options.cell_pixels, options.fork) + 1e-9)))


def all_nodes(
    points: Float[Tensor, "P 3"], levels: Levels
) -> tuple[Float[Tensor, "C 3"], Int[Tensor, "C"], Int[Tensor, "K P"]]:
    """Returns (positions, levels, group) of the nodes nearest to the points on each level (Octree-GS)."""
    positions, of, group, total = [], [], [], 0
    for level in range(levels.count):
        cells, place = new_cells(levels.cells(points, level), torch.empty(0, 3, dtype=torch.long, device=points.device))
        positions.append(levels.nodes(cells, level))
        of.append(torch.full((len(cells),), level, dtype=torch.int16, device=points.device))
        group.append(place + total)
        total += len(cells)
    return torch.cat(positions), torch.cat(of), torch.stack(group)


def initial_nodes(
    points: Float[Tensor, "P 3"], levels: Levels
) -> tuple[Float[Tensor, "N 3"], Int[Tensor, "N"], Int[Tensor, "K P"]]:
    """Returns (positions, levels as int16, group) of the initial nodes: those that enough cameras draw (Octree-GS).

    `group[L, p]` is the row of the node of point p on level L; -1: it was left out.
    """
    positions, of, group = all_nodes(points, levels)
    chosen = kept(levels, positions, of)
    number = torch.where(chosen, chosen.cumsum(0) - 1, -1)
    return positions[chosen], of[chosen], number[group]


def whole_level(ideal: Float[Tensor, "M"], mode: str, highest: int) -> tuple[Int[Tensor, "M"], Float[Tensor, "M"]]:
    """Returns (highest level drawn, weight of its opacities) for each primitive (Octree-GS)."""
    if mode == "progressive":
        place = (ideal + 1).clamp(BELOW_ONE, highest + BELOW_ONE)
        return place.floor().long(), place - place.floor()
    rounded = {"round": torch.round, "floor": torch.floor, "ceil": torch.ceil}[mode](ideal)
    return rounded.clamp(0, highest).long(), torch.ones_like(ideal)


def drawn_fraction(levels: Levels, positions: Float[Tensor, "M 3"], of: Int[Tensor, "M"]) -> Float[Tensor, "M"]:
    """Returns the share of training cameras that draw each primitive (Octree-GS, weed_out)."""
    views, counts = levels.views, torch.zeros_like(positions[:, 0])
    for centre, coarseness in zip(views.centres, views.coarseness.tolist(), strict=True):
        ideal = levels.ideal(offsets_from(positions, centre).norm(dim=1), coarseness)
        counts += of <= whole_level(ideal, levels.mode, levels.count - 1)[0]
    return counts / len(views.centres)


def kept(levels: Levels, positions: Float[Tensor, "M 3"], of: Int[Tensor, "M"]) -> Bool[Tensor, "M"]:
    """Marks primitives at finite positions that enough training cameras draw (Octree-GS, weed_out)."""
    placed = torch.isfinite(positions).all(1)
    places = torch.where(placed[:, None], positions, 0.0)
    return (drawn_fraction(levels, places, of) > levels.threshold) & placed


def drawn(
    levels: Levels,
    positions: Float[Tensor, "N 3"],
    of: Int[Tensor, "N"],
    bias: Float[Tensor, "N"],
    camera: Camera,
    highest: int,
) -> tuple[Bool[Tensor, "N"], Float[Tensor, "N"]]:
    """Returns (primitives whose level the camera draws, factors of their opacities), without gradient (Octree-GS).

    `bias` is added to each primitive's ideal level; `highest`: finest level in use, K - 1 outside training.
    """
    shift = levels.cell_of(of)[:, None] / 2 if levels.half_cell else 0.0
    distances = (offsets_from(positions.detach(), camera.centre) + shift).norm(dim=1)
    ideal = levels.ideal(distances, levels.coarseness(camera))
    known = torch.isfinite(distances)  # the render counts the others
    top, weight = whole_level(torch.where(known, ideal + bias.detach(), 0.0), levels.mode, highest)
    return (of <= top) | ~known, torch.where((of == top) & known, weight, 1.0)


def switch_points(count: int, first: int, until: int, factor: float) -> tuple[int, ...]:
    """Returns the steps at which levels above `first` join, at shrinking intervals (Octree-GS)."""
    intervals = count - 1 - first
    lengths = [factor**-n for n in range(intervals)]
    return tuple(int(until * sum(lengths[: n + 1]) / sum(lengths) + 0.5) for n in range(intervals))


def unlocked(switches: Sequence[int], first: int, step: int) -> int:
    """Returns the highest level at a step: `first` plus one after each switch point (Octree-GS)."""
    return first + sum(switch < step for switch in switches)


def thresholds(base: float, fork: int, update_ratio: float, count: int) -> tuple[float, ...]:
    """Returns the gradient thresholds of the levels, tau_L = base f^(update_ratio L) (Octree-GS)."""
    return tuple(base * fork ** (update_ratio * level) for level in range(count))


def facts_of(levels: Levels, of: Int[Tensor, "N"]) -> dict[str, Any]:
    """Returns the parameters of the levels, lengths in scene units, and the primitives on each."""
    return {
        "levels": levels.count,
        "nearest": levels.nearest,
        "farthest": levels.farthest,
        "box": levels.box,
        "base_layer": levels.base_layer,
        "voxel": levels.cell,
        "finest_voxel": levels.size(levels.count - 1),
        "pixels_per_cell": levels.pixels_per_cell,
        "first_level": levels.first,
        "switch_points": list(levels.switches),
        "threshold": levels.threshold,
        "anchors": of.long().bincount(minlength=levels.count).tolist(),
    }


def note_of(levels: Levels) -> str:
    """Returns a file comment with what a viewer needs to choose levels (Octree-GS, save_ply)."""
    return (
        f"levels {levels.count}, fork {levels.fork}, standard_dist {levels.farthest!r} at a focal length of "
        f"{levels.views.focal!r} px, init_pos {levels.origin!r}, voxel_size {levels.cell!r}"
    )


def warnings_of(levels: Levels, anchors: int) -> list[str]:
    """Returns warnings about the levels of a scene with this many initial primitives."""
    finest, near, far = levels.size(levels.count - 1), levels.nearest, levels.farthest
    step = FLOAT_STEP * max(abs(levels.origin), abs(levels.origin + levels.box))
    warnings = {
        f"{levels.count} levels are more than {MANY_LEVELS}, for distances from {near:.3g} to {far:.3g}: set "
        "backbone.levels.count or lower backbone.levels.distance_quantile": levels.count > MANY_LEVELS,
        f"the nearest points are {near:.3g} from a camera, the farthest {far:.3g}: points at cameras add levels; "
        "lower backbone.levels.distance_quantile": near < NEAR_RATIO * far,
        f"all points are in one place: cells divide the farthest distance {far:.3g} instead": levels.extent == 0,
        f"cells of the finest level, {finest:.3g}, are below the precision of positions, {step:.3g}: lower "
        "backbone.levels.count or backbone.levels.base_layer": finest < step,
        f"{anchors} primitives to start from are fewer than {FEW_ANCHORS}: raise backbone.levels.base_layer, or give "
        "more points": anchors < FEW_ANCHORS,
        f"{anchors} primitives to start from are more than {MANY_ANCHORS}: lower backbone.levels.base_layer, or "
        "raise backbone.levels.visible_threshold": anchors > MANY_ANCHORS,
    }
    return [warning for warning, holds in warnings.items() if holds]
