"""Skips steps that gain too little on validation windows: a run then continues with its last part.

From `start` on, windows of some training views enter no loss while the number of steps grows by a tenth. The difference
of their errors at both ends is the gain of these steps on pixels that were not learnt, in dB per doubling of the steps:
the unit of the price. Below the price the run continues at `to`, with the end of its schedules (finer pixels, decaying
learning rates). Each test uses windows of other views. Test views are not used.
"""

import logging
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any

import torch
from torch import Tensor

from gsx.core.data.scene import View
from gsx.core.data.window import Window
from gsx.core.ranges import Range, Share
from gsx.core.shapes import Float
from gsx.core.training.importance import Probe
from gsx.core.training.module import ModuleContext, TrainingModule
from gsx.core.training.run import Run
from gsx.core.training.validation import decibels, rounding_in, validation_windows
from gsx.modules.milestones import last_milestone

logger = logging.getLogger(__name__)

GROWTH = 10
"""A test takes one step per this many earlier steps, but at least a pass over the views."""


@dataclass(frozen=True, kw_only=True)
class PlateauOptions:
    """Options; values in conf/module/plateau.yaml."""

    price: Annotated[float, Range(0, 100)] = 0.0
    """Least gain of a doubling of the steps, dB; 0: no step is skipped."""
    start: Share = 0.5
    """Share of the steps before any are skipped."""
    to: Share = 0.8
    """Share of the steps at which a run continues."""
    views: Annotated[int, Range(1, 1000)] = 6
    """Training views that have a validation window at a time."""
    window: Annotated[float, Range(0.05, 1)] = 0.5
    """Sides of a window as shares of the view's sides."""

    def __post_init__(self) -> None:
        if self.price > 0 and not 0 < self.start < self.to:
            raise ValueError(
                f"training.plateau.start is {self.start} and training.plateau.to {self.to}: set shares of the steps "
                "above 0, the first one smaller"
            )


