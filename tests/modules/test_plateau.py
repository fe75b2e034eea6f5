"""Steps that are left out: when steps are judged, by which numbers, what is learnt from meanwhile, resume."""

import json
import math
from collections import Counter
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from module_contexts import build_module
from small_scene import small_scene, spread
from tiny import final_tensors, same_ending, stopped_at, tiny_run, tiny_settings
from torch import Tensor

from gsx.core.data.camera import look_at
from gsx.core.data.scene import View
from gsx.core.data.window import Window
from gsx.core.errors import ConfigError
from gsx.core.training.photo_cache import PhotoCache
from gsx.core.training.pseudo_views import PseudoView, mask_windows, pseudo_loss
from gsx.core.training.run import Run
from gsx.core.training.validation import rounding_in
from gsx.experiments.runs.build import build
from gsx.experiments.runs.load_scene import load_scene
from gsx.modules.plateau import Plateau, PlateauOptions

WORDS = (
    "backbone.density.stop=6000",
    "iterations=40",
    "training.plateau.start=0.25",
    "rasterizer=eager",
    "training.log_every=1",
    "training.test_points=0",
    "scene.points=100",
    "backbone.max_primitives=150",
    "eval.zoom=[1]",
)
"""Six views: windows begin after step 10, are judged after step 16, then after 22 and 28; the last part is from 32."""
LEAVES_OUT = (*WORDS, "training.plateau.price=100")


def steps_of(folder: Path) -> list[int]:
    """Steps that a run took."""
    return [json.loads(line)["step"] for line in (folder / "metrics.jsonl").read_text().splitlines()]


def plateau_of(price: float, views: int, iterations: int = 1000) -> Plateau:
    return build_module(Plateau, PlateauOptions(price=price), iterations=iterations, views=views)


def run_with(*milestones: int) -> SimpleNamespace:
    """A run in which something else happens once before these steps."""
    other = SimpleNamespace(milestones=lambda: milestones)
    return SimpleNamespace(backbone=None, modules={"other": other})


def started(price: float, before: list[float], step: int = 500) -> Plateau:
    """125 views; windows began with these errors."""
    plateau = plateau_of(price, 125)
    plateau.start_test(step, torch.tensor(before, dtype=torch.float64))
    return plateau


def windows_of(*sides: int) -> dict[View, Window]:
    views = small_scene(spread(1), views=len(sides)).train
    return {view: Window(0, 0, side, side) for view, side in zip(views, sides, strict=True)}


def test_when_steps_are_judged() -> None:
    """A tenth of the steps so far or a pass over the views, whatever is more; while there are steps to leave out."""
    plateau, run = plateau_of(1.0, 52), run_with()
    assert [step for step in range(1000) if plateau.test_starts_after(run, step)] == [500]
    plateau.start_test(500, torch.zeros(1))
    assert [step for step in range(1000) if plateau.test_ends_after(run, step)] == [552]
    assert plateau.test_starts_after(run, 552)
    plateau.start_test(700, torch.zeros(1))
    assert [step for step in range(1000) if plateau.test_ends_after(run, step)] == [770]
    assert not plateau.test_starts_after(run, 770)  # its windows would be judged after step 847
    free = plateau_of(0.0, 52)
    assert not any(free.test_starts_after(run, step) for step in range(1000))


def test_nothing_that_is_due_once_is_left_out() -> None:
    plateau, run = plateau_of(1.0, 52), run_with(625)
    assert [step for step in range(1000) if plateau.test_starts_after(run, step)] == [625]


def test_windows_of_another_schedule_are_not_judged() -> None:
    """The run has become longer since: they began before density control ends now."""
    plateau, run = plateau_of(1.0, 52, iterations=2000), run_with()
    plateau.start_test(500, torch.zeros(1))
    assert not any(plateau.test_ends_after(run, step) for step in range(2000))
    assert [step for step in range(2000) if plateau.test_starts_after(run, step)] == [1000]


@pytest.mark.parametrize(("price", "left_out"), [(9.5, range(626, 800)), (9.0, range(0))])
def test_gain_by_hand(price: float, left_out: range) -> None:
    """Half the error by a quarter more steps: 3.01 dB by 0.32 doublings, 9.35 dB a doubling."""
    plateau = started(price, [6e6, 2e6])
    plateau.finish_test(windows_of(10, 10), torch.tensor([3e6, 1e6], dtype=torch.float64), 625)
    assert plateau.gains[0, :2].tolist() == pytest.approx([625, 10 * math.log10(2) / math.log2(1.25)])
    assert plateau.skipped == left_out
    told = {"step_gain": float(plateau.gains[0, 1]), "step_price": price}
    assert plateau.metrics_at(626) == told
    assert plateau.metrics_at(800) == (told | {"steps_left_out": 174} if left_out else {})
    assert plateau.metrics_at(627) == {}


def test_errors_below_the_rounding_of_photographs_are_no_gain() -> None:
    plateau = started(0.1, [1e-9])
    plateau.finish_test(windows_of(16), torch.tensor([1e-12], dtype=torch.float64), 625)
    assert plateau.skipped


