"""NeRF-synthetic scenes against cameras placed by hand."""

import json
import math
from collections.abc import Callable
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from omegaconf import OmegaConf
from refusals import refused
from synthetic_colmap import shipped

from gsx.builtin import plugins
from gsx.core.data.images import write_image
from gsx.core.data.resize import resize
from gsx.core.errors import ConfigError, InputError
from gsx.experiments.evaluation.evaluator import Evaluator
from gsx.experiments.runs.compose import compose
from gsx.experiments.runs.execute import execute
from gsx.experiments.runs.inspect import describe
from gsx.experiments.runs.open import open_run, start
from gsx.formats.ply import write_ply
from gsx.scenes.blender import FORMAT, BlenderOptions, BoxAverage, load

FOV = 2 * math.atan(0.5)  # the focal length is the width
# looks along +y from (0, -4, 0) with z up: right is +x, up is +z, back is -y
FRONT = [[1, 0, 0, 0], [0, 0, -1, -4], [0, 1, 0, 0], [0, 0, 0, 1]]
# looks along -x from (5, 0, 1) with z up: right is +y, up is +z, back is +x
SIDE = [[0, 0, 1, 5], [1, 0, 0, 0], [0, 1, 0, 1], [0, 0, 0, 1]]


def picture(seed: int, width: int = 40, height: int = 30) -> torch.Tensor:
    values = np.random.default_rng(seed).integers(0, 256, (4, height, width), dtype=np.uint8)
    return torch.from_numpy(values)


def write(folder: Path, split: str, poses: list[Any], **changes: Any) -> None:
    (folder / split).mkdir(exist_ok=True)
    frames = [{"file_path": f"./{split}/r_{i}", "transform_matrix": pose} for i, pose in enumerate(poses)]
    content = {"camera_angle_x": FOV, "frames": frames} | changes
    (folder / f"transforms_{split}.json").write_text(json.dumps(content))
    for i in range(len(poses)):
        photo = folder / split / f"r_{i}.png"
        write_image(photo, picture(i))
        photo.write_bytes(photo.read_bytes() + split.encode())  # after its end: pictures are alike, files are not


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    write(tmp_path, "train", [FRONT, SIDE])
    write(tmp_path, "test", [SIDE])
    return tmp_path


def options(folder: Path, **changes: Any) -> BlenderOptions:
    """The shipped configuration with changes."""
    merged = OmegaConf.merge(
        OmegaConf.structured(BlenderOptions), shipped("blender"), {"path": str(folder), "random_points": 50}, changes
    )
    made = OmegaConf.to_object(merged)
    assert isinstance(made, BlenderOptions)
    return made


def test_shipped_values_are_the_published_ones() -> None:
    values = OmegaConf.create(shipped("blender"))
    assert (values.random_points, values.points_bound, values.background) == (100000, 1.3, [1, 1, 1])


def test_points_project_where_the_hand_says(folder: Path) -> None:
    scene = load(options(folder))
    front, side = (view.camera for view in scene.train)
    assert front.size == (40, 30)
    # 4 ahead, 1 to the right, 0.5 up: right of the middle by 40/4, above it by 40 * 0.5 / 4
    pixel, depth = front.project(torch.tensor([[1.0, 0.0, 0.5]]))
    torch.testing.assert_close(pixel, torch.tensor([[20 + 10.0, 15 - 5.0]]))
    assert depth.tolist() == [4]
    # 5 ahead, 2 to the right, 1 down
    pixel, depth = side.project(torch.tensor([[0.0, 2.0, 0.0]]))
    torch.testing.assert_close(pixel, torch.tensor([[20 + 16.0, 15 + 8.0]]))
    assert depth.tolist() == [5]
    torch.testing.assert_close(side.centre, torch.tensor([5.0, 0, 1], dtype=torch.float64))


def test_views_follow_the_files(folder: Path) -> None:
    scene = load(options(folder))
    assert [view.name for view in scene.train] == ["train/r_0", "train/r_1"]
    assert [view.name for view in scene.test] == ["test/r_0"]
    # centres (0,-4,0) and (5,0,1) are sqrt(25 + 16 + 1)/2 from their mean
    assert scene.extent == pytest.approx(1.1 * math.sqrt(42) / 2)
    assert scene.background.tolist() == [1, 1, 1]
    assert scene.name == folder.name
    json.dumps(scene.provenance)


