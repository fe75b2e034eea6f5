"""Adaptive capacity: growth continues while new primitives raise validation PSNR by more than their price.

Between two events of density control, windows of some training views are held out of the loss. The next event renders
them with and without the primitives that the last event added. The difference of the squared errors is the gain, in dB
per doubling of the primitives, the unit of the price. A larger gain makes growth faster; below the price growth ends,
and primitives worth less than the price are removed. The windows change with every event, so training still uses all
pixels; test views are never read.
"""

import logging
import math
import sys
from collections.abc import Sequence
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
"""Least and largest factor between the growth rates of two events."""
STEPS = 100
"""Steps that a growth rate refers to: the distance of events depends on the number of training views."""
AT_ONCE = 0.75
"""Largest share of the rows removed in one event: each is measured alone, but together they may be worth much."""
AGAIN = 0.1
"""After growth, events continue to remove rows while the last one removed at least this share."""
WITNESSES = 2
"""Views that must show a point of empty space as transparent: one alone may have a wrong pose."""


@dataclass(frozen=True, kw_only=True)
class AdaptiveOptions:
    """Options of adaptive growth; values in conf/backbone/parts/capacity.yaml."""

    price: Annotated[float, Range(1e-6, 100)] = 0.8
    """Least gain of a doubling of the primitives at the end of the run, dB."""
    discount: Annotated[float, Range(1e-6, 1)] = 0.2
    """Share of a gain or error measured during growth that remains at the end of the run."""
    judged: bool = True
    """True: the gain of each event sets the growth rate. False: published growth, then primitives worth less than the
    price are removed; for primitives that become useful late (anchors)."""
    rate: Annotated[float, Range(1e-6, 10)] = 0.15
    """Initial growth per hundred steps."""
    fastest: Annotated[float, Range(1e-6, 10)] = 0.4
    """Largest growth per hundred steps."""
    slowest: Annotated[float, Range(1e-6, 10)] = 0.025
    """Growth per hundred steps below which growth ends."""
    views: Annotated[int, Range(1, 1000)] = 6
    """Training views with a validation window at a time."""
    window: Annotated[float, Range(0.05, 1)] = 0.5
    """Sides of a window as shares of the view's."""


