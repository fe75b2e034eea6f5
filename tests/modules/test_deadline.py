"""Deadline: when steps are skipped and how many, by hand-worked times; repeated runs; resume."""

import json
from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from module_contexts import build_module
from tiny import final_tensors, tiny_run

from gsx.core.errors import ConfigError
from gsx.modules.deadline import Deadline, DeadlineOptions

PLANNED = [float(seconds) for seconds in range(10, 81, 10)] + [110.0, 140.0]
"""Of 1,000 steps: 0.1 s for each of the first 800, 0.3 s for the others."""


def deadline_of(seconds: float = 140.0, **options: Any) -> Deadline:
    return build_module(Deadline, DeadlineOptions(seconds=seconds, steps=1000, planned=PLANNED, **options))


def run_at(step: int, seconds: float, milestones: Sequence[int] = ()) -> Any:
    """A run that has used so many seconds; another module acts once before each milestone."""
    other = SimpleNamespace(milestones=lambda: list(milestones))
    progress = SimpleNamespace(seconds=seconds)
    return SimpleNamespace(step=step, progress=progress, backbone=None, modules={"other": other})


def test_planned_seconds_between_shares() -> None:
    deadline = deadline_of()
    times = [deadline.planned_until(step) for step in (0, 50, 100, 800, 850, 900, 1000)]
    assert times == pytest.approx([0, 5, 10, 80, 95, 110, 140])


@pytest.mark.parametrize(
    ("step", "seconds", "last"),
    [
        (600, 60.0, 0),  # as planned
        (600, 61.0, 0),  # 1.017 times the plan: the rest takes 81.3 s, 79 s are left, and 4.2 s do not count
        (600, 66.0, 612),  # 1.1 times: 88 s, of which the last stretch takes 66 s, and 74 s are left: 8 of 20 steps
        (600, 90.0, 618),  # there is time for none, and a tenth is always taken
        (605, 90.0, 0),  # no window begins here
        (400, 90.0, 418),  # before half of the steps, and far too late
        (180, 90.0, 0),  # late, but before a fifth of the steps
    ],
)
def test_steps_before_the_last_stretch(step: int, seconds: float, last: int) -> None:
    run = run_at(step, seconds)
    metrics = deadline_of().before_step(run)
    assert run.step == (last or step)
    assert metrics == ({"steps_left_out": last - step, "late_from": step + 1, "late_to": last} if last else {})


def test_a_milestone_is_not_skipped() -> None:
    deadline, run = deadline_of(), run_at(600, 90.0, milestones=[300, 605, 900])
    assert deadline.before_step(run)
    assert run.step == 604
    assert deadline.before_step(run_at(604, 90.0, milestones=[605])) == {}


def test_windows_before_the_last_milestone_take_most_of_their_steps() -> None:
    """A milestone after the last stretch has begun does not count."""
    ends = []
    for milestones in ([700], [600, 850]):
        run = run_at(600, 90.0, milestones)
        deadline_of().before_step(run)
        ends.append(run.step)
    assert ends == [608, 618]


def test_the_last_stretch_shrinks_to_what_is_left() -> None:
    """0.6 s a step from step 800 on, twice the plan: after 20 steps 108 s are needed and 58 s are left."""
    deadline = deadline_of()
    assert deadline.before_step(run_at(800, 70.0)) == {}
    run = run_at(820, 82.0)
    metrics = deadline.before_step(run)
    assert run.step == 829
    assert metrics["late_from"] == 821


def test_half_of_the_last_stretch_is_always_taken() -> None:
    run = run_at(820, 139.0)
    deadline_of().before_step(run)
    assert run.step == 830


