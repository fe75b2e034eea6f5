"""How many primitives there are: curves by hand, budgets met, validation windows, what ends growth, resume."""

import json
import math
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pytest
import torch
from module_contexts import build_module
from safetensors.torch import load_file
from small_scene import Grey, published_options, small_context, small_gs3d, small_scene, spread
from test_anchors import small_anchors
from tiny import LIGHT, final_tensors, same_ending, stopped_at, tiny_run, tiny_settings
from torch import Tensor

from gsx.backbones.adaptive import Adaptive, AdaptiveOptions
from gsx.backbones.capacity import Budget, BudgetOptions, EventSteps, with_rows, worth_in_training
from gsx.backbones.gs3d import GS3D, gs3d
from gsx.backbones.gs3d_options import GS3DOptions
from gsx.core.data.camera import Camera, look_at
from gsx.core.data.scene import Scene, View
from gsx.core.data.window import Window
from gsx.core.errors import ConfigError
from gsx.core.rasterizer import rasterize
from gsx.core.training.distributed import Ranks
from gsx.core.training.importance import Probe, Removal
from gsx.core.training.photo_cache import PhotoCache
from gsx.core.training.validation import decibels, part_of
from gsx.experiments.reports.report import growth_chart
from gsx.modules.bilateral_grid import RANK, apply_grid
from gsx.modules.blur import Blur, BlurOptions
from gsx.modules.exposure import Exposure, ExposureOptions
from gsx.modules.motion_blur import motion_blurred

PUBLISHED = EventSteps(500, 15000, 100)
"""3D-GS: steps 600, 700, ... 14900."""


def options_of(capacity: str, **more: object) -> GS3DOptions:
    return replace(published_options(), capacity=capacity, **more)


# -- when, how many ----------------------------------------------------------------------------------------------------


def test_events_of_the_published_run() -> None:
    due = [step for step in range(1, 30001) if PUBLISHED.due(step)]
    assert due == list(range(600, 15000, 100))
    assert PUBLISHED.count() == len(due) == 144
    assert [PUBLISHED.passed(step) for step in (500, 600, 7700, 14900, 20000)] == [0, 1 / 144, 0.5, 1, 1]


@pytest.mark.parametrize(("start", "stop", "every"), [(17, 500, 43), (20, 600, 100), (0, 10, 3), (5, 7, 9), (0, 9, 3)])
def test_events_are_counted_for_any_schedule(start: int, stop: int, every: int) -> None:
    growing = EventSteps(start, stop, every)
    due = [step for step in range(stop + 50) if growing.due(step)]
    assert max(1, growing.count()) == max(1, len(due))
    assert [growing.passed(step) for step in due] == [(i + 1) / len(due) for i in range(len(due))]


def test_the_curve_of_a_budget_by_hand() -> None:
    """From 100 to 1,000: a quarter of the events, half of the way."""
    budget = Budget(BudgetOptions(primitives=1000), small_context(small_scene(spread(1))), EventSteps(0, 17, 2))
    assert [budget.target(100, step) for step in (0, 4, 16)] == [100, 550, 1000]
    assert budget.target(2000, 4) == 1500  # more points than primitives: the curve falls


@pytest.mark.parametrize(("points", "primitives"), [(120, 200), (120, 50)])
def test_a_budget_is_met(points: int, primitives: int, tmp_path: Path) -> None:
    words = (*LIGHT, "iterations=20", "backbone.capacity=budget", f"backbone.budget.primitives={primitives}")
    run = tiny_run(tmp_path, (*words, f"scene.points={points}", "backbone.density.prune_opacity=0"), stop_after=12)
    assert len(run.backbone.table) == primitives


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        (("backbone.capacity=most",), "backbone.capacity is 'most'; choose published, budget, adaptive, mcmc"),
        (("backbone.capacity=budget",), "capacity=budget and a number above 0"),
        (("backbone.budget.primitives=9",), "capacity=budget and a number above 0"),
        (("backbone.capacity=budget", "backbone.budget.primitives=6000000"), "above backbone.max_primitives"),
        (("backbone.adaptive.window=0",), r"backbone.adaptive.window is 0.0; give a number from 0.05 to 1"),
        (("backbone.adaptive.price=-1",), "backbone.adaptive.price is -1.0; give a number from 1e-06 to 100"),
    ],
)
def test_options_are_checked(words: tuple[str, ...], complaint: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=complaint):
        tiny_settings(tmp_path, *words)