def test_rounding_counts_where_pixels_do(monkeypatch: pytest.MonkeyPatch) -> None:
    """Three values a pixel, each off by 1 / 255 / sqrt(12) in the mean; ten pixels of the second view do not count."""
    windows = windows_of(10, 8)
    masked, counted = list(windows)[1], torch.ones(16, 24, dtype=torch.bool)
    counted[0, :10] = False
    monkeypatch.setattr(View, "counted", lambda self: counted if self is masked else None)
    assert rounding_in(windows).tolist() == pytest.approx([300 / 12 / 255**2, 3 * (64 - 8) / 12 / 255**2])


def test_masked_windows_leave_no_step_out(monkeypatch: pytest.MonkeyPatch) -> None:
    """They are not judged, and others take their place."""
    monkeypatch.setattr(View, "counted", lambda view: torch.zeros(*reversed(view.camera.size), dtype=torch.bool))
    plateau = started(9.5, [0.0, 0.0])
    plateau.finish_test(windows_of(10, 10), torch.zeros(2, dtype=torch.float64), 625)
    assert not plateau.skipped
    assert not len(plateau.gains)
    assert not plateau.testing(run_with())


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> tuple[Run, Path]:
    """(a finished run that left steps out, its folder)."""
    folder = tmp_path_factory.mktemp("whole") / "run"
    return tiny_run(folder, LEAVES_OUT, evaluated=False), folder


def test_steps_that_gain_too_little_are_left_out(whole: tuple[Run, Path]) -> None:
    run, folder = whole
    assert steps_of(folder) == [*range(1, 17), *range(32, 41)]
    assert run.modules["plateau"].gains[:, 0].tolist() == [16]
    assert run.progress.curves[16]["steps_left_out"] == 15


@pytest.mark.parametrize(
    ("more", "first"),
    [
        ((), 20),  # published density control ends with half of the steps
        (("backbone.density.stop=6000",), 10),
        (("backbone.density.stop=6000", "backbone.sh_judged=0.7"), 28),
        (("backbone.density.stop=6000", "backbone.sh_judged=0.8"), 10),  # done with the first step that is taken again
        (("backbone.density.stop=6000", "training.exposure.when=always", "training.exposure.until=0.5"), 21),
        (("backbone.density.stop=6000", "training.supersampling.factor=2", "training.supersampling.start=0.6"), 24),
        (("backbone.density.stop=6000", "training.coarse_to_fine.factor=2", "training.coarse_to_fine.until=0.3"), 12),
    ],
)
def test_steps_are_judged_when_all_else_is_settled(more: tuple[str, ...], first: int, tmp_path: Path) -> None:
    words = [word for word in WORDS if not word.startswith("backbone.density")]
    settings = tiny_settings(tmp_path, *words, "training.plateau.price=1", *more)
    run = build(settings, load_scene(settings), tmp_path, training=True)
    assert run.modules["plateau"].first_test(run) == first


@pytest.fixture
def seen(monkeypatch: pytest.MonkeyPatch) -> list[PseudoView]:
    """Pseudo views that steps learn from."""
    learnt = list[PseudoView]()

    def noted(image: Tensor, view: PseudoView, *more: Any) -> Tensor:
        learnt.append(view)
        return pseudo_loss(image, view, *more)

    monkeypatch.setattr("gsx.core.training.pseudo_terms.pseudo_loss", noted)
    return learnt


def test_pseudo_details_whose_event_was_left_out_begin_late(tmp_path: Path, seen: list[PseudoView]) -> None:
    """Windows of eight steps begin after steps 21, 28 and 36: of the second, step 32 is the first that is taken."""
    timing = [f"augmenter.upscale.timing.{word}" for word in ("start=21000", "every=7500", "span=7500")]
    words = (*LEAVES_OUT, "augmenter=upscale", "regenerator/upscale=lanczos", *timing)
    run = tiny_run(tmp_path / "run", words)
    assert steps_of(tmp_path / "run") == [*range(1, 17), *range(32, 41)]
    events = {line["step"]: line["pseudo"]["upscale"]["event"] for line in run.progress.curves if "pseudo" in line}
    assert events == {32: 31, 37: 36}
    assert all("upscale" in line["terms"] for line in run.progress.curves if line["step"] >= 32)
    late = [view for view in seen if view.provenance["event"] == 28]
    assert {view.provenance["made_after_step"] for view in late} == {31}


