"""Exposure and white balance of each photo, learnt with the model if photos differ.

A photo is compared with A [r, g, b, 1]^T of its render: a 3 x 4 matrix A per training photo, learnt by Adam (3D-GS
release, `exposure_lr_init`, `exposure_lr_final`). Ours: a test decides if exposures are learnt. They start from the
gains between photos and renders, not the identity, and such gains correct them a few times, since early renders are
poor. Their mean stays the identity: the model has the exposure of the mean photo. Adam counts steps per photo: one Adam
over all photos, as published, keeps moving a photo during the steps of others, by several rates per visit. Where light
differs within photos a bilateral grid follows A (`bilateral_grid`).
"""

import logging
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, TypeAlias

import torch
from torch import Tensor

from gsx.core.data.scene import View
from gsx.core.data.window import Window
from gsx.core.quality.colour_matrix import transform_colours
from gsx.core.ranges import Range
from gsx.core.shapes import Float
from gsx.core.training.module import ModuleContext
from gsx.core.training.run import Run
from gsx.core.training.schedule import log_linear
from gsx.core.training.training_views import TrainingViews
from gsx.modules.bilateral_grid import WHOLE, Edges, apply_grid, initial_grids, light_slopes, without_common
from gsx.modules.corrections import WHEN, Correction, CorrectionOptions, ViewCount, log_test, percent, sample
from gsx.modules.photo_pairs import LIGHT, Pair, log_gains, render_reduced, shared_spread, usable_pixels

logger = logging.getLogger(__name__)

PositiveRate = Annotated[float, Range(1e-9, 1)]
BETAS, EPS = (0.9, 0.99), 1e-8
"""Adam's constants; a short run visits a photo a few dozen times."""
EQUAL = "photos are treated as equal"
MIN_BLOCK_PIXELS = 16
"""Fewest usable pixels of a block of a photo."""


@dataclass(frozen=True, kw_only=True)
class LearnedOptions(CorrectionOptions):
    """Learning rates of a correction that Adam learns."""

    rate: PositiveRate = 0.01
    rate_final: PositiveRate = 0.001
    """Learning rates of Adam at the first and at the last step; their logarithm is interpolated."""

    def rate_at(self, step: int, iterations: int) -> float:
        """Returns the learning rate of a step."""
        first = round(self.start * iterations)
        return log_linear(step - first, iterations - first, self.rate, self.rate_final)


@dataclass(frozen=True, kw_only=True)
class ExposureOptions(LearnedOptions):
    """Options; values in conf/module/exposure.yaml."""

    key: ClassVar[str] = "exposure"
    spread: Annotated[float, Range(0, 1)] = 0.06
    """`auto`: standard deviation of log gains above which photos get exposures; with grids they always do."""
    grid: str = "never"
    """One of WHEN; auto: a bilateral grid per photo where light differs within photos."""
    grid_spread: Annotated[float, Range(0, 1)] = 0.08
    """`auto`: standard deviation of slopes of log gains, from the middle of a photo to its sides, above which photos
    get grids."""
    views: ViewCount = 24
    """Most photos that the test uses."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.grid not in WHEN:
            raise ValueError(f"training.exposure.grid is '{self.grid}'; choose from {', '.join(WHEN)}")
        if self.when == "never" != self.grid:
            raise ValueError(
                f"training.exposure.grid is '{self.grid}', but training.exposure.when is 'never': a grid needs "
                "exposures; set training.exposure.when=auto"
            )


# -- light of a photo --------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Light:
    """Light of a photo relative to its render."""

    gains: Float[Tensor, "3 3"]
    """Log gains of the whole image, of its left and of its right half; nan where pixels are too few."""
    slopes: Float[Tensor, "3 2 3"] | None
    """Slopes of log gains (`light_slopes`); None: not measured."""


Measure: TypeAlias = Callable[[int], Light]
"""Number of a photo -> its light, by one render."""


def light_of(pair: Pair, slopes: bool) -> Light:
    """Measures a photo's light; slopes: also within the photo."""
    image, photo, mask = pair
    within = light_slopes(image, photo, usable_pixels(*pair), MIN_BLOCK_PIXELS) if slopes else None
    half = image.shape[2] // 2
    parts = (slice(None), slice(half), slice(half, None))
    gains = [log_gains(image[..., p], photo[..., p], None if mask is None else mask[..., p]) for p in parts]
    return Light(torch.stack(gains), within)