@pytest.mark.parametrize("backbone", ["mip_splatting", "gs3d_zoom", "octree_gs3d", "scaffold", "octree_scaffold"])
def test_every_backbone_takes_every_capacity(backbone: str, tmp_path: Path) -> None:
    for words in (("backbone.capacity=adaptive",), ("backbone.capacity=budget", "backbone.budget.primitives=900")):
        tiny_settings(tmp_path, f"backbone={backbone}", *words)


# -- validation windows ------------------------------------------------------------------------------------------------


def adaptive(scene: Scene, growing: EventSteps = PUBLISHED, **more: float) -> Adaptive:
    return Adaptive(AdaptiveOptions(**more), small_context(scene), growing, 0)  # type: ignore[arg-type]


def test_windows_move_with_every_event_and_stay_between() -> None:
    scene = small_scene(spread(5), views=9)
    judge, model = adaptive(scene, views=3), small_gs3d(scene, options=options_of("adaptive"))

    def all_at(step: int) -> dict[str, Window]:
        found = {view.name: judge.validation_window(model.table, view, step) for view in scene.train}
        return {name: window for name, window in found.items() if window is not None}

    assert len(all_at(601)) == 3
    assert all_at(601) == all_at(700) != all_at(701)
    assert all_at(500) == {} == all_at(15000)
    for window in all_at(601).values():
        assert (window.width, window.height) == (12, 8)
        assert 0 <= window.left <= 12
        assert 0 <= window.top <= 8


def test_a_window_lies_where_it_is_told() -> None:
    view = small_scene(spread(5)).train[0]
    assert part_of(view, 0.5, 0.0, 1.0) == Window(0, 8, 12, 8)
    assert part_of(view, 1.0, 0.7, 0.2) == Window(0, 0, 24, 16)


