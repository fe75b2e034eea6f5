"""In what order the rows of a model go: what pictures need least first, by itself or merged with a neighbour.

Pictures lose what a row is worth where it goes. Where two become one they lose that share of what both are worth by
which the field of both changes (`backbones.merging`): little where they lie on each other and agree in colour,
however much they are worth. Rows take part once in a round, of which none takes more than a quarter of what is left.
A 3D filter is part of what is drawn: rows are merged with it, and it is taken off what they become.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from gsx.backbones.merging import PARAMETERS, Rows, changes, densities, merged
from gsx.backbones.neighbours import nearest
from gsx.core.gaussians.smoothing import smoothed_raw, unsmoothed
from gsx.core.shapes import Bool, Float, Int
from gsx.core.training.parameter_table import (
    ParameterTable,
    append_rows,
    detached_rows,
    keep_rows,
    second_moments,
)

ROUND = 0.25
"""Share of the rows that go in one round."""
NEIGHBOURS = 10
"""Nearest rows that each may be merged with."""
AT_ONCE = 1 << 16
"""Pairs looked at at a time."""
ORDERLESS = ("log_scales", "quats")
"""Parameters whose entries are along other axes once rows are merged."""


@dataclass(frozen=True, eq=False)
class Round:
    """Rows that go, in order, by their numbers before the round."""

    gone: Int[Tensor, "K"]
    into: Int[Tensor, "K"]
    """The row that each is merged with; -1: none."""


class Reduction:
    """The order in which rows go, found as far as it is asked for."""

    def __init__(self, table: ParameterTable, worth: Float[Tensor, "N"], colours: Float[Tensor, "N 3"] | None) -> None:
        """`worth`: what pictures lose without each row; `colours`: as they see them, where rows can be merged."""
        rows = detached_rows(table)
        able = colours is not None and all(name in rows for name in PARAMETERS)
        self.rows: dict[str, Tensor] = {}
        if able and colours is not None:
            drawn = with_filter(rows, smoothed_raw)
            needed = (name for name, value in drawn.items() if name in PARAMETERS or not value.is_floating_point())
            self.rows = {name: drawn[name].clone() for name in needed} | {"colours": colours}
        self.worth, self.count = worth, len(worth)
        self.rounds: list[Round] = []

    def apply(self, table: ParameterTable, share: float) -> None:
        """Take a share of the rows off the table, whose rows are still all those of the beginning; one stays."""
        left = min(self.count - 1, round(share * self.count))
        number = 0
        while left > 0:
            if number == len(self.rounds):
                self.find()
            taken = self.rounds[number]
            reduce_table(table, taken.gone[:left], taken.into[:left])
            left, number = left - len(taken.gone), number + 1

    def find(self) -> None:
        """The next round, and what is left after it."""
        found = next_round(self.rows, self.worth)
        self.rounds.append(found)
        kept, pairs = survivors(len(self.worth), found.gone, found.into), found.into >= 0
        first, second = found.gone[pairs], found.into[pairs]
        if self.rows:
            new = merged(self.rows, first, second)
            self.rows = {name: torch.cat([value[kept], new[name]]) for name, value in self.rows.items()}
        self.worth = torch.cat([self.worth[kept], self.worth[first] + self.worth[second]])


def with_filter(rows: Rows, change: Callable[[Tensor, Tensor, Tensor], tuple[Tensor, Tensor]]) -> dict[str, Tensor]:
    """Rows whose scales and opacities a change by their 3D filter has made others, where there is one: put on them
    (`smoothed_raw`), or taken off as far as it can be (`unsmoothed`)."""
    if "filter" not in rows:
        return dict(rows)
    names = ("log_scales", "opacity_logits")
    changed = change(*(rows[name].double() for name in (*names, "filter")))
    return dict(rows) | {name: value.to(rows[name]) for name, value in zip(names, changed, strict=True)}


def survivors(count: int, gone: Int[Tensor, "K"], into: Int[Tensor, "K"]) -> Bool[Tensor, "N"]:
    """Rows that have no part in it."""
    kept = torch.ones(count, dtype=torch.bool, device=gone.device)
    kept[gone] = False
    kept[into[into >= 0]] = False
    return kept


def reduce_table(table: ParameterTable, gone: Int[Tensor, "K"], into: Int[Tensor, "K"]) -> None:
    """Take rows off a table; merged ones come last. These learn on as what they were, so that they begin with the
    second moments of both; as zeros they would let the first steps be far too long."""
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


# -- a round -----------------------------------------------------------------------------------------------------------


def next_round(rows: Rows, worth: Float[Tensor, "N"]) -> Round:
    """What goes next, the cheapest first. rows: empty where none can be merged."""
    wanted = math.ceil(ROUND * len(worth))
    first, second = pairs_of(rows) if rows and len(worth) > 1 else (worth.new_empty(0).long(),) * 2
    costs = torch.cat([worth.double(), merging_costs(rows, worth, first, second)])
    gone, into = cheapest(costs, first, second, len(worth), wanted)
    return Round(torch.tensor(gone, device=worth.device), torch.tensor(into, device=worth.device))


def pairs_of(rows: Rows) -> tuple[Int[Tensor, "P"], Int[Tensor, "P"]]:
    """Rows that may be merged: neighbours that are alike in all whole numbers, as levels are; each pair once."""
    count = len(rows["means"])
    _, others = nearest(rows["means"], min(NEIGHBOURS, count - 1))
    own = torch.arange(count, device=others.device)[:, None].expand_as(others)
    number = torch.unique(torch.minimum(own, others) * count + torch.maximum(own, others))
    first, second = number // count, number % count
    for value in rows.values():
        if not value.is_floating_point():
            alike = value[first] == value[second]
            first, second = first[alike], second[alike]
    return first, second


def merging_costs(
    rows: Rows, worth: Float[Tensor, "N"], first: Int[Tensor, "P"], second: Int[Tensor, "P"]
) -> Float[Tensor, "P"]:
    """What pictures lose where two become one; infinite where that cannot be told."""
    if not len(first):
        return worth.new_empty(0).double()
    all_of = densities(rows, rows["colours"])
    parts = []
    for a, b in zip(first.split(AT_ONCE), second.split(AT_ONCE), strict=True):
        whole = merged(rows, a, b)
        change = changes(all_of.at(a), all_of.at(b), densities(whole, whole["colours"]))
        parts.append(change * (worth[a] + worth[b]).double())
    return torch.cat(parts).nan_to_num(nan=math.inf)


def cheapest(
    costs: Float[Tensor, "C"], first: Int[Tensor, "P"], second: Int[Tensor, "P"], count: int, wanted: int
) -> tuple[list[int], list[int]]:
    """(rows that go, those they are merged with or -1) of the cheapest ways, each row taking part once.

    costs: of `count` rows going, then of P pairs merging.
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
        if len(gone) == wanted:
            break
    return gone, into
