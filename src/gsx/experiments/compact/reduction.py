"""The order in which rows of a model go: the least important first, removed or merged with a neighbour.

Removing a row costs its importance. Merging two costs the share of the importance of both by which their field changes
(`backbones.merging`): little where they overlap and agree in colour. A row takes part once in a round; no round takes
more than a quarter of the rows. Rows are merged as their 3D filter draws them; it is taken off the merged row.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from gsx.backbones.merging import PARAMETERS, Rows, changes, densities, merged
from gsx.backbones.neighbours import nearest
from gsx.core.shapes import Bool, Float, Int
from gsx.core.training.parameter_table import (
    ParameterTable,
    append_rows,
    detached_rows,
    keep_rows,
    second_moments,
)
from gsx.formats.smoothing import smoothed_raw, unsmoothed

ROUND = 0.25
"""Share of the rows that go in one round."""
NEIGHBOURS = 10
"""Nearest rows that each row may be merged with."""
AT_ONCE = 1 << 16
"""Pairs whose cost is computed at once."""
ORDERLESS = ("log_scales", "quats")
"""Parameters whose entries are along other axes after merging."""


@dataclass(frozen=True, eq=False)
class Round:
    """Rows that go, in order, by their indices before the round."""

    gone: Int[Tensor, "K"]
    into: Int[Tensor, "K"]
    """The row that each is merged with; -1: none."""


class Reduction:
    """The order in which rows go, computed round by round."""

    def __init__(
        self, table: ParameterTable, importance: Float[Tensor, "N"], colours: Float[Tensor, "N 3"] | None
    ) -> None:
        """`importance`: loss of pictures without each row; `colours`: mean over views, None: rows are not merged."""
        rows = detached_rows(table)
        self.rows: dict[str, Tensor] = {}
        """Rows as they are drawn; empty: they cannot be merged."""
        if colours is not None and all(name in rows for name in PARAMETERS):
            drawn = with_filter(rows, smoothed_raw)
            needed = (name for name, value in drawn.items() if name in PARAMETERS or not value.is_floating_point())
            self.rows = {name: drawn[name].clone() for name in needed} | {"colours": colours}
        self.importance, self.count = importance, len(importance)
        self.rounds: list[Round] = []

    def apply(self, table: ParameterTable, share: float) -> None:
        """Takes a share of the rows off a table that has all of them; at least one row stays."""
        left = min(self.count - 1, round(share * self.count))
        number = 0
        while left > 0:
            if number == len(self.rounds):
                self.add_round()
            gone, into = self.rounds[number].gone, self.rounds[number].into
            reduce_table(table, gone[:left], into[:left])
            left, number = left - len(gone), number + 1

    def add_round(self) -> None:
        """Computes the next round, and the rows that are left after it."""
        new_round = next_round(self.rows, self.importance)
        self.rounds.append(new_round)
        kept, pairs = survivors(len(self.importance), new_round.gone, new_round.into), new_round.into >= 0
        first, second = new_round.gone[pairs], new_round.into[pairs]
        if self.rows:
            new = merged(self.rows, first, second)
            self.rows = {name: torch.cat([value[kept], new[name]]) for name, value in self.rows.items()}
        self.importance = torch.cat([self.importance[kept], self.importance[first] + self.importance[second]])


def with_filter(rows: Rows, change: Callable[[Tensor, Tensor, Tensor], tuple[Tensor, Tensor]]) -> dict[str, Tensor]:
    """Puts the 3D filter of rows, if any, on scales and opacities (`smoothed_raw`) or takes it off (`unsmoothed`)."""
    if "filter" not in rows:
        return dict(rows)
    names = ("log_scales", "opacity_logits")
    changed = change(*(rows[name].double() for name in (*names, "filter")))
    return dict(rows) | {name: value.to(rows[name]) for name, value in zip(names, changed, strict=True)}


def survivors(count: int, gone: Int[Tensor, "K"], into: Int[Tensor, "K"]) -> Bool[Tensor, "N"]:
    """Marks rows that neither go nor are merged."""
    kept = torch.ones(count, dtype=torch.bool, device=gone.device)
    kept[gone] = False
    kept[into[into >= 0]] = False
    return kept


def reduce_table(table: ParameterTable, gone: Int[Tensor, "K"], into: Int[Tensor, "K"]) -> None:
    """Takes rows off a table; merged ones come last.

    They begin with the second moments of both: zeros would make their first steps far too long.
    """
    pairs = into >= 0
    first, second = gone[pairs], into[pairs]
    new: dict[str, Tensor] = {}
    if len(first):
        drawn = with_filter(detached_rows(table), smoothed_raw)
        new = with_filter(merged(drawn, first, second), unsmoothed)
    moments = {name: value[first] + value[second] for name, value in second_moments(table).items()}
    for name in ORDERLESS:
        if name in moments:
            moments[name] = moments[name].mean(1, keepdim=True).expand_as(moments[name])
    keep_rows(table, survivors(len(table), gone, into))
    if new:
        append_rows(table, new, moments)


def next_round(rows: Rows, importance: Float[Tensor, "N"]) -> Round:
    """Computes what goes next, the cheapest first; `rows`: empty where none can be merged."""
    count = len(importance)
    first, second = pairs_of(rows) if rows and count > 1 else (importance.new_empty(0).long(),) * 2
    costs = torch.cat([importance.double(), merging_costs(rows, importance, first, second)])
    gone, into = cheapest(costs, first, second, count, math.ceil(ROUND * count))
    return Round(torch.tensor(gone, device=importance.device), torch.tensor(into, device=importance.device))


def pairs_of(rows: Rows) -> tuple[Int[Tensor, "P"], Int[Tensor, "P"]]:
    """Lists pairs that may be merged: neighbours with the same whole numbers, such as levels; each pair once."""
    count = len(rows["means"])
    _, others = nearest(rows["means"], min(NEIGHBOURS, count - 1))
    rows_of = torch.arange(count, device=others.device)[:, None].expand_as(others)
    pairs = torch.unique(torch.minimum(rows_of, others) * count + torch.maximum(rows_of, others))
    first, second = pairs // count, pairs % count
    for value in rows.values():
        if not value.is_floating_point():
            alike = value[first] == value[second]
            first, second = first[alike], second[alike]
    return first, second


def merging_costs(
    rows: Rows, importance: Float[Tensor, "N"], first: Int[Tensor, "P"], second: Int[Tensor, "P"]
) -> Float[Tensor, "P"]:
    """Estimates what pictures lose where two rows become one; infinite where that is not a number."""
    if not len(first):
        return importance.new_empty(0).double()
    all_of = densities(rows, rows["colours"])
    parts = []
    for a, b in zip(first.split(AT_ONCE), second.split(AT_ONCE), strict=True):
        whole = merged(rows, a, b)
        change = changes(all_of.at(a), all_of.at(b), densities(whole, whole["colours"]))
        parts.append(change * (importance[a] + importance[b]).double())
    return torch.cat(parts).nan_to_num(nan=math.inf)


def cheapest(
    costs: Float[Tensor, "C"], first: Int[Tensor, "P"], second: Int[Tensor, "P"], count: int, most: int
) -> tuple[list[int], list[int]]:
    """Picks the `most` cheapest ways, each row taking part once; returns (rows that go, rows they merge with or -1).

    `costs`: of removing each of `count` rows, then of merging P pairs.
    """
    one, other = first.tolist(), second.tolist()
    busy, gone, into = [False] * count, list[int](), list[int]()
    for way in costs.argsort(stable=True).tolist():
        row, partner = (way, -1) if way < count else (one[way - count], other[way - count])
        if busy[row] or (partner >= 0 and busy[partner]):
            continue
        busy[row] = True
        if partner >= 0:
            busy[partner] = True
        gone.append(row)
        into.append(partner)
        if len(gone) == most:
            break
    return gone, into
