"""Corrections of photos: their schedule, common options and hooks."""

import logging
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Annotated, Any, ClassVar, TypeVar

import torch

from gsx.core.data.scene import View
from gsx.core.ranges import Range, Share
from gsx.core.seeds import derived_seed
from gsx.core.training.module import ModuleContext, TrainingModule
from gsx.core.training.run import Run

logger = logging.getLogger(__name__)

Item = TypeVar("Item")
LIMIT = "_threshold_"
"""Between the key of figures and the option of a threshold, in metrics.jsonl."""
WHEN = ("never", "auto", "always")
"""auto: correct after a test; always: correct without one."""
Times = Annotated[int, Range(1, 1000)]
ViewCount = Annotated[int, Range(3, 10**6)]


@dataclass(frozen=True, kw_only=True)
class CorrectionOptions:
    """Schedule of a correction; values in conf/module."""

    key: ClassVar[str] = ""
    """Name below `training`, for messages."""
    when: str = "never"
    """One of WHEN."""
    start: Share = 0.2
    """Share of the steps before the first estimate."""
    until: Share = 0.7
    """Share of the steps before the last estimate."""
    times: Times = 5
    """Number of estimates, at shares that grow by the same factor."""

    def __post_init__(self) -> None:
        if self.when not in WHEN:
            raise ValueError(f"training.{self.key}.when is '{self.when}'; choose from {', '.join(WHEN)}")
        if not 0 < self.start < 1 or not self.start <= self.until < 1:
            raise ValueError(
                f"training.{self.key}.start is {self.start} and training.{self.key}.until {self.until}: set shares of "
                "the steps between 0 and 1, the second one not smaller"
            )

    def steps(self, iterations: int) -> list[int]:
        """Returns the steps before which the correction is estimated: most of them early, when models change most."""
        if self.when == "never":
            return []
        last = max(1, self.times - 1)
        shares = [self.start * (self.until / self.start) ** (index / last) for index in range(self.times)]
        return sorted({max(1, round(share * iterations)) + 1 for share in shares})


class Correction(TrainingModule):
    """A correction of photos: tested before one step, estimated before a few more if needed."""

    options: CorrectionOptions
    seconds_key: ClassVar[str]
    """Key of the time of an estimate in metrics.jsonl."""
    figures_key: ClassVar[str]
    """Key of its figures in evaluation.json."""
    count_key: ClassVar[str]
    """Key in metrics.jsonl that is 0 where no photo is corrected."""
    thresholds: ClassVar[Sequence[str]] = ()
    """Options with the thresholds of `auto`."""
    last_estimate = 0
    """Step of the last estimate: repeating that step does not estimate again."""

    @property
    def active(self) -> bool:
        """True if photos are corrected now: there is a state to save."""
        return bool(self.state_dict())

    def estimate(self, run: Run, step: int) -> dict[str, float]:
        """Tests and estimates the correction before a step; returns metrics for its line."""
        raise NotImplementedError

    def before_step(self, run: Run) -> dict[str, float]:
        """Estimates the correction if it is due before the next step."""
        step = run.step + 1
        if not self.due(step):
            return {}
        start = time.perf_counter()
        metrics = self.estimate(run, step)
        return metrics | self.limits(step) | {self.seconds_key: round(time.perf_counter() - start, 3)}

    def limits(self, step: int) -> dict[str, float]:
        """Returns the thresholds of the test before a step; none if there is no test."""
        tested = self.options.when == "auto" and step == self.milestones()[0]
        return {f"{self.figures_key}{LIMIT}{name}": getattr(self.options, name) for name in self.thresholds if tested}

    def due(self, step: int) -> bool:
        """Checks if it is estimated before a step: before the first of its steps, then only if it is active."""
        steps = self.milestones()
        return step in steps and step > self.last_estimate and (step == steps[0] or self.active)

    def milestones(self) -> list[int]:
        """Returns the steps before which it is estimated."""
        return self.options.steps(self.context.iterations)

    def supports(self, ranks: int) -> bool:
        """Returns True if it is off or one process trains: ranks do not estimate together."""
        return ranks == 1 or self.options.when == "never"

    def restarted(self, context: ModuleContext) -> TrainingModule:
        """Returns the module for another run; off where that run's views are corrected already."""
        return type(self)(type(self.options)() if self.in_views else self.options, context)

    @classmethod
    def figures(cls, lines: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
        """Returns figures for evaluation.json from the lines of its estimates, at least one."""
        raise NotImplementedError

    @classmethod
    def summary(cls, lines: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
        """Returns the figures of its estimates, thresholds and seconds; a stop before a step loses its line."""
        estimates = [line for line in lines if cls.seconds_key in line]
        if not estimates:
            return {}
        seconds, start = sum(line[cls.seconds_key] for line in estimates), cls.figures_key + LIMIT
        limits = {key.removeprefix(start): value for key, value in estimates[0].items() if key.startswith(start)}
        tested = {"thresholds": limits} if limits else {}
        return {cls.figures_key: cls.figures(estimates) | tested | {"seconds": seconds}}


@dataclass(eq=False)
class ViewCache:
    """Lists of views by the list that they were made from."""

    made: list[tuple[Sequence[View], list[View]]] = field(default_factory=list)

    def get(self, views: Sequence[View], make: Callable[[], list[View]]) -> list[View]:
        """Returns the list made from this one; makes it at the first call."""
        for source, made in self.made:
            if source is views:
                return made
        self.made.append((views, make()))
        return self.made[-1][1]


def sample(items: Sequence[Item], count: int, purpose: str) -> list[Item]:
    """Returns at most `count` items, in a random order that is the same in every run."""
    generator = torch.Generator().manual_seed(derived_seed(purpose))
    order = torch.randperm(len(items), generator=generator)[:count]
    return [items[index] for index in order.tolist()]


def log_test(step: int, what: str, value: float, threshold: float, write: Callable[[float], str], action: str) -> None:
    """Logs a test before a step: value, threshold and action; `write`: formats both with their unit."""
    sign = ">" if value > threshold else "<="
    logger.info("step %d: %s %s %s %s, %s", step, what, write(value), sign, write(threshold), action)


def percent(share: float) -> str:
    """Formats a share in percent."""
    return f"{100 * share:.1f} %"
