"""Watches that a job reports its phases to, and rivals that take turns before one."""

import statistics
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, Protocol

import torch


class Watch(Protocol):
    """What a job reports to: `begin` when its inputs are ready, `lap` at the end of each phase."""

    def begin(self) -> None:
        """Work starts now."""
        ...

    def lap(self, phase: str) -> None:
        """The phase that has just ended."""
        ...


Job = Callable[[Watch], Any]
"""Some work, the same on every call."""


@dataclass(eq=False)
class Clock:
    """Milliseconds per phase on the processor's clock."""

    phases: dict[str, float] = field(default_factory=dict)
    last: float = 0.0

    def begin(self) -> None:
        self.last = time.perf_counter()

    def lap(self, phase: str) -> None:
        now = time.perf_counter()
        self.phases[phase] = 1e3 * (now - self.last)
        self.last = now

    def read(self) -> dict[str, float]:
        """Milliseconds of each phase."""
        return self.phases


@dataclass(eq=False)
class Events:
    """Milliseconds per phase on the GPU's clock: events in the stream, read when all work is done."""

    names: list[str] = field(default_factory=list)
    moments: list[torch.cuda.Event] = field(default_factory=list)

    def begin(self) -> None:
        torch.cuda.synchronize()
        self.moment()

    def lap(self, phase: str) -> None:
        self.names.append(phase)
        self.moment()

    def moment(self) -> None:
        """Record an event."""
        event = torch.cuda.Event(enable_timing=True)
        event.record()
        self.moments.append(event)

    def read(self) -> dict[str, float]:
        """Milliseconds of each phase."""
        torch.cuda.synchronize()
        ends = zip(self.names, self.moments, self.moments[1:], strict=False)
        return {name: begin.elapsed_time(end) for name, begin, end in ends}


def timed(job: Job, device: torch.device) -> dict[str, float]:
    """Milliseconds of each phase of one call."""
    watch = Events() if device.type == "cuda" else Clock()
    job(watch)
    return watch.read()


@dataclass(frozen=True)
class Patience:
    """How often a job is repeated."""

    repeats: int
    seconds: float
    """After this time no more repeats are made than `LEAST`."""


LEAST = 3
"""Fewest repeats of a slow job, unless fewer are asked for."""


@dataclass(frozen=True)
class Timing:
    """What the calls of a job took."""

    first: float
    """The first call, ms: compilation and warming up."""
    rounds: list[dict[str, float]]
    """Milliseconds per phase of the calls after it."""

    def median(self, phase: str) -> float:
        """Of a phase, ms."""
        return statistics.median(each[phase] for each in self.rounds)

    @property
    def total(self) -> float:
        """Median over calls of the sum over phases, ms."""
        return statistics.median(sum(each.values()) for each in self.rounds)


def rounds_of(patience: Patience) -> Iterator[int]:
    """Numbers of rounds, as many as there is patience for."""
    begun = time.perf_counter()
    for number in range(patience.repeats):
        if number >= LEAST and time.perf_counter() - begun > patience.seconds:
            return
        yield number


def take_turns(jobs: Mapping[str, Job], device: torch.device, patience: Patience) -> dict[str, Timing]:
    """Time jobs call by call in turn, so that whatever slows the machine slows all of them.

    Each is called once before, to compile and to warm up.
    """
    first = {name: sum(timed(job, device).values()) for name, job in jobs.items()}
    rounds: dict[str, list[dict[str, float]]] = {name: [] for name in jobs}
    for _ in rounds_of(patience):
        for name, job in jobs.items():
            rounds[name].append(timed(job, device))
    return {name: Timing(first[name], rounds[name]) for name in jobs}