def test_alpha_is_composited_over_the_background_and_truncated(folder: Path) -> None:
    rgba = picture(0).double() / 255
    colour = torch.tensor([0.2, 0.4, 0.6], dtype=torch.float64)[:, None, None]
    expected = ((rgba[:3] * rgba[3:] + colour * (1 - rgba[3:])) * 255).floor() / 255
    image = load(options(folder, background=[0.2, 0.4, 0.6])).train[0].image()
    torch.testing.assert_close(image, expected.float(), atol=1e-7, rtol=0)


def test_reduced_training_keeps_the_original_as_zoom_truth(folder: Path) -> None:
    view = load(options(folder, downscale=2)).train[0]
    whole = load(options(folder)).train[0]
    assert view.camera.size == (20, 15)
    assert view.camera.fx == pytest.approx(20)
    full = (whole.image() * 255).round().to(torch.uint8)
    assert torch.equal(view.image(), resize(full, 20, 15).float() / 255)
    finer = view.zoom(2)
    assert finer is not None
    assert torch.equal(finer.image(), whole.image())
    assert view.zoom(4) is None


def test_random_points_are_those_of_the_spec(folder: Path) -> None:
    scene = load(options(folder, random_points=2000))
    assert len(scene.points) == 2000
    assert 1.29 < scene.points.positions.max() <= 1.3
    assert -1.3 <= scene.points.positions.min() < -1.29
    assert scene.points.colours.unique().tolist() == [127]
    assert any("2000 random points in [-1.3, 1.3]^3" in note for note in scene.notes)
    other = load(options(folder, random_points=2000, seed=1))
    assert not torch.equal(scene.points.positions, other.points.positions)


def test_stored_points_are_found_unless_told_otherwise(folder: Path) -> None:
    write_ply(folder / "points3d.ply", {axis: np.array([1.0, 2.0, 3.0]) for axis in "xyz"})
    write_ply(folder / "other.ply", {axis: np.array([7.0]) for axis in "xyz"})
    assert load(options(folder)).points.positions.tolist() == [[1, 1, 1], [2, 2, 2], [3, 3, 3]]
    assert load(options(folder, points="other.ply")).points.positions.tolist() == [[7, 7, 7]]
    assert len(load(options(folder, points="random")).points) == 50


def test_validation_views_stand_in_for_test_views(folder: Path) -> None:
    write(folder, "val", [FRONT])
    assert [view.name for view in load(options(folder)).test] == ["test/r_0"]
    (folder / "transforms_test.json").unlink()
    scene = load(options(folder))
    assert [view.name for view in scene.test] == ["val/r_0"]
    assert any("transforms_val.json" in note for note in scene.notes)
    (folder / "transforms_val.json").unlink()
    refused(r"neither transforms_test\.json nor transforms_val\.json", load, options(folder))


def test_none_trains_on_the_images_of_both_files(folder: Path) -> None:
    scene = load(options(folder, split="none"))
    assert sorted(view.name for view in scene.train) == ["test/r_0", "train/r_0", "train/r_1"]
    assert scene.test == []
    with pytest.raises(ConfigError, match="use json, or none to train on all"):
        load(options(folder, split="every:8"))


def test_a_file_to_train_on_alone_is_split_by_rule(folder: Path) -> None:
    """The remedy of the error is what `gsx FOLDER` and `gsx scenes` do."""
    write(folder, "train", [FRONT, SIDE, FRONT])
    (folder / "transforms_test.json").write_text('{"camera_angle_x": 1, "frames": []}')
    with pytest.raises(
        InputError,
        match=r"nor transforms_val\.json with frames: hold out training images with scene\.split=every:8, or none with",
    ):
        load(options(folder))
    assert FORMAT.recognise(folder)
    assert FORMAT.overrides(folder) == {"split": "every:8"}
    scene = load(options(folder, **FORMAT.overrides(folder)))
    assert [view.name for view in scene.test] == ["train/r_0"]
    assert len(scene.train) == 2
    assert len(load(options(folder, split="none")).train) == 3
    assert describe(folder, plugins())[-1].endswith(f"gsx scene=blender scene.path={folder} scene.split=every:8")


def test_missing_images_are_named_and_skipped(folder: Path) -> None:
    write(folder, "train", [FRONT, SIDE, FRONT])
    (folder / "train" / "r_1.png").unlink()
    refused(r"1 of the 3 images of .*train/r_1.*scene\.missing=0\.34", load, options(folder))
    scene = load(options(folder, missing=0.5))
    assert [view.name for view in scene.train] == ["train/r_0", "train/r_2"]
    assert any(
        "Skipped 1 of the 3 images of transforms_train.json" in note and "train/r_1" in note for note in scene.notes
    )
    (folder / "test" / "r_0.png").unlink()
    refused(r"None of the 1 images of .*transforms_test\.json", load, options(folder, missing=0.5))


