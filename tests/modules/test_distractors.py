"""Distractors in runs: found when they are due, left out of the loss, kept and resumed; no change where none are."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from module_contexts import build_module
from small_scene import Grey, small_scene, spread
from tiny import same_ending, tiny_run
from torch import Tensor

from gsx.builtin import plugins
from gsx.core.data.camera import Camera
from gsx.core.data.reduction import Reduction
from gsx.core.data.scene import View
from gsx.core.errors import Stopped
from gsx.experiments.runs.degraded import patch_of
from gsx.experiments.runs.execute import execute
from gsx.experiments.runs.open import open_run
from gsx.modules.derived_views import MaskedSource, mask_view, mask_views, reduce_view
from gsx.modules.distractors import (
    DistractorOptions,
    Distractors,
    measure_differences,
    remove_rows,
    rows_of_distractors,
)
from gsx.modules.poses import PoseOptions, Poses


def distractors(**options: object) -> Distractors:
    """Of a run of 1,000 steps."""
    return build_module(Distractors, DistractorOptions(**options))


def views(count: int = 4) -> list[View]:
    """Of 24 x 16 px."""
    return list(small_scene(spread(5), views=count).train)


def marks(count: int = 4) -> list[Tensor]:
    """The first photograph has a distractor at its upper left, in blocks of 4 px."""
    marked = [torch.zeros(4, 6, dtype=torch.bool) for _ in range(count)]
    marked[0][1, :2] = True
    return marked


def test_they_are_judged_once_and_found_again_only_where_there_are_any() -> None:
    own = distractors(when="auto", start=0.1, until=0.4, times=3)
    assert [number for number in range(1, 1001) if own.due(number)] == [101]
    own.mask(marks(), 101)
    assert [number for number in range(1, 1001) if own.due(number)] == [201, 401]
    assert not any(distractors().due(number) for number in range(1, 1001))


# -- pixels ----------------------------------------------------------------------------------------------------------


def test_pixels_of_marked_blocks_do_not_count_at_any_size_and_in_any_crop() -> None:
    view = mask_view(views()[0], marks()[0])
    expected = torch.ones(16, 24, dtype=torch.bool)
    expected[4:8, :8] = False
    assert torch.equal(view.counted(), expected)
    finer = replace(view, camera=view.camera.zoom(2))
    assert torch.equal(finer.counted(), expected.repeat_interleave(2, 0).repeat_interleave(2, 1))
    cut = replace(view, camera=view.camera.crop(6, 3, 10, 8))
    assert torch.equal(cut.counted(), expected[3:11, 6:16])
    assert torch.equal(view.image(), views()[0].image())
    assert mask_view(views()[1], marks()[1]).counted() is None


@pytest.mark.parametrize("times", [2, 4, 8, 16])
def test_a_coarse_pixel_counts_where_nothing_of_it_is_marked(times: int) -> None:
    """Also where it is larger than a block, of 4 px; of pictures that it does not divide."""
    view = View("a", views()[0].camera.resize(650, 523), Grey())
    marked = torch.zeros(523 // 4, 650 // 4, dtype=torch.bool)
    marked[40:60, 60:81] = True  # rows 160 to 240, columns 240 to 324
    coarse = reduce_view(view, Reduction(), times)
    assert coarse.camera.size == (650 // times, 523 // times)
    found, picture = mask_view(coarse, marked), coarse.source.image(coarse.camera)
    expected = torch.ones(523 // times, 650 // times, dtype=torch.bool)
    expected[160 // times : 240 // times, 240 // times : -(-324 // times)] = False
    assert torch.equal(found.counted(), expected)
    assert found.source.image(found.camera) is picture, "it is made once"
    assert coarse.counted() is None


@pytest.mark.parametrize(("width", "height"), [(67, 71), (131, 97)])
def test_blocks_are_whole_pixels_and_the_last_take_the_rest(width: int, height: int) -> None:
    """Of pictures that blocks of 4 px do not divide."""
    camera = views()[0].camera.resize(width, height)
    view = View("a", camera, Grey())
    marked = torch.zeros(height // 4, width // 4, dtype=torch.bool)
    marked[-2:, 3] = marked[2, -1] = True
    expected = torch.ones(height, width, dtype=torch.bool)
    expected[(height // 4 - 2) * 4 :, 12:16] = False
    expected[8:12, (width // 4 - 1) * 4 :] = False
    assert torch.equal(mask_view(view, marked).counted(), expected)


class CutOutGrey(Grey):
    """Transparent everywhere."""

    def transparent(self, camera: Camera) -> Tensor:
        return torch.ones(camera.height, camera.width, dtype=torch.bool)


def test_what_is_transparent_stays_so() -> None:
    view = replace(views()[0], source=CutOutGrey())
    assert bool(mask_view(view, marks()[0]).transparent().all())
    assert mask_view(views()[0], marks()[0]).transparent() is None


class HalfMasked(Grey):
    """Of which the left half does not count."""

    def counted(self, camera: Camera) -> Tensor:
        return (torch.arange(camera.width) >= camera.width // 2).expand(camera.height, -1)


def test_masks_of_the_scene_hold_beside_them() -> None:
    source, marked = HalfMasked(), torch.zeros(4, 6, dtype=torch.bool)
    marked[0] = True
    counted = MaskedSource(source=source, masked=marked, size=(24, 16)).counted(views()[0].camera)
    expected = torch.zeros(16, 24, dtype=torch.bool)
    expected[4:, 12:] = True
    assert torch.equal(counted, expected)


def test_views_are_the_same_until_others_are_found() -> None:
    own, given = distractors(), views()
    assert own.transform_views(given, None) is given
    assert own.mask(marks(), 5) == pytest.approx(2 / 24 / 4)
    made = own.transform_views(given, None)
    assert own.transform_views(given, None) is made
    assert made[1] is given[1]
    again = distractors()
    again.load_state_dict(own.state_dict())
    assert again.last_estimate == 5
    assert torch.equal(again.transform_views(given, 3)[0].counted(), made[0].counted())
    own.load_state_dict({})
    assert own.transform_views(given, None) is given


# -- runs ------------------------------------------------------------------------------------------------------------

BEFORE_IT = (
    "scene.disturb.covered=0.1",
    "training.distractors.when=always",
    "training.distractors.start=0.6",
    "training.distractors.until=0.8",
    "training.distractors.times=3",
    "iterations=40",
    "backbone.rates.shortened=0.4",
    "backbone.max_primitives=1200",
    "scene.points=900",
    "eval.zoom=[1]",
)


def test_a_run_resumes_as_if_never_stopped_and_leaves_out_what_covers_its_photographs(tmp_path: Path) -> None:
    """Of what covers them most is found; not much of the rest."""
    whole = tiny_run(tmp_path / "whole", BEFORE_IT)
    tiny_run(tmp_path / "stopped", BEFORE_IT, stop_after=26)
    run, settings = open_run(tmp_path / "stopped", plugins(), training=True)
    assert run.modules["distractors"].active
    execute(run, settings, plugins())
    a = same_ending(tmp_path / "whole", tmp_path / "stopped")
    assert "distractors.0" in a
    told = [line for line in whole.progress.curves if "distractor_seconds" in line]
    assert [line["step"] for line in told] == run.modules["distractors"].milestones()
    assert sum(line["forgotten"] for line in told) > 0
    found, covered, others = 0, 0, 0
    for view, own in zip(whole.train_views, whole.scene.train, strict=True):
        patch, counted = patch_of(view.name, 0.1), view.counted()
        black = torch.zeros(3, view.camera.height, view.camera.width, dtype=torch.uint8)
        there = (patch.over(black, own.camera) != patch.over(black + 255, own.camera)).logical_not().all(0)
        out = torch.zeros_like(there) if counted is None else ~counted
        found, covered = found + int((out & there).sum()), covered + int(there.sum())
        others += int((out & ~there).sum())
    assert found > 0.4 * covered
    assert others < found / 3


def test_a_stop_between_finding_and_the_step_is_told_as_far_as_it_is_known() -> None:
    lines = [{"step": 7, "distractors": 0.05, "distractor_seconds": 1.0}, {"step": 9, "loss": 1.0}]
    module, poses = distractors(), build_module(Poses, PoseOptions())
    summary = module.summary(lines)
    assert summary == {"distractors": {"step": 7, "share": None, "marked": [0.05], "seconds": 1.0}}
    assert "5.0% of the pixels" in " ".join(module.remarks(summary))
    summary = poses.summary([{"step": 7, "poses": 6, "pose_motion": 0.2, "pose_seconds": 1.0}])
    assert "corrected" in " ".join(poses.remarks(summary))


def test_renders_are_blurred_at_the_size_that_they_are_compared_at(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Movements are shares of a view's sides: those of the smaller view that was rendered."""
    run, seen = (
        tiny_run(tmp_path, ["iterations=1", "eval.zoom=[1]", "scene.width=80", "scene.height=64"]),
        list[tuple[object, ...]](),
    )

    def applied(image: Tensor, view: View, *rest: object) -> Tensor:
        seen.append(((image.shape[2], image.shape[1]), view.camera.size))
        return image

    monkeypatch.setattr(run.modules["blur"], "transform_render", applied)
    measure_differences(run, run.scene.train[:2])
    assert len(seen) == 2
    assert all(rendered == size for rendered, size in seen)


