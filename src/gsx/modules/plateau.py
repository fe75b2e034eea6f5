"""Steps that would gain too little are left out: a run goes on with its last part where validation windows say so.

From `start` on, windows of some training views count in no loss while the number of steps grows by a tenth. They are
drawn at both ends of these steps, and what their error differs by is the gain of the steps where nothing was learnt
from the pixels themselves, told in dB per doubling of the steps, the unit of the price. Below the price the run goes on
at `to`: with what its schedules do at the end (finer pixels, learning rates that go down). Windows move to other views
and places with every such tenth. Test views play no part.
"""

import logging
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Annotated, Any

import torch
from torch import Tensor

from gsx.core.data.scene import View
from gsx.core.data.window import Window
from gsx.core.ranges import Range, Share
from gsx.core.shapes import Float
from gsx.core.training.validation import decibels, rounding_in, validation_windows

logger = logging.getLogger(__name__)

ONE_IN = 10
"""Of so many steps another is taken before they are judged, if that is more than a pass over the views."""


@dataclass(frozen=True, kw_only=True)
class PlateauOptions:
    """Options; values in conf/config.yaml."""

    price: Annotated[float, Range(0, 100)] = 0.0
    """dB that a doubling of the steps has to bring; 0: every step is taken."""
    start: Share = 0.5
    """Share of the steps before any are left out."""
    to: Share = 0.8
    """Share of the steps that a run goes on from."""
    views: Annotated[int, Range(1, 1000)] = 6
    """Training views that have a validation window at a time."""
    window: Annotated[float, Range(0.05, 1)] = 0.5
    """Its sides as shares of the view's."""

    def __post_init__(self) -> None:
        if self.price > 0 and not 0 < self.start < self.to:
            raise ValueError(
                f"training.plateau.start is {self.start} and training.plateau.to {self.to}: give shares of the steps "
                "above 0, the first one smaller"
            )

    def last_part(self, iterations: int) -> int:
        """First step of the part of a run of so many steps that is never left out."""
        return round(self.to * iterations)


@dataclass(eq=False)
class Plateau:
    """What a run knows of the gain of its steps."""

    options: PlateauOptions
    iterations: int
    passing: int
    """Steps of a pass over the training views."""
    settled: int = 0
    """Step after which nothing is due once that a run must not leave out."""
    begun: int = 0
    """Step after which the windows of the moment began; 0: there are none."""
    before: Float[Tensor, "W"] = field(default_factory=lambda: torch.zeros(0, dtype=torch.float64))
    """Squared error in each of them at that time."""
    found: Float[Tensor, "T 3"] = field(default_factory=lambda: torch.zeros(0, 3, dtype=torch.float64))
    """Step, gain in dB per doubling of the steps, and its standard error, of each judgement."""
    left_out: range = range(0)
    """Numbers of the steps that were left out."""

    @property
    def first(self) -> int:
        """Step after which the first windows begin."""
        return max(1, round(self.options.start * self.iterations), self.settled)

    @property
    def last(self) -> int:
        """Step that is taken next where the others before it are left out."""
        return self.options.last_part(self.iterations)

    def ends(self, begun: int) -> int:
        """Step after which windows that began after a step are judged."""
        return begun + max(math.ceil(begun / ONE_IN), self.passing)

    @property
    def open(self) -> bool:
        """Whether there are windows, which this run is to judge: not those of a schedule that was another."""
        return self.options.price > 0 and self.begun >= self.first

    def judged_after(self, step: int) -> bool:
        """Whether the windows of the moment are judged after this step."""
        return self.open and step == self.ends(self.begun)

    def begins_after(self, step: int) -> bool:
        """Whether windows begin after this step: there are to be steps left that can be left out."""
        due = self.options.price > 0 and step == (self.ends(self.begun) if self.open else self.first)
        return due and self.ends(step) + 1 < self.last

    def windows(self, views: Sequence[View], begun: int) -> dict[View, Window]:
        """Those that begin after a step."""
        return validation_windows(views, self.options.views, self.options.window, "plateau", begun)

    def window(self, views: Sequence[View], view: View, step: int) -> Window | None:
        """The window of a view that counts in no loss at a step."""
        if not (self.open and self.begun < step <= self.ends(self.begun)):
            return None
        return self.windows(views, self.begun).get(view)

    def judge(self, windows: Mapping[View, Window], after: Float[Tensor, "W"], step: int) -> None:
        """Find what the steps since the windows began have gained, if pixels of them count. There are no windows
        then."""
        floor, begun, before = rounding_in(windows), self.begun, self.before
        self.begun, self.before = 0, before[:0]
        if not bool(floor.any()):
            return
        gain, error = (value / math.log2(step / begun) for value in decibels(after + floor, before + floor))
        self.found = torch.cat([self.found, torch.tensor([[step, gain, error]], dtype=torch.float64)])
        told = step, gain, error, self.options.price, step - begun
        logger.info("step %d: %.2f +- %.2f dB per doubling of the steps, price %.2f, by the last %d", *told)
        if gain < self.options.price:
            self.left_out = range(step + 1, self.last)
            logger.info("step %d: the run goes on with step %d", step, self.last)

    def begin(self, step: int, before: Float[Tensor, "W"]) -> None:
        """Windows begin after this step, with these errors."""
        self.begun, self.before = step, before

    def told_at(self, number: int) -> dict[str, float]:
        """What was found, and left out, before a step; for its line."""
        if not len(self.found) or number not in (int(self.found[-1, 0]) + 1, self.left_out.stop):
            return {}
        told = {"step_gain": float(self.found[-1, 1]), "step_price": self.options.price}
        return told | ({"steps_left_out": len(self.left_out)} if number == self.left_out.stop else {})

    def plan(self) -> dict[str, Any]:
        """When steps may be left out, for the log and the report; nothing where none may."""
        if self.options.price == 0:
            return {}
        return {"plateau": {"from": self.first, "to": self.last, "price_db_per_doubling": self.options.price}}

    def tensors(self) -> dict[str, Tensor]:
        """What a checkpoint holds; nothing where no step has been judged, nor is."""
        if not (self.begun or len(self.found)):
            return {}
        numbers = torch.tensor([self.begun, self.left_out.start, self.left_out.stop])
        return {"numbers": numbers, "before": self.before, "found": self.found}

    def restore(self, tensors: dict[str, Tensor]) -> None:
        """Go on from a checkpoint's tensors."""
        if tensors:
            self.begun, start, stop = tensors["numbers"].tolist()
            self.before, self.found, self.left_out = tensors["before"], tensors["found"], range(start, stop)
