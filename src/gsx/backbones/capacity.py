"""How many primitives a model may have: under a cap as published, or towards a budget."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import torch
from torch import Tensor
from torch.nn import Parameter

from gsx.backbones.density import room_under
from gsx.core.data.scene import View
from gsx.core.data.window import Window
from gsx.core.ranges import Count, Share
from gsx.core.shapes import Bool, Float
from gsx.core.training.backbone import CAUTION, Backbone, BackboneContext
from gsx.core.training.importance import Probe, Removal, random_views
from gsx.core.training.parameter_table import ParameterTable, detached_rows, keep_rows
from gsx.core.training.schedule import Schedule


@dataclass(frozen=True, kw_only=True)
class BudgetOptions:
    """Growth towards a number; values in conf/backbone/parts/capacity.yaml."""

    primitives: Count = 0
    """How many there are to be when growth ends, at most: what is faint then is pruned as ever."""
    power: Share = 0.5
    """At a share t of the growth there may be first + (primitives - first) t^power (Improved-GS: a square root)."""


@dataclass(frozen=True)
class Growing:
    """The steps at which density control acts: multiples of `every` between `start` and `stop`, both left out."""

    start: int
    stop: int
    every: int

    def due(self, step: int) -> bool:
        """Whether it acts at a step."""
        return self.start < step < self.stop and step % self.every == 0

    def count(self) -> int:
        """How often it acts; not at all: 0 or less."""
        return (self.stop - 1) // self.every - self.start // self.every

    def events(self) -> int:
        """How often it acts, at least once."""
        return max(1, self.count())

    def caution(self) -> dict[str, str]:
        """For a plan: that nothing will be decided, where it does not act at all."""
        if self.count() > 0:
            return {}
        when = f"every {self.every} steps between {self.start} and {self.stop}"
        remedy = "take more steps, or fewer training views, all of which an interval passes over"
        return {CAUTION: f"decides nothing, as density control acts at no step of this run, {when}: {remedy}"}

    def passed(self, step: int) -> float:
        """How much of the events is over after the one at a step, from 0 to 1."""
        return min(1.0, max(0.0, (step // self.every - self.start // self.every) / self.events()))


@runtime_checkable
class Timed(Protocol):
    """Options of something that acts now and then, in steps of the published run."""

    @property
    def start(self) -> int: ...
    @property
    def stop(self) -> int: ...
    @property
    def every(self) -> int: ...


def growing_of(options: Timed, schedule: Schedule) -> Growing:
    """When density control acts in this run, to its last step at most: what learns on afterwards does not grow."""
    stop = min(schedule.step(options.stop), schedule.iterations + 1)
    return Growing(schedule.step(options.start), stop, schedule.interval(options.every))


LOOKS = 48
"""Training views, at most, that are asked what a row, or its colours, are worth (all at the last event of a budget)."""
Undone = Callable[[ParameterTable], ParameterTable | None]
"""The table as it would be had the last event added nothing; None: it added nothing."""


@runtime_checkable
class Capacity(Protocol):
    """Decides at each event of density control how many primitives may come."""

    ranked: bool
    """Whether those that draw most of the error come first."""

    def begin(self, table: ParameterTable) -> None:
        """Give a fresh table what is kept there."""
        ...

    def clear(self, table: ParameterTable, positions: Float[Tensor, "N 3"]) -> dict[str, float]:
        """Remove rows that nothing has to be learnt of, at the first step; how many, for the log."""
        ...

    def judge(self, model: Backbone[Any], undone: Undone, step: int) -> dict[str, float]:
        """Look at the model before an event; what was found, for the log."""
        ...

    def room(self, table: ParameterTable, wanted: int, step: int) -> int:
        """How many of the primitives `wanted` may be added now."""
        ...

    def validation_window(self, table: ParameterTable, view: View, step: int) -> Window | None:
        """The window of a view that counts in no loss at a step; None: all of it counts."""
        ...

    def plan(self) -> dict[str, Any]:
        """What is decided before training, for the log and the report."""
        ...


class Cap:
    """As published: whatever density control asks for, up to a cap."""

    ranked = False

    def __init__(self, most: int) -> None:
        self.most = most

    def begin(self, table: ParameterTable) -> None:
        """Nothing."""

    def clear(self, table: ParameterTable, positions: Float[Tensor, "N 3"]) -> dict[str, float]:
        """Nothing."""
        return {}

    def judge(self, model: Backbone[Any], undone: Undone, step: int) -> dict[str, float]:
        """Nothing."""
        return {}

    def room(self, table: ParameterTable, wanted: int, step: int) -> int:
        """Up to the cap."""
        return room_under(self.most, len(table))

    def validation_window(self, table: ParameterTable, view: View, step: int) -> Window | None:
        """Nothing."""
        return None

    def plan(self) -> dict[str, Any]:
        """Nothing."""
        return {}


class Budget(Cap):
    """Growth along a curve to a number of primitives (Taming-3DGS; the curve of Improved-GS)."""

    ranked = True

    def __init__(self, options: BudgetOptions, context: BackboneContext, growing: Growing) -> None:
        super().__init__(options.primitives)
        self.options, self.context, self.growing = options, context, growing

    def begin(self, table: ParameterTable) -> None:
        """Where the curve begins."""
        table.record["first"] = torch.tensor(float(len(table)), dtype=torch.float64)

    def judge(self, model: Backbone[Any], undone: Undone, step: int) -> dict[str, float]:
        """Remove what is beyond the curve, which falls where there are more points than primitives asked for.

        What goes is worth least to some views: of what these show as large a share as is too many of all. At the last
        event all views are asked.
        """
        excess = len(model.table) - self.target(int(model.table.record["first"]), step)
        if excess <= 0:
            return {}
        views, last = len(self.context.scene.train), self.growing.passed(step) == 1
        looks = views if last else min(LOOKS, views)
        found = worth_in_training(model, self.context, step, looks)
        shown = found.views > 0  # of what no view asked shows nothing is known: others may show it
        count = excess if looks == views else round(excess * float(shown.double().mean()))
        kept = torch.ones_like(shown)
        kept[torch.where(shown, found.squares, torch.inf).argsort(stable=True)[:count]] = False
        keep_rows(model.table, kept)
        return {"removed": count}

    def room(self, table: ParameterTable, wanted: int, step: int) -> int:
        """Up to the curve."""
        return max(0, self.target(int(table.record["first"]), step) - len(table))

    def target(self, first: int, step: int) -> int:
        """How many there may be after the event of a step, of a model that began with `first`."""
        return math.floor(first + (self.most - first) * self.growing.passed(step) ** self.options.power)

    def plan(self) -> dict[str, Any]:
        """The number."""
        return {"budget": {"primitives": self.most} | self.growing.caution()}


def error_exponent(price: float) -> float:
    """The squared error falls as N^-this where a doubling of N brings so many dB."""
    return price * math.log(10) / (10 * math.log(2))


def worth_in_training(model: Backbone[Any], context: BackboneContext, step: int, looks: int = LOOKS) -> Removal:
    """What training views, at most so many of them, lose without each row."""
    views = random_views(context.views.at(step), looks, context.generator)
    probe = Probe(model=model, views=context.views, step=step)
    return context.on_rank0(lambda: probe.removal(views, context.generator).to("cpu")).to(context.device)


def mark_newborn(table: ParameterTable, old: int) -> None:
    """Remember that the rows behind the `old` first ones were added by this event, where that is asked for."""
    if "born" in table.statistics:
        table.statistics["born"] = (torch.arange(len(table), device=table.statistics["born"].device) >= old).float()


def without_newborn(table: ParameterTable) -> ParameterTable | None:
    """The table without the rows that the last event added; None: it added none."""
    old = table.statistics["born"] == 0
    if bool(old.all()) or not bool(old.any()):
        return None
    return with_rows(table, old)


def with_rows(table: ParameterTable, kept: Bool[Tensor, "N"]) -> ParameterTable:
    """The table with these rows alone, by which nothing is learnt."""
    return to_look_at(table, {name: value[kept] for name, value in detached_rows(table).items()})


def to_look_at(table: ParameterTable, rows: dict[str, Tensor]) -> ParameterTable:
    """A table of these parameters and columns in the place of another's, by which nothing is learnt."""
    return ParameterTable(
        {name: Parameter(rows[name], requires_grad=False) for name in table.parameters},
        {name: rows[name] for name in table.columns},
        networks=table.networks,
    )
