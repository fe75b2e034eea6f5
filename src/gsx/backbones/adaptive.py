"""As many primitives as pay for themselves: growth goes on while validation windows say so.

Between two events of density control a window of some training views counts in no loss. The next event draws them
twice: by the model as it is, and as it would be had the last event added nothing. The difference of the errors is the
gain of what was added, in dB per doubling of the primitives, the unit of the price. Growth is faster the more it gains,
and ends where that stays below the price. Then what is not worth the price is removed: at the events after as long as
much goes, and at the last one.
No step has seen the windows since what they measure was added. They move to other views and places with every event, so
that all pixels are learnt from in the end. Test views play no part.
"""

import logging
import math
import sys
from dataclasses import dataclass
from typing import Annotated, Any

import torch
from torch import Tensor

from gsx.backbones.capacity import (
    BeforeLastEvent,
    Capacity,
    EventSteps,
    error_exponent,
    with_rows,
    worth_in_training,
)
from gsx.backbones.density import room_under
from gsx.backbones.empty_space import in_empty_space
from gsx.backbones.sky import not_sky
from gsx.core.data.scene import View
from gsx.core.data.window import Window
from gsx.core.ranges import Range
from gsx.core.shapes import Bool, Float
from gsx.core.training.backbone import Backbone, BackboneContext
from gsx.core.training.importance import Probe
from gsx.core.training.parameter_table import ParameterTable, keep_rows
from gsx.core.training.validation import decibels, rounding_in, validation_windows

logger = logging.getLogger(__name__)

SLOWER, FASTER = 0.5, 2.0
"""By how much the rate of growth changes from one event to the next, at most."""
STEPS = 100
"""Rates of growth hold for so many: the more training views there are, the farther apart events are."""
AT_ONCE = 0.75
"""Largest share of the rows that is removed at once: each is measured beside all others, though together they may be
worth much. What is left learns before the next removal."""
AGAIN = 0.1
"""Once growth has ended, events go on removing while the last one removed such a share."""


@dataclass(frozen=True, kw_only=True)
class AdaptiveOptions:
    """Growth while it pays; values in conf/backbone/parts/capacity.yaml."""

    price: Annotated[float, Range(1e-6, 100)] = 0.8
    """dB that a doubling of the primitives has to bring in the end."""
    discount: Annotated[float, Range(1e-6, 1)] = 0.2
    """Share of gains and errors measured during growth that is left in the end: other primitives count on the new ones,
    nothing has learnt without them, and learning goes on."""
    judged: bool = True
    """Whether what each event gains decides how fast growth goes on. Otherwise growth is as published, and what is not
    worth the price is removed: for primitives that become useful only later (anchors)."""
    rate: Annotated[float, Range(1e-6, 10)] = 0.15
    """Growth over a hundred steps, at first."""
    fastest: Annotated[float, Range(1e-6, 10)] = 0.4
    """Over a hundred steps, whatever is gained."""
    slowest: Annotated[float, Range(1e-6, 10)] = 0.025
    """Growth that slows down to less over a hundred steps has ended."""
    views: Annotated[int, Range(1, 1000)] = 6
    """Training views that have a validation window at a time."""
    window: Annotated[float, Range(0.05, 1)] = 0.5
    """Its sides as shares of the view's."""


@dataclass(frozen=True)
class Trial:
    """The gain of the primitives that one event added, measured at the event after it."""

    step: int
    primitives: int
    added: int
    gain: float
    """dB per doubling, discounted."""
    error: float
    """Its standard error over the windows."""
    rate: float
    """Growth from here on, over a hundred steps."""


