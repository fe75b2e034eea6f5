"""Plans of runs by time, for made measurements: time kept, size chosen, values of the user kept."""

from dataclasses import replace
from typing import Any

import pytest
from tiny import composed

from gsx.core.errors import ConfigError
from gsx.experiments.minutes.cost import Measurement, plan_options
from gsx.experiments.minutes.plan import Task, changes_of, drawn_pixels, plan_run, training_seconds

MEASURED = Measurement(
    base=0.01,
    megapixel=0.5,
    pixels=30_000,
    downscale=4,
    primitives=5_000,
    photo=0.02,
    evaluate=0.3,
    check=0.01,
    path="compiled",
    device="cpu",
)


def task_of(seconds: float, *fixed: str, words: tuple[str, ...] = (), **changes: Any) -> Task:
    return Task(
        settings=composed("backbone=gs3d_zoom", *words),
        fixed=frozenset(fixed),
        views=40,
        tests=6,
        seconds=seconds,
        published=30_000,
        measurement=replace(MEASURED, **changes),
        options=plan_options(),
    )


@pytest.mark.parametrize("seconds", [60.0, 300.0, 1800.0])
def test_a_plan_uses_the_time(seconds: float) -> None:
    task = task_of(seconds)
    plan = plan_run(task)
    most = seconds * task.options.used
    assert plan.seconds <= most
    assert plan.other + training_seconds(task, plan.downscale, plan.steps + 1)[-1] > most


def test_more_time_brings_finer_photos_and_more_steps() -> None:
    plans = [plan_run(task_of(seconds)) for seconds in (30.0, 120.0, 600.0, 3600.0)]
    sizes = [plan.downscale for plan in plans]
    assert sizes == sorted(sizes, reverse=True)
    assert sizes[0] > sizes[-1]
    assert all(plan.steps >= task_of(0).options.enough_steps for plan in plans[1:])


def test_a_slower_machine_takes_fewer_steps() -> None:
    fast, slow = (
        plan_run(task_of(600.0, "scene.downscale", base=b, megapixel=m)) for b, m in ((0.01, 0.5), (0.03, 1.5))
    )
    assert 0.25 * fast.steps < slow.steps < 0.5 * fast.steps


def test_no_plan_is_longer_than_the_published_run() -> None:
    plan = plan_run(task_of(1e7))
    assert plan.steps == 30_000
    assert plan.downscale == 1
    assert plan.seconds < 1e7


def test_too_little_time_is_refused_with_what_it_takes() -> None:
    with pytest.raises(
        ConfigError, match=r"3 s are left .* 60 steps at 1/\d+ size take about \d+ s: give more minutes"
    ):
        plan_run(task_of(3.0))


def test_values_of_the_command_line_stay() -> None:
    task = task_of(600.0, "scene.downscale", "training.supersampling.start", "backbone.capacity")
    plan = plan_run(task)
    changes = changes_of(task, plan)
    assert plan.downscale == 4
    assert not {"scene.downscale", "training.supersampling.start", "backbone.capacity"} & changes.keys()


def test_what_a_plan_changes() -> None:
    task = task_of(600.0)
    plan, schedule = plan_run(task), task.options.schedule
    changes = changes_of(task, plan)
    assert changes["iterations"] == plan.steps == changes["training.deadline.steps"]
    assert changes["backbone.capacity"] == "budget"
    assert changes["backbone.budget.primitives"] == plan.primitives
    assert changes["rasterizer.path"] == "compiled"
    assert changes["training.deadline.to"] == schedule["training.supersampling.start"]
    assert changes["training.deadline.planned"][-1] == pytest.approx(plan.planned[-1], abs=0.01)


def test_backbones_without_supersampling_have_no_finer_stretch() -> None:
    task = replace(task_of(600.0), settings=composed())
    assert "training.deadline.to" not in changes_of(task, plan_run(task))


def test_anchors_cost_several_primitives() -> None:
    anchors = replace(task_of(600.0), settings=composed("backbone=scaffold"))
    free, rows = (
        plan_run(task_of(600.0, "scene.downscale")),
        plan_run(replace(anchors, fixed=frozenset(["scene.downscale"]))),
    )
    assert rows.primitives < free.primitives


