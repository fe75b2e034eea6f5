"""Cores that others want, too."""

import os
import subprocess
import sys
import threading
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from gsx.engine import threads

SLEEPS = """
import time, torch
from pathlib import Path
from gsx.core.rasterizer.sorting import GRAIN
from gsx.engine.threads import start_idle_threads

def sleeps():
    lines = (line for task in Path("/proc/self/task").iterdir() for line in (task / "status").read_text().splitlines())
    return sum(int(line.split()[1]) for line in lines if line.startswith("voluntary_ctxt"))

def loops():
    before = sleeps()
    for _ in range(300):
        numbers.add_(1)
        begun = time.perf_counter()
        while time.perf_counter() < begun + 2e-4:
            pass
    return sleeps() - before

torch.set_num_threads(2)
numbers = torch.zeros(4 * GRAIN)
loops()
start_idle_threads()
print(any(loops() > 200 for _ in range(100)))
"""
"""Prints whether threads fall asleep in nearly every one of 300 short loops, as soon as idle threads have started."""


@pytest.mark.skipif(not threads.waits(), reason="the system does not tell how long threads wait")
def test_threads_that_wait_for_each_other_sleep_while_there_are_idle_ones() -> None:
    own = {name: value for name, value in os.environ.items() if not name.startswith(("OMP_", "GOMP_"))}
    found = subprocess.run([sys.executable, "-c", SLEEPS], env=own, capture_output=True, text=True, check=True).stdout
    assert found == "True\n"  # without idle threads next to none; where cores are scarce more, with or without


def test_cores_are_scarce_from_much_waiting_until_there_is_next_to_none(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("INFO")
    seconds = [0.0, 0.0, 0.1, 0.5, 0.1, 0.0, 0.3, 0.0]  # that two threads have waited in each second
    sums, idle, clock = [sum(seconds[: end + 1]) for end in range(len(seconds))], list[int](), [0.0]
    started = list[threading.Event]()

    def waits() -> dict[str, int]:
        ended = 10**12 if len(idle) % 2 else 0  # a thread that is there only now and then
        return {"1": int(sums[len(idle)] * 5e8), "2": int(sums[len(idle)] * 5e8), str(len(idle) + 7): ended}

    def sleep(_: float) -> None:
        idle.append(sum(not ended.is_set() for ended in started))
        clock[0] += 1
        if len(idle) == len(seconds):
            raise EOFError

    monkeypatch.setattr(threads, "waits", waits)
    monkeypatch.setattr(threads, "start_idle_threads", lambda: started.append(threading.Event()) or started[-1])
    monkeypatch.setattr(threads, "time", SimpleNamespace(perf_counter=lambda: clock[0], sleep=sleep))
    with pytest.raises(EOFError):
        threads.watch()
    assert idle == [0, 0, 0, 1, 1, 0, 1, 0]
    assert len(caplog.records) == 1, "it is said once"


@pytest.mark.parametrize(
    ("cores", "own", "teams"), [(2, 2, 1), (3, 2, 2), (4, 2, 3), (8, 2, 7), (16, 8, 2), (8, 16, 1)]
)
def test_so_many_teams_are_idle_that_openmp_counts_more_threads_than_cores(
    cores: int, own: int, teams: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """GNU OpenMP counts the threads that it has begun, all but the first of a team, and the process's first one."""
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(cores)), raising=False)
    monkeypatch.setattr(torch, "get_num_threads", lambda: own)
    assert threads.teams_needed() == teams
    assert 1 + (1 + teams) * (own - 1) > cores
    assert teams == 1 or 1 + teams * (own - 1) <= cores


def test_a_process_is_watched_once_and_only_where_the_system_tells(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    names, ended = list[str](), threading.Event()
    monkeypatch.setattr(threads, "watch", lambda: names.append(threading.current_thread().name) or ended.wait())
    monkeypatch.setattr(threads, "TASKS", tmp_path)
    monkeypatch.setattr(torch, "get_num_threads", lambda: 2)
    threads.watch_cores()
    assert names == [], "the system hides how long threads wait"
    (tmp_path / "1").mkdir()
    (tmp_path / "1" / "schedstat").write_text("5 7 9\n")
    for _ in range(2):
        threads.watch_cores()
    ended.set()
    for thread in threading.enumerate():
        if thread.name == threads.NAME:
            thread.join()
    assert names == ["gsx cores"]