class Adaptive(Capacity):
    """Growth that continues while each event gains more than its price."""

    ranked = True

    def __init__(self, options: AdaptiveOptions, context: BackboneContext, events: EventSteps, most: int) -> None:
        super().__init__(most)
        self.options, self.context, self.events = options, context, events

    def initialise(self, table: ParameterTable) -> None:
        """Adds the statistic and the record that adaptive capacity keeps in a table."""
        table.statistics["born"] = torch.zeros(len(table), device=table.device)
        # of each measured event: step, primitives, added, gain and its standard error (dB per doubling), next rate
        table.record["trials"] = torch.zeros(0, 6, dtype=torch.float64)
        table.record["removed_share"] = torch.zeros((), dtype=torch.float64)

    def remove_empty(self, table: ParameterTable, positions: Float[Tensor, "N 3"]) -> dict[str, float]:
        """Removes rows in space that photos show to be empty: most of random points."""
        empty = in_empty_space(positions.detach(), self.context.scene.train) & not_sky(table)
        count = int(empty.sum())
        if count in (0, len(empty)):
            return {}
        logger.info("step 1: %d of %d points lie where photos are transparent, removing them", count, len(empty))
        keep_rows(table, ~empty)
        return {"cleared": count}

    # -- validation windows --------------------------------------------------------------------------------------

    def windows(self, step: int) -> dict[View, Window]:
        """Returns the windows held out of the loss at a step: those of its interval between events."""
        views, interval = self.context.views.at(step), (step - 1) // self.events.every
        return validation_windows(views, self.options.views, self.options.window, "withheld", interval)

    def validation_window(self, table: ParameterTable, view: View, step: int) -> Window | None:
        """Returns the view's held-out window at a step, while events are measured."""
        if not self.events.start < step < self.events.stop or not self.measures(table):
            return None
        return self.windows(step).get(view)

    # -- evaluation ----------------------------------------------------------------------------------------------

    def evaluate(self, model: Backbone[Any], before_last_event: BeforeLastEvent, step: int) -> dict[str, float]:
        """Measures the gain of the last event; when growth ends and at the last event, removes rows below the price."""
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
        """Renders the validation windows with and without the primitives of the last event."""
        table = model.table
        before = before_last_event(table) if self.measures(table) else None
        if before is None or not bool(rounding_in(self.windows(step)).any()):  # all windows are masked
            return {}
        each = self.options.discount / math.log2(len(table) / len(before))
        gain, error = (each * value for value in self.gain(model, table, before, step))
        price, added = self.options.price, len(table) - len(before)
        rate = min(self.rate(table) * min(FASTER, max(SLOWER, gain / price)), self.options.fastest)
        trial = torch.tensor([[step, len(table), added, gain, error, rate]], dtype=torch.float64)
        table.record["trials"] = torch.cat([table.record["trials"], trial])
        decision = "growth ends" if self.ended(table) else f"growth continues by {self.share(table):.1%}"
        logger.info(
            "step %d: the last %d primitives gained %.2f +- %.2f dB per doubling, price %.2f: %s at %d primitives",
            *(step, added, gain, error, price, decision, len(table)),
        )
        spread = {"gain_error": error} if math.isfinite(error) else {}  # infinite for one window
        return {"judged": len(table), "gain": gain, "price": price} | spread

    def gain(
        self, model: Backbone[Any], table: ParameterTable, before: ParameterTable, step: int
    ) -> tuple[float, float]:
        """Returns (gain of a table over `before` in the validation windows, its standard error), dB."""
        windows = self.windows(step)
        floor, probe = rounding_in(windows), Probe(model=model, views=self.context.views, step=step)

        def measure() -> tuple[float, float]:
            both = (probe.with_table(rows).window_errors(windows) for rows in (table, before))
            return decibels(*(errors.cpu() + floor for errors in both))

        return self.context.on_rank0(measure)

    def remove_idle_levels(self, model: Backbone[Any], step: int) -> dict[str, float]:
        """Removes the finest levels of detail that gain less than the price; returns the gain of each, dB per doubling.

        A level that no window shows has gain 0 and stays: other views may show it.
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
        """Returns the loss of the validation windows without these rows, dB per doubling, discounted."""
        without = with_rows(model.table, ~rows)
        doublings = math.log2(len(model.table) / len(without))
        return self.options.discount * self.gain(model, model.table, without, step)[0] / doublings

    def remove_idle_rows(self, model: Backbone[Any], step: int) -> dict[str, float]:
        """Removes rows whose removal raises the squared error of training views by less than their share of the price.

        A view that shows N rows may lose price / (N ln 2) dB with each, which is price ln 10 / (10 N ln 2) of its final
        squared error, rounding of the photo included. The least important rows go first, at most `AT_ONCE` of all.
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

    # -- the rate of growth --------------------------------------------------------------------------------------

    def rate(self, table: ParameterTable) -> float:
        """Returns the growth per hundred steps after the last measured event."""
        trials = table.record["trials"]
        return float(trials[-1, 5]) if len(trials) else self.options.rate

    def share(self, table: ParameterTable) -> float:
        """Returns the share of the primitives that an event adds at this rate."""
        return (1 + self.rate(table)) ** (self.events.every / STEPS) - 1

    def ended(self, table: ParameterTable) -> bool:
        """Returns whether growth has become too slow to go on."""
        return self.rate(table) < self.options.slowest

    def measures(self, table: ParameterTable) -> bool:
        """Returns whether the gains of events are measured."""
        return self.options.judged and not self.ended(table)

    def room(self, table: ParameterTable, candidates: int, step: int) -> int:
        """Returns how many primitives an event may add, up to the cap."""
        return min(self.demand(table, step), room_under(self.most, len(table)))

    def demand(self, table: ParameterTable, step: int) -> int:
        """Returns how many primitives an event would add without a cap; none at the last, which no event measures."""
        if self.ended(table) or self.events.passed(step) == 1:
            return 0
        return max(1, round(self.share(table) * len(table))) if self.options.judged else sys.maxsize

    def plan(self) -> dict[str, Any]:
        """Returns the price and the number of events."""
        numbers = {"price_db_per_doubling": self.options.price, "events": max(1, self.events.count())}
        return {"capacity": numbers | self.events.caution()}


def in_empty_space(positions: Float[Tensor, "P 3"], views: Sequence[View]) -> Bool[Tensor, "P"]:
    """Marks world points that at least `WITNESSES` views show as transparent; none without alpha channels.

    A scene lies inside the visual hull of its cut-out photos (Laurentini 1994). Most random initial points lie outside
    it (3D-GS starts NeRF-synthetic scenes from 100,000 in a cube).
    """
    witnesses = torch.zeros(len(positions), dtype=torch.int64, device=positions.device)
    for view in views:
        empty = view.transparent()
        if empty is not None:
            pixels, depths = view.camera.project(positions)
            inside = view.camera.shows(pixels, depths)
            column, row = torch.where(inside[:, None], pixels, 0).long().unbind(1)
            witnesses += inside & empty.to(positions.device)[row, column]
    return witnesses >= WITNESSES
