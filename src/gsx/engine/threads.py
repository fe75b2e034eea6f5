"""Threads that wait for each other, on cores that other programs want, too.

Each of a step's hundreds of short loops ends when all of its threads have. GNU OpenMP has those that are ready turn in
circles for longer than a scheduler's slice, which is fastest alone; but where another program has taken a core, they
keep from it the very thread that they wait for. It lets them sleep early only while it counts more threads of its own
in a process than there are cores: so a process whose threads wait for cores is given as many more, which do nothing.
"""

import logging
import os
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import TypeAlias

import torch

logger = logging.getLogger(__name__)

TASKS = Path("/proc/self/task")
"""Linux tells there of each thread for how long it has run, and waited for a core (schedstat), ns."""
EVERY = 0.25
"""Seconds between looks."""
NAME = "gsx cores"
"""Of the thread that looks."""
MANY, FEW = 0.25, 0.05
"""Threads that wait for a core, on average, where others want it, and where nobody does. By hand on two cores, beside
another program: 1, and 0.4 with idle threads; alone: below 0.01."""
GRAIN = 1 << 15
"""Numbers for which torch takes another thread (ATen, at::internal::GRAIN_SIZE)."""
Times: TypeAlias = dict[str, int]
"""For how long each thread has waited for a core, ns."""


@contextmanager
def relieve_oversubscription() -> Iterator[None]:
    """Watch whether this process's threads wait for cores; while they do, they sleep early where they wait for each
    other. No result depends on it. Where the system tells nothing, where there is one thread, and within another such
    watch, nothing happens."""
    watched = any(thread.name == NAME for thread in threading.enumerate())
    if watched or torch.get_num_threads() == 1 or not times():
        yield
        return
    ended = threading.Event()
    watcher = threading.Thread(target=watch, args=(ended,), name=NAME, daemon=True)
    try:
        with suppress(RuntimeError):  # no thread more is allowed
            watcher.start()
        yield
    finally:
        ended.set()
        if watcher.is_alive():
            watcher.join()


def watch(ended: threading.Event) -> None:
    """Add idle threads while cores are scarce, until `ended`."""
    before, begun, scarce, told = times(), time.perf_counter(), False, False
    with ExitStack() as stack:
        while not ended.wait(EVERY):
            now, looked = times(), time.perf_counter()
            threads = waiting(before, now) / (looked - begun)
            before, begun = now, looked
            was, scarce = scarce, threads > (FEW if scarce else MANY)
            if scarce and not told:
                logger.info("more threads want cores than there are: this takes longer")
                told = True
            if scarce and not was:
                stack.enter_context(idle_threads())
            elif was and not scarce:
                stack.close()


def times() -> Times:
    """Of each thread of this process; empty where the system does not tell."""
    found = Times()
    for file in TASKS.glob("*/schedstat"):
        with suppress(OSError, IndexError, ValueError):  # a thread may end meanwhile
            found[file.parent.name] = int(file.read_text().split()[1])
    return found


def waiting(before: Times, now: Times) -> float:
    """For how long threads, taken together, have waited for a core in between, seconds."""
    return sum(now[thread] - before[thread] for thread in before.keys() & now.keys()) / 1e9


def teams_needed() -> int:
    """Teams of as many threads as torch has, beside its own, with which OpenMP counts more threads than cores. It
    counts those that it has begun: all but the first of a team, and one more."""
    cores, begun = len(os.sched_getaffinity(0)), max(1, torch.get_num_threads() - 1)
    return max(1, -(-(cores - begun) // begun))


@contextmanager
def idle_threads() -> Iterator[None]:
    """Threads that are asleep, so many that OpenMP counts more than there are cores."""
    ended = threading.Event()

    def lead() -> None:
        torch.zeros(GRAIN * torch.get_num_threads()).add_(1)  # a loop of its own, whose threads stay with this one
        ended.wait()

    leaders = [threading.Thread(target=lead, name="gsx idle", daemon=True) for _ in range(teams_needed())]
    with suppress(RuntimeError):  # no thread more is allowed
        for leader in leaders:
            leader.start()
    try:
        yield
    finally:
        ended.set()
        for leader in leaders:
            if leader.is_alive():
                leader.join()