def test_names_with_suffix_are_found(folder: Path) -> None:
    frames = [{"file_path": f"train/r_{i}.png", "transform_matrix": pose} for i, pose in enumerate([FRONT, SIDE])]
    (folder / "transforms_train.json").write_text(json.dumps({"camera_angle_x": FOV, "frames": frames}))
    assert [view.name for view in load(options(folder)).train] == ["train/r_0.png", "train/r_1.png"]


def test_an_image_of_both_files_is_refused(folder: Path) -> None:
    (folder / "transforms_test.json").write_bytes((folder / "transforms_train.json").read_bytes())
    refused(r"2 test photographs of .*transforms_test.json' are trained on, too .*r_0.png", load, options(folder))


@pytest.mark.parametrize("way", [Path.symlink_to, Path.hardlink_to, lambda new, old: new.write_bytes(old.read_bytes())])
def test_a_training_image_under_another_name_cannot_be_tested_on(folder: Path, way: Callable[..., object]) -> None:
    (folder / "test" / "r_0.png").unlink()
    way(folder / "test" / "r_0.png", folder / "train" / "r_1.png")
    refused(r"'[^']*train/r_1\.png' is '[^']*test/r_0\.png' byte for byte\): remove one", load, options(folder))


@pytest.mark.parametrize("way", [Path.symlink_to, Path.hardlink_to])
def test_links_to_one_image_may_be_trained_on(folder: Path, way: Callable[..., object]) -> None:
    """As where files are kept by what they hold."""
    (folder / "train" / "r_1.png").unlink()
    way(folder / "train" / "r_1.png", folder / "train" / "r_0.png")
    assert {"train/r_0", "train/r_1"} <= {view.name.removesuffix(".png") for view in load(options(folder)).train}


def test_a_single_image_is_refused(folder: Path) -> None:
    write(folder, "train", [FRONT])
    refused("at least 2 images", load, options(folder))


@pytest.mark.parametrize(
    ("row", "value", "message"),
    [
        (1, [0, 0, math.nan, -4], "finite numbers"),
        (1, [0, 0, -1, math.inf], "finite numbers"),
        (0, [2, 0, 0, 0], "scales or mirrors"),
        (0, [-1, 0, 0, 0], "scales or mirrors"),
        (0, [1, 0, 0], "no matrix of numbers"),
        (0, [1, "x", 0, 0], "no matrix of numbers"),
    ],
)
def test_impossible_poses_are_refused_by_name(folder: Path, row: int, value: list[Any], message: str) -> None:
    broken = [list(line) for line in FRONT]
    broken[row] = value
    write(folder, "train", [SIDE, broken])
    refused(rf"Frame 'train/r_1' of .*transforms_train\.json.*{message}", load, options(folder))


def test_poses_rounded_by_text_become_rotations(folder: Path) -> None:
    turned = [[0.866, -0.5, 0, 1], [0.5, 0.866, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]]
    write(folder, "train", [FRONT, turned])
    camera = load(options(folder)).train[1].camera
    identity = torch.eye(3, dtype=torch.float64)
    torch.testing.assert_close(camera.rotation @ camera.rotation.T, identity, atol=1e-12, rtol=0)
    torch.testing.assert_close(camera.centre, torch.tensor([1.0, 2, 3], dtype=torch.float64))


def test_unreadable_files_are_refused(folder: Path) -> None:
    file = folder / "transforms_train.json"
    for text, message in [
        ("{", "no valid JSON"),
        ("[]", "no JSON object"),
        ('{"camera_angle_x": 1, "frames": []}', "no frames"),
        ('{"camera_angle_x": 1, "frames": [{}]}', "without 'file_path'"),
        (f'{{"camera_angle_x": {10**400}, "frames": [{{"file_path": "train/r_0"}}]}}', r"camera_angle_x 10+\.\.\.0+, "),
        (
            '{"camera_angle_x": 5e-324, "frames": [{"file_path": "train/r_0"}]}',
            "camera_angle_x 5e-324, which is no angle",
        ),
        ('{"fl_x": 1, "frames": [{"file_path": "train/r_0"}]}', "camera_angle_x None.*scene=transforms"),
    ]:
        file.write_text(text)
        refused(rf"transforms_train\.json.*{message}", load, options(folder))
    file.unlink()
    refused(r"transforms_train\.json' does not exist", load, options(folder))


