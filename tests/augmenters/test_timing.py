"""Events, windows and weights against the tables of the paper."""

from dataclasses import replace

import pytest

from gsx.augmenters.pseudo_options import Timing, event_at, events_of, progress, ramp, span_of, stepped
from gsx.builtin import plugins
from gsx.core.training.schedule import Schedule
from gsx.experiments.runs.compose import compose

B = Timing(published_iterations=40000, start=20000, stop=38000, every=2000, span=750, stop_inclusive=True)
UP = Timing(published_iterations=40000, start=22000, stop=38000, every=2000, span=1000, stop_inclusive=True)


def schedule(iterations: int = 40000, published: int = 40000) -> Schedule:
    return Schedule(iterations=iterations, published_iterations=published, views=50)


def test_the_shipped_options_are_the_papers() -> None:
    found = compose(["augmenter=[upscale_paper,bootstrap]"], plugins()).augmenters
    up, boot = (found[name].options for name in ("upscale", "bootstrap"))
    assert (up.timing, boot.timing) == (UP, B)
    assert (up.weights, boot.weights) == ([0.1, 0.05], [0.15, 0.1])
    assert (up.narrow, boot.narrow, up.variants, boot.variants) == (0.5, 0.4, 2, 2)
    assert (up.rotation_noise, up.translation_noise) == (0.2, 0.0)
    assert (boot.rotation_noise, boot.translation_noise) == (0.2, 0.1)
    assert (boot.strength, up.seed, up.scales, up.base, boot.base) == ([0.06, 0.01], 22, [2], True, False)


def test_events_of_the_paper() -> None:
    assert events_of(B, schedule()) == list(range(20000, 38001, 2000))
    assert events_of(UP, schedule()) == list(range(22000, 38001, 2000))
    assert events_of(replace(UP, stop_inclusive=False), schedule()) == list(range(22000, 36001, 2000))


def test_active_steps_of_the_paper() -> None:
    for timing, total in ((B, 7500), (UP, 9000)):
        events, span = events_of(timing, schedule()), span_of(timing, schedule())
        assert sum(event_at(step, events, span) is not None for step in range(1, 40001)) == total


@pytest.mark.parametrize(("offset", "weights"), [
    (0, (0.0, 0.0)), (1, (0.15, 0.10)), (375, (0.15, 0.10)), (376, (0.10, 0.10)), (500, (0.10, 0.10)),
    (501, (0.10, 0.05)), (750, (0.10, 0.05)), (751, (0.0, 0.05)), (1000, (0.0, 0.05)), (1001, (0.0, 0.0)),
])  # fmt: skip
def test_combined_weights_after_a_common_event(offset: int, weights: tuple[float, float]) -> None:
    found = []
    for timing, values in ((B, [0.15, 0.1]), (UP, [0.1, 0.05])):
        events, span = events_of(timing, schedule()), span_of(timing, schedule())
        event = event_at(24000 + offset, events, span)
        place = None if event is None else progress(24000 + offset, event, events, span, "window")
        found.append(0.0 if place is None else stepped(values, place, "window"))
    assert tuple(found) == weights


def test_strength_decays_over_the_events() -> None:
    found = [round(ramp([0.06, 0.01], at, B, schedule()), 4) for at in (20000, 24000, 28000, 32000, 36000, 38000)]
    assert found == [0.06, 0.0489, 0.0378, 0.0267, 0.0156, 0.01]
    assert ramp([0.06, 0.01], 15000, replace(B, start=15000), schedule()) == 0.06
    assert round(ramp([0.06, 0.01], 37000, replace(B, start=15000), schedule()), 4) == 0.0122


def test_other_ways_to_split_the_weights() -> None:
    events, span = events_of(UP, schedule()), span_of(UP, schedule())
    halves = [stepped([0.1, 0.05], progress(s, 22000, events, span, "run"), "run") for s in (22001, 23000)]
    assert halves == [0.1, 0.1]
    assert stepped([0.1, 0.05], progress(38001, 38000, events, span, "run"), "run") == 0.05
    ends = [stepped([0.1, 0.05], progress(s, 24000, events, span, "linear"), "linear") for s in (24001, 25000)]
    assert ends == pytest.approx([0.1, 0.05])


@pytest.mark.parametrize("iterations", [60, 400, 3000])
def test_short_runs_keep_the_places_of_the_windows(iterations: int) -> None:
    events, span = events_of(UP, schedule(iterations)), span_of(UP, schedule(iterations))
    assert events[0] == round(22000 * iterations / 40000)
    assert len(events) == len(set(events))
    assert max(events) < iterations
    assert span == max(1, round(1000 * iterations / 40000))
    for event in events:
        assert event_at(event, events, span) != event
        assert event_at(event + 1, events, span) == event


def test_the_30k_runs_of_objects_have_their_windows_at_the_same_fractions() -> None:
    assert events_of(UP, schedule(30000))[:2] == [16500, 18000]
    assert events_of(UP, schedule(30000))[-1] == 28500
    assert span_of(UP, schedule(30000)) == 750


@pytest.mark.parametrize("change", [{"span": 2001}, {"start": 39000}, {"every": 0}])
def test_timing_is_checked(change: dict[str, int]) -> None:
    with pytest.raises(ValueError, match="timing"):
        replace(UP, **change)