def test_without_need_training_is_bit_for_bit_that_without_the_question(tmp_path: Path) -> None:
    short = ["iterations=6", "eval.zoom=[1]"]
    plain = tiny_run(tmp_path / "plain", short, evaluated=False)
    asked = ["training.distractors.when=auto", "training.distractors.share=0.9"]
    judged = tiny_run(tmp_path / "judged", [*short, *asked], evaluated=False)
    assert not plain.modules["distractors"].active
    assert not judged.modules["distractors"].active
    summary = judged.modules["distractors"].summary(judged.progress.curves)["distractors"]
    assert (summary["thresholds"], summary["marked"]) == ({"share": 0.9}, [])
    assert [line["distractors"] for line in judged.progress.curves if "distractor_share" in line] == [0]
    same_ending(tmp_path / "plain", tmp_path / "judged")


def test_primitives_that_show_what_does_not_count_are_removed_and_no_others(tmp_path: Path) -> None:
    """All but the first photograph count whole, and of that the left half does not."""
    run = tiny_run(tmp_path, ["iterations=4", "eval.zoom=[1]"])
    blocks = [torch.zeros(9, 12, dtype=torch.bool) for _ in run.scene.train]
    blocks[0][:, :6] = True
    before = run.backbone.table["means"].clone()
    gone = remove_rows(run, rows_of_distractors(run, mask_views(run.scene.train, blocks)))
    left = {tuple(mean) for mean in run.backbone.table["means"].tolist()}
    removed = torch.tensor([mean for mean in before.tolist() if tuple(mean) not in left])
    assert 0 < gone == len(removed) < len(before) / 4
    sees = torch.stack([view.camera.sees(removed) for view in run.scene.train]).sum(0)
    assert float(sees.float().mean()) < 3  # of six: others would show them where they count
    pixels, _ = run.scene.train[0].camera.project(removed)
    assert float((pixels[:, 0] < 24).float().mean()) > 0.9
    nothing = mask_views(run.scene.train, [torch.ones_like(one) for one in blocks])
    assert remove_rows(run, rows_of_distractors(run, nothing)) == 0  # a model of nothing is none


def test_a_stop_while_distractors_are_found_leaves_all_to_be_found_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Marks without what they tell to remove would stay so."""
    run = tiny_run(tmp_path, ["iterations=4", "eval.zoom=[1]", "training.distractors.when=always"])
    module = run.modules["distractors"]
    before = module.masks, module.last_estimate

    def stop(**_: object) -> None:
        raise Stopped

    blocks = [torch.ones(9, 12, dtype=torch.bool) for _ in run.scene.train]
    monkeypatch.setattr("gsx.modules.distractors.distractors_in", lambda _: blocks)
    monkeypatch.setattr("gsx.modules.distractors.Probe", stop)
    with pytest.raises(Stopped):
        module.estimate(run, module.milestones()[0])
    assert (module.masks, module.last_estimate) == before
