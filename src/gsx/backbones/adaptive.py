"""As many primitives as pay for themselves: growth goes on while validation windows say so.

Between two events of density control a window of some training views counts in no loss. At the next event they are
drawn twice: by the model as it is, and as it would be had the last event added nothing. What the error differs by
is the gain of what was added, told in dB per doubling of the primitives, the unit of the price. Growth is the faster
the more it gains, and ends where that stays below the price; then, at the events after as long as much goes, and at the
last one, goes what is not worth it.
No step has seen the windows since what is judged was added; they move to other views and places with every event, so
that all pixels are learnt from in the end. Test views play no part.
"""

import logging
import math
import sys
from dataclasses import dataclass
from typing import Annotated, Any

import torch
from torch import Tensor

from gsx.backbones.capacity import Growing, Undone, error_exponent, with_rows, worth_in_training
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
"""Rates of growth are told for so many: the more training views there are, the farther apart events are."""
AT_ONCE = 0.75
"""Share of the rows that is removed at once, at most: they are judged one by one, though none may be worth anything
beside the others and all of them together much. What is left learns before it is asked."""
AGAIN = 0.1
"""Once growth has ended, events go on asking while the last answer removed such a share."""


@dataclass(frozen=True, kw_only=True)
class AdaptiveOptions:
    """Growth while it pays; values in conf/backbone/parts/capacity.yaml."""

    price: Annotated[float, Range(1e-6, 100)] = 0.8
    """dB that a doubling of the primitives has to bring in the end."""
    discount: Annotated[float, Range(1e-6, 1)] = 0.2
    """So much of what is found during growth is left in the end: of gains, since other primitives count on the new
    ones and nothing has learnt without them; of errors, since learning goes on."""
    judged: bool = True
    """Whether what each event gains decides how fast growth goes on. Otherwise it is published growth, of which goes
    what is not worth the price: where what is new comes to be worth something only later (anchors)."""
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
    """What was found of the primitives that one event added, at the event after it."""

    step: int
    primitives: int
    added: int
    gain: float
    """dB per doubling, discounted."""
    error: float
    """Its standard error over the windows."""
    rate: float
    """Growth from here on, over a hundred steps."""


