"""Growing and pruning of anchors (Scaffold-GS, adjust_anchor; Octree-GS, anchor_growing).

An offset whose Gaussian has a large screen gradient grows an anchor in its grid cell, if that is empty. Scaffold-GS
tries three cell sizes in turn, Octree-GS the cells of the anchor's own level and of the next.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from gsx.backbones.anchor_options import GrowthOptions, Quirks
from gsx.backbones.cells import new_cells, pooled_max
from gsx.backbones.decoding import Representation, lengths
from gsx.backbones.density import mean_of, within_room
from gsx.backbones.levels import Levels, kept, thresholds
from gsx.core.shapes import Bool, Float, Int
from gsx.core.training.parameter_table import ParameterTable, append_rows, keep_rows

LARGEST_CELL = 2.0**53
"""Integers up to this are exact in float64."""


# -- statistics --------------------------------------------------------------------------------------------------------


def fresh_statistics(count: int, offsets: int, device: torch.device | str) -> dict[str, Tensor]:
    """Returns statistics of `count` anchors, all 0."""
    return {
        "opacity_sum": torch.zeros(count, device=device),
        "visits": torch.zeros(count, device=device),
        "gradient_sum": torch.zeros(count, offsets, device=device),
        "gradient_count": torch.zeros(count, offsets, device=device),
    }


@torch.no_grad()
def observe(
    table: ParameterTable,
    rows: Int[Tensor, "A"],
    opacities: Float[Tensor, "A k"],
    slots: Int[Tensor, "M"],
    gradients: Float[Tensor, "M"],
    visits: Float[Tensor, "M"],
    weight: Float[Tensor, "1"],
) -> None:
    """Adds one picture: opacities and visits of the anchors in view, gradient norms of the Gaussians (Scaffold-GS).

    `weight` is that of the picture in the step's loss (see `backbones.density`); `visits` is 0 for Gaussians without a
    radius, else the weight.
    """
    table["opacity_sum"][rows] += weight * opacities.sum(1)
    table["visits"][rows] += weight
    table["gradient_sum"].view(-1).index_add_(0, slots, gradients)
    table["gradient_count"].view(-1).index_add_(0, slots, visits)


def eligible(table: ParameterTable, least: float) -> tuple[Bool[Tensor, "N k"], Float[Tensor, "N k"]]:
    """Returns (offsets visible in more than `least` steps, their mean gradients, 0 for the others) (Scaffold-GS)."""
    count = table["gradient_count"]
    enough = count > least
    return enough, torch.where(enough, mean_of(table["gradient_sum"], count), 0.0)


def reset_offsets(table: ParameterTable, enough: Bool[Tensor, "N k"]) -> None:
    """Zeroes the gradients of eligible offsets; the others keep theirs."""
    for name in ("gradient_sum", "gradient_count"):
        table[name][: len(enough)][enough] = 0


# -- growing -----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False, kw_only=True)
class NewAnchors:
    """Candidate anchors of one cell size."""

    positions: Float[Tensor, "U 3"]
    size: float
    """Edge of the cell, the initial length of all six scales, world units."""
    parents: Int[Tensor, "P"]
    """Anchor rows whose offsets lie in a new cell."""
    group: Int[Tensor, "P"]
    """Row of `positions` of each parent."""
    strength: Float[Tensor, "U"]
    """Largest mean gradient in the cell."""
    inherit: bool
    """True: anchors inherit the largest values of their parents."""
    level: int

    def at(self, keep: Bool[Tensor, "U"]) -> "NewAnchors":
        """Returns the marked anchors and their parents."""
        number, inside = keep.cumsum(0) - 1, keep[self.group]
        return replace(
            self,
            positions=self.positions[keep],
            parents=self.parents[inside],
            group=number[self.group[inside]],
            strength=self.strength[keep],
        )


@dataclass(eq=False)
class Growth:
    """One event that adds anchors cell size by cell size; of all, those with the largest gradients stay."""

    table: ParameterTable
    representation: Representation
    options: GrowthOptions
    least: float
    """Number of steps that an offset must be visible in more often."""
    room: int
    """Most anchors to add."""
    finest: float
    """Smallest cell, world units."""

    def __post_init__(self) -> None:
        table = self.table
        self.old, self.proposed, self.strengths = len(table), 0, list[Tensor]()
        enough, self.gradient = eligible(table, self.least)
        self.row_gradient = self.gradient.sum(1) / (enough.sum(1) + 1e-6)
        reach = lengths(table["log_scales"].detach()[:, :3])
        self.means = table["anchors"][:, None] + table["offsets"].detach() * reach[:, None]
        self.enough = enough & (self.means.double().abs() < LARGEST_CELL * self.finest).all(2)

    def propose(
        self,
        candidates: Bool[Tensor, "N k"],
        cells: Int[Tensor, "M 3"],
        taken: Int[Tensor, "T 3"],
        origin: float,
        size: float,
        inherit: bool = True,
        level: int = 0,
    ) -> NewAnchors:
        """Returns new anchors in those cells of the M candidates that are not taken."""
        fresh, group = new_cells(cells, taken)
        inside = group >= 0
        return NewAnchors(
            positions=(fresh.double() * size + origin).to(self.table["anchors"]),
            size=size,
            parents=candidates.nonzero()[:, 0][inside],
            group=group[inside],
            strength=pooled_max(self.gradient[candidates], group, len(fresh)),
            inherit=inherit,
            level=level,
        )

    def add(self, new: NewAnchors) -> None:
        """Appends the new anchors with the largest gradients, at most as many as there is room for."""
        self.proposed += len(new.positions)
        new = new.at(within_room(torch.ones_like(new.strength, dtype=torch.bool), new.strength, self.room))
        add_anchors(self.table, new, self.representation)
        self.strengths.append(new.strength)

    def within_room(self) -> tuple[int, int]:
        """Removes the weakest appended anchors beyond the room; returns (number added, number without room)."""
        strengths = torch.cat([*self.strengths, self.table["anchors"].new_zeros(0)])
        if len(strengths) > self.room:
            new = within_room(torch.ones_like(strengths, dtype=torch.bool), strengths, self.room)
            keep_rows(self.table, torch.cat([new.new_ones(self.old), new]))
        grown = len(self.table) - self.old
        return grown, self.proposed - grown


class DepthGrowth(Growth):
    """Growth of Scaffold-GS: three cell sizes in turn, a random part of the candidates each (anchor_growing)."""

    def grow(self, early_stop: bool, generator: torch.Generator) -> tuple[int, int]:
        """Adds anchors; returns (number added, number without room)."""
        options = self.options
        for depth in range(options.depths):
            multiple = options.coarsest // options.hierarchy**depth
            if multiple == 0:  # the reference divides by it
                continue
            chance = torch.rand(self.enough.shape, generator=generator).to(self.enough.device)
            threshold = options.gradient * (options.hierarchy // 2) ** depth
            candidates = self.enough & (self.gradient >= threshold) & (chance > 0.5 ** (depth + 1))
            size = self.finest * multiple
            cells, taken = nodes_of(self.means[candidates], size), nodes_of(self.table["anchors"], size)
            self.add(self.propose(candidates, cells, taken, 0.0, size))
            if early_stop and self.proposed == 0:
                break
        return self.within_room()


@dataclass(eq=False)
class LevelGrowth(Growth):
    """Growth of Octree-GS: cells of the own level, and of the next for the largest gradients (anchor_growing)."""

    levels: Levels
    quirks: Quirks
    gate: bool
    """True: promotion and bias take place."""

    def grow(self) -> tuple[int, int]:
        """Adds anchors; returns (number added, number without room)."""
        options, levels = self.options, self.levels
        self.taus = thresholds(options.gradient, levels.fork, options.update_ratio, levels.count + 1)
        level_of = self.table["level"].clone()
        for level in range(levels.count):
            on_level = level_of == level
            if not bool(on_level.any()):
                continue
            if self.gate:
                self.add_bias(level, on_level)
            for new in self.of_level(level, self.enough & on_level[:, None]):
                self.add(new)
        return self.within_room()

    def add_bias(self, level: int, on_level: Bool[Tensor, "N"]) -> None:
        """Raises the level bias of anchors with large gradients: they are drawn from farther (Octree-GS)."""
        bias = self.table["bias"]
        chosen = self.row_gradient >= self.options.bias_gradient * self.taus[level]
        if self.quirks.bias != "all":
            chosen = chosen & on_level
        bias[: len(chosen)] += self.options.bias_step * chosen
        if self.quirks.bias == "own":
            bias.clamp_max_(1.0)

    def of_level(self, level: int, enough: Bool[Tensor, "N k"]) -> Iterator[NewAnchors]:
        """Yields anchors on the same level, then promotions to the next (Octree-GS)."""
        last, overlap, quirks = level == self.levels.count - 1, self.options.overlap, self.quirks
        below = self.gradient < self.taus[level + 1]
        if last and quirks.finest == "open":
            below = torch.ones_like(below)
        staying = enough & (self.gradient >= self.taus[level]) & below
        yield self.at_level(staying, level, level)
        if self.gate and not last and (overlap or bool((self.table["level"] == level + 1).any())):
            compared = level if quirks.duplicates == "own" else level + 1
            promoted = enough & (self.gradient >= self.taus[level + 1])
            yield self.at_level(promoted, level + 1, compared, overlap or quirks.promoted == "max")

    def at_level(self, candidates: Bool[Tensor, "N k"], level: int, compared: int, inherit: bool = True) -> NewAnchors:
        """Returns anchors that enough cameras draw, in cells of a level without an anchor of level `compared`.

        With overlap in any cell (Octree-GS, weed_out).
        """
        levels, occupied = self.levels, self.table["anchors"][self.table["level"] == compared]
        taken = levels.cells(occupied[:0] if self.options.overlap else occupied, level)
        cells, size = levels.cells(self.means[candidates], level), levels.size(level)
        new = self.propose(candidates, cells, taken, levels.origin, size, inherit, level)
        of = torch.full((len(new.positions),), level, dtype=torch.int16, device=new.positions.device)
        return new.at(kept(levels, new.positions, of))


def nodes_of(positions: Float[Tensor, "M 3"], size: float) -> Int[Tensor, "M 3"]:
    """Returns the nearest nodes of a grid through the world's origin, halves to even."""
    return (positions.double() / size).round().long()


