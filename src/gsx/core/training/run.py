"""State of one training, and the result of one step."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import torch
from torch import Tensor

from gsx.core.data.scene import Scene, View
from gsx.core.device import upload
from gsx.core.errors import Stopped
from gsx.core.options import without_effect
from gsx.core.quality.metrics import psnr
from gsx.core.ranges import Interval, Range, Share
from gsx.core.rasterizer import RasterSettings, Rendering
from gsx.core.shapes import Bool, Float
from gsx.core.training.augmenter import Augmenter
from gsx.core.training.backbone import Backbone, Observation
from gsx.core.training.distributed import Ranks
from gsx.core.training.module import Modules
from gsx.core.training.photo_cache import PhotoCache
from gsx.core.training.sampler import Sampler
from gsx.core.training.training_views import TrainingViews


@dataclass(frozen=True, kw_only=True)
class TrainingOptions:
    """Options of the training loop; values in conf/config.yaml."""

    ssim_weight: Share
    random_background: bool
    log_every: Interval = without_effect()
    checkpoint_every: Interval = without_effect()
    checkpoints_kept: Interval = without_effect()
    test_points: Annotated[int, Range(0, 10**6)] = without_effect()
    batch: Annotated[int, Range(1, 10**6)] = 1
    """Views per step; the loss is their mean. The default is for runs older than this option."""
    cooldown: Share = 0.0
    """Share of the steps, at the end, over which all learning rates of the model fall linearly to 0; 0, as published:
    they do not."""

    def pace(self, step: int, iterations: int) -> float:
        """Returns the factor of all learning rates at a step."""
        steps = self.cooldown * iterations
        return min(1.0, max(0.0, (iterations - step + 1) / steps)) if steps >= 1 else 1.0


@dataclass(eq=False, kw_only=True)
class Progress:
    """Progress of a run."""

    step: int = 0
    """Last step done."""
    seconds: float = 0.0
    """Time of training steps, without evaluation, file access and compilation."""
    stopping: bool = False
    """True: end after the current step, or within a long one (`Run.raise_if_stopping`)."""
    changing: bool = False
    """True while a step is being applied, with parameters and statistics between two steps."""
    curves: list[dict[str, float]] = field(default_factory=list)
    """Lines of metrics.jsonl so far."""


@dataclass(eq=False, kw_only=True)
class Run:
    """State of one training; `checkpoint.py` saves what must survive an interruption."""

    config: dict[str, Any]
    """Composed configuration, resolved, JSON-serialisable."""
    folder: Path
    backbone: Backbone[Any]
    raster: RasterSettings
    training: TrainingOptions
    views: TrainingViews
    iterations: int
    """Steps of the whole run."""
    photos: PhotoCache
    """Photos on the run's device."""
    generator: torch.Generator
    """CPU generator of the run's random numbers."""
    sampler: Sampler
    augmenters: Mapping[str, Augmenter] = field(default_factory=dict)
    """Augmenters by name, in the order of their terms."""
    ranks: Ranks = Ranks()
    """Processes that train this run together."""
    progress: Progress = field(default_factory=Progress)

    @property
    def step(self) -> int:
        """Last step done; 0 before the first."""
        return self.progress.step

    @step.setter
    def step(self, step: int) -> None:
        self.progress.step = step

    @property
    def model_step(self) -> int:
        """Step whose rules the model is drawn by between steps: the last one done, at least 1."""
        return max(1, self.step)

    @property
    def complete(self) -> bool:
        """True when all iterations are done."""
        return self.step >= self.iterations

    @property
    def device(self) -> torch.device:
        """Device of the model and the photos."""
        return self.photos.device

    @property
    def scene(self) -> Scene:
        """Scene that the run trains on."""
        return self.views.scene

    @property
    def background(self) -> Float[Tensor, "3"]:
        """The scene's background on the run's device."""
        return upload(self.scene.background, self.device)

    @property
    def modules(self) -> Modules:
        """Training modules by name, in the order of their registration."""
        return self.views.modules

    @property
    def train_views(self) -> Sequence[View]:
        """Training views at the photos' own resolution, as corrected by the modules."""
        return self.views.full_size

    def as_photo(self, image: Float[Tensor, "3 H W"], view: View) -> Float[Tensor, "3 H W"]:
        """Returns a render of a training view with the photo's corrections, for display."""
        return self.views.match_photo(image, None, view)

    def skipped(self, step: int) -> bool:
        """Returns whether a module skipped a step."""
        return any(step in module.skipped for module in self.modules.values())

    def raise_if_stopping(self) -> None:
        """Ends a long step early; call it where nothing has changed yet.

        Raises:
            Stopped: the run is stopping, and no other process would wait for this one.
        """
        if self.progress.stopping and self.ranks.size == 1:
            raise Stopped(f"step {self.step + 1} was abandoned: the run is stopping")


@dataclass(frozen=True, eq=False, kw_only=True)
class StepResult:
    """Result of a step's backward pass; of a batch, view, target and rendering are this rank's first."""

    number: int
    """Step, from 1."""
    view: View
    target: Float[Tensor, "3 H W"]
    """The photo, black where it does not count."""
    rendering: Rendering
    loss: Float[Tensor, ""]
    """Mean over the batch."""
    counted: Bool[Tensor, "H W"] | None = None
    """Pixels that enter the loss; None: all."""
    observations: Sequence[Observation] = ()
    """Observations of the batch for density control, in order."""
    dropped: int = 0
    """Splats that training renders left out because of non-finite values."""
    others: Sequence["StepResult"] = ()
    """Results of this rank's other views."""
    changes: dict[str, float] = field(default_factory=dict)
    """Metrics of modules and density control."""
    terms: dict[str, float] = field(default_factory=dict)
    """Weighted parts of the loss by name, mean over the batch; empty: the backbone's own alone."""
    pseudo: dict[str, dict[str, Any]] = field(default_factory=dict)
    """Accounts of the pictures requested at this step, by augmenter (`Accounting`)."""
    skipped: str = ""
    """Reason why nothing was updated; empty: the step was applied."""

    def psnr(self) -> float:
        """Returns the PSNR of the training view before the update, dB; of a batch the mean over this rank's views."""
        own = psnr(self.rendering.image.detach().clamp(0, 1), self.target, self.counted)
        return (own + sum(other.psnr() for other in self.others)) / (1 + len(self.others))