@pytest.mark.parametrize(
    ("first", "later", "least"),
    [(1.3, 1.3, 0.98), (1.6, 1.6, 0.98), (1.0, 1.5, 0.98), (1.4, 0.9, 0.82), (0.9, 0.9, 0.9)],
)
def test_a_run_ends_in_time(first: float, later: float, least: float) -> None:
    """On a machine that is so many times as slow as planned, another number from step 650 on.

    It skips a few steps at a time; one that becomes faster ends at most 18 % early.
    """
    deadline, run = deadline_of(), run_at(0, 0.0)
    while run.step < 1000:
        deadline.before_step(run)
        run.step += 1
        pace = first if run.step <= 650 else later
        run.progress.seconds += pace * (deadline.planned_until(run.step) - deadline.planned_until(run.step - 1))
    assert run.step == 1000
    assert least * 140 - 1e-6 < run.progress.seconds < 1.04 * 140
    assert all(step > 200 and step % 20 for step in deadline.skipped)
    assert bool(deadline.skipped) == (max(first, later) > 1)


def test_the_last_step_is_not_skipped() -> None:
    with pytest.raises(ConfigError, match="ends at step 1000 of 1000: the last step is always taken"):
        build_module(Deadline, DeadlineOptions(skip=[900, 1000]))


def test_a_run_of_another_length_has_no_deadline() -> None:
    longer = build_module(Deadline, DeadlineOptions(seconds=140.0, steps=1000, planned=PLANNED), iterations=2000)
    assert longer.before_step(run_at(1500, 900.0)) == {}


def test_no_deadline_skips_nothing() -> None:
    assert build_module(Deadline, DeadlineOptions()).before_step(run_at(900, 1e9)) == {}


@pytest.mark.parametrize("skip", [[5], [9, 5], [1, 5, 4, 8]])
def test_lists_that_are_no_rising_pairs(skip: list[int]) -> None:
    with pytest.raises(ValueError, match=r"training\.deadline\.skip is"):
        DeadlineOptions(skip=skip)


@pytest.mark.parametrize("planned", [[], [3.0, 2.0], [0.0, 1.0]])
def test_a_deadline_needs_a_plan(planned: list[float]) -> None:
    with pytest.raises(ValueError, match=r"training\.deadline\.planned is"):
        DeadlineOptions(seconds=1.0, steps=2, planned=planned)


def test_state_survives_a_checkpoint() -> None:
    deadline = deadline_of()
    deadline.before_step(run_at(600, 66.0))
    restored = deadline_of()
    restored.load_state_dict(deadline.state_dict())
    assert restored.skipped == list(range(601, 613))
    restored.load_state_dict(deadline_of().state_dict())
    assert not restored.skipped


LATE = (
    "iterations=20",
    "training.log_every=1",
    "backbone.density.stop=3000",
    "training.deadline.seconds=0.000001",
    "training.deadline.steps=20",
    "training.deadline.planned=[0.0000005,0.000001]",
)
"""Late from the beginning, whatever the machine: all is skipped that may be."""


def test_a_late_run_ends_its_schedule_and_can_be_repeated(tmp_path: Path) -> None:
    run = tiny_run(tmp_path / "late", LATE)
    lines = [json.loads(line) for line in (run.folder / "metrics.jsonl").read_text().splitlines()]
    steps, late = [line["step"] for line in lines], json.loads((run.folder / "evaluation.json").read_text())["late"]
    assert steps[:10] == list(range(1, 11))
    assert steps[-1] == 20
    assert len(steps) < 20
    skip = ",".join(f"{round(step)}" for step in late)
    again = tiny_run(tmp_path / "again", [*LATE[:3], f"training.deadline.skip=[{skip}]"])
    one, other = final_tensors(run.folder), final_tensors(again.folder)
    model = [name for name in one if "deadline" not in name]
    assert model
    assert all(torch.equal(one[name], other[name]) for name in model)


def test_processes_that_train_together_have_no_clock() -> None:
    assert not deadline_of().supports(2)
    assert deadline_of().supports(1)
    assert build_module(Deadline, DeadlineOptions()).supports(2)


def test_wrong_lists_are_refused_before_a_run(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"training\.deadline\.skip"):
        tiny_run(tmp_path / "run", ["training.deadline.skip=[3]"])
