"""How anchors come and go (Scaffold-GS, adjust_anchor; Octree-GS, anchor_growing). Pure functions over a table.

Growing looks at offsets: where an offset's Gaussian has a large screen gradient, the empty grid cell that it lies in
gets an anchor. Scaffold-GS tries three cell sizes in turn, Octree-GS the cells of the anchor's own level and the next.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from gsx.backbones.cells import new_cells, pooled_max
from gsx.backbones.decoding import Representation, lengths
from gsx.backbones.density import mean_of, within_room
from gsx.backbones.growth_options import GrowthOptions, Quirks
from gsx.backbones.levels import Levels, kept, thresholds
from gsx.core.shapes import Bool, Float, Int
from gsx.core.training.parameter_table import ParameterTable, append_rows, keep_rows

LARGEST_CELL = 2.0**53
"""Integers up to this are exact in float64."""


def fresh_statistics(count: int, offsets: int, device: torch.device | str) -> dict[str, Tensor]:
    """Statistics of `count` anchors that nothing has been seen of."""
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
    seen: Float[Tensor, "M"],
    weight: Float[Tensor, "1"],
) -> None:
    """Count one picture: visits of the anchors in view, and gradient norms of the Gaussians on screen (Scaffold-GS).

    `gradients` are 0 for Gaussians without a radius, as is `seen`, elsewhere the weight; `opacities` are summed over an
    anchor's offsets. All but gradients, which carry it already, are counted by the picture's weight in the step's loss
    (see `backbones.density`): what is judged in steps sums up to steps, whatever the batch and the augmenters.
    """
    table["opacity_sum"][rows] += weight * opacities.sum(1)
    table["visits"][rows] += weight
    table["gradient_sum"].view(-1).index_add_(0, slots, gradients)
    table["gradient_count"].view(-1).index_add_(0, slots, seen)


def eligible(table: ParameterTable, least: float) -> tuple[Bool[Tensor, "N k"], Float[Tensor, "N k"]]:
    """(offsets seen in more than `least` steps, their mean gradients; 0 for the others) (Scaffold-GS)."""
    count = table["gradient_count"]
    enough = count > least
    return enough, torch.where(enough, mean_of(table["gradient_sum"], count), 0.0)


@dataclass(frozen=True, eq=False, kw_only=True)
class CandidateAnchors:
    """New anchors of one cell size."""

    positions: Float[Tensor, "U 3"]
    size: float
    """Of the cell, world units: the initial length of all six scales."""
    parents: Int[Tensor, "P"]
    """Anchor rows whose offsets lie in a new cell."""
    group: Int[Tensor, "P"]
    """Row of `positions` of each parent."""
    strength: Float[Tensor, "U"]
    """Largest mean gradient in the cell."""
    inherit: bool
    """Whether the largest values of the parents are taken over."""
    level: int


def selected(new: CandidateAnchors, keep: Bool[Tensor, "U"]) -> CandidateAnchors:
    """The marked ones, with their parents."""
    number, inside = keep.cumsum(0) - 1, keep[new.group]
    return replace(
        new,
        positions=new.positions[keep],
        parents=new.parents[inside],
        group=number[new.group[inside]],
        strength=new.strength[keep],
    )


def strongest(new: CandidateAnchors, room: int) -> CandidateAnchors:
    """At most `room` of them, those with the largest gradients."""
    all_cells = torch.ones_like(new.strength, dtype=torch.bool)
    return selected(new, within_room(all_cells, new.strength, room))


def offset_means(table: ParameterTable) -> Float[Tensor, "N k 3"]:
    """Where every offset's Gaussian is, world units."""
    reach = lengths(table["log_scales"].detach()[:, :3])
    return table["anchors"][:, None] + table["offsets"].detach() * reach[:, None]


def candidate_anchors(
    table: ParameterTable,
    candidates: Bool[Tensor, "N k"],
    gradient: Float[Tensor, "N k"],
    cells: Int[Tensor, "M 3"],
    taken: Int[Tensor, "T 3"],
    origin: float,
    size: float,
    *,
    inherit: bool = True,
    level: int = 0,
) -> CandidateAnchors:
    """New anchors in the cells of the M candidates that none of the cells taken is."""
    fresh, group = new_cells(cells, taken)
    parents = candidates.nonzero()[:, 0]
    inside = group >= 0
    return CandidateAnchors(
        positions=(fresh.double() * size + origin).to(table["anchors"]),
        size=size,
        parents=parents[inside],
        group=group[inside],
        strength=pooled_max(gradient[candidates], group, len(fresh)),
        inherit=inherit,
        level=level,
    )


