"""Trials of corrections: what is masked, which stretch stays, by which numbers, and equal bits after going back."""

import math
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from module_contexts import build_module
from small_scene import small_scene, spread
from tiny import final_tensors, stopped_at, tiny_run, tiny_settings

from gsx.builtin import plugins
from gsx.core.data.window import Window
from gsx.core.training.parameter_table import table_tensors
from gsx.core.training.run import Run
from gsx.core.training.trainer import train_step
from gsx.experiments.runs.build import build
from gsx.experiments.runs.load_scene import load_scene
from gsx.modules.exposure import Exposure, ExposureOptions
from gsx.modules.poses import PoseOptions, Poses
from gsx.modules.trial import (
    RunState,
    Stretch,
    Trial,
    TrialOptions,
    WindowPair,
    error_at_best_gains,
    gain_of,
    return_to,
    state_of,
)

WORDS = (
    "iterations=60",
    "training.exposure.when=auto",
    "scene.disturb.exposure=0.3",
    *("training.trial.steps=0.2", "training.trial.passes=9"),
    "training.trial.window=0.3",
    "backbone.density.stop=6000",
    "scene.points=100",
    "training.log_every=1",
    "eval.zoom=[1]",
)
"""Exposures are tested before step 13, since photos differ; stretches have 12 steps."""


def silent_steps(run: Run, count: int) -> None:
    for _ in range(count):
        train_step(run, plugins())


def fresh_run(folder: Path, *more: str) -> Run:
    settings = tiny_settings(folder, *more)
    return build(settings, load_scene(settings), folder, training=True)


# -- going back --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("backbone", ["gs3d_zoom", "octree_scaffold"])
def test_a_run_that_goes_back_repeats_its_bits(tmp_path: Path, backbone: str) -> None:
    run = fresh_run(tmp_path, f"backbone={backbone}", "iterations=30")
    silent_steps(run, 4)
    state = state_of(run)
    silent_steps(run, 9)
    first = {name: value.detach().clone() for name, value in table_tensors(run.backbone.table).items()}
    return_to(run, state)
    assert run.step == 4
    silent_steps(run, 9)
    again = table_tensors(run.backbone.table)
    assert first.keys() == again.keys()
    assert all(torch.equal(first[name], again[name]) for name in first)


# -- windows -----------------------------------------------------------------------------------------------------------


def test_windows_are_masked_during_a_trial_only() -> None:
    scene = small_scene(spread(5), views=3)
    trial = build_module(Trial, TrialOptions(steps=0.04), scene=scene)
    assert trial.transform_views(scene.train, 1) is scene.train
    trial.set_windows({1: Window(2, 3, 4, 5)})
    views = trial.transform_views(scene.train, 1)
    assert views[0] is scene.train[0]
    counted = views[1].counted()
    assert counted is not None
    assert int((~counted).sum()) == 20
    assert not counted[3:8, 2:6].any()
    assert trial.transform_views(scene.train, 2) is views
    trial.set_windows({})
    assert trial.transform_views(scene.train, 3) is scene.train


# -- numbers -----------------------------------------------------------------------------------------------------------


def test_errors_are_those_at_the_best_gain_of_each_channel() -> None:
    image = torch.tensor([1.0, 2.0]).expand(3, 1, 2).clone()
    photo = torch.tensor([[2.0, 4.0], [1.0, 1.0], [0.0, 0.0]])[:, None]
    everything = torch.ones(1, 2, dtype=torch.bool)
    error = error_at_best_gains(WindowPair(image=image, photo=photo, counted=everything), everything)
    assert float(error) == pytest.approx(2 - 9 / 5)  # channel 2: gain 3/5 leaves 0.4^2 + 0.2^2; the others fit


