"""Steps that would gain too little are left out: a run goes on with its last part where validation windows say so.

From `start` on, windows of some training views count in no loss while the number of steps grows by a tenth. They are
drawn at both ends of these steps, and what their error differs by is the gain of the steps where nothing was learnt
from the pixels themselves, told in dB per doubling of the steps, the unit of the price. Below the price the run goes on
at `to`: with what its schedules do at the end (finer pixels, learning rates that go down). Windows move to other views
and places with every such tenth. Test views play no part.
"""

import logging
import math
from collections.abc import Sequence
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

GROWN = 1.1
"""Times as many steps lie at the end of what is judged as at its beginning, or a pass over the views does."""


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


@dataclass(eq=False)
class Plateau:
    """What a run knows of the gain of its steps."""

    options: PlateauOptions
    iterations: int
    passing: int
    """Steps of a pass over the training views."""
    begun: int = 0
    """Step after which the windows of the moment began; 0: there are none."""
    before: Float[Tensor, "W"] = field(default_factory=lambda: torch.zeros(0, dtype=torch.float64))
    """Squared error in each of them at that time."""
    found: Float[Tensor, "T 3"] = field(default_factory=lambda: torch.zeros(0, 3, dtype=torch.float64))
    """Step, gain in dB per doubling of the steps, and its standard error, of each judgement."""

    @property
    def first(self) -> int:
        """Step after which the first windows begin."""
        return max(1, round(self.options.start * self.iterations))

    @property
    def last(self) -> int:
        """Step that is taken next where the others before it are left out."""
        return round(self.options.to * self.iterations)

    def ends(self, begun: int) -> int:
        """Step after which windows that began after a step are judged."""
        return begun + max(math.ceil((GROWN - 1) * begun), self.passing)

    def judged_after(self, step: int) -> bool:
        """Whether the windows of the moment are judged after this step."""
        return self.begun > 0 and step == self.ends(self.begun)

    def begins_after(self, step: int) -> bool:
        """Whether windows begin after this step: there are to be steps left that can be left out."""
        due = self.options.price > 0 and step == (self.ends(self.begun) if self.begun else self.first)
        return due and self.ends(step) < self.last

    def windows(self, views: Sequence[View]) -> dict[View, Window]:
        """Those of the moment."""
        return validation_windows(views, self.options.views, self.options.window, "plateau", self.begun)

    def window(self, views: Sequence[View], view: View, step: int) -> Window | None:
        """The window of a view that counts in no loss at a step."""
        if not (self.begun and self.begun < step <= self.ends(self.begun)):
            return None
        return {other.name: window for other, window in self.windows(views).items()}.get(view.name)

    def judge(self, windows: Sequence[Window], after: Float[Tensor, "W"], step: int) -> dict[str, float]:
        """Find what the steps since the windows began have gained; for the line of the step."""
        floor, doublings = rounding_in(windows), math.log2(step / self.begun)
        gain, error = (value / doublings for value in decibels(after + floor, self.before + floor))
        self.found = torch.cat([self.found, torch.tensor([[step, gain, error]], dtype=torch.float64)])
        told = step, gain, error, self.options.price, step - self.begun
        logger.info("step %d: %.2f +- %.2f dB per doubling of the steps, price %.2f, by the last %d", *told)
        return {"step_gain": gain, "step_price": self.options.price}

    @property
    def reached(self) -> bool:
        """Whether the last steps that were judged have gained less than their price."""
        return len(self.found) > 0 and float(self.found[-1, 1]) < self.options.price

    def begin(self, step: int) -> None:
        """Windows begin after this step; what they show is not known yet."""
        self.begun = step

    def end(self) -> None:
        """There are no windows any more."""
        self.begun, self.before = 0, self.before[:0]

    def plan(self) -> dict[str, Any]:
        """When steps may be left out, for the log and the report; nothing where none may."""
        if self.options.price == 0:
            return {}
        return {"plateau": {"from": self.first, "to": self.last, "price_db_per_doubling": self.options.price}}

    def tensors(self) -> dict[str, Tensor]:
        """What a checkpoint holds; nothing where no step has been judged, nor is."""
        if not (self.begun or len(self.found)):
            return {}
        return {"begun": torch.tensor(self.begun), "before": self.before, "found": self.found}

    def restore(self, tensors: dict[str, Tensor]) -> None:
        """Go on from a checkpoint's tensors."""
        if tensors:
            self.begun, self.before, self.found = int(tensors["begun"]), tensors["before"], tensors["found"]