class Adaptive(Capacity):
    """Grows while what each event has added gains more than its price."""

    ranked = True

    def __init__(self, options: AdaptiveOptions, context: BackboneContext, events: EventSteps, most: int) -> None:
        super().__init__(most)
        self.options, self.context, self.events = options, context, events

    def initialise(self, table: ParameterTable) -> None:
        """Gives a fresh table its statistic and its record."""
        table.statistics["born"] = torch.zeros(len(table), device=table.device)
        table.record["trials"] = torch.zeros(0, 6, dtype=torch.float64)
        table.record["removed_share"] = torch.zeros((), dtype=torch.float64)

    def remove_empty(self, table: ParameterTable, positions: Float[Tensor, "N 3"]) -> dict[str, float]:
        """Removes what lies where photos show that nothing is: most of random points."""
        empty = in_empty_space(positions.detach(), self.context.scene.train) & not_sky(table)
        count = int(empty.sum())
        if count in (0, len(empty)):
            return {}
        logger.info("step 1: %d of %d points lie where photos are transparent, removing them", count, len(empty))
        keep_rows(table, ~empty)
        return {"cleared": count}

    # -- validation windows --------------------------------------------------------------------------------------

    def windows(self, step: int) -> dict[View, Window]:
        """Returns the windows that count in no loss at a step: those of its interval between events."""
        views, interval = self.context.views.at(step), (step - 1) // self.events.every
        return validation_windows(views, self.options.views, self.options.window, "withheld", interval)

    def validation_window(self, table: ParameterTable, view: View, step: int) -> Window | None:
        """Returns that of the interval which the step belongs to, while there is something to measure."""
        if not self.events.start < step < self.events.stop or not self.measures(table):
            return None
        return self.windows(step).get(view)

    # -- evaluation ----------------------------------------------------------------------------------------------

    def evaluate(self, model: Backbone[Any], before_last_event: BeforeLastEvent, step: int) -> dict[str, float]:
        """Measures the gain of the primitives that the last event added, and removes what is not worth the price.

        Rows are removed when growth ends, at the last event, and in between while that makes the model much smaller.
        """
        grew = not self.ended(model.table)
        metrics = self.measure(model, before_last_event, step)
        last = self.events.passed(step) == 1
        ends = grew and (last or self.ended(model.table))
        metrics |= self.remove_idle_levels(model, step) if ends else {}
        goes_on = not grew and float(model.table.record["removed_share"]) >= AGAIN
        metrics |= self.remove_idle_rows(model, step) if last or ends or goes_on else {}
        over_cap = self.demand(model.table, step) - room_under(self.most, len(model.table))
        return metrics | ({"withheld": over_cap} if over_cap > 0 and self.options.judged else {})

    def measure(self, model: Backbone[Any], before_last_event: BeforeLastEvent, step: int) -> dict[str, float]:
        """Draws the validation windows with and without what the last event added."""
        table = model.table
        before = before_last_event(table) if self.measures(table) else None
        if before is None or not bool(rounding_in(self.windows(step)).any()):  # masked windows tell nothing
            return {}
        gain, error = self.gain(model, table, before, step)
        each = self.options.discount / math.log2(len(table) / len(before))
        rate = self.rate(table) * min(FASTER, max(SLOWER, each * gain / self.options.price))
        added = len(table) - len(before)
        trial = Trial(step, len(table), added, each * gain, each * error, min(rate, self.options.fastest))
        row = torch.tensor([list(vars(trial).values())], dtype=torch.float64)
        table.record["trials"] = torch.cat([table.record["trials"], row])
        self.log(trial, table)
        spread = {"gain_error": trial.error} if math.isfinite(trial.error) else {}  # of one window there is none
        return {"judged": len(table), "gain": trial.gain, "price": self.options.price} | spread

    def gain(
        self, model: Backbone[Any], table: ParameterTable, before: ParameterTable, step: int
    ) -> tuple[float, float]:
        """Returns (dB by which a table draws validation windows better than another, its standard error)."""
        windows = self.windows(step)
        floor, probe = rounding_in(windows), Probe(model=model, views=self.context.views, step=step)

        def measure() -> tuple[float, float]:
            both = (probe.with_table(rows).window_errors(windows) for rows in (table, before))
            return decibels(*(errors.cpu() + floor for errors in both))

        return self.context.on_rank0(measure)

    def remove_idle_levels(self, model: Backbone[Any], step: int) -> dict[str, float]:
        """Removes the finest levels of detail while they gain less than the price; returns the gains of all.

        A level's gain is what validation windows lose without its primitives, in dB per doubling. A level that no
        window shows is kept: others may, and nothing is known of it.
        """
        if "level" not in model.table.columns:
            return {}
        gains: dict[str, float] = {}
        removing, removed = True, 0
        for level in model.table["level"].unique().flip(0).tolist():
            of_level = model.table["level"] == level
            if bool(of_level.all()):
                break
            gain = self.gain_of_rows(model, of_level, step)
            removing = removing and gain != 0 and gain < self.options.price
            logger.info(
                "step %d: level %d gains %.2f dB per doubling, price %.2f, %s its %d primitives",
                *(step, level, gain, self.options.price, "removing" if removing else "keeping", int(of_level.sum())),
            )
            gains[f"gain_of_level_{level}"] = gain
            if removing:
                keep_rows(model.table, ~of_level)
                removed += 1
        return gains | {"levels_removed": removed}

    def gain_of_rows(self, model: Backbone[Any], rows: Bool[Tensor, "N"], step: int) -> float:
        """Returns the dB per doubling of the primitives that validation windows lose without these, discounted."""
        without = with_rows(model.table, ~rows)
        doublings = math.log2(len(model.table) / len(without))
        return self.options.discount * self.gain(model, model.table, without, step)[0] / doublings

    def remove_idle_rows(self, model: Backbone[Any], step: int) -> dict[str, float]:
        """Removes rows without which the error of the training views would grow by less than their share of the price.

        A view that shows N rows may lose lambda / (N ln 2) dB with one of them, lambda being the price: lambda ln 10 /
        (10 N ln 2) of its squared error, as that will be in the end, with that of the photo's rounding. A row's worth
        is the mean over the views that show it; those worth least go first, at most three quarters of all at once.
        """
        removal = worth_in_training(model, self.context, step)
        lasting = self.options.discount * removal.error_share + removal.rounding_share
        least = error_exponent(self.options.price) * lasting
        idle = (removal.views > 0) & (removal.squares < least)
        count = min(int(idle.sum()), math.floor(AT_ONCE * len(idle)))
        kept = torch.ones_like(idle)
        kept[torch.where(idle, removal.squares, torch.inf).argsort(stable=True)[:count]] = False
        logger.info(
            "step %d: %d of %d primitives each add less than %.3g to the squared error, removing %d",
            *(step, int(idle.sum()), len(idle), least, count),
        )
        model.table.record["removed_share"] = torch.tensor(count / len(idle), dtype=torch.float64)
        keep_rows(model.table, kept)
        return {"removed": count}

    def log(self, trial: Trial, table: ParameterTable) -> None:
        """Logs what was decided, because of which number and threshold."""
        verdict = "growth ends" if self.ended(table) else f"growth goes on by {self.share(table):.1%}"
        logger.info(
            "step %d: the last %d primitives gained %.2f +- %.2f dB per doubling, price %.2f: %s at %d primitives",
            *(trial.step, trial.added, trial.gain, trial.error, self.options.price, verdict, trial.primitives),
        )

    # -- the rate of growth --------------------------------------------------------------------------------------

    def rate(self, table: ParameterTable) -> float:
        """Returns the growth over a hundred steps: more while a doubling gains more than its price."""
        trials = table.record["trials"]
        return float(trials[-1, 5]) if len(trials) else self.options.rate

    def share(self, table: ParameterTable) -> float:
        """Returns the share of the primitives that an event adds at the rate of growth."""
        return (1 + self.rate(table)) ** (self.events.every / STEPS) - 1

    def ended(self, table: ParameterTable) -> bool:
        """Returns whether growth has become too slow to go on."""
        return self.rate(table) < self.options.slowest

    def measures(self, table: ParameterTable) -> bool:
        """Returns whether events are measured by what they gain."""
        return self.options.judged and not self.ended(table)

    def room(self, table: ParameterTable, candidates: int, step: int) -> int:
        """Returns a share of the primitives while growth pays, up to the cap."""
        return min(self.demand(table, step), room_under(self.most, len(table)))

    def demand(self, table: ParameterTable, step: int) -> int:
        """Returns how many an event may add without a cap; none at the last one, which nothing would measure."""
        if self.ended(table) or self.events.passed(step) == 1:
            return 0
        return max(1, round(self.share(table) * len(table))) if self.options.judged else sys.maxsize

    def plan(self) -> dict[str, Any]:
        """Returns the price and the number of events."""
        numbers = {"price_db_per_doubling": self.options.price, "events": max(1, self.events.count())}
        return {"capacity": numbers | self.events.caution()}
