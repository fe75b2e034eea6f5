"""gsx prepare: other readers find the cameras, points and bytes that gsx trains on; nothing half written stays."""

import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pytest
import torch
from synthetic_colmap import synthesize, write_scene
from tiny import OVERRIDES
from torch import Tensor

from gsx.builtin import plugins
from gsx.cli.dispatch import main
from gsx.cli.program_arguments import parse_prepare
from gsx.core.data.camera import Camera
from gsx.core.data.images import header_of, read_image, write_image
from gsx.core.data.scene import Scene, View
from gsx.core.errors import ConfigError, InputError
from gsx.core.files import read_json
from gsx.experiments.evaluation.eval_options import protocol_of
from gsx.experiments.prepare import prepare as prepared
from gsx.experiments.prepare.picture_names import file_names
from gsx.experiments.runs.compose import compose
from gsx.experiments.runs.load_scene import load_scene
from gsx.formats.ply import read_ply

FRAMES = 10
UTM = (500_000.0, 5_400_000.0, 300.0)
DEMO = [word for word in OVERRIDES if word.startswith("scene.")]
DEMO_HASH = "73e5e9a504cb793b"
"""Of the protocol of this scene before `gsx prepare` existed."""


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A COLMAP scene of ten photos of 64 x 48 px with a principal point off the centre."""
    folder = tmp_path_factory.mktemp("source")
    write_scene(synthesize(frames=FRAMES), folder)
    return folder


def of_source(source: Path, *more: str) -> Scene:
    """The scene as gsx trains on it."""
    return scene_of(["scene=colmap", f"scene.path={source}", "scene.downscale=2", *more])


def scene_of(words: Sequence[str]) -> Scene:
    return load_scene(compose(words, plugins()))


def run(source: Path, to: Path, *more: str) -> Path:
    """The folder that the command line prepares."""
    assert main(["prepare", str(source), "--to", str(to), "scene.downscale=2", "eval.zoom=[1,2]", *more]) == 0
    return to


@pytest.fixture(scope="module")
def train_only(source: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return run(source, tmp_path_factory.mktemp("prepared") / "new" / "train_only")


@pytest.fixture(scope="module")
def whole(source: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return run(source, tmp_path_factory.mktemp("prepared") / "whole", "--with-test", "--with-truth")


def same_views(views: Sequence[View], others: Sequence[View]) -> None:
    """Cameras agree to 1e-6, photos to the bit."""
    for one, other in zip(views, others, strict=True):
        assert torch.equal(one.picture(), other.picture())
        same_camera(one.camera, other.camera)


def same_camera(one: Camera, other: Camera) -> None:
    assert one.size == other.size
    for name in ("fx", "fy", "cx", "cy"):
        assert getattr(one, name) == pytest.approx(getattr(other, name), abs=1e-6)
    assert torch.allclose(one.rotation.double(), other.rotation.double(), atol=1e-6)
    assert torch.allclose(one.translation.double(), other.translation.double(), atol=1e-6)


def same_points(scene: Scene, other: Scene) -> None:
    order, others = (torch.argsort(one.points.positions[:, 0]) for one in (scene, other))
    assert torch.equal(scene.points.positions[order], other.points.positions[others])
    assert torch.equal(scene.points.colours[order], other.points.colours[others])


# -- read by gsx -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("form", ["colmap", "transforms"])
def test_gsx_reads_its_own_training_views(source: Path, train_only: Path, form: str) -> None:
    scene, again = of_source(source), scene_of([f"scene={form}", f"scene.path={train_only}", "scene.split=none"])
    assert len(again.train) == FRAMES - 2
    same_views(scene.train, again.train)
    same_points(scene, again)


def test_with_test_photos_both_forms_keep_the_split(source: Path, whole: Path) -> None:
    scene = of_source(source)
    for words in (["scene=colmap", "scene.split=every:8"], ["scene=transforms"]):
        again = scene_of([*words, f"scene.path={whole}"])
        same_views(scene.train, again.train)
        same_views(scene.test, again.test)
    assert read_json(whole / "prepared.json")["every_8th_is_test"] is True


def test_without_test_photos_no_program_can_train_on_them(source: Path, train_only: Path) -> None:
    manifest = read_json(train_only / "prepared.json")
    files = {f"images/{path.name}" for path in (train_only / "images").iterdir()}
    assert files == {entry["file"] for entry in manifest["train"]}
    assert {frame["file_path"] for frame in read_json(train_only / "transforms.json")["frames"]} == files
    assert not {entry["file"] for entry in manifest["test"]} & {file.removeprefix("images/") for file in files}
    assert [entry["name"] for entry in manifest["test"]] == [view.name for view in of_source(source).test]
    assert (train_only / "test_views.txt").read_text().split() == [entry["file"] for entry in manifest["test"]]
    assert not (train_only / "truth").exists()


def test_the_manifest_loads_the_same_scene_by_the_same_protocol(train_only: Path) -> None:
    manifest = read_json(train_only / "prepared.json")
    settings = compose(manifest["overrides"], plugins())
    assert settings.evaluation.zoom == manifest["zooms"] == [1, 2]
    scene = load_scene(settings)
    assert protocol_of(scene, settings.evaluation, "n/a (no weights)") == manifest["protocol"]
    assert [view.name for view in scene.train] == [entry["name"] for entry in manifest["train"]]


def test_the_hash_of_a_protocol_stays() -> None:
    settings = compose(["scene=demo", *DEMO, "eval.zoom=[1,2]"], plugins())
    assert protocol_of(load_scene(settings), settings.evaluation, "n/a (no weights)")["hash"] == DEMO_HASH


# -- read by others ----------------------------------------------------------------------------------------------------


def projected(camera: Camera, points: np.ndarray) -> np.ndarray:
    """Pixels of points by hand, float64: docs/reference/conventions.md."""
    x, y, z = camera.rotation.double().numpy() @ points.T + camera.translation.double().numpy()[:, None]
    return np.stack([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy], 1)


def nerfstudio(folder: Path, split: str) -> tuple[dict[str, Any], np.ndarray]:
    """Frames of a split by file with matrix and intrinsics, and points, by nerfstudio_dataparser.py.

    Values of the file hold for all frames where it has them; frames are sorted by name; lists choose a split.
    """
    meta = json.loads((folder / "transforms.json").read_text())
    frames = sorted(meta["frames"], key=lambda frame: Path(frame["file_path"]))
    if any(f"{one}_filenames" in meta for one in ("train", "val", "test")):
        frames = [frame for frame in frames if frame["file_path"] in meta[f"{split}_filenames"]]
    lens = ("fl_x", "fl_y", "cx", "cy", "w", "h")
    values = {f["file_path"]: [np.array(f["transform_matrix"]), *((meta | f)[key] for key in lens)] for f in frames}
    assert np.array_equal(meta["applied_transform"], np.eye(4)[:3])
    assert meta["camera_model"] == "PINHOLE"
    columns = read_ply(folder / meta["ply_file_path"])
    return values, np.stack([columns[axis] for axis in "xyz"], 1).astype(np.float64)


@pytest.mark.parametrize("split", ["train", "val", "test"])
def test_nerfstudio_projects_the_points_to_the_same_pixels(source: Path, whole: Path, split: str) -> None:
    scene = of_source(source)
    views = scene.train if split == "train" else scene.test
    frames, points = nerfstudio(whole, split)
    for (file, (matrix, fx, fy, cx, cy, width, height)), view in zip(frames.items(), views, strict=True):
        assert torch.equal(read_image(whole / file), view.picture())
        assert (width, height) == view.camera.size
        x, y, z, _ = np.linalg.inv(matrix) @ np.concatenate([points, np.ones((len(points), 1))], 1).T
        pixels = np.stack([fx * x / -z + cx, fy * -y / -z + cy], 1)  # OpenGL: y up, z back
        assert np.allclose(pixels, projected(view.camera, points), atol=1e-6)


@pytest.mark.parametrize(
    ("model", "train", "test"),
    [("sparse/0", True, False), ("all_views/sparse/0", True, True), ("test_x2/sparse/0", False, True)],
)
def test_colmap_projects_the_points_to_the_same_pixels(
    source: Path, train_only: Path, model: str, train: bool, test: bool
) -> None:
    scene, read = of_source(source), pycolmap.Reconstruction(train_only / model)
    views = [*scene.train * train, *scene.test * test]
    if "x2" in model:
        views = [zoomed for view in views if (zoomed := view.zoom(2))]
    names = sorted(view.name for view in views)  # they end in .png, as those of the files
    images = {image.name: image for image in read.images.values()}
    assert sorted(images) == names
    assert read.num_cameras() == 1
    points = np.stack([point.xyz for point in read.points3D.values()])
    assert np.allclose(np.sort(points[:, 0]), np.sort(scene.points.positions[:, 0].numpy()), atol=1e-7)
    for view in views:
        image = images[view.name]
        pixels = image.camera.img_from_cam(image.cam_from_world() * points)
        assert np.allclose(pixels, projected(view.camera, points), atol=1e-6)
        assert (image.camera.width, image.camera.height) == view.camera.size


def test_cameras_at_each_zoom_are_those_of_the_truth(source: Path, whole: Path) -> None:
    scene, points = of_source(source), np.random.default_rng(0).uniform(-1, 1, (20, 3))
    for zoom in (1, 2):
        content = read_json(whole / f"cameras_x{zoom}.json")
        assert content["zoom"] == zoom
        for entry, view in zip(content["cameras"], scene.test, strict=True):
            finer = view.zoom(zoom)
            assert finer
            assert torch.equal(read_image(whole / "truth" / f"x{zoom}" / entry["file"]), finer.picture())
            assert [entry["width"], entry["height"]] == list(finer.camera.size)
            matrix = np.array(entry["camera_from_world"])
            assert np.allclose(matrix @ np.array(entry["world_from_camera"]), np.eye(4), atol=1e-12)
            x, y, z = matrix[:3, :3] @ points.T + matrix[:3, 3:]
            pixels = np.stack([entry["fx"] * x / z + entry["cx"], entry["fy"] * y / z + entry["cy"]], 1)
            assert np.allclose(pixels, projected(finer.camera, points), atol=1e-6)
    sizes = read_json(whole / "prepared.json")["test"][0]["sizes"]
    assert sizes == {"1": [32, 24], "2": [64, 48]}


# -- special scenes ----------------------------------------------------------------------------------------------------


def test_a_scene_far_away_is_written_in_the_coordinates_of_its_files(tmp_path: Path) -> None:
    model = synthesize(frames=FRAMES)
    model.transform(pycolmap.Sim3d(1.0, pycolmap.Rotation3d(), np.array(UTM)))
    write_scene(model, tmp_path / "source")
    to = run(tmp_path / "source", tmp_path / "prepared")
    names = {image.name: image for image in model.images.values()}
    for image in pycolmap.Reconstruction(to / "sparse" / "0").images.values():
        assert np.allclose(image.projection_center(), names[image.name].projection_center(), atol=1e-6)
    for form in ("colmap", "transforms"):
        again = scene_of([f"scene={form}", f"scene.path={to}", "scene.split=none"])
        same_views(of_source(tmp_path / "source", "scene.split=every:8").train, again.train)


def test_masks_are_written_as_nerfstudio_reads_them(source: Path, tmp_path: Path) -> None:
    write_scene(synthesize(frames=FRAMES), tmp_path / "source")
    masks = tmp_path / "source" / "masks"
    masks.mkdir()
    masked = sorted(path.name for path in (tmp_path / "source" / "images").iterdir())[1]
    picture = torch.full((3, 48, 64), 255, dtype=torch.uint8)
    picture[:, 10:20, 30:50] = 0
    write_image(masks / masked, picture)
    to = run(tmp_path / "source", tmp_path / "prepared")
    frames = read_json(to / "transforms.json")["frames"]
    assert all((to / frame["mask_path"]).is_file() for frame in frames), "of all frames or of none"
    assert header_of(to / "masks" / masked).nchannels == 1, "nerfstudio refuses others"
    for form in ("colmap", "transforms"):
        for view, other in zip(
            of_source(tmp_path / "source").train,
            scene_of([f"scene={form}", f"scene.path={to}", "scene.split=none"]).train,
            strict=True,
        ):
            assert torch.equal(counted(view), counted(other))
    assert not counted(view).all() or view.name != masked


def counted(view: View) -> Tensor:
    """The pixels that count."""
    marks = view.counted()
    return torch.ones(view.camera.height, view.camera.width, dtype=torch.bool) if marks is None else marks


def test_the_built_in_scene_is_written_without_a_folder(tmp_path: Path) -> None:
    assert main(["prepare", "--to", str(tmp_path / "demo"), "scene=demo", *DEMO, "eval.zoom=[1,2]"]) == 0
    assert sorted(path.name for path in (tmp_path / "demo" / "images").iterdir())[0] == "train_000.png"


@pytest.mark.parametrize("folder", ["train_only", "whole"])
def test_commands_in_the_readme_train_on_training_views_alone(folder: str, request: pytest.FixtureRequest) -> None:
    text = (request.getfixturevalue(folder) / "README.txt").read_text()
    split = {"train.py": "--eval\n", "simple_trainer.py": "--test_every 8 "}
    assert {word: option in text for word, option in split.items()} == dict.fromkeys(split, folder == "whole")
    assert ("--eval-mode all" in text) == ("opensplat FOLDER" in text) == (folder == "train_only")


# -- names -------------------------------------------------------------------------------------------------------------


def test_names_come_from_views() -> None:
    assert file_names(["a.jpg", "b/c d.PNG", "e.f.jpg", "g"]) == ["a.png", "b_c_d.png", "e_f.png", "g.png"]
    assert file_names(["b/x.jpg", "a/x.JPG"]) == ["b_x.png", "a_x.png"]
    assert file_names(["a/b.jpg", "a_b.jpg", "c.png"]) == ["2_a_b.png", "1_a_b.png", "3_c.png"], "two would be one"
    assert file_names(["A.jpg", "a.png"]) == ["1_A.png", "2_a.png"], "one file for Windows"


def test_names_sort_as_views_where_the_split_counts_them() -> None:
    names = ["left/2.jpg", "right/1.jpg"]  # 3D-GS sorts by the last part
    assert file_names(names) == ["left_2.png", "right_1.png"]
    assert file_names(names, keep_order=True) == ["2_left_2.png", "1_right_1.png"]
    assert file_names(["a.jpg", "b.jpg"], keep_order=True) == ["a.png", "b.png"]


# -- refusals ----------------------------------------------------------------------------------------------------------


def test_a_prepared_folder_stays_and_others_are_refused(
    source: Path, train_only: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = (train_only / "prepared.json").stat().st_mtime_ns
    run(source, train_only)
    assert (train_only / "prepared.json").stat().st_mtime_ns == before
    assert "stays as it is" in capsys.readouterr().err
    assert main(["prepare", str(source), "--to", str(train_only), "scene.downscale=4"]) == 2
    assert "other settings (overrides, protocol, test, zooms differ): remove it" in capsys.readouterr().err
    (tmp_path / "mine.txt").write_text("x")
    for place, reason in ((tmp_path, "holds other files"), (tmp_path / "mine.txt", "is a file")):
        assert main(["prepare", str(source), "--to", str(place)]) == 2
        assert reason in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["mine.txt"]


def test_a_folder_inside_of_the_scene_is_refused(source: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Photos without poses are searched in subfolders."""
    assert main(["prepare", str(source), "--to", str(source / "prepared")]) == 2
    assert "inside of the scene's folder" in capsys.readouterr().err
    assert not (source / "prepared").exists()