def test_every_step_is_taken_that_gains_enough(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gsx.modules.plateau.decibels", lambda has, had: (1.0, 0.0))
    run = tiny_run(tmp_path / "run", (*WORDS, "training.plateau.price=0.1"))
    assert steps_of(tmp_path / "run") == list(range(1, 41))
    assert run.modules["plateau"].gains[:, 0].tolist() == [16, 22, 28]


def test_training_does_not_see_the_windows(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """PhotoCache white in them train to the same bits as long as they stay; where they are seen again, to others."""
    words, photograph = (*WORDS, "training.plateau.price=1e-6"), PhotoCache.of
    plain = tiny_run(tmp_path / "plain", words, stop_after=16)
    own = {view.name: window for view, window in plain.modules["plateau"].windows(plain.scene.train, 10).items()}
    assert len(own) == 6
    taken = list[int]()

    def disturbed(self: PhotoCache, view: View) -> Tensor:
        taken.append(0)
        out = photograph(self, view).clone()
        if len(taken) > 10:
            out[:, *own[view.name].pixels] = 1
        return out

    monkeypatch.setattr(PhotoCache, "of", disturbed)
    tiny_run(tmp_path / "white", words, stop_after=16)
    taken.clear()
    tiny_run(tmp_path / "later", words, stop_after=18)
    monkeypatch.undo()
    tiny_run(tmp_path / "longer", words, stop_after=18)
    plain_end, white, later, longer = (final_tensors(tmp_path / name) for name in ("plain", "white", "later", "longer"))
    parameters = [name for name in plain_end if name.startswith("parameters.")]
    assert all(torch.equal(plain_end[name], white[name]) for name in parameters)
    assert not all(torch.equal(later[name], longer[name]) for name in parameters)


def test_pseudo_details_do_not_show_the_windows(tmp_path: Path, seen: list[PseudoView]) -> None:
    """Of photographs at their own and at twice their scale, while the windows that began after step 10 are there."""
    timing = [f"augmenter.upscale.timing.{word}" for word in ("start=8000", "every=28000", "span=28000")]
    more = ("augmenter=upscale", "regenerator/upscale=lanczos", "augmenter.upscale.scales=[1,2]", *timing)
    run = tiny_run(tmp_path, (*WORDS, "training.plateau.price=1e-6", *more), stop_after=15)
    before, since = seen[: 2 * 2], seen[2 * 2 :]  # steps 9 and 10, two scales each
    windows = list(run.modules["plateau"].windows(run.scene.train, 10).items())
    assert all(view.pixel_weight is None for view in before)
    hidden = Counter[int]()
    for pseudo in since:
        (parent, window), camera = windows_by_parent(windows, run)[pseudo.parent], pseudo.camera
        rows, columns = (torch.arange(side) + 0.5 for side in (camera.height, camera.width))
        x = (columns - camera.cx) / camera.fx * parent.camera.fx + parent.camera.cx
        y = (rows - camera.cy) / camera.fy * parent.camera.fy + parent.camera.cy
        across = (x > window.left) & (x < window.left + window.width)
        down = (y > window.top) & (y < window.top + window.height)
        inside = down[:, None] & across
        weight = torch.full(inside.shape, 255) if pseudo.pixel_weight is None else pseudo.pixel_weight
        assert not bool(weight[inside].any())
        assert bool((weight[~inside] == 255).all())
        assert pseudo.coarse is None or not bool(inside.any())
        hidden[pseudo.provenance["scale"]] += int(inside.sum())
    assert min(hidden[1], hidden[2]) > 0


@pytest.mark.parametrize(
    ("provenance", "corrected", "hidden"),
    [
        ({}, False, 12),
        ({"kind": "base"}, True, 12),
        ({"kind": "coarser"}, True, 12),
        ({"source": "photo"}, True, 12),
        ({"kind": "random"}, True, 0),
    ],
)
def test_where_a_pseudo_view_shows_a_window_is_told_by_what_it_was_made_from(
    provenance: dict[str, str], corrected: bool, hidden: int
) -> None:
    camera = look_at((0, -3, 0), (0, 0, 0), fov_x=0.7, width=12, height=8)
    now = replace(camera, translation=camera.translation + 0.01) if corrected else camera
    target = torch.zeros(3, 8, 12, dtype=torch.uint8)
    view = PseudoView(camera=camera, target=target, parent=0, provenance=provenance)
    weight = mask_windows(view, now, [Window(5, 2, 4, 3)]).pixel_weight
    assert (0 if weight is None else int((weight[2:5, 5:9] == 0).sum())) == hidden
    assert weight is None or int((weight == 255).sum()) == 12 * 8 - hidden


def windows_by_parent(windows: list[tuple[View, Window]], run: Run) -> dict[int, tuple[View, Window]]:
    """By the number of the training view."""
    return {list(run.scene.train).index(view): (view, window) for view, window in windows}


def test_resuming_equals_never_having_stopped(whole: tuple[Run, Path], tmp_path: Path) -> None:
    """Before the windows are judged, just then, and after steps were left out."""
    stopped_at(tmp_path / "parts", LEAVES_OUT, 15, 16, 33)
    same_ending(whole[1], tmp_path / "parts")
    assert steps_of(tmp_path / "parts") == steps_of(whole[1])


def test_options_are_checked_together(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"training.plateau.start is 0.9 and training.plateau.to 0.8"):
        tiny_settings(tmp_path, "training.plateau.price=0.1", "training.plateau.start=0.9")
