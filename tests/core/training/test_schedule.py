"""Schedules against the published step numbers."""

from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st
from small_scene import published_options, small_gs3d, small_scene, spread

from gsx.core.training.schedule import Schedule, log_linear


def schedule(iterations: int, views: int = 100) -> Schedule:
    return Schedule(iterations=iterations, published_iterations=30000, views=views)


@pytest.mark.parametrize(
    ("step", "rate"),
    [(0, 1.6e-4), (7500, 5.059644e-5), (15000, 1.6e-5), (22500, 5.059644e-6), (30000, 1.6e-6), (40000, 1.6e-6)],
)
def test_position_rate_at_published_steps(step: int, rate: float) -> None:
    assert log_linear(step, 30000, 1.6e-4, 1.6e-6) == pytest.approx(rate, rel=1e-6)


def test_a_decay_over_no_steps_has_ended() -> None:
    """`backbone.decay_until` of a short run may come to step 0."""
    assert [log_linear(step, 0, 1e-2, 1e-4) for step in (0, 1, 50)] == pytest.approx([1e-4] * 3)


@pytest.mark.parametrize(
    ("iterations", "exponent", "factor"),
    [(30000, 0.4, 1), (60000, 0.4, 1), (3000, 0.0, 1), (3000, 0.5, 10**0.5), (1200, 1.0, 25), (1000, 0.4, 3.89806)],
)
def test_shortened_runs_learn_faster_by_a_power_of_how_short_they_are(
    iterations: int, exponent: float, factor: float
) -> None:
    assert schedule(iterations).shortened(exponent) == pytest.approx(factor, rel=1e-6)
    published = published_options()
    options = replace(published, rates=replace(published.rates, shortened=exponent))
    model = small_gs3d(small_scene(spread(4)), iterations=iterations, options=options)
    model.set_rates(0)
    for name, own in (("sh_dc", 0.0025), ("sh_rest", 1.25e-4), ("log_scales", 0.005), ("quats", 0.001)):
        assert model.table.group(name)["lr"] == pytest.approx(factor * own, rel=1e-6)
    assert model.table.group("opacity_logits")["lr"] == 0.05
    assert model.table.group("means")["lr"] == pytest.approx(factor * 1.6e-4, rel=1e-6)
    model.set_rates(iterations)
    assert model.table.group("means")["lr"] == pytest.approx(1.6e-6, rel=1e-6)


@given(middle=st.integers(1, 999), reach=st.integers(1, 500), first=st.floats(1e-6, 1), last=st.floats(1e-6, 1))
def test_equal_steps_multiply_the_rate_by_equal_factors(middle: int, reach: int, first: float, last: float) -> None:
    reach = min(reach, middle, 1000 - middle)
    before, now, after = (log_linear(middle + k * reach, 1000, first, last) for k in (-1, 0, 1))
    assert now**2 == pytest.approx(before * after, rel=1e-9)


@pytest.mark.parametrize(
    ("iterations", "published", "step"),
    [(30000, 15000, 15000), (30000, 600, 600), (7000, 15000, 3500), (3000, 500, 50), (60000, 500, 1000), (100, 500, 2)],
)
def test_steps_keep_their_fraction_of_the_run(iterations: int, published: int, step: int) -> None:
    assert schedule(iterations).step(published) == step


@pytest.mark.parametrize(
    ("iterations", "views", "published", "passes", "interval"),
    [
        (30000, 400, 100, 1, 100),  # published length: the published interval, however many views
        (30000, 1, 3000, 10, 3000),
        (3000, 20, 100, 1, 20),  # 10 steps would not pass over the views
        (3000, 4, 100, 1, 10),  # they do here
        (3000, 400, 100, 1, 100),  # the floor stops at the published interval
        (3000, 60, 3000, 10, 600),
        (3000, 20, 3000, 10, 300),
        (3000, 7, 100, 1.5, 11),  # rounded up to whole steps
        (100, 1, 100, 1, 1),  # never 0
        (10, 0, 100, 1, 1),
        (60000, 50, 100, 1, 200),
    ],
)
def test_intervals_shrink_with_the_run_but_see_every_view(
    iterations: int, views: int, published: int, passes: float, interval: int
) -> None:
    assert schedule(iterations, views).interval(published, passes) == interval


@given(iterations=st.integers(1, 30000), views=st.integers(1, 500), published=st.integers(1, 5000))
def test_interval_of_a_shortened_run_is_bounded(iterations: int, views: int, published: int) -> None:
    interval = schedule(iterations, views).interval(published)
    assert min(published, views) <= interval <= published


def steps_when(due: object, iterations: int) -> list[int]:
    return [step for step in range(1, iterations + 1) if due(step)]


def test_published_cadence_at_full_length() -> None:
    backbone = small_gs3d(small_scene(spread(4), views=200), iterations=30000)
    events = steps_when(backbone.control.events.due, 30000)
    assert (events[0], events[-1], len(events)) == (600, 14900, 144)
    assert events == list(range(600, 15000, 100))
    assert steps_when(backbone.control.reset_due, 30000) == [3000, 6000, 9000, 12000]


def test_white_backgrounds_reset_once_more_at_500() -> None:
    white = small_gs3d(small_scene(spread(4), background=1.0), iterations=30000)
    assert steps_when(white.control.reset_due, 30000) == [500, 3000, 6000, 9000, 12000]
    grey = small_gs3d(small_scene(spread(4), background=0.99), iterations=30000)
    assert steps_when(grey.control.reset_due, 1000) == []


def test_opacities_are_not_reset_where_density_control_has_ended() -> None:
    """As in train.py, where both resets are within it: a model to go on with would lose all it draws."""
    options = published_options(stop=0)
    white = small_gs3d(small_scene(spread(4), background=1.0), iterations=30000, options=options)
    assert steps_when(white.control.reset_due, 30000) == []
    assert white.plan()["opacity_reset"] == {"every": 3000, "until": 0}


@pytest.mark.parametrize(
    ("views", "events", "resets"),
    [(10, range(60, 1500, 10), [300, 600, 900, 1200]), (60, range(60, 1500, 60), [600, 1200])],
)
def test_cadence_of_a_tenth_of_the_run(views: int, events: range, resets: list[int]) -> None:
    backbone = small_gs3d(small_scene(spread(4), views=views), iterations=3000)
    assert steps_when(backbone.control.events.due, 3000) == list(events)
    assert steps_when(backbone.control.reset_due, 3000) == resets


def test_plan_names_the_steps_taken() -> None:
    plan = small_gs3d(small_scene(spread(4), extent=2.0, views=60), iterations=3000).plan()
    assert plan["densify"] == {"from": 50, "until": 1500, "every": 60}
    assert plan["opacity_reset"] == {"every": 600, "until": 1500}
    assert plan["sh_degree"] == {"every": 100, "up_to": 3}
    assert plan["means_rate"] == {"from": pytest.approx(3.2e-4), "to": pytest.approx(3.2e-6), "over": 3000}
