"""Deadline: a run that falls behind its planned time skips steps, a few of each window, and keeps its schedule.

`minutes=N` plans a run and sets these options. While the run keeps to its plan, the clock changes nothing.
"""

import logging
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Annotated, Any

import torch
from torch import Tensor

from gsx.core.errors import ConfigError
from gsx.core.ranges import MOST_STEPS, Range, Seconds, Share, Steps
from gsx.core.training.module import ModuleContext, TrainingModule
from gsx.core.training.run import Run
from gsx.modules.milestones import last_milestone, next_milestone

logger = logging.getLogger(__name__)

WINDOWS, SHORTEST = 50, 10
"""Windows of a run, each of which may skip its first steps, and the steps of the shortest one."""
RECENT = 4
"""Windows whose pace is that of the rest."""
SLACK = 0.03
"""Share of the time by which a run may be late before it skips steps."""
LEAST_EARLY, LEAST, LEAST_END = 0.6, 0.1, 0.5
"""Least share of the steps that a window takes: before the last milestone, before the last stretch, and in it."""


@dataclass(frozen=True, kw_only=True)
class DeadlineOptions:
    """Options; values in conf/module/deadline.yaml."""

    seconds: Seconds = 0.0
    """Seconds of training; 0: no deadline."""
    steps: Steps = 0
    """Steps of the planned run; a run of another length has no deadline."""
    planned: Annotated[list[float], Range(0, 10**9)] = field(default_factory=list)
    """Planned seconds of training after equal shares of the steps, the last: all."""
    start: Share = 0.2
    """Share of the steps before any are skipped."""
    to: Share = 0.8
    """Share of the steps at which the last stretch begins."""
    skip: Annotated[list[int], Range(1, MOST_STEPS)] = field(default_factory=list)
    """First and last steps to skip, in pairs, instead of looking at the clock."""

    def __post_init__(self) -> None:
        pairs = list(zip(self.skip[::2], self.skip[1::2], strict=False))
        ordered = all(first <= last for first, last in pairs) and self.skip == sorted(self.skip)
        if len(self.skip) % 2 or not ordered:
            raise ValueError(f"training.deadline.skip is {self.skip}: give rising pairs, [FIRST,LAST,FIRST,LAST,...]")
        if self.seconds and (not self.planned or min(self.planned) <= 0 or self.planned != sorted(self.planned)):
            raise ValueError(
                f"training.deadline.planned is {self.planned}: give rising seconds, as minutes=N sets them, "
                "or training.deadline.seconds=0"
            )


