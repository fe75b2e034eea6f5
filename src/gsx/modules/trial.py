"""Trials of corrections: one that its test has called for stays only if it helps on pixels that are not learnt.

An early model differs from its photos because it has not learnt them yet, and a test of a correction takes some of that
for errors of the photos. So a run trains a stretch of steps without the correction and again with it, from the same
state and in the same order of views. Meanwhile windows of some training views are masked: no loss and no estimate uses
them. Errors in these windows, each at its best gain of each channel, decide. The better stretch counts as training.

Several corrections that are tested before the same step are tried in order, each on top of those that stay.
"""

import logging
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any

import torch
from torch import Tensor

from gsx.core.data.scene import View
from gsx.core.data.window import Window
from gsx.core.plugins import load_plugins
from gsx.core.ranges import Range, Share
from gsx.core.shapes import Bool, Float
from gsx.core.training.module import ModuleContext, TrainingModule
from gsx.core.training.parameter_table import RECORD, restore_table, table_tensors
from gsx.core.training.render import render
from gsx.core.training.run import Run
from gsx.core.training.trainer import train_step
from gsx.core.training.validation import decibels, validation_windows
from gsx.modules.corrections import Correction, ViewCache
from gsx.modules.derived_views import mask_view

logger = logging.getLogger(__name__)
GAIN, ERROR = "_trial", "_error"
"""Ends of the keys of a gain and its standard error in metrics.jsonl."""
SURE = 2
"""Standard errors by which a gain must exceed 0."""
MOST_MASKED = 1 / 3
"""Largest share of the training views with a masked window."""
MIN_STEPS = 10
"""Fewest steps of a stretch: in shorter runs tests alone decide."""


@dataclass(frozen=True, eq=False, kw_only=True)
class RunState:
    """Content of a checkpoint, in memory."""

    step: int
    table: Mapping[str, Tensor]
    """Tensors of the model by their names in checkpoints."""
    modules: Mapping[str, Mapping[str, Tensor]]
    """Tensors of each module."""
    generator: Tensor
    """State of the run's generator."""
    order: tuple[int, ...]
    """Indices left in the sampler's order."""
    orders: int
    """Number of orders drawn."""


