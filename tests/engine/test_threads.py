"""Cores that others want, too."""

import os
import subprocess
import sys
import threading
from pathlib import Path
from pkgutil import resolve_name

import pytest
import torch

from gsx.engine import threads

SLEEPS = """
import time, torch
from contextlib import nullcontext
from pathlib import Path
from gsx.engine.threads import GRAIN, idle_threads

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
with idle_threads():
    time.sleep(0.2)
    print(loops())
"""
"""Prints how often threads fell asleep in 300 short loops beside idle threads."""


@pytest.mark.skipif(not threads.times(), reason="the system does not tell how long threads wait")
def test_threads_that_wait_for_each_other_sleep_while_there_are_idle_ones() -> None:
    own = {name: value for name, value in os.environ.items() if not name.startswith(("OMP_", "GOMP_"))}
    found = subprocess.run([sys.executable, "-c", SLEEPS], env=own, capture_output=True, text=True, check=True).stdout
    assert int(found) > 200  # without idle threads next to none; where cores are scarce more, with or without


def test_cores_are_scarce_from_much_waiting_until_there_is_next_to_none(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("INFO")
    waits = [0.0, 0.0, 0.1, 0.5, 0.1, 0.0, 0.3]  # seconds that two threads have waited in each second
    there = [0, 0, 0, 1, 1, 0, 1]
    told, seen, clock = iter(waits), list[int](), [0.0]
    total = [0.0]

    def times() -> threads.Times:
        total[0] += next(told)
        return {"1": int(total[0] * 5e8), "2": int(total[0] * 5e8), str(len(seen) + 7): 10**12}

    class Ended(threading.Event):
        def wait(self, timeout: float | None = None) -> bool:
            seen.append(sum(thread.name == "gsx idle" for thread in threading.enumerate()))
            clock[0] += 1
            return len(seen) > len(waits) - 1

    monkeypatch.setattr(threads, "times", times)
    monkeypatch.setattr(threads, "teams_needed", lambda: 1)
    monkeypatch.setattr(threads.time, "perf_counter", lambda: clock[0])
    threads.watch(Ended())
    assert seen == there
    assert not any(thread.name == "gsx idle" for thread in threading.enumerate())
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


@pytest.mark.parametrize("place", [
    "core.training.trainer.train",
    *(f"experiments.runs.{name}" for name in ("evaluate.evaluate", "export.export", "export.losses")),
    *(f"experiments.runs.render.{name}" for name in ("render_test_views", "render_orbit", "render_path")),
    *(f"experiments.runs.{name}" for name in ("view.view_run", "view.view_file", "photographs.judge_photographs")),
    "experiments.compact.compact.compact",
    *("api.TrainedRun.render", "api.SplatFile.render"),
])  # fmt: skip
def test_all_that_draws_for_long_is_watched(place: str) -> None:
    function = resolve_name(f"gsx.{place}")
    within = [getattr(cell.cell_contents, "func", None) for cell in function.__closure__]
    assert threads.relieve_oversubscription.__wrapped__ in within


def test_a_system_that_does_not_tell_is_left_alone(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(threads, "TASKS", tmp_path / "missing")
    monkeypatch.setattr(torch, "get_num_threads", lambda: 2)
    with threads.relieve_oversubscription():
        assert not any(thread.name == "gsx cores" for thread in threading.enumerate())
    monkeypatch.setattr(threads, "TASKS", tmp_path)
    (tmp_path / "1").mkdir()
    (tmp_path / "1" / "schedstat").write_text("5 7 9\n")
    with threads.relieve_oversubscription(), threads.relieve_oversubscription():
        assert sum(thread.name == "gsx cores" for thread in threading.enumerate()) == 1
    assert not any(thread.name == "gsx cores" for thread in threading.enumerate())
