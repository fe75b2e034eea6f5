"""Training modules: corrections of photos, schedules and stopping rules that a run is composed of.

A plugin registers one by `registry.add("module", NAME, factory, options)`. The options lie below `training.NAME`, and
`factory(options, context)` returns a `TrainingModule`. A run has them in the order of their registration. Each hook has
a default that changes nothing. A module draws no numbers from `run.generator`.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import torch
from torch import Tensor

from gsx.core.data.scene import Scene, View
from gsx.core.data.window import Window
from gsx.core.shapes import Float

if TYPE_CHECKING:
    from gsx.core.training.run import Run


@dataclass(frozen=True, eq=False, kw_only=True)
class ModuleContext:
    """What a module is built from."""

    name: str
    """Key below `training`, and prefix of the module's tensors in checkpoints."""
    scene: Scene
    iterations: int
    """Steps of the whole run."""
    device: torch.device
    batch: int = 1
    """Views per step."""


class TrainingModule:
    """A part of training beside the model; a subclass overrides the hooks that it needs."""

    in_views: ClassVar[bool] = False
    """Whether views that another run gets from this one have its corrections, which `restarted` must not repeat."""
    skipped = range(0)
    """Steps that it skipped."""

    def __init__(self, options: Any, context: ModuleContext) -> None:
        self.options, self.context, self.name = options, context, context.name

    def before_step(self, run: "Run") -> dict[str, float]:
        """Estimate, correct, or skip steps before step `run.step + 1`; returns metrics for the line of that step.

        To skip steps, set `run.step` to the last one skipped.
        """
        return {}

    def transform_views(self, views: Sequence[View], step: int | None) -> Sequence[View]:
        """Returns the training views, in order, as a step sees them; None: at the photos' own resolution.

        Return the same list for the same argument until something changes: a new one means new views.
        """
        return views

    def transform_render(
        self,
        image: Float[Tensor, "3 H W"],
        view: View,
        photo: Float[Tensor, "3 H W"] | None,
        window: Window | None,
        learning: bool,
    ) -> Float[Tensor, "3 H W"]:
        """Returns a render as the photo of that training view would show it. Renders pass the last module first.

        Args:
            image: the render, of the whole view or of a window of it.
            photo: what the render is to be compared with; None: it is to be looked at.
            window: in pixels of the view; None: the whole view.
            learning: the step under way sends gradients back through the result.
        """
        return image

    def ignored_windows(self, run: "Run", view: View, step: int) -> Sequence[Window]:
        """Returns windows of a training view that enter no loss at a step."""
        return ()

    def raster_scale(self, step: int) -> int:
        """Returns how many times as fine as photos renders of a step are; they are reduced as photos were."""
        return 1

    def zero_grad(self) -> None:
        """Drop gradients, before a step's backward passes."""

    def optimizer_step(self, step: int) -> None:
        """Update what the module learns, after the model's own update; not called for a step that was vetoed."""

    def milestones(self) -> Sequence[int]:
        """Returns the steps before which the module acts once, which must not be skipped."""
        return ()

    def supports(self, ranks: int) -> bool:
        """Returns whether so many processes can train with it together, as it is configured."""
        return True

    def state_dict(self) -> Mapping[str, Tensor]:
        """Returns what a checkpoint holds of the module, none of it on the autograd graph; empty: nothing."""
        return {}

    def load_state_dict(self, tensors: Mapping[str, Tensor]) -> None:
        """Go on from the tensors of a checkpoint; empty: from the start."""

    def restarted(self, context: ModuleContext) -> "TrainingModule":
        """Returns the module for another run from its step 0, on some of this run's views as they are corrected now."""
        return type(self)(self.options, context)

    def plan(self, run: "Run") -> dict[str, Any]:
        """Returns its schedule in absolute steps, for log and report; empty: nothing is planned."""
        return {}

    @classmethod
    def summary(cls, lines: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
        """Returns figures for evaluation.json from the lines of metrics.jsonl; empty: nothing happened."""
        return {}

    @classmethod
    def remarks(cls, evaluation: Mapping[str, Any]) -> Iterator[str]:
        """Yields sentences for log and report about an evaluation, which holds the module's `summary`."""
        yield from ()


Modules = Mapping[str, TrainingModule]
"""Modules of a run by name, in the order of their registration."""