def test_pixels_that_one_stretch_masks_count_in_neither() -> None:
    photo, mask = torch.full((3, 1, 4), 0.5), torch.tensor([[True, True, False, False]])
    rough, smooth = (
        torch.tensor([0.4, 0.6, 0.0, 9.0]).expand(3, 1, 4),
        torch.tensor([0.5, 0.5, 7.0, 0.0]).expand(3, 1, 4),
    )
    tried = stretch_of([pair(rough, photo), pair(rough, photo)])
    other = stretch_of([pair(smooth, photo, mask), pair(rough, photo, mask)])
    gain, error = gain_of(tried, other)
    assert gain == pytest.approx(-10 * math.log10(2))
    assert error > 0


def test_a_model_that_is_not_finite_loses() -> None:
    fine, broken = stretch_of([]), stretch_of([], finite=False)
    assert gain_of(fine, broken) == (math.inf, 0)
    assert gain_of(broken, fine) == (-math.inf, 0)


def pair(image: torch.Tensor, photo: torch.Tensor, counted: torch.Tensor | None = None) -> WindowPair:
    everything = torch.ones(photo.shape[1:], dtype=torch.bool)
    return WindowPair(image=image, photo=photo, counted=everything if counted is None else counted)


def stretch_of(pairs: list[WindowPair], finite: bool = True) -> Stretch:
    state = RunState(step=0, table={}, modules={}, generator=torch.zeros(1), order=(), orders=0)
    return Stretch(pairs=pairs, end=state, finite=finite)


def test_a_stretch_ends_before_another_correction_is_tested() -> None:
    trial = build_module(Trial, TrialOptions(steps=0.1, passes=100))
    poses = build_module(Poses, PoseOptions(when="auto", start=0.25))
    run = SimpleNamespace(modules={"trial": trial, "poses": poses})
    assert trial.length(run, 201) == 50
    assert trial.length(run, 251) == 100
    assert trial.length(run, 951) == 50
    assert build_module(Trial, TrialOptions(steps=0.1, passes=5), views=4).length(run, 301) == 20


# -- runs --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("gain", [1.0, -1.0])
def test_the_better_stretch_stays(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, gain: float) -> None:
    monkeypatch.setattr("gsx.modules.trial.gain_of", lambda tried, other: (gain, 0.4))
    run = tiny_run(tmp_path, WORDS)
    assert run.complete
    assert run.modules["exposure"].active == (gain > 0)
    evaluation = run_evaluation(tmp_path)
    trial = evaluation["trials"]["exposure"]
    assert (trial["gain"], trial["threshold"], trial["stays"]) == (gain, 0.8, gain > 0)
    assert evaluation["exposures"]["thresholds"] == {"spread": 0.06, "grid_spread": 0.08}
    assert (evaluation["exposures"]["learnt"] > 0) == (gain > 0)


def run_evaluation(folder: Path) -> dict:
    import json

    return json.loads((folder / "evaluation.json").read_text())


def test_a_run_with_a_trial_resumes_to_the_same_bits(tmp_path: Path) -> None:
    tiny_run(tmp_path / "whole", WORDS, evaluated=False)
    stopped_at(tmp_path / "parts", WORDS, 11, 40)
    whole, parts = final_tensors(tmp_path / "whole"), final_tensors(tmp_path / "parts")
    assert all(torch.equal(whole[name], parts[name]) for name in whole)


def test_where_tests_call_for_nothing_a_run_has_the_bits_of_one_without(tmp_path: Path) -> None:
    tiny_run(tmp_path / "auto", (*WORDS, "training.exposure.spread=1"), evaluated=False)
    tiny_run(tmp_path / "never", ("training.exposure.when=never", *WORDS[2:], WORDS[0]), evaluated=False)
    auto, never = final_tensors(tmp_path / "auto"), final_tensors(tmp_path / "never")
    assert all(torch.equal(auto[name], never[name]) for name in never)


def test_runs_with_augmenters_have_no_trials() -> None:
    trial = build_module(Trial, TrialOptions(steps=0.1))
    exposure = build_module(Exposure, ExposureOptions(when="auto"))
    run = SimpleNamespace(modules={"trial": trial, "exposure": exposure}, step=200, augmenters={"upscale": object()})
    assert trial.tested(run, 201) == [exposure]
    assert trial.before_step(run) == {}