def add_anchors(table: ParameterTable, new: CandidateAnchors, representation: Representation) -> None:
    """Append new anchors with fresh statistics."""
    count, like = len(new.positions), table["anchors"]
    if count == 0:
        return
    log_lengths = torch.full((count,), math.log(new.size), dtype=like.dtype, device=like.device)
    rows = representation.rows(log_lengths, torch.full_like(new.positions, 0.5))
    if new.inherit:
        rows |= {n: pooled_max(table[n].detach()[new.parents], new.group, count) for n in representation.pooled}
    rows["anchors"] = new.positions
    fresh = {"bias": 0.0, "filter": 0.0, "earned": math.inf}
    rows |= {name: like.new_full((count,), value) for name, value in fresh.items() if name in table.columns}
    if "level" in table.columns:
        rows["level"] = torch.full((count,), new.level, dtype=torch.int16, device=like.device)
    append_rows(table, rows)


class Added:
    """What one event adds to a table, cell size by cell size: those with the largest gradients of all sizes stay."""

    def __init__(self, table: ParameterTable, representation: Representation, room: int) -> None:
        self.table, self.representation, self.room = table, representation, room
        self.old, self.wanted, self.strengths = len(table), 0, list[Tensor]()

    def add(self, new: CandidateAnchors) -> None:
        """Append those that may stay: no more of a size than there is room for in all."""
        self.wanted += len(new.positions)
        new = strongest(new, self.room)
        add_anchors(self.table, new, self.representation)
        self.strengths.append(new.strength)

    def within_room(self) -> tuple[int, int]:
        """Remove the weakest of those appended that are too many; (how many stay, how many found no room)."""
        strengths = torch.cat([*self.strengths, self.table["anchors"].new_zeros(0)])
        if len(strengths) > self.room:
            new = within_room(torch.ones_like(strengths, dtype=torch.bool), strengths, self.room)
            keep_rows(self.table, torch.cat([new.new_ones(self.old), new]))
        grown = len(self.table) - self.old
        return grown, self.wanted - grown


