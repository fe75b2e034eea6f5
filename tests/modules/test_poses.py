"""Poses of photographs: found wrong where they are, left alone where they are not, corrected, kept and resumed."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from unittest.mock import patch

import pytest
import torch
from module_contexts import build_module
from small_scene import small_scene, spread
from tiny import final_tensors, same_ending, tiny_run, tiny_settings
from torch import Tensor

from gsx.backbones.anchors import view_number
from gsx.builtin import plugins
from gsx.core.data.camera import Camera
from gsx.core.data.scene import View
from gsx.core.errors import Stopped
from gsx.core.training import trainer
from gsx.core.training.run import Run, StepResult
from gsx.core.training.trainer import view_loss
from gsx.experiments.runs.build import build
from gsx.experiments.runs.execute import execute
from gsx.experiments.runs.load_scene import load_scene
from gsx.experiments.runs.open import open_run
from gsx.modules import poses as poses_module
from gsx.modules.alignment import Motion, move_camera, rotation_by
from gsx.modules.derived_views import FixedPoseSource, change_pose
from gsx.modules.distractors import DistractorOptions
from gsx.modules.photo_pairs import render_reduced, shared_spread
from gsx.modules.poses import (
    PoseOptions,
    Poses,
    half_shifts,
    in_moved_world,
    motion_px,
    usual_shift,
    without_common,
)

DEPTH = 4.0


def poses_of(options: PoseOptions, iterations: int = 1000) -> Poses:
    """Poses of eight photos."""
    return build_module(Poses, options, iterations=iterations, views=8)


def numbers(*shape: int, seed: int = 0) -> Tensor:
    """Normally distributed, float64."""
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def cameras(count: int = 8) -> list[Camera]:
    """Of a small scene, in float64."""
    views = small_scene(spread(5), views=count).train
    return [replace(v.camera, rotation=v.camera.rotation.double(), translation=v.camera.translation.double())
            for v in views]  # fmt: skip


def nudged(camera: Camera, twist: Tensor) -> Camera:
    """The camera after a turn, rad, and a move."""
    return move_camera(camera, Motion(rotation=rotation_by(twist[:3]), move=twist[3:]))


# -- when ----------------------------------------------------------------------------------------------------------


def test_corrections_are_early_and_then_ever_rarer() -> None:
    poses = poses_of(PoseOptions(when="auto", start=0.1, until=0.8, times=4))
    assert poses.milestones() == [101, 201, 401, 801]
    assert [number for number in range(1, 1001) if poses.due(number)] == [101]
    poses.take(torch.zeros(8, 3, 4, dtype=torch.float64))
    assert [number for number in range(1, 1001) if poses.due(number)] == [101, 201, 401, 801]
    assert not any(poses_of(PoseOptions()).due(number) for number in range(1, 1001))
    assert poses_of(PoseOptions(when="auto", times=1), 10).milestones() == [3]


def test_auto_corrects_above_the_threshold_and_always_in_any_case() -> None:
    auto, always = (poses_of(PoseOptions(when=when, spread=0.3), 10) for when in ("auto", "always"))
    assert [auto.wrong(value, 3) for value in (0.2, 0.4)] == [False, True]
    assert always.wrong(0.0, 3)


def errors_expected(poses: Poses, usual: float, steps: Sequence[int]) -> list[float]:
    """At corrections before these steps."""
    out = []
    for number in steps:
        out.append(poses.expected_error(number, usual))
        still = [view.camera for view in poses.context.scene.train]
        poses.correct(still, still, DEPTH, number, out[-1])
    return out


def test_poses_are_held_ever_more_firmly_also_where_a_run_goes_on_longer() -> None:
    options = PoseOptions(when="auto", start=0.1, until=0.8, times=4)
    for usual, wanted in ((4.0, [4, 2, 1, 0.5]), (0.1, [0.5] * 4), (math.nan, [0.5] * 4)):
        poses = poses_of(options)
        assert errors_expected(poses, usual, poses.milestones()) == pytest.approx(wanted)
    poses = poses_of(options)
    assert errors_expected(poses, 4.0, poses.milestones()[:3]) == pytest.approx([4, 2, 1])
    longer = poses_of(options, 10_000)
    longer.load_state_dict(poses.state_dict())
    assert errors_expected(longer, math.nan, longer.milestones()) == pytest.approx([0.5 * 2**share for share in
                                                                             (3 / 4, 1 / 2, 1 / 4, 0)])  # fmt: skip
    once = poses_of(PoseOptions(when="auto", times=1))
    assert errors_expected(once, 4.0, once.milestones()) == [4.0]


@pytest.mark.parametrize("options", [PoseOptions, DistractorOptions])
@pytest.mark.parametrize(
    ("wrong", "told"),
    [({"when": "on"}, "never, auto, always"), ({"start": 0.0}, "between 0 and 1"), ({"until": 0.05}, "not smaller")],
)
def test_wrong_options_are_named(options, wrong, told: str) -> None:
    with pytest.raises(ValueError, match=told):
        options(**wrong)


# -- are they wrong? -----------------------------------------------------------------------------------------------


def waves(across: float, down: float) -> Tensor:
    """A smooth picture of 96 x 64 px, as it looks when it has moved."""
    x, y = torch.arange(96.0)[None] - across, torch.arange(64.0)[:, None] - down
    grey = 0.5 + 0.15 * (0.35 * x + 0.1 * y).sin() + 0.1 * (0.2 * x - 0.4 * y).sin()
    return torch.stack([grey, 0.9 * grey, 0.8 * grey])


def spread_between(pictures: Iterable[tuple[Tensor, Tensor, None, float]]) -> float:
    """The spread of shifts of pictures."""
    return shared_spread(*half_shifts(pictures).unbind(1))


def test_the_spread_of_shifts_is_that_of_poses() -> None:
    shifts = 0.8 * numbers(20, 2)
    found = spread_between((waves(0, 0), waves(*shift), None, 1.0) for shift in shifts.tolist())
    assert found == pytest.approx(float(shifts.var(0).mean().sqrt()), rel=0.05)
    small = spread_between((waves(0, 0), waves(*shift), None, 2.0) for shift in shifts.tolist())
    assert small == pytest.approx(2 * found)  # px of photographs twice as large
    halves = [torch.cat([waves(a, 0)[..., :48], waves(b, 0)[..., 48:]], 2) for a, b in numbers(20, 2).tolist()]
    assert (
        spread_between((waves(0, 0), one, None, 1.0) for one in halves) < 0.45
    )  # halves that do not agree tell nothing
    assert spread_between([(waves(0, 0), waves(1, 1), None, 1.0)] * 2) == 0  # two are too few


def test_a_usual_shift_is_that_of_most_photographs() -> None:
    shifts = 0.8 * numbers(400, 1, 2)
    noisy = shifts + 0.3 * numbers(400, 2, 2, seed=1)
    assert usual_shift(noisy) == pytest.approx(0.8, rel=0.15)
    noisy[:20] = 40.0
    noisy[20:30] = math.nan
    assert usual_shift(noisy) == pytest.approx(0.8, rel=0.2)
    assert shared_spread(*noisy.unbind(1)) > 5
    assert usual_shift(torch.full((4, 2, 2), math.nan)) == 0


# -- motions -------------------------------------------------------------------------------------------------------


def test_a_motion_in_px_is_what_pictures_move_by() -> None:
    camera = cameras()[0]
    point = (torch.tensor([0.0, 0.0, DEPTH]).double() - camera.translation) @ camera.rotation
    turn, move = nudged(camera, torch.tensor([0, 1e-3, 0, 0, 0, 0]).double()), torch.zeros(6).double()
    move[3] = 1e-3
    for other, index in ((turn, 1), (nudged(camera, move), 3)):
        told = motion_px(camera, other, DEPTH)
        seen = (other.project(point[None])[0] - camera.project(point[None])[0])[0]
        assert float(told[index]) == pytest.approx(float(seen[0]), rel=1e-3)
        assert float(told.norm()) == pytest.approx(abs(float(told[index])))


def test_a_motion_of_the_world_is_taken_back_and_those_of_single_cameras_are_kept() -> None:
    given, world = cameras(), Motion(rotation=rotation_by(torch.tensor([0.01, -0.02, 0.015]).double()),
                                     move=torch.tensor([0.02, 0.01, -0.03]).double())  # fmt: skip
    back = without_common(given, [in_moved_world(camera, world) for camera in given], DEPTH)
    for one, other in zip(back, given, strict=True):
        assert float(motion_px(other, one, DEPTH).norm()) < 0.02  # of some 0.6 px: the world's motion is not small
    twists = 1e-3 * numbers(8, 6, seed=1)
    own = [nudged(camera, twist) for camera, twist in zip(given, twists, strict=True)]
    kept = without_common(given, own, DEPTH)
    again = without_common(given, kept, DEPTH)
    for one, other in zip(again, kept, strict=True):  # nothing in common is left
        assert float(motion_px(other, one, DEPTH).norm()) < 1e-3
    shares = [float(motion_px(a, b, DEPTH).square().sum()) for a, b in zip(given, kept, strict=True)]
    before = [float(motion_px(a, b, DEPTH).square().sum()) for a, b in zip(given, own, strict=True)]
    assert 0.5 < sum(shares) / sum(before) < 1  # 6 of 48 numbers are common


def test_a_world_that_moves_shows_the_same_from_cameras_that_move_with_it() -> None:
    camera, point = cameras()[0], torch.tensor([[0.3, -0.2, 0.4]]).double()
    turn, move = torch.tensor([[0.3, 0.2, -0.1], [1.0, 2.0, 3.0]], dtype=torch.float64)
    motion = Motion(rotation=rotation_by(turn), move=move)
    own = camera.project(motion.apply(point.T).T)
    other = in_moved_world(camera, motion).project(point)
    torch.testing.assert_close(own, other)


# -- views -----------------------------------------------------------------------------------------------------------


class Asked:
    """Computed from the pose that it is asked for."""

    def image(self, camera: Camera) -> Tensor:
        self.camera = camera
        return torch.zeros(3, camera.height, camera.width, dtype=torch.uint8)

    def max_zoom(self, camera: Camera) -> float:
        return math.inf


class File(Asked):
    path = Path("a.png")


def test_the_photograph_stays_when_the_pose_changes() -> None:
    one, other = cameras()[:2]
    source = Asked()
    view = change_pose(change_pose(View("a", one, source), other), cameras()[2])
    view.zoom(2).image()
    assert torch.equal(view.camera.rotation, cameras()[2].rotation)
    assert torch.equal(source.camera.rotation, one.rotation)
    assert torch.equal(source.camera.translation, one.translation)
    assert source.camera.width == 2 * one.width
    file = File()
    assert change_pose(View("a", one, file), other).source is file  # files do not know poses
    assert isinstance(view.source, FixedPoseSource)


def test_views_are_the_same_until_poses_change() -> None:
    given = cameras()
    poses, views = poses_of(PoseOptions(), 10), [View(str(n), c, Asked()) for n, c in enumerate(given)]
    assert poses.transform_views(views, 1) is views
    other = [nudged(camera, twist) for camera, twist in zip(given, 1e-2 * numbers(8, 6), strict=True)]
    motion = poses.correct(given, other, DEPTH, 5, 0.7)
    made = poses.transform_views(views, 1)
    assert poses.transform_views(views, 2) is made
    moves = [motion_px(a, b.camera, DEPTH).square().sum() for a, b in zip(given, made, strict=True)]
    assert motion == pytest.approx(float(torch.stack(moves).mean().sqrt()), rel=1e-5)
    kept = poses.state_dict()
    again = poses_of(PoseOptions(when="auto", times=1), 10)
    again.load_state_dict(kept)
    assert torch.equal(again.transform_views(views, None)[3].camera.rotation, made[3].camera.rotation)
    assert (again.last_estimate, again.error) == (5, 0.7)
    again.load_state_dict({name: value for name, value in kept.items() if name != "error"})  # as earlier ones were
    assert again.expected_error(3, math.nan) == 0.5
    poses.load_state_dict({})
    assert poses.transform_views(views, 1) is views


def test_appearance_codes_go_with_photographs_whatever_their_pose(tmp_path: Path) -> None:
    coarse = ("training.coarse_to_fine.factor=2", "training.coarse_to_fine.until=0.5")
    settings = tiny_settings(
        tmp_path, "backbone=scaffold", "scene.width=96", "scene.height=72", "iterations=10", *coarse
    )
    run = build(settings, load_scene(settings), tmp_path, training=True)
    coarse, own = run.views.at(1), run.scene.train
    run.modules["poses"].take(
        torch.stack([torch.cat([v.camera.rotation, v.camera.translation[:, None]], 1) for v in own]).double()
    )
    assert coarse[0].camera.width == 48
    for views, step in ((run.views.at(1), 1), (run.train_views, 1), (run.train_views, 10), (own, 10)):
        assert [view_number(run.backbone.numbers, run.views, view.camera, step) for view in views] == list(range(6))
    assert view_number(run.backbone.numbers, run.views, run.scene.test[0].camera, 10) == -1


def test_small_photographs_are_not_made_smaller(tmp_path: Path) -> None:
    settings = tiny_settings(tmp_path, "scene.width=96", "scene.height=72", "iterations=10")
    run = build(settings, load_scene(settings), tmp_path, training=True)
    for pixels, width in ((0, 48), (48 * 36, 48), (48 * 36 + 1, 96)):
        small, rendering = render_reduced(run, run.scene.train[0], depth=False, min_pixels=pixels)
        assert (small.camera.width, rendering.image.shape[2]) == (width, width)


# -- runs ------------------------------------------------------------------------------------------------------------

WRONG = (
    "training.poses.start=0.1",
    "scene.disturb.pose=1.5",
    "training.poses.when=always",
    "training.poses.times=3",
    "iterations=12",
    "scene.points=150",
    "eval.zoom=[1]",
)


def wrong_run(folder: Path, stop_after: int | None = None) -> Run:
    """A run with wrong poses, which pictures as small as these do not tell."""
    with patch.object(poses_module, "usual_shift", return_value=1.7312345678901233):
        return tiny_run(folder, WRONG, stop_after)


@pytest.fixture(scope="module")
def corrected(tmp_path_factory: pytest.TempPathFactory) -> tuple[Run, Path]:
    """(a finished run with corrected poses, its folder)."""
    folder = tmp_path_factory.mktemp("corrected") / "run"
    return wrong_run(folder), folder


def test_a_run_with_corrected_poses_resumes_as_if_never_stopped(corrected: tuple[Run, Path], tmp_path: Path) -> None:
    whole, folder = corrected
    assert whole.modules["poses"].matrices is not None
    assert len(whole.modules["poses"].matrices) == 6
    wrong_run(tmp_path / "stopped", stop_after=3)
    run, settings = open_run(tmp_path / "stopped", plugins(), training=True)
    assert run.modules["poses"].matrices is not None
    assert (run.modules["poses"].last_estimate, run.modules["poses"].error) == (2, 1.7312345678901233)
    with patch.object(poses_module, "estimate_camera", wraps=poses_module.estimate_camera) as corrections:
        execute(run, settings, plugins())
    held = [call.kwargs["prior_weight"] for call in corrections.call_args_list]
    assert held == pytest.approx([250 / (0.5 * 1.7312345678901233)] * 6 + [1000] * 6)
    a = same_ending(folder, tmp_path / "stopped")
    assert "poses.matrices" in a
    longer, _ = open_run(tmp_path / "stopped", plugins(), ["iterations=300"], training=True)
    longer.step = longer.modules["poses"].milestones()[0] - 1
    assert "pose_spread" not in longer.modules["poses"].before_step(longer), "corrected poses are tested again"


def test_a_step_that_is_given_up_after_a_correction_is_taken_by_the_same_poses(
    corrected: tuple[Run, Path], tmp_path: Path
) -> None:
    """Asked to stop while the views of step 4 are rendered, before which poses are corrected a second time."""

    def stop(run: Run, number: int, view: View, *rest: object) -> StepResult:
        if number == 4:
            raise Stopped("asked to")
        return view_loss(run, number, view, *rest)

    whole, folder = corrected
    with patch.object(trainer, "view_loss", stop):
        wrong_run(tmp_path / "stopped")
    run, settings = open_run(tmp_path / "stopped", plugins(), training=True)
    assert (run.step, run.modules["poses"].last_estimate) == (3, 4)
    execute(run, settings, plugins())
    assert torch.equal(run.modules["poses"].matrices, whole.modules["poses"].matrices)
    a, b = final_tensors(folder), final_tensors(tmp_path / "stopped")
    assert all(torch.equal(a[name], b[name]) for name in a)


def test_without_need_training_is_bit_for_bit_that_without_the_question(tmp_path: Path) -> None:
    short = ["iterations=6", "eval.zoom=[1]"]
    plain = tiny_run(tmp_path / "plain", short, evaluated=False)
    asked = [*short, "training.poses.when=auto", "training.poses.spread=50"]
    judged = tiny_run(tmp_path / "judged", asked, evaluated=False)
    assert not plain.modules["poses"].active
    assert not judged.modules["poses"].active
    assert [line["poses"] for line in judged.progress.curves if "pose_spread" in line] == [0]
    same_ending(tmp_path / "plain", tmp_path / "judged")