def add_anchors(table: ParameterTable, new: NewAnchors, representation: Representation) -> None:
    """Appends new anchors with fresh statistics."""
    count, like = len(new.positions), table["anchors"]
    if count == 0:
        return
    log_lengths = torch.full((count,), math.log(new.size), dtype=like.dtype, device=like.device)
    rows = representation.rows(log_lengths, torch.full_like(new.positions, 0.5))
    if new.inherit:
        rows |= {n: pooled_max(table[n].detach()[new.parents], new.group, count) for n in representation.pooled}
    fresh = {"bias": 0.0, "filter": 0.0, "earned": math.inf}
    rows |= {name: like.new_full((count,), value) for name, value in fresh.items() if name in table.columns}
    if "level" in table.columns:
        rows["level"] = torch.full((count,), new.level, dtype=torch.int16, device=like.device)
    append_rows(table, rows | {"anchors": new.positions})


# -- pruning -----------------------------------------------------------------------------------------------------------


def prune(table: ParameterTable, options: GrowthOptions, least: float) -> int:
    """Removes anchors that stayed faint in more than `least` visits; returns how many (Scaffold-GS, adjust_anchor)."""
    ready = table["visits"] > least
    faint = ready & (table["opacity_sum"] < options.prune_opacity * table["visits"])
    for name in ("opacity_sum", "visits"):
        table[name][ready] = 0
    if bool(faint.all()):  # an empty model cannot recover
        return 0
    keep_rows(table, ~faint)
    return int(faint.sum())


def clamp_scales(table: ParameterTable, largest: float) -> None:
    """Clamps the log-scales of the Gaussians, not those of the offsets (Scaffold-GS)."""
    with torch.no_grad():
        table["log_scales"][:, 3:].clamp_(max=largest)