def test_nothing_stays_of_a_folder_that_cannot_be_finished(
    source: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*arguments: Any) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(prepared, "write_transforms", full)
    assert main(["prepare", str(source), "--to", str(tmp_path / "out")]) == 2
    assert list(tmp_path.iterdir()) == []


@pytest.mark.skipif(sys.platform != "linux", reason="no folder that refuses all files")
def test_a_place_that_cannot_be_written_is_named(source: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["prepare", str(source), "--to", "/proc/prepared"]) == 2
    assert "(/proc/prepared)" in capsys.readouterr().err


def test_an_empty_folder_is_filled(source: Path, tmp_path: Path) -> None:
    assert (run(source, tmp_path) / "prepared.json").is_file()


def test_a_zoom_without_photos_that_fine_is_refused(source: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"eval\.zoom has 4, but test photos are at most 2\.02 times as fine"):
        prepared.prepare(
            ["scene=colmap", f"scene.path={source}", "scene.downscale=2", "eval.zoom=[1,4]"], tmp_path / "o", plugins()
        )


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        ([], "required: --to"),
        (["--to", "x"], "needs a scene"),
        (["--to", "x", "scene.downscale=2"], "needs a scene"),
        (["--to", "x", "scene=demo", "iterations=5"], "trains nothing"),
        ([".", "--to", "x", "scene=demo"], "does not go with the folder"),
        ([".", "other", "--to", "x"], "'other' is no setting"),
        (["./absent", "--to", "x"], "does not exist"),
        (["--to", "x", "--scene=demo"], "settings have no dashes"),
    ],
)
def test_words_that_belong_to_no_scene_are_refused(words: list[str], reason: str) -> None:
    with pytest.raises((ConfigError, InputError), match=reason):
        parse_prepare(words)
