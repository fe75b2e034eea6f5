"""Training modules: corrections of photos, schedules and stopping rules that a run is composed of.

A plugin registers one by `registry.add("module", NAME, factory, options)`. The options lie below `training.NAME`, and
`factory(options, context)` returns a `TrainingModule`. Modules run in the order of their registration. Each hook has a
default that changes nothing. A module must not draw from `run.generator`.
"""

from collections.abc import Container, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, Protocol, runtime_checkable

import torch
from torch import Tensor

from gsx.core.data.camera import Camera
from gsx.core.data.scene import Scene, View
from gsx.core.data.window import Window
from gsx.core.gaussians.splats import Splats
from gsx.core.shapes import Bool, Float

if TYPE_CHECKING:
    from gsx.core.training.run import Run


@dataclass(frozen=True, eq=False, kw_only=True)
class ModuleContext:
    """Scene, schedule and device that a module is built from."""

    name: str
    """Key below `training` and prefix of the module's tensors in checkpoints."""
    scene: Scene
    iterations: int
    """Steps of the whole run."""
    device: torch.device
    batch: int = 1
    """Views per step."""


@runtime_checkable
class PreparesScene(Protocol):
    """Options of a module that changes the scene before the run is built, such as its starting points."""

    def prepare_scene(self, scene: Scene, generator: torch.Generator) -> Scene:
        """Returns the scene that the run uses; the generator depends on the run's seed and the module's name."""


class TrainingModule:
    """Base class of training modules; subclasses override the hooks they need."""

    in_views: ClassVar[bool] = False
    """True: views passed on to another run contain the corrections, so `restarted` must not repeat them."""
    off: ClassVar[str] = "when=never"
    """Override below `training.NAME` that switches the module off."""
    skipped: Container[int] = range(0)
    """Steps that the module skipped."""

    def __init__(self, options: Any, context: ModuleContext) -> None:
        self.options, self.context, self.name = options, context, context.name

    def before_step(self, run: "Run") -> dict[str, float]:
        """Estimates, corrects, or skips steps before step `run.step + 1`; returns metrics for that step's log line.

        To skip steps, set `run.step` to the last one skipped.
        """
        return {}

    def transform_views(self, views: Sequence[View], step: int | None) -> Sequence[View]:
        """Returns the training views of a step, in order, with scale, pose and mask; None: at full photo resolution.

        Return the same list for the same step until something changes: a new list means new views.
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
        """Applies the photo's exposure, blur or colours to a render of its view; the last module is applied first.

        Args:
            image: Render of the view or of a window of it, display values.
            view: Training view.
            photo: Target that the render will be compared with; None: the render is for display.
            window: Window of the view that is rendered, px; None: the whole view.
            learning: True: the step sends gradients back through the result.
        """
        return image

    def fit_render(
        self, image: Float[Tensor, "3 H W"], photo: Float[Tensor, "3 H W"], fitted: Bool[Tensor, "H W"]
    ) -> Float[Tensor, "3 H W"] | None:
        """Returns the render of a held-out view, corrected as fits these pixels of its photo best.

        It must not use any other pixel of the photo. None: the module does not correct held-out views.
        """
        return None

    def ignored_windows(self, run: "Run", view: View, step: int) -> Sequence[Window]:
        """Returns the windows of a training view that enter no loss at a step."""
        return ()

    def channels(self, run: "Run", splats: Splats, camera: Camera, step: int) -> Float[Tensor, "M K"] | None:
        """Returns values of each splat that a training render blends as it does colours, over 0; None: none."""
        return None

    def loss(
        self,
        run: "Run",
        view: View,
        step: int,
        camera: Camera,
        blended: Float[Tensor, "K H W"],
        counted: Bool[Tensor, "h w"] | None,
    ) -> Float[Tensor, ""] | None:
        """Returns a term of a training view's loss, from its blended `channels`; None: the loss stays as it is.

        Args:
            camera: Camera of the raster of `blended`, which may be finer than the view's.
            counted: Pixels of the view that enter losses; None: all.
        """
        return None

    def raster_scale(self, step: int) -> int:
        """Returns the factor by which renders of a step are finer than the photos; they are reduced as photos were."""
        return 1

    def zero_grad(self) -> None:
        """Clears gradients before a step's backward passes."""

    def optimizer_step(self, step: int) -> None:
        """Updates learned tensors, after the model's update; not called in a step that is skipped."""

    def milestones(self) -> Sequence[int]:
        """Returns the steps before which the module acts once; no module may skip them."""
        return ()

    def supports(self, ranks: int) -> bool:
        """Returns whether the module, as configured, works with that number of processes."""
        return True

    def state_dict(self) -> Mapping[str, Tensor]:
        """Returns the module's detached tensors for a checkpoint; empty: none."""
        return {}

    def load_state_dict(self, tensors: Mapping[str, Tensor]) -> None:
        """Restores the tensors of a checkpoint; empty: the module keeps its initial state."""

    def restarted(self, context: ModuleContext) -> "TrainingModule":
        """Returns a module for another run from step 0, on some of this run's views with their current corrections."""
        return type(self)(self.options, context)

    def plan(self, run: "Run") -> dict[str, Any]:
        """Returns the schedule in absolute steps, for log and report; empty: none."""
        return {}

    @classmethod
    def summary(cls, lines: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
        """Returns figures for evaluation.json from the lines of metrics.jsonl; empty: none."""
        return {}

    @classmethod
    def remarks(cls, evaluation: Mapping[str, Any]) -> Iterator[str]:
        """Yields sentences for log and report about an evaluation, which contains the module's `summary`."""
        yield from ()


Modules = Mapping[str, TrainingModule]
"""Training modules of a run by name, in the order of their registration."""
