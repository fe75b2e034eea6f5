"""Idle threads that keep training fast on cores shared with other programs.

Each of a step's hundreds of short loops ends when all of its threads have. GNU OpenMP lets finished threads spin for
longer than a scheduler's slice. That is fastest on free cores; on busy ones they block the very thread that they wait
for. OpenMP lets threads sleep early only while it counts more of its own in a process than there are cores. So a
process whose threads wait for cores gets extra threads, which do nothing.
"""

import logging
import os
import threading
import time
from contextlib import suppress
from pathlib import Path

import torch

from gsx.core.rasterizer.sorting import GRAIN

logger = logging.getLogger(__name__)

TASKS = Path("/proc/self/task")
"""Folder of Linux with the times that each thread has run, and waited for a core (schedstat), ns."""
EVERY = 0.25
"""Seconds between measurements."""
NAME = "gsx cores"
"""Name of the measuring thread."""
MANY, FEW = 0.25, 0.05
"""Mean number of threads waiting for a core, above which idle threads start and up to which they end. Measured on two
cores with another program: 1, and 0.4 with idle threads; without one: below 0.01."""


def watch_cores() -> None:
    """Starts a thread, once per process, that adds idle threads while this process's threads wait for cores.

    No result depends on it. Does nothing for a single thread, or on a system that does not report waiting times.
    """
    watched = any(thread.name == NAME for thread in threading.enumerate())
    if not watched and torch.get_num_threads() > 1 and waits():
        with suppress(RuntimeError):  # no more threads are allowed
            threading.Thread(target=watch, name=NAME, daemon=True).start()


def watch() -> None:
    """Adds idle threads while cores are scarce, for the rest of the process."""
    before, start, logged = waits(), time.perf_counter(), False
    idle: threading.Event | None = None
    while True:
        time.sleep(EVERY)
        after, end = waits(), time.perf_counter()
        waiting = sum(after[thread] - before[thread] for thread in before.keys() & after.keys()) / 1e9 / (end - start)
        before, start = after, end
        if idle is None and waiting > MANY:
            idle = start_idle_threads()
            if not logged:
                logger.info("CPU is busy with other programs: training will be slower")
                logged = True
        elif idle is not None and waiting <= FEW:
            idle.set()
            idle = None


def waits() -> dict[str, int]:
    """Returns the time that each thread of this process has waited for a core, ns; empty if the system hides it."""
    times = dict[str, int]()
    for file in TASKS.glob("*/schedstat"):
        with suppress(OSError, IndexError, ValueError):  # a thread may end meanwhile
            times[file.parent.name] = int(file.read_text().split()[1])
    return times


def teams_needed() -> int:
    """Returns how many extra teams of torch's size make OpenMP count more threads than cores.

    It counts the threads that it has started: all but the first of a team, and one more.
    """
    cores, started = len(os.sched_getaffinity(0)), max(1, torch.get_num_threads() - 1)
    return max(1, -(-(cores - started) // started))


def start_idle_threads() -> threading.Event:
    """Starts enough threads for OpenMP to count more than there are cores; they sleep until the event is set."""
    ended = threading.Event()

    def lead() -> None:
        torch.zeros(GRAIN * torch.get_num_threads()).add_(1)  # a loop whose threads stay with this one
        ended.wait()

    with suppress(RuntimeError):  # no more threads are allowed
        for _ in range(teams_needed()):
            threading.Thread(target=lead, name="gsx idle", daemon=True).start()
    return ended