def grow_by_depth(
    table: ParameterTable,
    representation: Representation,
    options: GrowthOptions,
    voxel: float,
    least: float,
    early_stop: bool,
    generator: torch.Generator,
    room: int,
) -> tuple[int, int]:
    """Scaffold-GS: three cell sizes in turn, a random part of the candidates each (anchor_growing).

    Returns how many grew, at most `room`, and how many did not for want of it.
    """
    enough, gradient = eligible(table, least)
    means, added = offset_means(table), Added(table, representation, room)
    enough = enough & on_grid(means, voxel)
    for depth in range(options.depths):
        multiple = options.coarsest // options.hierarchy**depth
        if multiple == 0:  # the reference divides by it (Scaffold-GS, anchor_growing)
            continue
        chance = torch.rand(enough.shape, generator=generator).to(enough.device)
        threshold = options.gradient * (options.hierarchy // 2) ** depth
        candidates = enough & (gradient >= threshold) & (chance > 0.5 ** (depth + 1))
        size = voxel * multiple
        cells, taken = nodes_of(means[candidates], size), nodes_of(table["anchors"], size)
        added.add(candidate_anchors(table, candidates, gradient, cells, taken, 0.0, size))
        if early_stop and added.wanted == 0:
            break
    return added.within_room()


def on_grid(means: Float[Tensor, "N k 3"], size: float) -> Bool[Tensor, "N k"]:
    """Places whose cells of that size have a number: False for those that are not finite, or beyond 2^53 cells."""
    return (means.double().abs() < LARGEST_CELL * size).all(2)


def nodes_of(positions: Float[Tensor, "M 3"], size: float) -> Int[Tensor, "M 3"]:
    """Nearest node of a grid through the world's origin, halves to even."""
    return (positions.double() / size).round().long()


def grow_by_level(
    table: ParameterTable,
    representation: Representation,
    options: GrowthOptions,
    levels: Levels,
    least: float,
    quirks: Quirks,
    gate: bool,
    room: int,
) -> tuple[int, int]:
    """Octree-GS: cells of the own level, and of the next one for the strongest gradients (anchor_growing).

    `gate`: whether promotion and bias take place. Returns how many grew, at most `room`, and how many did not for want
    of it.
    """
    enough, gradient = eligible(table, least)
    taus = thresholds(options.gradient, levels.fork, options.update_ratio, levels.count + 1)
    means, of = offset_means(table), table["level"].clone()
    mean_gradient = gradient.sum(1) / (enough.sum(1) + 1e-6)
    enough = enough & on_grid(means, levels.size(levels.count - 1))
    added = Added(table, representation, room)
    for level in range(levels.count):
        own = of == level
        if not bool(own.any()):
            continue
        if gate:
            bias_anchors(table, mean_gradient, own, options, taus[level], quirks)
        for found in candidates_of_level(
            table, enough & own[:, None], gradient, means, level, taus, levels, options, quirks, gate
        ):
            added.add(found)
    return added.within_room()


def bias_anchors(
    table: ParameterTable,
    gradient: Float[Tensor, "N"],
    own: Bool[Tensor, "N"],
    options: GrowthOptions,
    threshold: float,
    quirks: Quirks,
) -> None:
    """Let anchors with larger gradients be drawn from a little farther (Octree-GS, anchor_growing)."""
    bias, count = table["bias"], len(gradient)
    chosen = gradient >= options.bias_gradient * threshold
    if quirks.bias != "all":
        chosen = chosen & own
    bias[:count] += options.bias_step * chosen
    if quirks.bias == "own":
        bias.clamp_max_(1.0)


def candidates_of_level(
    table: ParameterTable,
    enough: Bool[Tensor, "N k"],
    gradient: Float[Tensor, "N k"],
    means: Float[Tensor, "N k 3"],
    level: int,
    taus: tuple[float, ...],
    levels: Levels,
    options: GrowthOptions,
    quirks: Quirks,
    gate: bool,
) -> Iterator[CandidateAnchors]:
    """Anchors on the same level, then promotions to the next (Octree-GS, anchor_growing)."""
    last = level == levels.count - 1
    below = gradient < taus[level + 1]
    if last and quirks.finest == "open":
        below = torch.ones_like(below)
    staying = enough & (gradient >= taus[level]) & below
    yield filtered(at_level(table, staying, gradient, means, level, level, levels, options), levels)
    next_exists = options.overlap or bool((table["level"] == level + 1).any())
    if gate and not last and next_exists:
        compared = level if quirks.duplicates == "own" else level + 1
        promoted = enough & (gradient >= taus[level + 1])
        inherit = options.overlap or quirks.promoted == "max"
        yield filtered(
            at_level(table, promoted, gradient, means, level + 1, compared, levels, options, inherit), levels
        )


def at_level(
    table: ParameterTable,
    candidates: Bool[Tensor, "N k"],
    gradient: Float[Tensor, "N k"],
    means: Float[Tensor, "N k 3"],
    level: int,
    compared: int,
    levels: Levels,
    options: GrowthOptions,
    inherit: bool = True,
) -> CandidateAnchors:
    """Anchors in the cells of a level that no anchor of level `compared` holds; with overlap in all of them."""
    occupied = table["anchors"][table["level"] == compared]
    taken = levels.cells(occupied[:0] if options.overlap else occupied, level)
    cells, size = levels.cells(means[candidates], level), levels.size(level)
    return candidate_anchors(
        table, candidates, gradient, cells, taken, levels.origin, size, inherit=inherit, level=level
    )


def filtered(new: CandidateAnchors, levels: Levels) -> CandidateAnchors:
    """Without those that too few cameras would draw (Octree-GS, weed_out)."""
    positions = new.positions
    of = torch.full((len(positions),), new.level, dtype=torch.int16, device=positions.device)
    return selected(new, kept(levels, positions, of))


def reset_offsets(table: ParameterTable, enough: Bool[Tensor, "N k"]) -> None:
    """Forget the gradients of the offsets that were judged; the others keep theirs over later intervals."""
    for name in ("gradient_sum", "gradient_count"):
        table[name][: len(enough)][enough] = 0


def prune(table: ParameterTable, options: GrowthOptions, least: float) -> int:
    """Remove anchors that were visited often and stayed faint; returns how many (Scaffold-GS, adjust_anchor)."""
    ready = table["visits"] > least
    doomed = ready & (table["opacity_sum"] < options.prune_opacity * table["visits"])
    for name in ("opacity_sum", "visits"):
        table[name][ready] = 0
    if bool(doomed.all()):  # a cloud about to vanish keeps what it has
        return 0
    keep_rows(table, ~doomed)
    return int(doomed.sum())


def clamp_scales(table: ParameterTable, largest: float) -> None:
    """Hold the log-scales of the Gaussians, not the reach of the offsets, below a limit (Scaffold-GS)."""
    with torch.no_grad():
        table["log_scales"][:, 3:].clamp_(max=largest)