class Adaptive:
    """Judges what each event has added."""

    ranked = True

    def __init__(self, options: AdaptiveOptions, context: BackboneContext, growing: Growing, most: int) -> None:
        self.options, self.growing, self.most = options, growing, most
        self.context = context

    def begin(self, table: ParameterTable) -> None:
        """Nothing has been added or found yet."""
        table.statistics["born"] = torch.zeros(len(table), device=table.device)
        table.record["trials"] = torch.zeros(0, 6, dtype=torch.float64)
        table.record["removed_share"] = torch.zeros((), dtype=torch.float64)

    def clear(self, table: ParameterTable, positions: Float[Tensor, "N 3"]) -> dict[str, float]:
        """Remove what lies where photographs show that nothing is: most of random points."""
        empty = in_empty_space(positions.detach(), self.context.scene.train) & not_sky(table)
        count = int(empty.sum())
        if count in (0, len(empty)):
            return {}
        logger.info(
            "%s of %s points lie where photographs are transparent: they are removed", f"{count:,}", f"{len(empty):,}"
        )
        keep_rows(table, ~empty)
        return {"cleared": count}

    # -- validation windows --------------------------------------------------------------------------------------

    def windows(self, step: int) -> dict[View, Window]:
        """The windows that count in no loss at a step: those of the interval between events that it belongs to."""
        views, interval = self.context.views.at(step), (step - 1) // self.growing.every
        return validation_windows(views, self.options.views, self.options.window, "withheld", interval)

    def validation_window(self, table: ParameterTable, view: View, step: int) -> Window | None:
        """That of the interval which the step belongs to, while there is something to judge."""
        if not self.growing.start < step < self.growing.stop or not self.tries(table):
            return None
        return self.windows(step).get(view)

    # -- what is found -------------------------------------------------------------------------------------------

    def judge(self, model: Backbone[Any], undone: Undone, step: int) -> dict[str, float]:
        """Find what the primitives added by the event before this one have gained; when growth ends, while that makes
        the model much smaller, and at the last event, remove what is not worth the price."""
        grew = not self.ended(model.table)
        found = self.tried(model, undone, step)
        last = self.growing.passed(step) == 1
        ends = grew and (last or self.ended(model.table))
        found |= self.without_idle_levels(model, step) if ends else {}
        goes_on = not grew and float(model.table.record["removed_share"]) >= AGAIN
        found |= self.removed(model, step) if last or ends or goes_on else {}
        held = self.asked(model.table, step) - room_under(self.most, len(model.table))
        return found | ({"withheld": held} if held > 0 and self.options.judged else {})

    def tried(self, model: Backbone[Any], undone: Undone, step: int) -> dict[str, float]:
        """Draw the validation windows with and without what the last event added."""
        table = model.table
        before = undone(table) if self.tries(table) else None
        if before is None or not bool(rounding_in(self.windows(step)).any()):  # masked windows tell nothing
            return {}
        gain, error = self.gain(model, table, before, step)
        each = self.options.discount / math.log2(len(table) / len(before))
        rate = self.rate(table) * min(FASTER, max(SLOWER, each * gain / self.options.price))
        added = len(table) - len(before)
        trial = Trial(step, len(table), added, each * gain, each * error, min(rate, self.options.fastest))
        row = torch.tensor([list(vars(trial).values())], dtype=torch.float64)
        table.record["trials"] = torch.cat([table.record["trials"], row])
        self.tell(trial, table)
        spread = {"gain_error": trial.error} if math.isfinite(trial.error) else {}  # of one window there is none
        return {"judged": len(table), "gain": trial.gain, "price": self.options.price} | spread

    def gain(
        self, model: Backbone[Any], table: ParameterTable, before: ParameterTable, step: int
    ) -> tuple[float, float]:
        """(dB by which validation windows are better drawn with one table than with another, its standard error)."""
        windows = self.windows(step)
        floor, probe = rounding_in(windows), Probe(model=model, views=self.context.views, step=step)

        def measure() -> tuple[float, float]:
            both = (probe.with_table(rows).window_errors(windows) for rows in (table, before))
            return decibels(*(errors.cpu() + floor for errors in both))

        return self.context.on_rank0(measure)

    def without_idle_levels(self, model: Backbone[Any], step: int) -> dict[str, float]:
        """Remove the finest levels of detail while they gain less than the price; tell what all of them gain.

        Each is judged by what validation windows lose without its primitives, in dB per doubling. A level that no
        window shows is kept: others may, and nothing is known of it.
        """
        if "level" not in model.table.columns:
            return {}
        gains: dict[str, float] = {}
        removing, gone = True, 0
        for level in model.table["level"].unique().flip(0).tolist():
            of_level = model.table["level"] == level
            if bool(of_level.all()):
                break
            gain = self.gain_of_rows(model, of_level, step)
            removing = removing and gain != 0 and gain < self.options.price
            self.tell_level(level, int(of_level.sum()), gain, removing, step)
            gains[f"gain_of_level_{level}"] = gain
            if removing:
                keep_rows(model.table, ~of_level)
                gone += 1
        return gains | {"levels_removed": gone}

    def gain_of_rows(self, model: Backbone[Any], rows: Bool[Tensor, "N"], step: int) -> float:
        """dB per doubling of the primitives that validation windows lose without these, discounted."""
        without = with_rows(model.table, ~rows)
        doublings = math.log2(len(model.table) / len(without))
        return self.options.discount * self.gain(model, model.table, without, step)[0] / doublings

    def tell_level(self, level: int, count: int, gain: float, removed: bool, step: int) -> None:
        """Log what a level of detail gains, and what becomes of it."""
        verdict = "is removed" if removed else "is kept"
        told = step, level, verdict, count, gain, self.options.price
        logger.info("step %d: level %d %s: its %d primitives gain %.2f dB per doubling, price %.2f", *told)

    def removed(self, model: Backbone[Any], step: int) -> dict[str, float]:
        """Remove rows without which the error of the training views would grow by less than their share of the price.

        A view that shows N rows may lose lambda / (N ln 2) dB with one of them, lambda being the price: lambda ln 10 /
        (10 N ln 2) of its squared error, as that will be in the end, with that of the photograph's rounding. Rows
        are judged in the mean over the views that show them; those worth least go first, at most three quarters of all
        at once.
        """
        found = worth_in_training(model, self.context, step)
        lasting = self.options.discount * found.error_share + found.rounding_share
        least = error_exponent(self.options.price) * lasting
        idle = (found.views > 0) & (found.squares < least)
        count = min(int(idle.sum()), math.floor(AT_ONCE * len(idle)))
        doomed = torch.zeros_like(idle)
        doomed[torch.where(idle, found.squares, torch.inf).argsort(stable=True)[:count]] = True
        logger.info(
            "step %d: %d of %d primitives are removed, of %d that each add less than %.3g to the squared error",
            *(step, count, len(idle), int(idle.sum()), least),
        )
        model.table.record["removed_share"] = torch.tensor(count / len(idle), dtype=torch.float64)
        keep_rows(model.table, ~doomed)
        return {"removed": count}

    def tell(self, trial: Trial, table: ParameterTable) -> None:
        """Log what was decided, because of which number and threshold."""
        verdict = "has ended" if self.ended(table) else f"goes on by {self.share(table):.1%}"
        gain, price = f"{trial.gain:.2f} +- {trial.error:.2f} dB per doubling in validation windows", self.options.price
        told = trial.step, verdict, trial.primitives, trial.added, gain, price
        logger.info("step %d: growth %s at %d primitives: the last %d gained %s, price %.2f", *told)

    def rate(self, table: ParameterTable) -> float:
        """Growth over a hundred steps: more while a doubling gains more than its price."""
        trials = table.record["trials"]
        return float(trials[-1, 5]) if len(trials) else self.options.rate

    def share(self, table: ParameterTable) -> float:
        """Share of the primitives that an event adds at the rate of growth."""
        return (1 + self.rate(table)) ** (self.growing.every / STEPS) - 1

    def ended(self, table: ParameterTable) -> bool:
        """Whether growth has become too slow to go on."""
        return self.rate(table) < self.options.slowest

    def tries(self, table: ParameterTable) -> bool:
        """Whether events are tried by what they gain."""
        return self.options.judged and not self.ended(table)

    def room(self, table: ParameterTable, wanted: int, step: int) -> int:
        """A share of the primitives while growth pays, up to the cap."""
        return min(self.asked(table, step), room_under(self.most, len(table)))

    def asked(self, table: ParameterTable, step: int) -> int:
        """How many an event may add if no cap holds it; none at the last one, which nothing would judge."""
        if self.ended(table) or self.growing.passed(step) == 1:
            return 0
        return max(1, round(self.share(table) * len(table))) if self.options.judged else sys.maxsize

    def plan(self) -> dict[str, Any]:
        """The price."""
        found = {"price_db_per_doubling": self.options.price, "events": self.growing.events()}
        return {"capacity": found | self.growing.caution()}
