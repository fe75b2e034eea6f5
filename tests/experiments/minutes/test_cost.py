"""Cost model of training against sums by hand."""

from dataclasses import replace

import pytest

from gsx.experiments.minutes.cost import (
    SHARES,
    CostOptions,
    Growth,
    Measurement,
    Stage,
    StepCost,
    planned_seconds,
    stages_of,
    step_cost,
)

CONSTANT = Growth(first=1000, last=1000, start=0.0, stop=0.5, power=0.5)


def test_stages_of_a_schedule() -> None:
    assert stages_of(1, 0.0, 1, 0.0) == [Stage(start=0.0, stop=1.0, scale=1.0)]
    assert stages_of(2, 0.4, 2, 0.85) == [
        Stage(start=0.0, stop=0.4, scale=0.5),
        Stage(start=0.4, stop=0.85, scale=1.0),
        Stage(start=0.85, stop=1.0, scale=2.0),
    ]
    assert [(stage.stop, stage.scale) for stage in stages_of(4, 0.4, 1, 0.0)] == [(0.2, 0.25), (0.4, 0.5), (1.0, 1.0)]
    assert stages_of(1, 0.0, 2, 0.0) == [Stage(start=0.0, stop=1.0, scale=2.0)]


def test_growth_follows_the_square_root() -> None:
    growth = Growth(first=100, last=300, start=0.1, stop=0.5, power=0.5)
    assert [growth.at(share) for share in (0.0, 0.1, 0.2, 0.5, 1.0)] == pytest.approx([100, 100, 200, 300, 300])


def test_seconds_of_a_schedule() -> None:
    """1,000 steps at 0.1 s + 0.1 s per x1 picture: x1/4 for 0.4 of them, x1 for 0.45, x4 for 0.15; 0.01 s for rows."""
    cost = StepCost(base=0.1, pixel=1e-6, row=1e-5)
    seconds = planned_seconds(cost, stages_of(2, 0.4, 2, 0.85), CONSTANT, 1e5, 1000)
    assert seconds[-1] == pytest.approx(1000 * (0.1 + 0.01 + 0.1 * (0.4 / 4 + 0.45 + 0.15 * 4)))
    assert len(seconds) == SHARES
    assert seconds == sorted(seconds)
    assert seconds[SHARES * 2 // 5 - 1] == pytest.approx(400 * (0.11 + 0.025))


def test_cost_of_a_step_by_a_measurement() -> None:
    """0.05 s without pixels at 10,000 rows, of which rows cost 10,000 x 0.4 s / 10^6 x 2 = 0.008 s."""
    measurement = Measurement(
        base=0.05,
        megapixel=0.4,
        pixels=1e5,
        downscale=1,
        primitives=10_000,
        photo=0,
        evaluate=0,
        check=0,
        path="eager",
        device="cpu",
    )
    options = CostOptions(late=0.5, primitives=2.0, event=5.0, random=0.25, rows={"anchors": 3.0})
    cost = step_cost(measurement, options, "free")
    assert cost.seconds(0, 0) == pytest.approx(0.042)
    assert cost.seconds(1e6, 10_000) == pytest.approx(0.05 + 0.2)
    assert step_cost(measurement, options, "anchors").row == pytest.approx(3 * 0.8e-6)
    many = step_cost(replace(measurement, primitives=100_000), options, "free")  # 0.08 s by the model, 0.05 s measured
    assert (many.seconds(0, 0), many.seconds(0, 100_000)) == pytest.approx((0, 0.05))
    scattered = step_cost(replace(measurement, random=True), options, "free")
    assert scattered.seconds(0, 0) == pytest.approx(0.042 / 4)
    assert scattered.seconds(1e6, 10_000) == pytest.approx(0.25 / 4)
    crowded = step_cost(replace(measurement, random=True, primitives=100_000), options, "free")
    assert (crowded.seconds(0, 0), crowded.seconds(0, 100_000)) == pytest.approx((0, 0.02)), "rows last"


def test_events_of_density_control_take_steps() -> None:
    """4 events of 5 steps each at 0.1 s, in the first half of the run."""
    cost, stages = StepCost(base=0.1, pixel=0.0, row=0.0, event=5.0), stages_of(1, 0.0, 1, 0.0)
    growth = Growth(first=10, last=10, start=0.0, stop=0.5, power=0.5, events=4.0)
    seconds = planned_seconds(cost, stages, growth, 1e4, 100)
    assert seconds[-1] == pytest.approx(10 + 2)
    assert seconds[SHARES // 2 - 1] == pytest.approx(5 + 2)
