"""A run: everything that belongs to one training, and one step as listeners see it."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Protocol, runtime_checkable

import torch
from torch import Tensor

from gsx.core.data.scene import Scene, View
from gsx.core.device import uploaded
from gsx.core.errors import Stopped
from gsx.core.options import without_effect
from gsx.core.quality.metrics import psnr
from gsx.core.ranges import Interval, Range, Share
from gsx.core.rasterizer import RasterSettings, Rendering
from gsx.core.shapes import Bool, Float
from gsx.core.training.backbone import Backbone, Observation
from gsx.core.training.distributed import Ranks
from gsx.core.training.module import Modules
from gsx.core.training.photo_cache import PhotoCache
from gsx.core.training.pseudo_views import Term
from gsx.core.training.sampler import Sampler
from gsx.core.training.training_views import TrainingViews


@dataclass(frozen=True, kw_only=True)
class TrainingOptions:
    """Options of the loop; values in conf/config.yaml."""

    ssim_weight: Share
    random_background: bool
    log_every: Interval = without_effect()
    checkpoint_every: Interval = without_effect()
    checkpoints_kept: Interval = without_effect()
    test_points: Annotated[int, Range(0, 10**6)] = without_effect()
    batch: Annotated[int, Range(1, 10**6)] = 1
    """Views per step, whose mean loss it lowers. The default: runs older than this option."""
    cooldown: Share = 0.0
    """Share of the steps, the last ones, over which all learning rates of the model go down to nothing, linearly; 0, as
    published: these stay as they are."""

    def pace(self, step: int, iterations: int) -> float:
        """What learning rates are multiplied by at a step."""
        steps = self.cooldown * iterations
        return min(1.0, max(0.0, (iterations - step + 1) / steps)) if steps >= 1 else 1.0


@runtime_checkable
class Augmenter(Protocol):
    """Makes pseudo views from training views, and says when they count."""

    def term(self, run: "Run", step: int, view: int) -> Term | None:
        """What this step adds for the training view that was picked; None outside the active windows.

        The first call of a window makes its pseudo views, from the model as it is then.
        """
        ...

    def begins(self) -> int:
        """Steps that a run has in common with one without this augmenter."""
        ...

    def plan(self) -> dict[str, Any]:
        """The rescaled schedule in absolute steps, for the log and the report."""
        ...


@dataclass(eq=False, kw_only=True)
class Progress:
    """How far a run is."""

    step: int = 0
    """Steps done."""
    seconds: float = 0.0
    """Time of training steps, without evaluation, files and waiting for code to be compiled."""
    stopping: bool = False
    """Whether to end after the current step, or within it where that takes long (`Run.refuse_if_stopping`)."""
    changing: bool = False
    """Whether a step is being applied: parameters and statistics are neither those before it nor those after it."""
    curves: list[dict[str, float]] = field(default_factory=list)
    """Lines of metrics.jsonl so far."""


@dataclass(eq=False, kw_only=True)
class Run:
    """State of one training. What must survive an interruption is in `checkpoint.py`."""

    config: dict[str, Any]
    """The composed configuration, resolved, JSON-serialisable."""
    folder: Path
    backbone: Backbone[Any]
    raster: RasterSettings
    training: TrainingOptions
    views: TrainingViews
    iterations: int
    photos: PhotoCache
    """Photos on the run's device."""
    generator: torch.Generator
    sampler: Sampler
    augmenters: Mapping[str, Augmenter] = field(default_factory=dict)
    """By name, in the order of their terms."""
    ranks: Ranks = Ranks()
    """The processes that train it together."""
    progress: Progress = field(default_factory=Progress)
    """What changes from step to step, beside the model."""

    @property
    def step(self) -> int:
        """Steps done."""
        return self.progress.step

    @step.setter
    def step(self, step: int) -> None:
        self.progress.step = step

    @property
    def scene(self) -> Scene:
        """The scene that the run trains on."""
        return self.views.scene

    @property
    def device(self) -> torch.device:
        """Where the run computes."""
        return self.photos.device

    @property
    def modules(self) -> Modules:
        """Modules of the run by name, in the order of their registration."""
        return self.views.modules

    def skipped(self, step: int) -> bool:
        """Returns whether a module skipped a step."""
        return any(step in module.skipped for module in self.modules.values())

    @property
    def train_views(self) -> Sequence[View]:
        """Training views at the photos' own resolution, as the modules correct them."""
        return self.views.full_size

    @property
    def complete(self) -> bool:
        """All iterations are done."""
        return self.step >= self.iterations

    def as_photo(self, image: Float[Tensor, "3 H W"], view: View) -> Float[Tensor, "3 H W"]:
        """Returns a render of a training view as its photo would show it, to be looked at."""
        return self.views.match_photo(image, None, view)

    def refuse_if_stopping(self) -> None:
        """To be called within long parts of a step that change nothing yet.

        Raises:
            Stopped: the run was asked to stop; not where other processes would wait for this one.
        """
        if self.progress.stopping and self.ranks.size == 1:
            raise Stopped(f"step {self.step + 1} was given up: the run was asked to stop")

    @property
    def model_step(self) -> int:
        """The step by whose rules the model is drawn between steps: the last one done; before the first that one."""
        return max(1, self.step)

    @property
    def background(self) -> Float[Tensor, "3"]:
        """The scene's background on the run's device."""
        return uploaded(self.scene.background, self.device)


@dataclass(frozen=True, eq=False, kw_only=True)
class StepResult:
    """One training step, after its backward pass. Of a batch `view`, `target` and `rendering` are this rank's first."""

    number: int
    view: View
    target: Float[Tensor, "3 H W"]
    rendering: Rendering
    loss: Float[Tensor, ""]
    """Mean over the batch."""
    counted: Bool[Tensor, "H W"] | None = None
    """Which pixels of the target counted; None: all."""
    seen: Sequence[Observation] = ()
    """What density control learns from the renders of the batch, in its order."""
    dropped: int = 0
    """Splats that renders of training views left out because a value of theirs is not finite."""
    others: Sequence["StepResult"] = ()
    """This rank's other views, as steps of their own."""
    changes: dict[str, float] = field(default_factory=dict)
    """What density control did."""
    terms: dict[str, float] = field(default_factory=dict)
    """Parts of the loss by name, as they enter it, where there is more than the backbone's own; mean over the batch."""
    pseudo: dict[str, dict[str, Any]] = field(default_factory=dict)
    """Accounts of the pictures requested at this step, by augmenter (`Accounting`); mostly none."""
    skipped: str = ""
    """Why nothing was updated; empty for an ordinary step."""

    def psnr(self) -> float:
        """PSNR of the training view before the update, dB; of a batch the mean over this rank's views."""
        own = psnr(self.rendering.image.detach().clamp(0, 1), self.target, self.counted)
        return (own + sum(other.psnr() for other in self.others)) / (1 + len(self.others))