class Deadline(TrainingModule):
    """A limit of training time."""

    options: DeadlineOptions
    off = "seconds=0"

    def __init__(self, options: DeadlineOptions, context: ModuleContext) -> None:
        super().__init__(options, context)
        if options.skip and options.skip[-1] >= context.iterations:
            raise ConfigError(
                f"training.deadline.skip ends at step {options.skip[-1]} of {context.iterations}: the last step is "
                "always taken, give lower numbers"
            )
        self.active = options.seconds > 0 and options.steps == context.iterations and not options.skip
        """True: the clock may skip steps."""
        self.last_stretch = round(options.to * context.iterations)
        """Step before the last stretch, which is always taken."""
        self.listed = dict(zip(options.skip[::2], options.skip[1::2], strict=True))
        """Last step of each stretch to skip by its first one."""
        self.skipped: list[int] = []
        """Steps skipped so far."""
        self.marks: list[tuple[int, float, float]] = []
        """First step of each of the last windows, seconds of training, and planned ones without skipped steps."""

    # -- hooks ---------------------------------------------------------------------------------------------------------

    def before_step(self, run: Run) -> dict[str, float]:
        """Skips steps if the run is late, or as `skip` lists them."""
        first = run.step + 1
        last = self.last_late(run) if self.active else self.listed.get(first, 0)
        if last < first:
            return {}
        self.skipped += range(first, last + 1)
        clocked = self.log_late(run, first, last) if self.active else {}
        run.step = last
        return {"steps_left_out": float(last + 1 - first)} | clocked

    def log_late(self, run: Run, first: int, last: int) -> dict[str, float]:
        """Logs steps that are skipped because the run is late; returns their metrics."""
        used, limit = run.progress.seconds, self.options.seconds
        logger.info("step %d: %.0f s of %.0f s used, skipping to step %d", run.step, used, limit, last + 1)
        return {"late_from": float(first), "late_to": float(last)}

    def supports(self, ranks: int) -> bool:
        """Returns whether each process would skip the same steps."""
        return not self.active or ranks == 1

    def state_dict(self) -> Mapping[str, Tensor]:
        """Returns the steps skipped by the clock."""
        return {"skipped": torch.tensor(self.skipped)} if self.skipped and self.active else {}

    def load_state_dict(self, tensors: Mapping[str, Tensor]) -> None:
        """Restores a checkpoint."""
        self.skipped = tensors["skipped"].tolist() if tensors else []

    def plan(self, run: Run) -> dict[str, Any]:
        """Returns the deadline and the steps that may be skipped."""
        if not self.active:
            return {}
        may = {"may_skip_from": self.first_allowed(), "to": self.last_stretch}
        return {"deadline": {"seconds": self.options.seconds} | may}

    @classmethod
    def summary(cls, lines: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
        """Returns the steps that were skipped, as `skip` lists them."""
        late = [number for line in lines if "late_from" in line for number in (line["late_from"], line["late_to"])]
        return {"late": late} if late else {}

    @classmethod
    def remarks(cls, evaluation: Mapping[str, Any]) -> Iterator[str]:
        """Yields how to repeat a run that skipped steps."""
        if late := evaluation.get("late"):
            skip = ",".join(f"{round(step)}" for step in late)
            yield f"training fell behind its plan: it skipped steps; repeat it with training.deadline.skip=[{skip}]"

    # -- rules ---------------------------------------------------------------------------------------------------------

    def last_late(self, run: Run) -> int:
        """Returns the last step to skip now; 0: the run is in time, or no window begins here."""
        window = max(SHORTEST, math.ceil(self.context.iterations / WINDOWS))
        if run.step % window:
            return 0
        self.mark(run)
        stop = self.last_stretch if run.step < self.last_stretch else self.context.iterations
        if run.step < self.first_allowed():
            return 0
        taken = min(1.0, max(self.least_taken(run, stop), self.share_in_time(run.step)))
        return min(run.step + math.floor((1 - taken) * window), next_milestone(run, run.step, stop) - 1)

    def least_taken(self, run: Run, stop: int) -> float:
        """Returns the least share of the steps that a window takes."""
        if run.step >= self.last_stretch:
            return LEAST_END
        return LEAST_EARLY if run.step < last_milestone(run, stop) else LEAST

    def mark(self, run: Run) -> None:
        """Notes the clock before a window."""
        skipped = sum(self.planned_until(step) - self.planned_until(step - 1) for step in self.skipped)
        earlier = [mark for mark in self.marks if mark[0] < run.step]
        self.marks = [*earlier[-RECENT:], (run.step, run.progress.seconds, self.planned_until(run.step) - skipped)]

    def share_in_time(self, step: int) -> float:
        """Returns the share of the steps before the last stretch, or left in it, for which there is time."""
        rest = self.options.planned[-1] - self.planned_until(step)
        left, needed = self.options.seconds - self.marks[-1][1], self.pace() * rest
        if needed - left <= (0 if self.skipped else SLACK * self.options.seconds):
            return 1.0
        kept = self.pace() * (self.options.planned[-1] - self.planned_until(self.last_stretch))
        kept = kept if step < self.last_stretch else 0.0
        return (left - kept) / (needed - kept)

    def pace(self) -> float:
        """Returns the seconds of the last windows per planned second; without them, of the whole run."""
        first = self.marks[0] if len(self.marks) > 1 else (0, 0.0, 0.0)
        return (self.marks[-1][1] - first[1]) / (self.marks[-1][2] - first[2])

    def first_allowed(self) -> int:
        """Returns the step after which others may be skipped."""
        return max(1, round(self.options.start * self.context.iterations))

    def planned_until(self, step: int) -> float:
        """Returns the planned seconds of the first steps."""
        times = [0.0, *self.options.planned]
        position = step / self.context.iterations * (len(times) - 1)
        index = min(int(position), len(times) - 2)
        return times[index] + (position - index) * (times[index + 1] - times[index])