def test_a_plan_removes_no_anchors() -> None:
    """Where 19,000 primitives suit the pixels of 40 views, Gaussians shrink to them."""
    task = task_of(600.0, "scene.downscale", primitives=40_000)
    assert plan_run(task).primitives == round(0.1 * 30_000 * 40**0.5)
    assert plan_run(replace(task, settings=composed("backbone=octree_scaffold"))).primitives == 40_000


def test_short_runs_have_events_within_a_pass_over_the_views() -> None:
    """Growth from 500 to 15,000 of 30,000 steps: 0.4833 of the steps for 8 events."""
    task = task_of(0.0)
    short, long = (replace(plan_run(task_of(600.0)), steps=steps) for steps in (200, 2000))
    assert changes_of(task, short)["backbone.density.passes"] == pytest.approx(200 * 0.4833 / 8 / 40, abs=0.005)
    assert changes_of(task, long)["backbone.density.passes"] == 1


@pytest.mark.parametrize("words", [("scene.max_width=800",), ("scene.downscale=8",)])
def test_a_size_that_is_chosen_elsewhere_stays(words: tuple[str, ...]) -> None:
    task = task_of(600.0, *(word.partition("=")[0] for word in words if "width" in word), words=words)
    assert plan_run(task).downscale == 4
    assert "scene.downscale" not in changes_of(task, plan_run(task))


def test_a_cap_of_primitives_is_kept() -> None:
    task = task_of(600.0, words=("backbone.max_primitives=900",))
    assert changes_of(task, plan_run(task))["backbone.budget.primitives"] == 900


@pytest.mark.parametrize("capacity", ["budget", "mcmc"])
def test_a_number_of_primitives_that_is_chosen_stays(capacity: str) -> None:
    words = (f"backbone.capacity={capacity}", f"backbone.{capacity}.primitives=700")
    task = task_of(600.0, "backbone.capacity", words=words)
    assert plan_run(task).primitives == 700
    assert "backbone.budget.primitives" not in changes_of(task, plan_run(task))


def test_augmenters_keep_their_finer_renders() -> None:
    task = task_of(600.0, words=("augmenter=[mipmap]",))
    assert "training.supersampling.start" not in changes_of(task, plan_run(task))


def test_zooms_without_photos_cost_nothing() -> None:
    """At 1/4 size, zooms 1, 2 and 4 draw 1 + 4 + 16 x1 pictures, at 1/2 size 1 + 4, at full size 1."""
    task = task_of(600.0, words=("eval.zoom=[1,2,4]",))
    assert [drawn_pixels(task, downscale) for downscale in (4, 2, 1)] == [21, 5, 1]


# -- points by stereo --------------------------------------------------------------------------------------------------


def with_points(*fixed: str, **changes: Any) -> Task:
    """A run on a scene whose photos take a tenth of a second each."""
    return task_of(600.0, *fixed, **{"stereo": 0.1, **changes})


def on_anchors() -> Task:
    return replace(with_points(), settings=composed("backbone=octree_scaffold"))


def test_photos_begin_with_half_of_the_primitives() -> None:
    task = with_points()
    plan = plan_run(task)
    assert changes_of(task, plan)["scene.stereo"] == round(0.5 * plan.primitives) - MEASURED.primitives
    assert plan.other == pytest.approx(plan_run(with_points(stereo=0.2)).other - 4.0, abs=0.5)


@pytest.mark.parametrize(
    "task",
    [with_points("scene.stereo"), with_points(stereo=0.0), on_anchors()],
    ids=["chosen", "no points", "anchors"],
)
def test_other_runs_begin_without_stereo(task: Task) -> None:
    assert "scene.stereo" not in changes_of(task, plan_run(task))


def test_a_scene_with_enough_points_gets_no_others() -> None:
    """And no time is kept for them."""
    task, other = (with_points("scene.downscale", primitives=10**6, stereo=stereo) for stereo in (0.1, 0.2))
    assert changes_of(task, plan_run(task))["scene.stereo"] == 0
    assert plan_run(task).other == plan_run(other).other