def spreads_of(lights: Sequence[Light]) -> tuple[float, float]:
    """Returns the spread of gains over photos, and of slopes; nan where slopes were not measured."""
    gains = torch.stack([light.gains for light in lights])
    slopes = [light.slopes for light in lights if light.slopes is not None]
    within = shared_spread(*torch.stack(slopes)[:, 1:].flatten(2).unbind(1)) if slopes else math.nan
    return shared_spread(gains[:, 1], gains[:, 2]), within


def relative_gains(lights: Sequence[Light]) -> Float[Tensor, "N 3"]:
    """Returns log gains of photos relative to their mean, the model's exposure; 0 where they are unknown."""
    gains = torch.stack([light.gains[0] for light in lights])
    return (gains - gains.nanmean(0)).nan_to_num(0.0)


# -- learning ----------------------------------------------------------------------------------------------------------


class LearnedCorrection(Correction):
    """Correction with values of each photo that Adam learns; it counts the steps of each photo."""

    options: LearnedOptions
    moment_names: ClassVar[Mapping[str, str]]
    """Names of Adam's moments in checkpoints, by the names of learned values."""
    last_name: ClassVar[str] = "last_estimate"
    """Name of the last estimate's step in checkpoints."""

    def __init__(self, options: Any, context: ModuleContext) -> None:
        super().__init__(options, context)
        self.indices = {view.name: index for index, view in reversed([*enumerate(context.scene.train)])}
        """Number of a photo by its name; of photos of one name the first."""
        self.learned: dict[str, Tensor] = {}
        """Learned values by name; empty: photos do not differ."""
        self.moments: dict[str, Tensor] = {}
        """Adam's means of gradients and of their squares, by the same names."""
        self.visits: Float[Tensor, N] = torch.zeros(len(context.scene.train))
        """Steps of each photo."""
        self.rendered: set[int] = set()
        """Photos of the step under way."""

    def start(self, **values: Tensor) -> None:
        """Starts learning from these values."""
        device = self.context.device
        self.learned = {name: value.to(device).requires_grad_() for name, value in values.items()}
        self.moments = {name: torch.zeros(2, *value.shape, device=device) for name, value in values.items()}
        self.visits = torch.zeros_like(self.visits)

    def has_gradients(self) -> bool:
        """Checks if the step under way has rendered photos and sent gradients back."""
        return bool(self.rendered) and all(value.grad is not None for value in self.learned.values())

    def take_adam_step(self, name: str, index: Any, steps: float, step: int) -> None:
        """Changes a learned value, or its part at an index, by Adam."""
        value = self.learned[name]
        assert value.grad is not None
        direction = adam_direction(self.moments[name][:, index], value.grad[index], steps)
        value[index] -= self.options.rate_at(step, self.context.iterations) * direction

    def zero_grad(self) -> None:
        """Drops the gradients of a step."""
        self.rendered.clear()
        for value in self.learned.values():
            value.grad = None

    def state_dict(self) -> dict[str, Tensor]:
        """Returns learned values and Adam's state; empty without values."""
        if not self.learned:
            return {}
        tensors = {name: value.detach() for name, value in self.learned.items()}
        tensors |= {self.moment_names[name]: value for name, value in self.moments.items()}
        return tensors | {"visits": self.visits, self.last_name: torch.tensor(self.last_estimate)}

    def load_state_dict(self, tensors: Mapping[str, Tensor]) -> None:
        """Restores a checkpoint; empty: there are no values."""
        self.learned, self.moments, self.last_estimate = {}, {}, 0
        if tensors:
            self.start(**{name: tensors[name].clone() for name in self.moment_names if name in tensors})
            device = self.context.device
            self.moments = {name: tensors[self.moment_names[name]].to(device).clone() for name in self.learned}
            self.visits = tensors["visits"].clone()
            self.last_estimate = int(tensors.get(self.last_name, 0))  # older checkpoints lack it