def test_options_that_make_no_sense_are_refused(folder: Path) -> None:
    with pytest.raises(ConfigError, match=r"scene\.split is 'every:8'"):
        load(options(folder, split="every:8"))
    with pytest.raises(ConfigError, match=r"scene\.split is 'every:8{194}\.\.\.', but"):
        load(options(folder, split="every:" + "8" * 5000))
    with pytest.raises(ConfigError, match=r"Did you mean 'centred'\?"):
        load(options(folder, principal_point="centered"))
    with pytest.raises(ConfigError, match="give red, green and blue"):
        load(options(folder, background=[1.0]))


def test_smaller_images_are_box_averages_of_straight_rgba(folder: Path) -> None:
    scene = load(options(folder, scales=[1, 2, 5], background=[0.2, 0.4, 0.6]))
    assert [view.name for view in scene.train][2:] == [f"train/r_{i} x1/{k}" for k in (2, 5) for i in range(2)]
    for view, factor in zip(scene.train[2::2], (2, 5), strict=True):
        width, height = 40 // factor, 30 // factor
        rgba, mean = picture(0).tolist(), torch.zeros(4, height, width, dtype=torch.float64)
        for channel, row, column in product(range(4), range(30), range(40)):
            mean[channel, row // factor, column // factor] += rgba[channel][row][column] / factor**2
        straight = (mean + 1e-9).floor() / 255
        behind = torch.tensor([0.2, 0.4, 0.6], dtype=torch.float64)[:, None, None]
        expected = ((straight[:3] * straight[3:] + behind * (1 - straight[3:])) * 255).floor() / 255
        torch.testing.assert_close(view.image(), expected.float(), atol=1e-7, rtol=0)
        assert view.camera.size == (width, height)
        assert (view.camera.fx, view.camera.cx) == pytest.approx((40 / factor, 20 / factor))
    finer = scene.train[2].zoom(2)
    assert finer is None  # the truth of a reduced view is the reduced image


def test_three_averages_of_two_by_two_are_one_of_eight_by_eight() -> None:
    image = picture(3, 32, 24)
    halved = image.float() / 255
    for _ in range(3):
        halved = (halved[:, ::2, ::2] + halved[:, ::2, 1::2] + halved[:, 1::2, ::2] + halved[:, 1::2, 1::2]) / 4
    assert torch.equal(BoxAverage(8)(image), (halved * 255 + 1e-3).to(torch.uint8))


def test_test_views_are_grouped_by_scale(folder: Path) -> None:
    scene = load(options(folder, test_scales=[1, 2]))
    assert [(view.name, view.group) for view in scene.test] == [("test/r_0", "x1"), ("test/r_0 x1/2", "x1/2")]
    assert [view.group for view in scene.train] == ["", ""]
    assert scene.provenance["test_scales"] == [1, 2]
    assert [view.group for view in load(options(folder)).test] == [""]
    assert "scales" not in load(options(folder)).provenance


@pytest.mark.parametrize("first", ["x1/2", "x1"])
def test_views_from_afar_and_views_of_smaller_images_have_truths_of_their_own(folder: Path, first: str) -> None:
    """test_scales=[1,2] beside eval.zoom=[1,0.5]: both are 20 x 15, one reduced bicubically, one by box averages."""
    by_scale = {view.group: view for view in load(options(folder, test_scales=[1, 2])).test}
    order = [first, *(name for name in by_scale if name != first)]
    cameras = {name: by_scale[name].camera.zoom(0.5 if name == "x1" else 1) for name in order}
    truths = {name: by_scale[name].source.image(cameras[name]) for name in order}
    rgba = picture(0).long()
    blocks = (rgba[:, ::2, ::2] + rgba[:, 1::2, ::2] + rgba[:, ::2, 1::2] + rgba[:, 1::2, 1::2]) // 4
    colour, alpha = blocks[:3], blocks[3:]
    behind = (colour * alpha + 255 * (255 - alpha)) // 255  # over white, truncated
    assert (truths["x1/2"].long() - behind).abs().max() <= 1
    whole = by_scale["x1"].source.image(by_scale["x1"].camera)
    assert torch.equal(truths["x1"], resize(whole, 20, 15))  # which is Pillow's bicubic


def test_a_scale_given_twice_is_trained_on_twice_and_moves_no_camera(folder: Path) -> None:
    scene, plain = load(options(folder, scales=[1, 1, 2])), load(options(folder))
    assert [view.camera.width for view in scene.train] == [40, 40, 40, 40, 20, 20]
    assert (scene.reduction.filter, plain.reduction.filter) == ("area", "bicubic")
    assert scene.extent == pytest.approx(plain.extent)
    assert len(scene.test) == 1


def test_multiscale_blender_is_a_protocol() -> None:
    multi, single = (
        compose([f"protocol={name}", "scene.path=x"], plugins()).scene.options
        for name in ("multiscale_train", "singlescale_train")
    )
    assert (multi.name, single.name) == ("blender", "blender")
    assert (list(multi.scales), list(single.scales)) == ([1, 1, 2, 4, 8], [1])
    assert list(multi.test_scales) == list(single.test_scales) == [1, 2, 4, 8]


def test_zooming_in_on_photographs_is_a_protocol() -> None:
    settings = compose(["protocol=zoom_in", "scene.path=x"], plugins())
    assert (settings.scene.options.name, settings.scene.options.downscale) == ("colmap", 8)
    assert list(settings.evaluation.zoom) == [1, 2, 4, 8]
    other = compose(["protocol=zoom_in", "scene=transforms", "scene.path=x"], plugins()).scene.options
    assert (other.name, other.downscale) == ("transforms", 8)


@pytest.mark.parametrize(
    ("changes", "error", "message"),
    [
        ({"scales": [1, 4]}, InputError, r"r_0\.png' of 40 x 30 does not divide by 4"),
        ({"test_scales": [1, 3]}, InputError, "does not divide by 3"),
        ({"scales": [2], "downscale": 2}, ConfigError, r"scene\.downscale=1"),
        ({"scales": [2], "max_width": 20}, ConfigError, r"scene\.max_width=0"),
    ],
)
def test_scales_that_do_not_fit_the_images_are_refused(
    folder: Path, changes: dict[str, Any], error: type[Exception], message: str
) -> None:
    with pytest.raises(error, match=message):
        load(options(folder, **changes))


@pytest.mark.parametrize("override", ["scene.scales=[]", "scene.scales=[0]", "scene.test_scales=[1,1]"])
def test_impossible_scales_are_refused(override: str) -> None:
    with pytest.raises(ConfigError, match=override.split("=")[0]):
        compose(["scene=blender", override], plugins())


def test_one_image_at_many_scales_is_still_one(folder: Path) -> None:
    write(folder, "train", [FRONT])
    refused("at least 2 images", load, options(folder, scales=[1, 2, 5]))


def test_figures_by_scale_are_in_the_evaluation(folder: Path, tmp_path: Path) -> None:
    write(folder, "train", [FRONT, SIDE, FRONT])
    words = ["scene=blender", f"scene.path={folder}", "scene.random_points=50", "scene.scales=[1,1,2]", "device=cpu"]
    words += ["scene.test_scales=[1,2]", "eval.zoom=[1,0.5]", "iterations=2", f"folder={tmp_path / 'run'}"]
    words += ["backbone=mip_splatting"]
    settings = compose(words, plugins())
    execute(start(settings, plugins()), settings, plugins())
    evaluation = json.loads((tmp_path / "run" / "evaluation.json").read_text())
    assert list(evaluation["groups"]) == ["x1", "x1/2"]
    by_scale = [evaluation["groups"][name]["psnr"] for name in ("x1", "x1/2")]
    assert evaluation["psnr"] == pytest.approx(sum(by_scale) / 2)
    assert "<td>x1/2</td>" in (tmp_path / "run" / "report.html").read_text()
    again, judging = open_run(tmp_path / "run", plugins(), ["scene.cache_gb=0"])  # nothing is shared
    assert Evaluator(again, judging.evaluation).evaluate()["zoom"]["0.5"] == evaluation["zoom"]["0.5"]


def test_a_camera_that_is_nowhere_near_is_refused(folder: Path) -> None:
    write(folder, "train", [FRONT, [[0, 0, 1, 1e300], *SIDE[1:]]])
    refused(r"r_1\.png' is more than 1e\+09 units away", load, options(folder))


def test_a_lens_that_is_left_out_is_told(folder: Path) -> None:
    assert not any("states" in note for note in load(options(folder)).notes)
    write(folder, "train", [FRONT, SIDE], w=40, h=30, fl_x=40.0, fl_y=40.0, cx=20.0, cy=15.0, k1=0)
    assert not any("states" in note for note in load(options(folder)).notes)
    write(folder, "train", [FRONT, SIDE], w=40, h=30, fl_x=100.0, k1=-0.2, cx=20)
    (note,) = (note for note in load(options(folder)).notes if "states" in note)
    assert note.startswith("transforms_train.json states fl_x, k1, which the format's published readers and scene=bl")
