"""How many primitives a model may have: under a cap as published, or towards a budget."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

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

MOST_VIEWS = 48
"""Training views, at most, that tell what a row, or its colours, are worth (all at the last event of a budget)."""
BeforeLastEvent = Callable[[ParameterTable], ParameterTable | None]
"""Returns the table as it would be had the last event added nothing; None: it added nothing."""


@dataclass(frozen=True, kw_only=True)
class BudgetOptions:
    """Growth towards a number; values in conf/backbone/parts/capacity.yaml."""

    primitives: Count = 0
    """How many there are to be when growth ends, at most: what is faint then is pruned as ever."""
    power: Share = 0.5
    """At a share t of the growth there may be first + (primitives - first) t^power (Improved-GS: a square root)."""


@dataclass(frozen=True)
class EventSteps:
    """The steps at which density control acts: multiples of `every` between `start` and `stop`, both left out."""

    start: int
    stop: int
    every: int

    def due(self, step: int) -> bool:
        """Returns whether density control acts at a step."""
        return self.start < step < self.stop and step % self.every == 0

    def count(self) -> int:
        """Returns how often it acts; not at all: 0 or less."""
        return (self.stop - 1) // self.every - self.start // self.every

    def caution(self) -> dict[str, str]:
        """Returns a plan's warning that nothing will be decided, where it does not act at all."""
        if self.count() > 0:
            return {}
        when = f"every {self.every} steps between {self.start} and {self.stop}"
        remedy = "take more steps, or fewer training views, all of which an interval passes over"
        return {CAUTION: f"decides nothing, as density control acts at no step of this run, {when}: {remedy}"}

    def passed(self, step: int) -> float:
        """Returns the share of the events that is over after the one at a step, from 0 to 1."""
        return min(1.0, max(0.0, (step // self.every - self.start // self.every) / max(1, self.count())))


def event_steps(schedule: Schedule, start: int, stop: int, every: int) -> EventSteps:
    """Rescales published steps of density control; it ends with the run: what learns afterwards does not grow."""
    stop = min(schedule.step(stop), schedule.iterations + 1)
    return EventSteps(schedule.step(start), stop, schedule.interval(every))


class Capacity:
    """Decides at each event of density control how many primitives may come: as published, all up to a cap."""

    ranked = False
    """Whether those that draw most of the error come first."""

    def __init__(self, most: int) -> None:
        self.most = most

    def initialise(self, table: ParameterTable) -> None:
        """Gives a fresh table the statistics and the record that are kept there."""

    def remove_empty(self, table: ParameterTable, positions: Float[Tensor, "N 3"]) -> dict[str, float]:
        """Removes rows at the first step that nothing can be learnt of; returns how many, for the log."""
        return {}

    def evaluate(self, model: Backbone[Any], before_last_event: BeforeLastEvent, step: int) -> dict[str, float]:
        """Evaluates the model before an event, and removes rows; returns the findings, for the log."""
        return {}

    def room(self, table: ParameterTable, candidates: int, step: int) -> int:
        """Returns how many of the candidates may be added now."""
        return room_under(self.most, len(table))

    def validation_window(self, table: ParameterTable, view: View, step: int) -> Window | None:
        """Returns the window of a view that counts in no loss at a step; None: all of it counts."""
        return None

    def plan(self) -> dict[str, Any]:
        """Returns what is decided before training, for the log and the report."""
        return {}


class Budget(Capacity):
    """Growth along a curve to a number of primitives (Taming-3DGS; the curve of Improved-GS)."""

    ranked = True

    def __init__(self, options: BudgetOptions, context: BackboneContext, events: EventSteps) -> None:
        super().__init__(options.primitives)
        self.options, self.context, self.events = options, context, events

    def initialise(self, table: ParameterTable) -> None:
        """Records where the curve begins."""
        table.record["first"] = torch.tensor(float(len(table)), dtype=torch.float64)

    def evaluate(self, model: Backbone[Any], before_last_event: BeforeLastEvent, step: int) -> dict[str, float]:
        """Removes what is beyond the curve, which falls where there are more points than primitives asked for.

        What goes is worth least to some views: of what these show as large a share as is too many of all. At the last
        event all views count.
        """
        excess = len(model.table) - self.target(int(model.table.record["first"]), step)
        if excess <= 0:
            return {}
        views, last = len(self.context.scene.train), self.events.passed(step) == 1
        examined = views if last else min(MOST_VIEWS, views)
        removal = worth_in_training(model, self.context, step, examined)
        visible = removal.views > 0  # nothing is known of the others: views that were not examined may show them
        count = excess if examined == views else round(excess * float(visible.double().mean()))
        kept = torch.ones_like(visible)
        kept[torch.where(visible, removal.squares, torch.inf).argsort(stable=True)[:count]] = False
        keep_rows(model.table, kept)
        return {"removed": count}

    def room(self, table: ParameterTable, candidates: int, step: int) -> int:
        """Returns how many are missing to the curve."""
        return max(0, self.target(int(table.record["first"]), step) - len(table))

    def target(self, first: int, step: int) -> int:
        """Returns how many there may be after the event of a step, of a model that began with `first`."""
        return math.floor(first + (self.most - first) * self.events.passed(step) ** self.options.power)

    def plan(self) -> dict[str, Any]:
        """Returns the number."""
        return {"budget": {"primitives": self.most} | self.events.caution()}


def error_exponent(price: float) -> float:
    """Returns e: the squared error falls as N^-e where a doubling of N brings `price` dB."""
    return price * math.log(10) / (10 * math.log(2))


def worth_in_training(
    model: Backbone[Any], context: BackboneContext, step: int, most_views: int = MOST_VIEWS
) -> Removal:
    """Estimates what training views, at most so many of them, lose without each row."""
    views = random_views(context.views.at(step), most_views, context.generator)
    probe = Probe(model=model, views=context.views, step=step)
    return context.on_rank0(lambda: probe.removal(views, context.generator).to("cpu")).to(context.device)


# -- tables without the last event -------------------------------------------------------------------------------------


def mark_newborn(table: ParameterTable, old: int) -> None:
    """Records that the rows behind the `old` first ones were added by this event, where capacity is adaptive."""
    if "born" in table.statistics:
        table.statistics["born"] = (torch.arange(len(table), device=table.device) >= old).float()


def without_newborn(table: ParameterTable) -> ParameterTable | None:
    """Returns the table without the rows that the last event added; None: it added none."""
    old = table.statistics["born"] == 0
    if bool(old.all()) or not bool(old.any()):
        return None
    return with_rows(table, old)


def with_rows(table: ParameterTable, kept: Bool[Tensor, "N"]) -> ParameterTable:
    """Returns a table of these rows alone that learns nothing."""
    return frozen_table(table, {name: value[kept] for name, value in detached_rows(table).items()})


def frozen_table(table: ParameterTable, rows: dict[str, Tensor]) -> ParameterTable:
    """Returns a table of these parameters and columns in the place of another's that learns nothing."""
    return ParameterTable(
        {name: Parameter(rows[name], requires_grad=False) for name in table.parameters},
        {name: rows[name] for name in table.columns},
        networks=table.networks,
    )
