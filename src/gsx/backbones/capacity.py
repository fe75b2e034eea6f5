"""Number of primitives of a model: published growth up to a cap, or growth towards a budget."""

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
"""Most training views that importances are estimated from (all of them at the last event of a budget)."""
BeforeLastEvent = Callable[[ParameterTable], ParameterTable | None]
"""Returns a table without the primitives that the last event added; None: it added none."""


@dataclass(frozen=True, kw_only=True)
class BudgetOptions:
    """Options of a budget; values in conf/backbone/parts/capacity.yaml."""

    primitives: Count = 0
    """Most primitives when growth ends; pruning of faint ones continues."""
    power: Share = 0.5
    """Limit at a share t of the growth: first + (primitives - first) t^power (Improved-GS: a square root)."""


@dataclass(frozen=True)
class EventSteps:
    """Steps of density control: multiples of `every` strictly between `start` and `stop`."""

    start: int
    stop: int
    every: int

    def due(self, step: int) -> bool:
        """Returns whether a step has an event."""
        return self.start < step < self.stop and step % self.every == 0

    def steps(self) -> list[int]:
        """Returns the steps with an event, in order."""
        return list(range((self.start // self.every + 1) * self.every, self.stop, self.every))

    def count(self) -> int:
        """Returns the number of events; 0 or less: none."""
        return (self.stop - 1) // self.every - self.start // self.every

    def caution(self) -> dict[str, str]:
        """Returns a plan's warning if there is no event."""
        if self.count() > 0:
            return {}
        when = f"every {self.every} steps between {self.start} and {self.stop}"
        remedy = "take more steps, or fewer training views, all of which an interval passes over"
        return {CAUTION: f"has no effect: density control acts at no step of this run, {when}: {remedy}"}

    def passed(self, step: int) -> float:
        """Returns the share of the events that are over after the one at a step, 0 to 1."""
        return min(1.0, max(0.0, (step // self.every - self.start // self.every) / max(1, self.count())))


def event_steps(schedule: Schedule, start: int, stop: int, every: int, passes: float = 1.0) -> EventSteps:
    """Rescales published steps of density control, which ends with the run at the latest.

    passes: least passes over the training views between events of a shortened run.
    """
    stop = min(schedule.step(stop), schedule.iterations + 1)
    return EventSteps(schedule.step(start), stop, schedule.interval(every, passes))


class Capacity:
    """Number of primitives that each event of density control may add: as published, all candidates up to a cap."""

    ranked = False
    """True: candidates that draw most of the error come first."""

    def __init__(self, most: int) -> None:
        self.most = most

    def initialise(self, table: ParameterTable) -> None:
        """Adds statistics and record of this capacity to a new table."""

    def remove_empty(self, table: ParameterTable, positions: Float[Tensor, "N 3"]) -> dict[str, float]:
        """Removes rows in empty space at the first step; returns metrics."""
        return {}

    def evaluate(self, model: Backbone[Any], before_last_event: BeforeLastEvent, step: int) -> dict[str, float]:
        """Evaluates the model before an event and removes rows; returns metrics."""
        return {}

    def room(self, table: ParameterTable, candidates: int, step: int) -> int:
        """Returns how many of the candidates an event may add."""
        return room_under(self.most, len(table))

    def validation_window(self, table: ParameterTable, view: View, step: int) -> Window | None:
        """Returns the window of a view that is held out of the loss at a step; None: there is none."""
        return None

    def plan(self) -> dict[str, Any]:
        """Returns decisions made before training, for log and report."""
        return {}


class Budget(Capacity):
    """Growth along a curve to a number of primitives (Taming-3DGS; the curve of Improved-GS)."""

    ranked = True

    def __init__(self, options: BudgetOptions, context: BackboneContext, events: EventSteps) -> None:
        super().__init__(options.primitives)
        self.options, self.context, self.events = options, context, events

    def initialise(self, table: ParameterTable) -> None:
        """Records the number of primitives at which the curve begins."""
        table.record["first"] = torch.tensor(float(len(table)), dtype=torch.float64)

    def evaluate(self, model: Backbone[Any], before_last_event: BeforeLastEvent, step: int) -> dict[str, float]:
        """Removes the least important rows above the curve, which falls if the scene has more points than the budget.

        Some views estimate the importance and remove their share of the excess; at the last event all views do.
        """
        excess = len(model.table) - self.target(int(model.table.record["first"]), step)
        if excess <= 0:
            return {}
        views, last = len(self.context.scene.train), self.events.passed(step) == 1
        examined = views if last else min(MOST_VIEWS, views)
        removal = worth_in_training(model, self.context, step, examined)
        visible = removal.views > 0  # views that were not examined may show the others
        count = excess if examined == views else round(excess * float(visible.double().mean()))
        kept = torch.ones_like(visible)
        kept[torch.where(visible, removal.squares, torch.inf).argsort(stable=True)[:count]] = False
        keep_rows(model.table, kept)
        return {"removed": count}

    def room(self, table: ParameterTable, candidates: int, step: int) -> int:
        """Returns how many primitives are missing below the curve."""
        return max(0, self.target(int(table.record["first"]), step) - len(table))

    def target(self, first: int, step: int) -> int:
        """Returns the curve after the event of a step, for a model that began with `first` primitives."""
        return math.floor(first + (self.most - first) * self.events.passed(step) ** self.options.power)

    def plan(self) -> dict[str, Any]:
        """Returns the budget."""
        return {"budget": {"primitives": self.most} | self.events.caution()}


def error_exponent(price: float) -> float:
    """Returns e such that the squared error falls as N^-e if a doubling of N gains `price` dB."""
    return price * math.log(10) / (10 * math.log(2))


def worth_in_training(
    model: Backbone[Any], context: BackboneContext, step: int, most_views: int = MOST_VIEWS
) -> Removal:
    """Estimates what at most `most_views` training views lose without each row."""
    views = random_views(context.views.at(step), most_views, context.generator)
    probe = Probe(model=model, views=context.views, step=step)
    return context.on_rank0(lambda: probe.removal(views, context.generator).to("cpu")).to(context.device)


# -- tables without the last event -------------------------------------------------------------------------------------


def mark_newborn(table: ParameterTable, old: int) -> None:
    """Marks the rows after the first `old` ones as added by this event, if capacity is adaptive."""
    if "born" in table.statistics:
        table.statistics["born"] = (torch.arange(len(table), device=table.device) >= old).float()


def without_newborn(table: ParameterTable) -> ParameterTable | None:
    """Returns the table without the rows of the last event; None: it added none, or all."""
    old = table.statistics["born"] == 0
    if bool(old.all()) or not bool(old.any()):
        return None
    return with_rows(table, old)


def with_rows(table: ParameterTable, kept: Bool[Tensor, "N"]) -> ParameterTable:
    """Returns a table of these rows that does not learn."""
    return frozen_table(table, {name: value[kept] for name, value in detached_rows(table).items()})


def frozen_table(table: ParameterTable, rows: dict[str, Tensor]) -> ParameterTable:
    """Returns a table of these parameters and columns that does not learn."""
    return ParameterTable(
        {name: Parameter(rows[name], requires_grad=False) for name in table.parameters},
        {name: rows[name] for name in table.columns},
        networks=table.networks,
    )