def test_training_does_not_see_validation_windows(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """PhotoCache white in their windows train to the same bits, until the windows move."""
    words = (
        *LIGHT,
        "scene.train_views=4",
        "iterations=30",
        "training.checkpoint_every=3",
        "training.checkpoints_kept=9",
    )
    words = (*words, "backbone.capacity=adaptive", "backbone.density.stop=29000", "rasterizer=eager")
    plain = tiny_run(tmp_path / "plain", words, stop_after=9)
    model, learnt_from = plain.backbone, PhotoCache.of

    def disturbed(self: PhotoCache, view: View) -> Tensor:
        out = learnt_from(self, view).clone()
        window = model.validation_window(view, 2)  # type: ignore[attr-defined]
        if window is not None:
            out[:, *window.pixels] = 1
        return out

    monkeypatch.setattr(PhotoCache, "of", disturbed)
    tiny_run(tmp_path / "white", words, stop_after=9)
    before, after = (load_file(tmp_path / name / "checkpoints/step_0000003.safetensors") for name in ("plain", "white"))
    assert before.keys() == after.keys()
    assert all(torch.equal(before[name], after[name]) for name in before)
    whole, later = final_tensors(tmp_path / "plain"), final_tensors(tmp_path / "white")
    assert not torch.equal(later["parameters.sh_dc"], whole["parameters.sh_dc"])


# -- what ends growth --------------------------------------------------------------------------------------------------


def test_gain_in_decibels_by_hand() -> None:
    """Errors 8 + 2 instead of 9 + 1: nothing gained, and a spread of 1, -1: sqrt(2) over one window."""
    gain, error = decibels(torch.tensor([5.0, 5.0]).double(), torch.tensor([10.0, 10.0]).double())
    assert gain == pytest.approx(10 * math.log10(2))
    assert error == 0
    gain, error = decibels(torch.tensor([9.0, 1.0]).double(), torch.tensor([8.0, 2.0]).double())
    assert gain == 0
    assert error == pytest.approx(10 / math.log(10) * math.sqrt(2) * math.sqrt(2) / 10)


def test_an_event_on_anchors_adds_what_there_is_room_for(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []
    backbone = small_anchors("scaffold")
    monkeypatch.setattr(backbone.capacity, "room", lambda table, wanted, step: 7)
    monkeypatch.setattr(backbone.grid, "grow", lambda *given: asked.append(given[3]) or (0, 0))
    backbone.grow_and_prune(1600)
    assert asked == [7]


def test_a_cap_that_holds_growth_is_told() -> None:
    scene = small_scene(spread(50))
    model = small_gs3d(scene, options=options_of("adaptive"))
    cap_tiles = Adaptive(AdaptiveOptions(rate=0.3), small_context(scene), PUBLISHED, 57)
    assert cap_tiles.evaluate(model, lambda table: None, 700) == {"withheld": 8}  # 15 asked for, room for 7


def test_what_no_view_shows_outlives_a_budget() -> None:
    """Of a budget of 8 and 20 points: half lie behind the cameras."""
    points = spread(20)
    points[10:, 1] -= 50
    model = small_gs3d(small_scene(points), options=options_of("budget", budget=BudgetOptions(primitives=8)))
    model.capacity.evaluate(model, lambda table: None, 14900)
    assert len(model.table) == 8
    assert bool((model.table["means"][:, 1] < -40).all())


def test_a_budget_takes_as_much_from_what_any_view_shows(monkeypatch: pytest.MonkeyPatch) -> None:
    """Twelve views, each of a place of its own with twenty points: four are asked at an event, all at the last."""
    monkeypatch.setattr("gsx.backbones.capacity.MOST_VIEWS", 4)
    places = [10.0 * i for i in range(12)]
    cameras = [look_at([x, -4, 1], [x, 0, 0], fov_x=0.9, width=24, height=16) for x in places]
    points = torch.cat([spread(20, seed=i) + torch.tensor([x, 0, 0]) for i, x in enumerate(places)])
    scene = small_scene(points)
    scene = replace(scene, train=[View(f"view{i}", camera, Grey()) for i, camera in enumerate(cameras)])
    model = small_gs3d(scene, options=options_of("budget", budget=BudgetOptions(primitives=120)))

    def left() -> list[int]:
        return (model.table["means"].detach()[:, 0] / 10).round().long().bincount(minlength=12).tolist()

    model.capacity.evaluate(model, lambda table: None, 4100)  # a quarter of the events: half of the way, 60 too many
    assert sum(left()) == 240 - 60 * 4 // 12
    assert left().count(20) >= 8
    model.capacity.evaluate(model, lambda table: None, 14900)
    assert sum(left()) == 120
    assert min(left()) >= 3


@pytest.mark.parametrize(("capacity", "part"), [("budget", "budget"), ("adaptive", "capacity")])
def test_a_run_without_an_event_is_told_that_nothing_is_decided(capacity: str, part: str) -> None:
    scene = small_scene(spread(20), views=30)
    options = options_of(capacity, budget=BudgetOptions(primitives=10 * (capacity == "budget")))
    plan = small_gs3d(scene, options=options, iterations=40).plan()
    assert plan[part]["caution"].startswith("has no effect: density control acts at no step of this run, every 30")
    assert "caution" not in small_gs3d(scene, options=options, iterations=400).plan()[part]


def test_nothing_grows_beyond_the_end_of_a_run() -> None:
    """Even where growth is to stop later than the published run: what learns on keeps its rows."""
    growing = small_gs3d(
        small_scene(spread(20)), options=published_options(stop=40000), iterations=30000
    ).control.events
    assert growing.due(30000)
    assert not any(growing.due(step) for step in range(30001, 40001))


def masked(view: View) -> torch.Tensor:
    """Nothing of it counts."""
    return torch.zeros(view.camera.height, view.camera.width, dtype=torch.bool)


def test_masked_windows_tell_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(View, "counted", masked)
    scene = small_scene(spread(40))
    model = small_gs3d(scene, options=options_of("adaptive"))
    half = with_rows(model.table, torch.arange(40) < 20)
    judge = adaptive(scene)
    assert judge.measure(model, lambda table: half, 700) == {}
    assert judge.gain_of_rows(model, torch.arange(40) < 20, 700) == 0
    assert not len(model.table.record["trials"])


@dataclass(frozen=True, kw_only=True)
class Told(Ranks):
    """The first of two processes, and then the other, which is told what the first has found."""

    said: list[Any]

    def broadcast(self, make: Callable[[], Any]) -> Any:
        if not self.first:
            return self.said.pop(0)
        self.said.append(make())
        return self.said[-1]


@pytest.mark.parametrize("name", ["budget", "adaptive"])
def test_all_processes_do_what_the_first_has_found(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """The second would find otherwise: its renders tell it nothing."""
    scene = small_scene(spread(40))
    models, said = [], list[Any]()
    for rank in range(2):
        options = options_of(name, budget=BudgetOptions(primitives=20 * (name == "budget")))
        context = replace(small_context(scene), ranks=Told(rank=rank, size=2, said=said))
        if rank:
            for method in ("removal", "window_errors", "row_errors"):
                monkeypatch.setattr(Probe, method, None)
        model = gs3d(options, context)
        for step in (600, 700, 14900):
            model.table.statistics |= {key: torch.ones(len(model.table)) for key in ("absolute", "count")}
            model.densify_and_prune(step)
        models.append((model.table["means"], context.generator.get_state()))
    (own, state), (other, after) = models
    assert not said
    assert len(own) != 40
    assert torch.equal(own, other)
    assert torch.equal(state, after)


def trials(*rates: float) -> Tensor:
    """Rows of a record: step, primitives, added, gain, error, rate."""
    return torch.tensor([[600.0, 100, 10, 1, 0, rate] for rate in rates], dtype=torch.float64).view(-1, 6)


def test_growth_is_as_fast_as_the_last_event_has_earned() -> None:
    scene = small_scene(spread(50))
    judge, table = adaptive(scene, rate=0.1), small_gs3d(scene, options=options_of("adaptive")).table
    for rates, room in (((), 5), ((0.2,), 10), ((0.2, 0.3), 15), ((0.2, 0.024), 0)):
        table.record["trials"] = trials(*rates)
        assert judge.room(table, 50, 700) == room
        assert judge.ended(table) == (room == 0)
    assert adaptive(scene).room(table, 50, 14900) == 0  # the last event


@pytest.mark.parametrize(("every", "room"), [(50, 10), (100, 23), (200, 57)])
def test_growth_goes_by_steps_not_by_events(every: int, room: int) -> None:
    """46 % of 50 over a hundred steps: 23; by two events in that time 20.83 % each, by one of twice that 113.16 %."""
    scene = small_scene(spread(50))
    table = small_gs3d(scene, options=options_of("adaptive")).table
    judge = Adaptive(AdaptiveOptions(rate=0.46), small_context(scene), EventSteps(500, 15000, every), 0)
    assert judge.room(table, 50, 700) == room


def test_the_cap_holds_growth() -> None:
    scene = small_scene(spread(50))
    table = small_gs3d(scene, options=options_of("adaptive")).table
    cap_tiles = Adaptive(AdaptiveOptions(rate=0.3), small_context(scene), PUBLISHED, 57)
    assert cap_tiles.room(table, 50, 700) == 7


@pytest.mark.parametrize(("had", "price", "rate"), [(2.0, 0.4, 0.2), (1.0, 0.6, 0.05), (10**0.06, 0.2, 0.1)])
def test_the_rate_follows_the_gain(had: float, price: float, rate: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """Twice as many primitives; a third of what they gain counts. Half the error: 2.5 times the price, 2 at most.
    The same error: nothing, half of the rate at least. 0.6 dB: the price."""
    scene = small_scene(spread(50))
    model = small_gs3d(scene, options=options_of("adaptive"))
    judge = Adaptive(AdaptiveOptions(price=price, discount=1 / 3, rate=0.1), small_context(scene), PUBLISHED, 0)
    half = small_gs3d(small_scene(spread(25)), options=options_of("adaptive")).table
    errors = {50: torch.full((4,), 1e9).double(), 25: torch.full((4,), had * 1e9).double()}
    monkeypatch.setattr(Probe, "window_errors", lambda probe, windows: errors[len(probe.model.table)])
    found = judge.evaluate(model, lambda table: half, 700)
    assert judge.rate(model.table) == pytest.approx(rate, rel=1e-5)
    assert found["gain"] == pytest.approx(10 * math.log10(had) / 3, abs=1e-5)
    assert model.table.record["trials"][0, :3].tolist() == [700, 50, 25]


@dataclass(frozen=True)
class Printed:
    """A photograph that was taken before."""

    picture: Tensor

    def image(self, camera: Camera) -> Tensor:
        return self.picture

    def max_zoom(self, camera: Camera) -> float:
        return 1.0


@pytest.mark.parametrize("how", ["dark", "bright", "moved", "shaded"])
def test_photographs_are_compared_with_what_they_would_show_of_the_model(how: str) -> None:
    """They show the model itself at half its brightness, at two and a half times that so that they saturate, by
    cameras that moved, or brighter to the right: where that is known it has no error to speak of, and half
    of it does far worse."""
    bare = small_scene(spread(40), torch.full((40, 3), 200, dtype=torch.uint8), background=0.1)
    model, gain = small_gs3d(bare, options=options_of("adaptive")), {"dark": 0.5, "bright": 2.5}.get(how, 1.0)
    across, shown = 3.0 if how == "moved" else 0.0, []
    light = torch.zeros(RANK, 3, 4)
    light[1, :, :3] = 0.5 * torch.eye(3) if how == "shaded" else 0.0
    for view in bare.train:
        splats = model.draw(view.camera, 700).splats
        image = rasterize(splats, view.camera, model.raster, background=bare.background).image.detach()
        photographed = gain * apply_grid(motion_blurred(image, across, 0.0), light)
        shown.append((255 * photographed).round().clamp(0, 255).byte())
    scene = replace(bare, train=[replace(v, source=Printed(p)) for v, p in zip(bare.train, shown, strict=True)])
    half, lost, found = with_rows(model.table, torch.arange(40) < 20), [], []
    exposure, blur = (
        build_module(Exposure, ExposureOptions(), scene=scene),
        build_module(Blur, BlurOptions(), scene=scene),
    )
    for known in (False, True):
        if known and how == "moved":
            blur.movements = {view.name: (across / view.camera.width, 0.0) for view in scene.train}
        elif known:
            matrices = torch.cat([gain * torch.eye(3), torch.zeros(3, 1)], 1).repeat(len(scene.train), 1, 1)
            grids = {"grids": light.repeat(len(scene.train), 1, 1, 1)} if how == "shaded" else {}
            exposure.start(matrices=matrices, **grids)
        context = small_context(scene, modules={"exposure": exposure, "blur": blur})
        judge = Adaptive(AdaptiveOptions(window=0.5 if how == "shaded" else 1.0), context, PUBLISHED, 0)
        lost.append(judge.gain(model, model.table, half, 700)[0])
        found.append(worth_in_training(model, context, 700))
    assert lost[1] > lost[0] + 5
    assert found[0].error_share > 4 * found[0].rounding_share
    assert found[1].error_share < 2 * found[1].rounding_share


def half_of_it_faint() -> tuple[Scene, GS3D]:
    """40 Gaussians before a grey background, of which half are too faint to be seen."""
    scene = small_scene(spread(40), torch.full((40, 3), 200, dtype=torch.uint8), background=128 / 255)
    model = small_gs3d(scene, options=options_of("adaptive"))
    with torch.no_grad():
        model.table["opacity_logits"][:20] = -1
        model.table["opacity_logits"][20:] = -15
        model.table["log_scales"].fill_(-1.5)
    return scene, model


def test_what_no_picture_needs_is_removed_at_the_last_event() -> None:
    """What is too faint to be seen goes, and of the others those that make a difference stay."""
    scene, model = half_of_it_faint()
    judge = adaptive(scene, price=0.2)
    assert judge.evaluate(model, lambda table: None, 700) == {}
    done = judge.evaluate(model, lambda table: None, 14900)
    assert done["removed"] >= 20
    assert len(model.table) == 40 - done["removed"] > 0
    assert bool((model.table["opacity_logits"] > -15).all())


def test_what_rounding_hides_is_removed_though_photographs_are_met(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without an error, a share of it would be a price that nothing is below."""
    monkeypatch.setattr(Probe, "difference", lambda probe, image, *_: torch.zeros_like(image))
    scene, model = half_of_it_faint()
    assert adaptive(scene).evaluate(model, lambda table: None, 14900)["removed"] == 20
    assert bool((model.table["opacity_logits"] > -15).all())


def worth(*squares: float) -> Removal:
    """Of rows that a view shows, whose error is so large that none is worth it."""
    worths = torch.tensor(squares)
    return Removal(squares=worths, views=torch.ones_like(worths), error_share=1e9, rounding_share=0.0)


def test_unjudged_growth_is_published_growth_of_which_goes_what_no_picture_needs() -> None:
    scene, model = half_of_it_faint()
    own = Adaptive(AdaptiveOptions(judged=False), small_context(scene), PUBLISHED, 1000)
    assert own.room(model.table, sys.maxsize, 700) == 1000 - len(model.table)
    assert own.evaluate(model, lambda table: pytest.fail("nothing is tried"), 700) == {}
    assert all(own.validation_window(model.table, view, 650) is None for view in scene.train)
    assert own.room(model.table, sys.maxsize, 14900) == 0
    before = len(model.table)
    assert own.evaluate(model, lambda table: None, 14900) == {"removed": before - len(model.table)}
    assert len(model.table) < before


def test_at_most_three_quarters_of_the_rows_go_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """None of five is worth the price beside the others: the three go that are worth least."""
    monkeypatch.setattr("gsx.backbones.adaptive.worth_in_training", lambda *_: worth(3.0, 1.0, 4.0, 0.5, 9.0))
    scene = small_scene(spread(5))
    model = small_gs3d(scene, options=options_of("adaptive"))
    means = model.table["means"].detach().clone()
    assert adaptive(scene).evaluate(model, lambda table: None, 14900) == {"removed": 3}
    assert torch.equal(model.table["means"], means[[2, 4]])
    assert float(model.table.record["removed_share"]) == 0.6


@pytest.mark.parametrize(("rate", "before", "asked"), [(0.001, 0.1, True), (0.001, 0.09, False), (0.2, 0.5, False)])
def test_events_go_on_asking_once_growth_has_ended_while_much_goes(
    rate: float, before: float, asked: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("gsx.backbones.adaptive.worth_in_training", lambda *_: worth(3.0, 1.0, 4.0, 0.5, 9.0))
    scene = small_scene(spread(5))
    model = small_gs3d(scene, options=options_of("adaptive"))
    model.table.record |= {"trials": trials(rate), "removed_share": torch.tensor(before, dtype=torch.float64)}
    assert adaptive(scene).evaluate(model, lambda table: None, 800) == ({"removed": 3} if asked else {})


@pytest.mark.parametrize(
    ("fine", "middle", "coarse", "left"),
    [
        (1.0001, 1.0001, 1.5, [0]),  # both finer levels gain next to nothing
        (1.0001, 1.5, 1.0001, [0, 1]),  # what coarse ones gain is told, but those before which finer ones are stay
        (1.5, 1.0001, 1.5, [0, 1, 2]),
        (1.0, 1.0001, 1.5, [0, 1, 2]),  # of what no window shows nothing is known
    ],
)
def test_finest_levels_that_gain_too_little_are_removed(
    fine: float, middle: float, coarse: float, left: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Levels of 8, 16, 16 primitives; errors are told by which levels there are, times 1e9."""
    scene = small_scene(spread(40))
    model = small_gs3d(scene, options=options_of("adaptive"))
    model.table.columns["level"] = torch.tensor([0] * 8 + [1] * 16 + [2] * 16, dtype=torch.int16)
    factors = {0: coarse, 1: middle, 2: fine}

    def errors(probe: Probe, windows: object) -> Tensor:
        missing = [factors[level] for level in factors if not bool((probe.model.table["level"] == level).any())]
        return torch.full((4,), 1e9 * math.prod(missing)).double()

    monkeypatch.setattr(Probe, "window_errors", errors)
    judge = Adaptive(AdaptiveOptions(price=0.1, discount=1 / 3), small_context(scene), PUBLISHED, 0)
    found = judge.remove_idle_levels(model, 700)
    assert model.table["level"].unique().tolist() == left
    assert found["levels_removed"] == 3 - len(left)
    gain = 10 * math.log10(fine) / 3 / math.log2(40 / 24)
    assert found["gain_of_level_2"] == pytest.approx(gain, abs=1e-6)
    assert len(found) == (3 if left == [0] else 4)  # the last one left is not judged


@pytest.mark.parametrize(("level", "left"), [(1, [0]), (0, [0, 1])])
def test_a_level_that_a_render_hardly_shows_is_removed_if_it_is_the_finest(level: int, left: list[int]) -> None:
    """Two levels of black anchors before photographs that are grey; one of them is nearly transparent."""
    words = (
        "levels.count=2",
        "levels.mode=ceil",
        "levels.base_layer=2",
        "levels.coarse_until=0",
        "levels.visible_threshold=0",
        "capacity=adaptive",
    )
    scene = small_scene(spread(60), torch.zeros(60, 3, dtype=torch.uint8), background=128 / 255)
    model = small_anchors("octree_gs3d", *words, scene=scene)
    levels = model.table["level"]
    assert levels.unique().tolist() == [0, 1]
    with torch.no_grad():
        model.table["opacity_logits"].fill_(2.0)
        model.table["opacity_logits"][levels == level] = -5.0
        model.table["sh_dc"][levels != level] = 0.0  # grey, as photographs
    found = model.capacity.remove_idle_levels(model, 30000)
    assert model.table["level"].unique().tolist() == left
    assert found["gain_of_level_1"] != 0


def test_levels_are_judged_when_growth_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    """Once, while no step has seen the windows: at the event that ends growth, or at the last one."""
    scene = small_scene(spread(40))
    for rate, step, asked in ((0.1, 700, 0), (0.1, 14900, 1), (0.001, 14900, 0)):
        calls = list[int]()
        monkeypatch.setattr(
            Adaptive, "remove_idle_levels", lambda judge, model, step, calls=calls: calls.append(step) or {}
        )
        model = small_gs3d(scene, options=options_of("adaptive"))
        model.table.record["trials"] = trials(rate)
        adaptive(scene, price=0.2).evaluate(model, lambda table: None, step)
        assert len(calls) == asked


class RightHalf(Grey):
    """PhotoCache that are transparent left of their middle; `all_of_it`: everywhere."""

    all_of_it = False

    def transparent(self, camera: Camera) -> Tensor:
        column = torch.arange(camera.width).expand(camera.height, -1)
        return (column < camera.width // 2) | self.all_of_it


@pytest.mark.parametrize("all_of_it", [False, True])
def test_adaptive_growth_starts_without_points_in_empty_space(all_of_it: bool) -> None:
    """Those on the left of two photographs and more go at the first step; where that is all, none does."""
    source, scene = RightHalf(), small_scene(spread(60))
    source.all_of_it = all_of_it
    scene = replace(scene, train=[replace(view, source=source) for view in scene.train])
    left = torch.stack([v.camera.project(scene.points.positions)[0][:, 0] < 12 for v in scene.train]).sum(0) >= 2
    assert 10 < int(left.sum()) < 50
    models = {name: small_gs3d(scene, options=options_of(name)) for name in ("adaptive", "published")}
    done = {name: [model.densify_and_prune(step) for step in (1, 2)] for name, model in models.items()}
    kept = scene.points.positions if all_of_it else scene.points.positions[~left]
    assert torch.equal(models["adaptive"].table["means"].detach(), kept)
    assert done["adaptive"] == [{} if all_of_it else {"cleared": int(left.sum())}, {}]
    assert done["published"] == [{}, {}]
    assert len(models["published"].table) == 60


def test_reports_show_what_growth_gained() -> None:
    lines = [{"step": s, "judged": n, "gain": g, "price": 0.8} for s, n, g in ((6, 100, 2.0), (12, 150, 0.5))]
    chart = growth_chart([{"step": 1}, *lines])
    assert chart.count("<polyline") + chart.count("<path") >= 2
    assert growth_chart([{"step": 1}, {"step": 2, "judged": 3}]) == ""
    assert growth_chart([]) == ""


DENSE = ("start=0", "stop=28000", "gradient=1e-7", "every=1000")
"""Events at steps 3, 6 and, of backbones published with 30,000 steps, 9 of 12."""


@pytest.mark.parametrize(
    ("words", "part"),
    [
        (("backbone=gs3d", "backbone.sh_judged=0.5"), "density"),
        (("backbone=octree_gs3d", "backbone.densification=clone_split"), "clone_split.density"),
        (
            (
                *("backbone=scaffold", "backbone.adaptive.judged=true"),
                *("backbone.growth.observe_from=0", "backbone.growth.success=0.1"),
            ),
            "growth",
        ),
    ],
    ids=["free", "levels", "anchors"],
)
def test_adaptive_runs_resume_bit_for_bit(words: tuple[str, ...], part: str, tmp_path: Path) -> None:
    """What was found and decided is in the checkpoint."""
    dense = [f"backbone.{part}.{word}" for word in DENSE]
    words = (*words, *dense, *LIGHT, "iterations=12", "backbone.capacity=adaptive", "rasterizer=eager")
    tiny_run(tmp_path / "whole", words, evaluated=False)
    stopped_at(tmp_path / "parts", words, 5, 7)
    expected = same_ending(tmp_path / "whole", tmp_path / "parts")
    assert len(expected["record.trials"]) > 0
    lines = [json.loads(line) for line in (tmp_path / "whole" / "metrics.jsonl").read_text().splitlines()]
    judged = [(line["step"], line["judged"], line["gain"]) for line in lines if "judged" in line]
    assert judged == [tuple(trial[[0, 1, 3]].tolist()) for trial in expected["record.trials"]]