def adam_direction(moments: Float[Tensor, "2 *S"], gradient: Float[Tensor, "*S"], steps: float) -> Float[Tensor, "*S"]:
    """Returns Adam's direction at a photo's step number `steps`; updates its moments in place."""
    means = []
    for moment, beta, value in zip(moments, BETAS, (gradient, gradient.square()), strict=True):
        moment.mul_(beta).add_((1 - beta) * value)
        means.append(moment / (1 - beta**steps))
    return means[0] / (means[1].sqrt() + EPS)


# -- the module --------------------------------------------------------------------------------------------------------


class Exposure(LearnedCorrection):
    """Per-photo exposure: one 3x4 colour matrix, and a bilateral grid where light differs within photos."""

    options: ExposureOptions
    seconds_key = "exposure_seconds"
    figures_key = "exposures"
    count_key = "exposures"
    moment_names: ClassVar[Mapping[str, str]] = {"matrices": "moments", "grids": "grid_moments"}
    last_name = "told_last"
    thresholds = ("spread", "grid_spread")

    @property
    def matrices(self) -> Float[Tensor, "N 3 4"] | None:
        """Returns the matrices; None: photos do not differ."""
        return self.learned.get("matrices")

    @property
    def grids(self) -> Float[Tensor, "N rank 3 4"] | None:
        """Returns the matrices of bilateral grids; None: light does not differ within photos."""
        return self.learned.get("grids")

    def due(self, step: int) -> bool:
        """Checks if exposures are estimated before a step: with grids only once, since gains know less."""
        return self.grids is None and super().due(step)

    # -- estimates -----------------------------------------------------------------------------------------------------

    def estimate(self, run: Run, step: int) -> dict[str, float]:
        """Tests if photos differ in exposure, or corrects exposures by gains between photos and renders."""
        views = run.train_views

        def measure(index: int) -> Light:
            return light_of(photo_pair(run, views[index]), slopes=not self.active and self.options.grid != "never")

        if not self.active:
            return log_tests(self, step, *self.test(measure, step))
        change = self.correct(measure, step)
        logger.info("step %d: exposures re-estimated, RMS change %.1f %%", step, 100 * change)
        return {"exposures": len(self.visits), "exposure_motion": change}

    def test(self, measure: Measure, step: int) -> tuple[float, float]:
        """Measures some photos, and starts from the gains of all if they differ.

        Returns the spreads of gains and of slopes; nan where grids are off.
        """
        options, everyone = self.options, range(len(self.visits))
        lights = {index: measure(index) for index in sample(everyone, options.views, "exposures")}
        spread, within = spreads_of(list(lights.values()))
        with_grids = options.grid == "always" or within > options.grid_spread
        if options.when == "always" or spread > options.spread or with_grids:
            lights |= {index: measure(index) for index in everyone if index not in lights}
            self.restart([lights[index] for index in everyone], with_grids, step)
        return spread, within

    def correct(self, measure: Measure, step: int) -> float:
        """Corrects the exposures; returns their RMS error, of log gains."""
        lights = [measure(index) for index in range(len(self.visits))]
        self.restart(lights, with_grids=False, step=step)
        return float(relative_gains(lights).square().mean().sqrt())

    @torch.no_grad()
    def restart(self, lights: Sequence[Light], with_grids: bool, step: int) -> None:
        """Restarts learning from the present exposures times the gains of the photos."""
        gains = relative_gains(lights).exp()
        now = torch.eye(3, 4).expand(len(self.visits), -1, -1) if self.matrices is None else self.matrices.cpu()
        slopes = [light.slopes[0] for light in lights if with_grids and light.slopes is not None]
        grids = {"grids": initial_grids(torch.stack(slopes))} if slopes else {}
        self.start(matrices=centred_on_identity(gains[:, :, None] * now), **grids)
        self.last_estimate = step

    # -- learning ------------------------------------------------------------------------------------------------------

    def transform_render(
        self, image: Tensor, view: View, photo: Tensor | None, window: Window | None, learning: bool
    ) -> Tensor:
        """Returns the render at its photo's exposure; where the photo is saturated, more is no error."""
        if self.matrices is None:
            return image
        edges = WHOLE if window is None else window.shares(*view.camera.size)
        return within_range(self.expose(image, self.indices[view.name], learning, edges), photo)

    def expose(self, image: Tensor, index: int, learning: bool = False, edges: Edges = WHOLE) -> Tensor:
        """Returns the render [3 H W], or its part between these edges, at the exposure of a photo."""
        assert self.matrices is not None
        if learning:
            self.rendered.add(index)
        matrix, grid = self.matrices[index], None if self.grids is None else self.grids[index]
        out = transform_colours(image.to(self.context.device), matrix if learning else matrix.detach())
        return out if grid is None else apply_grid(out, grid if learning else grid.detach(), edges)

    @torch.no_grad()
    def optimizer_step(self, step: int) -> None:
        """Takes a step of Adam for each rendered photo; keeps the mean exposure the identity."""
        if not self.has_gradients():
            return
        for index in sorted(self.rendered):
            self.visits[index] += 1
            for name in self.learned:
                self.take_adam_step(name, index, float(self.visits[index]), step)
        self.learned["matrices"].copy_(centred_on_identity(self.learned["matrices"]))
        if self.grids is not None:
            self.grids.copy_(without_common(self.grids))
        self.zero_grad()

    @classmethod
    def figures(cls, lines: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
        """Returns the step of the test, the spreads, the number of corrected photos, and the changes since."""
        first, motions = lines[0], [line["exposure_motion"] for line in lines if "exposure_motion" in line]
        figures = {"step": first["step"], "spread": first.get("exposure_spread"), "learnt": first["exposures"]}
        grids = {"within": first["light_spread"], "grids": first["grids"]} if "light_spread" in first else {}
        return figures | {"motions": motions} | grids

    @classmethod
    def remarks(cls, evaluation: Mapping[str, Any]) -> Iterator[str]:
        """Reports that photos have exposures, and the model that of the mean photo."""
        figures = evaluation.get("exposures") or {}
        if figures.get("learnt"):
            spread = "differ" if figures["spread"] is None else f"are spread by {figures['spread']:.1%}"
            yield (
                f"exposures of photos {spread}, each has its own from step {figures['step']:,} on: the model has that "
                "of the mean photo; eval.colours=fitted looks past that"
            )
        if figures.get("grids"):
            yield (
                f"light within photos is spread by {figures['within']:.1%}, each has a bilateral grid from step "
                f"{figures['step']:,} on"
            )


def within_range(image: Float[Tensor, "3 H W"], photo: Float[Tensor, "3 H W"] | None) -> Float[Tensor, "3 H W"]:
    """Returns a render to compare with its photo: the photo where that is saturated and the render brighter."""
    return image if photo is None else torch.where((photo >= 1) & (image > 1), photo, image)


def photo_pair(run: Run, view: View, views: TrainingViews | None = None) -> Pair:
    """Returns a reduced render as its photo, the photo, and the pixels that count and are not saturated.

    views: whose corrections the render gets; None: the run's.
    """
    small, rendering = render_reduced(run, view, depth=False)
    image = (views or run.views).match_photo(rendering.image, None, small).detach().cpu()
    below, mask = (rendering.image < LIGHT).all(0), small.counted()
    return image, small.image(), below if mask is None else below & mask


def log_tests(module: Exposure, step: int, spread: float, within: float) -> dict[str, float]:
    """Logs the spreads of a test and what follows; returns them for the line of the step."""
    options, active, grids = module.options, module.active, module.grids is not None
    action = "learning one per photo" if active else EQUAL
    log_test(step, "exposure spread", spread, options.spread, percent, action)
    metrics = {"exposure_spread": spread, "exposures": len(module.visits) if active else 0}
    if math.isnan(within):
        return metrics
    action = "learning grids" if grids else EQUAL
    log_test(step, "light spread within photos", within, options.grid_spread, percent, action)
    return metrics | {"light_spread": within, "grids": len(module.visits) if grids else 0}


def centred_on_identity(matrices: Float[Tensor, "N 3 4"]) -> Float[Tensor, "N 3 4"]:
    """Returns the matrices with the identity as their mean."""
    return matrices - matrices.mean(0) + torch.eye(3, 4, device=matrices.device)
