"""Timing of pseudo views: events, windows and weights (the paper, Practical Implementation)."""

from collections.abc import Sequence
from dataclasses import dataclass

from gsx.core.ranges import Interval, Steps
from gsx.core.training.schedule import Schedule


@dataclass(frozen=True, kw_only=True)
class Timing:
    """Events of a published run and the windows after them, in its steps."""

    published_iterations: Interval
    start: Steps
    """Step after which pseudo views are first made."""
    stop: Steps
    every: Interval
    span: Interval
    """Length of the window after an event, in which its pseudo views count."""
    stop_inclusive: bool

    def __post_init__(self) -> None:
        if self.start > self.stop:
            raise ValueError(f"timing: start is {self.start} and stop {self.stop}; give start <= stop")
        if self.span > self.every:
            raise ValueError(f"timing: span is {self.span}, longer than every, {self.every}: windows would overlap")


def events_of(timing: Timing, schedule: Schedule) -> list[int]:
    """Returns the steps of this run after which pseudo views are made, without duplicates in very short runs."""
    last = timing.stop + 1 if timing.stop_inclusive else timing.stop
    published = range(timing.start, last, timing.every)
    steps = {max(1, schedule.step(step)) for step in published}
    return sorted(step for step in steps if step < schedule.iterations)


def span_of(timing: Timing, schedule: Schedule) -> int:
    """Returns the length of a window in steps of this run."""
    return max(1, schedule.step(timing.span))


def event_at(step: int, events: Sequence[int], span: int) -> int | None:
    """Returns the event whose window contains a step (1-based), if any."""
    earlier = [event for event in events if event < step]
    return earlier[-1] if earlier and step <= earlier[-1] + span else None


def progress(step: int, event: int, events: Sequence[int], span: int, split: str) -> float:
    """Returns the place of a step, 0 to 1: in its window, or (run) from the first event to the last window's end."""
    if split == "run":
        return (step - events[0] - 1) / max(1, events[-1] + span - events[0] - 1)
    return (step - event - 1) / max(1, span - 1)


def stepped(values: list[float], place: float, split: str) -> float:
    """Returns a weight that changes half-way (window, run) or linearly (linear) between two values."""
    first, last = values
    if split == "linear":
        return first + (last - first) * place
    return first if place < 0.5 else last


def ramp(values: list[float], event: int, timing: Timing, schedule: Schedule) -> float:
    """Interpolates a value linearly from `start` to `stop`."""
    first, last = values
    start, stop = schedule.step(timing.start), schedule.step(timing.stop)
    return first + (last - first) * min(1.0, max(0, event - start) / max(1, stop - start))