def copied(tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Returns copies of tensors."""
    return {name: value.detach().clone() for name, value in tensors.items()}


def state_of(run: Run) -> RunState:
    """Copies the state of a run."""
    return RunState(
        step=run.step,
        table=copied(table_tensors(run.backbone.table)),
        modules={name: copied(module.state_dict()) for name, module in run.modules.items()},
        generator=run.generator.get_state(),
        order=tuple(run.sampler.order),
        orders=run.sampler.orders,
    )


def return_to(run: Run, state: RunState) -> None:
    """Brings a run back to a state; the state stays usable."""
    table = run.backbone.table
    table.record = {name: entry for name, entry in table.record.items() if RECORD + name in state.table}
    run.backbone.table = restore_table(table, copied(state.table))
    for name, module in run.modules.items():
        module.load_state_dict(copied(state.modules[name]))
    run.generator.set_state(state.generator)
    run.sampler.order, run.sampler.orders = list(state.order), state.orders
    run.step = state.step


def finite(run: Run) -> bool:
    """Checks that all parameters of a run's model are finite."""
    return all(bool(torch.isfinite(value).all()) for value in run.backbone.table.parameters.values())


@dataclass(frozen=True, kw_only=True)
class TrialOptions:
    """Options; values in conf/module/trial.yaml."""

    steps: Share = 0.0
    """Largest share of the steps in a stretch; 0, as in runs older than this option: tests alone decide."""
    passes: Annotated[float, Range(0.01, 100)] = 1.0
    """Passes over the training views in a stretch."""
    views: Annotated[int, Range(2, 1000)] = 24
    """Most training views with a masked window."""
    window: Annotated[float, Range(0.05, 1)] = 0.5
    """Sides of a window as shares of the view's sides."""


@dataclass(frozen=True, eq=False, kw_only=True)
class WindowPair:
    """Render and photo of a masked window, and its pixels that count."""

    image: Float[Tensor, "3 h w"]
    photo: Float[Tensor, "3 h w"]
    counted: Bool[Tensor, "h w"]


@dataclass(frozen=True, eq=False, kw_only=True)
class Stretch:
    """Result of a stretch of steps."""

    pairs: Sequence[WindowPair]
    """Masked windows after it."""
    end: RunState
    finite: bool
    """False: the model has values that are not finite."""


class Trial(TrainingModule):
    """Trains with and without the corrections that `auto` tests before a step, and keeps those that help."""

    options: TrialOptions
    off = "steps=0"

    def __init__(self, options: TrialOptions, context: ModuleContext) -> None:
        super().__init__(options, context)
        self.windows: Mapping[int, Window] = {}
        """Masked windows by number of their view, during a trial."""
        self.cache = ViewCache()
        """Masked views."""

    # -- masked windows ------------------------------------------------------------------------------------------------

    def transform_views(self, views: Sequence[View], step: int | None) -> Sequence[View]:
        """Returns the views with masked windows during a trial."""
        if not self.windows:
            return views
        windows = self.windows
        return self.cache.get(views, lambda: [masked(view, windows.get(index)) for index, view in enumerate(views)])

    def choose_windows(self, run: Run, step: int) -> dict[int, Window]:
        """Picks windows of some views, in pixels of the photos."""
        views = run.scene.train
        count = min(self.options.views, math.ceil(MOST_MASKED * len(views)))
        chosen = validation_windows(views, count, self.options.window, "trial", step)
        return {index: chosen[view] for index, view in enumerate(views) if view in chosen}

    def set_windows(self, windows: Mapping[int, Window]) -> None:
        """Masks these windows, or none."""
        self.windows, self.cache = windows, ViewCache()

    # -- trials --------------------------------------------------------------------------------------------------------

    def before_step(self, run: Run) -> dict[str, float]:
        """Tries the corrections that are tested before the next step; augmenters would make their views twice."""
        step = run.step + 1
        tested = [] if self.windows or run.augmenters else self.tested(run, step)
        length = self.length(run, step) if tested else 0
        if length < MIN_STEPS:
            return {}
        start = state_of(run)
        self.set_windows(self.choose_windows(run, step))
        try:
            return self.decide(run, tested, start, length)
        except BaseException:
            return_to(run, start)
            raise
        finally:
            self.set_windows({})

    def tested(self, run: Run, step: int) -> list[Correction]:
        """Returns the corrections that `auto` tests before a step."""
        modules = [module for module in run.modules.values() if isinstance(module, Correction)]
        return [one for one in modules if one.options.when == "auto" and not one.active and one.due(step)]

    def length(self, run: Run, step: int) -> int:
        """Returns the steps of a stretch, which ends before the next correction is tested for the first time."""
        modules = [module for module in run.modules.values() if isinstance(module, Correction)]
        firsts = [first for module in modules if (first := min(module.milestones(), default=step)) > step]
        steps = round(self.options.steps * self.context.iterations)
        views = round(self.options.passes * len(self.context.scene.train) / self.context.batch)
        return min([steps, views, self.context.iterations - step + 1, *(first - step for first in firsts)])

    def decide(self, run: Run, tested: Sequence[Correction], start: RunState, length: int) -> dict[str, float]:
        """Tests corrections, tries those that their tests call for, and leaves the run after the best stretch."""
        metrics, called = self.test(run, tested, start)
        if not called:
            return metrics
        best, base = self.stretch(run, length), start
        for module, corrected in called.items():
            if base is start:
                return_to(run, corrected)
            else:
                metrics |= estimate_again(module, tested, run, base)
            settle(tested, start.step + 1)
            corrected = state_of(run)
            tried = self.stretch(run, length)
            gain, error = gain_of(tried, best)
            log_trial(module.name, start.step + 1, length, gain, error)
            metrics |= {module.name + GAIN: gain, module.name + GAIN + ERROR: error}
            if helps(gain, error):
                best, base = tried, corrected
            else:
                metrics[module.count_key] = 0
        return_to(run, best.end)
        return metrics

    def test(
        self, run: Run, tested: Sequence[Correction], start: RunState
    ) -> tuple[dict[str, float], dict[Correction, RunState]]:
        """Runs the tests; returns their metrics and the state after each correction they call for.

        The run ends as before, with all tests done.
        """
        metrics, called = dict[str, float](), dict[Correction, RunState]()
        for module in tested:
            metrics |= module.before_step(run)
            if module.active:
                called[module] = state_of(run)
                return_to(run, start)
        settle(tested, start.step + 1)
        return metrics, called

    def stretch(self, run: Run, length: int) -> Stretch:
        """Trains a number of steps; listeners are not called."""
        silent = load_plugins([], points=[])
        for _ in range(length):
            train_step(run, silent)
        return Stretch(pairs=list(self.window_pairs(run)), end=state_of(run), finite=finite(run))

    @torch.no_grad()
    def window_pairs(self, run: Run) -> Iterator[WindowPair]:
        """Yields renders and photos of the masked windows."""
        run_views = run.views.without(self)
        views = run_views.full_size
        for index, window in self.windows.items():
            view = views[index]
            image = run_views.match_photo(render(run, view.camera).image, None, view)
            counted = view.counted()
            whole = torch.ones(view.camera.height, view.camera.width, dtype=torch.bool) if counted is None else counted
            pixels = window.pixels
            yield WindowPair(
                image=window.cut(image).cpu(), photo=window.cut(view.image()), counted=whole[pixels].clone()
            )

    @classmethod
    def summary(cls, lines: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
        """Returns the gains of trials by correction, dB, their standard errors and thresholds, and the outcomes."""
        trials = {
            key.removesuffix(GAIN): {"step": line["step"]} | outcome_of(line[key], line[key + ERROR])
            for line in lines
            for key in line
            if key.endswith(GAIN)
        }
        return {"trials": trials} if trials else {}

    @classmethod
    def remarks(cls, evaluation: Mapping[str, Any]) -> Iterator[str]:
        """Reports which corrections stayed."""
        for name, trial in (evaluation.get("trials") or {}).items():
            outcome = "stay" if helps(trial["gain"], trial["error"]) else "were taken back"
            yield (
                f"corrections ({name}) {outcome} after a trial: {trial['gain']:+.2f} +- {trial['error']:.2f} dB on "
                "windows that were not learnt"
            )


def masked(view: View, window: Window | None) -> View:
    """Returns the view with a masked window of its photo."""
    if window is None:
        return view
    pixels = torch.zeros(view.camera.frame.height, view.camera.frame.width, dtype=torch.bool)
    pixels[window.pixels] = True
    return mask_view(view, pixels)


def settle(tested: Sequence[Correction], step: int) -> None:
    """Marks corrections as tested before a step, so that steps of a stretch do not test them again."""
    for module in tested:
        module.last_estimate = step


def estimate_again(module: Correction, tested: Sequence[Correction], run: Run, base: RunState) -> dict[str, float]:
    """Estimates a correction on top of others that stay; returns its metrics."""
    return_to(run, base)
    settle(tested, run.step + 1)
    module.last_estimate = 0
    return module.before_step(run)


def gain_of(tried: Stretch, other: Stretch) -> tuple[float, float]:
    """Returns the gain of a stretch over another on masked windows, dB, and its standard error."""
    if not (tried.finite and other.finite):
        return (math.inf if tried.finite else -math.inf), 0.0
    pairs = list(zip(tried.pairs, other.pairs, strict=True))
    both = [one.counted & two.counted for one, two in pairs]
    after, before = (
        torch.stack([error_at_best_gains(pair[side], mask) for pair, mask in zip(pairs, both, strict=True)])
        for side in (0, 1)
    )
    return decibels(after, before)


def error_at_best_gains(pair: WindowPair, mask: Bool[Tensor, "h w"]) -> Float[Tensor, ""]:
    """Returns the squared error of a window whose render is scaled by the best gain of each channel."""
    image, photo = (values[:, mask].double() for values in (pair.image, pair.photo))
    return (photo.square().sum(1) - (image * photo).sum(1).square() / image.square().sum(1).clamp_min(1e-12)).sum()


def log_trial(name: str, step: int, length: int, gain: float, error: float) -> None:
    """Logs the outcome of a trial."""
    sign, outcome = (">", "it stays") if helps(gain, error) else ("<=", "taken back")
    logger.info(
        "step %d: %s tried for %d steps, gain on masked windows %+.2f dB %s %d standard errors of %.2f dB: %s",
        *(step, name, length, gain, sign, SURE, error, outcome),
    )


def outcome_of(gain: float, error: float) -> dict[str, Any]:
    """Returns a gain, its standard error, its threshold and whether the correction stays."""
    return {"gain": gain, "error": error, "threshold": SURE * error, "stays": helps(gain, error)}


def helps(gain: float, error: float) -> bool:
    """Returns whether a gain is no chance."""
    return gain > SURE * error