class Plateau(TrainingModule):
    """A test of the gain of steps, which skips those that gain too little."""

    options: PlateauOptions

    def __init__(self, options: PlateauOptions, context: ModuleContext) -> None:
        super().__init__(options, context)
        self.one_pass = -(-len(context.scene.train) // context.batch)
        """Steps of a pass over the training views."""
        self.resume_at = round(options.to * context.iterations)
        """First step after skipped ones."""
        self.test_start = 0
        """Step after which the current windows begin; 0: none."""
        self.before: Float[Tensor, W] = torch.zeros(0, dtype=torch.float64)
        """Squared error in each window at that step."""
        self.gains: Float[Tensor, "T 3"] = torch.zeros(0, 3, dtype=torch.float64)
        """Step, gain in dB per doubling of the steps, and its standard error, of each test."""
        self.skipped: range = range(0)
        """Skipped steps."""

    # -- when ----------------------------------------------------------------------------------------------------------

    def first_test(self, run: Run) -> int:
        """Returns the step after which the first windows begin: after all milestones before `resume_at`."""
        return max(1, round(self.options.start * self.context.iterations), last_milestone(run, self.resume_at))

    def test_end(self, start: int) -> int:
        """Returns the step after which windows from `start` are tested."""
        return start + max(math.ceil(start / GROWTH), self.one_pass)

    def testing(self, run: Run) -> bool:
        """Checks if there are windows, of this schedule and not of one before `gsx resume`."""
        return self.options.price > 0 and self.test_start > 0 and self.test_start >= self.first_test(run)

    def test_ends_after(self, run: Run, step: int) -> bool:
        """Checks if the current windows are tested after this step."""
        return self.testing(run) and step == self.test_end(self.test_start)

    def test_starts_after(self, run: Run, step: int) -> bool:
        """Checks if windows begin after this step: there must be steps left to skip."""
        if self.options.price == 0:
            return False
        due = self.test_end(self.test_start) if self.testing(run) else self.first_test(run)
        return step == due and self.test_end(step) + 1 < self.resume_at

    # -- hooks ---------------------------------------------------------------------------------------------------------

    def before_step(self, run: Run) -> dict[str, float]:
        """Tests the gain of the last steps, if due, and skips steps if it is too small."""
        done = run.step
        ended = self.windows(run.views.at(done), self.test_start) if self.test_ends_after(run, done) else {}
        started = self.windows(run.views.at(done + 1), done) if self.test_starts_after(run, done) else {}
        after, before = errors_in(run, ended, done), errors_in(run, started, done + 1)  # nothing can fail from here on
        if ended:
            self.finish_test(ended, after, done)
        if self.skipped and run.step + 1 in self.skipped:
            run.step = self.resume_at - 1
        elif started:
            self.start_test(done, before)
        return self.metrics_at(run.step + 1)

    def ignored_windows(self, run: Run, view: View, step: int) -> Sequence[Window]:
        """Returns the validation window of a view."""
        if not (self.testing(run) and self.test_start < step <= self.test_end(self.test_start)):
            return ()
        window = self.windows(run.views.at(step), self.test_start).get(view)
        return () if window is None else (window,)

    def plan(self, run: Run) -> dict[str, Any]:
        """Returns the range of steps that may be skipped."""
        if self.options.price == 0:
            return {}
        start = self.first_test(run)
        return {"plateau": {"from": start, "to": self.resume_at, "price_db_per_doubling": self.options.price}}

    def state_dict(self) -> dict[str, Tensor]:
        """Returns windows and gains, if there are any."""
        if not (self.test_start or len(self.gains)):
            return {}
        numbers = torch.tensor([self.test_start, self.skipped.start, self.skipped.stop])
        return {"numbers": numbers, "before": self.before, "found": self.gains}

    def load_state_dict(self, tensors: Mapping[str, Tensor]) -> None:
        """Restores a checkpoint."""
        if tensors:
            self.test_start, start, stop = tensors["numbers"].tolist()
            self.before, self.gains, self.skipped = tensors["before"], tensors["found"], range(start, stop)

    # -- tests ---------------------------------------------------------------------------------------------------------

    def windows(self, views: Sequence[View], start: int) -> dict[View, Window]:
        """Returns the validation windows that begin after a step."""
        return validation_windows(views, self.options.views, self.options.window, "plateau", start)

    def start_test(self, step: int, before: Float[Tensor, "W"]) -> None:
        """Begins windows after a step, with their errors there."""
        self.test_start, self.before = step, before

    def finish_test(self, windows: Mapping[View, Window], after: Float[Tensor, "W"], step: int) -> None:
        """Ends the windows, computes their gain, if any of their pixels count, and skips steps if it is too small."""
        rounding, start, before = rounding_in(windows), self.test_start, self.before
        self.test_start, self.before = 0, before[:0]
        if not bool(rounding.any()):
            return
        gain, error = (value / math.log2(step / start) for value in decibels(after + rounding, before + rounding))
        self.gains = torch.cat([self.gains, torch.tensor([[step, gain, error]], dtype=torch.float64)])
        price = self.options.price
        sign, action = ("<", f"skipping to step {self.resume_at}") if gain < price else (">=", "continuing")
        logger.info(
            "step %d: gain %.2f +- %.2f dB per doubling of the steps, over the last %d, %s price %.2f: %s",
            *(step, gain, error, step - start, sign, price, action),
        )
        if gain < price:
            self.skipped = range(step + 1, self.resume_at)

    def metrics_at(self, step: int) -> dict[str, float]:
        """Returns the gain of a test that ended just before a step, and the number of skipped steps."""
        if not len(self.gains) or step not in (int(self.gains[-1, 0]) + 1, self.skipped.stop):
            return {}
        metrics = {"step_gain": float(self.gains[-1, 1]), "step_price": self.options.price}
        return metrics | ({"steps_left_out": len(self.skipped)} if step == self.skipped.stop else {})


def errors_in(run: Run, windows: Mapping[View, Window], step: int) -> Float[Tensor, "W"]:
    """Returns the squared error in each validation window, by the rules of a step; the same on all ranks."""
    if not windows:
        return torch.zeros(0, dtype=torch.float64)
    probe = Probe(model=run.backbone, views=run.views, step=run.model_step, raster_step=step)
    return run.ranks.broadcast(lambda: probe.window_errors(windows).cpu())
