"""What `gsx scenes` says about whole, broken and foreign folders; it must never raise."""

import json
import shlex
from pathlib import Path

import numpy as np
import pytest
import torch
from synthetic_colmap import synthesize, write_photos, write_scene

from gsx.builtin import plugins
from gsx.core.data.images import write_image
from gsx.experiments.runs.compose import compose_raw, hydra_session
from gsx.experiments.runs.inspect import describe, readable, training_command
from gsx.experiments.runs.overrides import word_of
from gsx.scenes import colmap, photos

POSE = [[1, 0, 0, 0], [0, 0, -1, -4], [0, 1, 0, 0], [0, 0, 0, 1]]


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("GSX_CACHE", str(tmp_path / "cache"))


def labelled(lines: list[str], label: str) -> list[str]:
    return [line[10:] for line in lines if line[:10].strip() == label]


def write_transforms(folder: Path, name: str, photos: int, absent: int = 0) -> None:
    frames = []
    for number in range(photos + absent):
        pose = np.array(POSE, dtype=float)
        pose[0, 3] = number
        frames.append({"file_path": f"./{number}", "transform_matrix": pose.tolist()})
        if number < photos:
            write_image(folder / f"{number}.png", torch.full((3, 12, 16), number / 100))
    folder.mkdir(exist_ok=True)
    (folder / name).write_text(json.dumps({"camera_angle_x": 0.8, "frames": frames}))


def test_colmap_scene(tmp_path: Path) -> None:
    folder = tmp_path / "my scene"
    write_scene(synthesize("SIMPLE_RADIAL", [80.0, 32.0, 24.0, 0.05], frames=11), folder)
    (folder / "images" / "camera000001_frame000004.png").unlink()
    lines = describe(folder, plugins())
    assert labelled(lines, "format") == ["colmap: COLMAP model with photos"]
    assert labelled(lines, "also") == ["readable as scene=photos"]
    assert labelled(lines, "camera") == ["SIMPLE_RADIAL 64x48, 11 images"]
    assert labelled(lines, "images") == ["10 of 11 in images, absent: camera000001_frame000004.png"]
    assert labelled(lines, "split") == ["8 to train on, 2 to test on"]
    assert labelled(lines, "points") == ["50"]
    assert labelled(lines, "extent")
    assert any("undistorted" in note for note in labelled(lines, "note"))
    assert labelled(lines, "problem") == []
    assert labelled(lines, "train") == [f"gsx scene=colmap 'scene.path={folder}'"]


def test_a_run_is_no_scene(tmp_path: Path) -> None:
    folder = tmp_path / "my run"
    (folder / "images").mkdir(parents=True)
    (folder / "config.yaml").write_text("")
    assert not any("is a run" in line for line in describe(folder, plugins())), "others have such files, too"
    (folder / "environment.json").write_text("")
    told = (
        f"{folder} is a run, not a scene. Use it with gsx view '{folder}', gsx eval '{folder}', gsx resume '{folder}'"
    )
    assert describe(folder, plugins()) == [f"problem   {told}"]


@pytest.mark.parametrize("name", ["plain", "my scene", "fö 'x", "p=q/fox", "a,b", "-lead", "{x}: $y", "back\\slash'"])
def test_the_command_can_be_pasted_whatever_the_folder_is_called(name: str, tmp_path: Path) -> None:
    told = training_command(plugins().registry.find("scene", "colmap"), tmp_path / name, {"images": name})
    program, *words = shlex.split(told)
    with hydra_session(plugins()):
        composed = compose_raw(words)
    assert program == "gsx"
    assert (composed.scene.name, composed.scene.path) == ("colmap", str(tmp_path / name))
    assert composed.scene.images == name


@pytest.mark.parametrize("name", ["2024.10", "1_000", "1e3", "null", "True", "nan", ".5", "0x1F", "on"])
def test_names_that_look_like_other_values_stay_names(name: str) -> None:
    with hydra_session(plugins()):
        composed = compose_raw(["scene=colmap", word_of("scene.images", name)])
    assert composed.scene.images == name


def test_photos_elsewhere_are_found_and_part_of_the_command(tmp_path: Path) -> None:
    reconstruction = synthesize()
    write_scene(reconstruction, tmp_path)
    write_photos(reconstruction, tmp_path / "images_2", (32, 24))
    for file in (tmp_path / "images").iterdir():
        file.unlink()
    lines = describe(tmp_path, plugins())
    assert labelled(lines, "images") == ["5 of 5 in images_2"]
    assert labelled(lines, "views") == ["5 of 32x24"]
    assert labelled(lines, "train") == [f"gsx scene=colmap scene.path={tmp_path} scene.images=images_2"]


def test_truncated_model_is_a_problem_and_the_command_comes_after(tmp_path: Path) -> None:
    model = write_scene(synthesize(), tmp_path)
    (model / "images.bin").write_bytes((model / "images.bin").read_bytes()[:-3])
    lines = describe(tmp_path, plugins())
    (problem,) = labelled(lines, "problem")
    assert "images.bin is truncated" in problem
    assert labelled(lines, "train") == []
    assert lines[-1].startswith("then      gsx scene=colmap")


def test_model_without_any_photo_still_tells_its_cameras(tmp_path: Path) -> None:
    write_scene(synthesize(), tmp_path)
    for file in (tmp_path / "images").iterdir():
        file.unlink()
    lines = describe(tmp_path, plugins())
    assert labelled(lines, "camera") == ["PINHOLE 64x48, 5 images"]
    assert labelled(lines, "images")[0].startswith("0 of 5 in images")
    assert "None of the 5 images" in labelled(lines, "problem")[0]


def test_blender_scene_with_absent_photos(tmp_path: Path) -> None:
    write_transforms(tmp_path, "transforms_train.json", 3)
    write_transforms(tmp_path, "transforms_test.json", 3, absent=1)
    lines = describe(tmp_path, plugins())
    assert labelled(lines, "format")[0].startswith("blender")
    assert labelled(lines, "images") == [
        "3 of 4 of transforms_test.json, absent: ./3",
        "3 of 3 of transforms_train.json",
    ]
    (problem,) = labelled(lines, "problem")
    assert problem.endswith("train on the others with scene.missing=0.25 or more.")
    assert labelled(lines, "then") == [f"gsx scene=blender scene.path={tmp_path}"]


def test_transforms_file_and_its_folder(tmp_path: Path) -> None:
    write_transforms(tmp_path, "transforms.json", 9)
    for path in (tmp_path, tmp_path / "transforms.json"):
        lines = describe(path, plugins())
        assert labelled(lines, "format")[0].startswith("transforms")
        assert labelled(lines, "split") == ["7 to train on, 2 to test on"]
        assert labelled(lines, "train") == [f"gsx scene=transforms scene.path={path}"]


def test_folder_of_photos_is_not_reconstructed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(photos, "reconstruct", None)
    for name, width in (("a.png", 16), ("b.png", 20), ("c.png", 16)):
        write_image(tmp_path / name, torch.zeros(3, 12, width))
    (tmp_path / "d.jpg").write_bytes(b"")
    lines = describe(tmp_path, plugins())
    assert labelled(lines, "images") == [f"2 of 16x12 in {tmp_path}", f"1 of 20x12 in {tmp_path}"]
    assert labelled(lines, "note") == ["Skipped 1 photos that cannot be read: d.jpg."]
    assert labelled(lines, "train") == [f"gsx scene=photos scene.path={tmp_path}"]


def test_bungee_poses_without_photos_are_a_problem(tmp_path: Path) -> None:
    (tmp_path / "poses_enu.json").write_text('{"poses": [[1, 2]]}')
    lines = describe(tmp_path, plugins())
    assert labelled(lines, "format")[0].startswith("bungee")
    assert len(labelled(lines, "problem")) == 1


def test_folder_of_scenes_names_them(tmp_path: Path) -> None:
    write_scene(synthesize(), tmp_path / "a")
    (tmp_path / "b").mkdir()
    write_transforms(tmp_path / "b", "transforms_train.json", 2)
    (problem,) = labelled(describe(tmp_path, plugins()), "problem")
    assert "is not a scene" in problem
    assert "scenes below it: a (colmap), b (blender)." in problem


@pytest.mark.parametrize("content", [None, b"", b"{", b"[1, 2]", b"\xff\xfe", b'{"frames": 3}', b'{"frames": [{}]}'])
@pytest.mark.parametrize(
    "name", ["transforms.json", "transforms_train.json", "poses_enu.json", "sparse/0/cameras.bin", "cameras.txt"]
)
def test_rubbish_is_described_without_raising(tmp_path: Path, name: str, content: bytes | None) -> None:
    file = tmp_path / name
    file.parent.mkdir(parents=True, exist_ok=True)
    if content is not None:
        file.write_bytes(content)
    lines = describe(tmp_path, plugins())
    assert len(labelled(lines, "problem")) == 1
    assert bool(labelled(lines, "then")) == (content is not None)


@pytest.mark.parametrize("name", ["nowhere", "file.txt"])
def test_what_is_no_folder_is_said_to_be_none(tmp_path: Path, name: str) -> None:
    (tmp_path / "file.txt").touch()
    (line,) = describe(tmp_path / name, plugins())
    assert line == f"problem   '{tmp_path / name}' is not a folder: check the name."


def test_unexpected_errors_become_problems(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(path: Path) -> None:
        raise PermissionError(13, "Permission denied", "sparse")

    write_scene(synthesize(), tmp_path)
    monkeypatch.setattr(colmap, "find_model", fail)
    (problem,) = labelled(describe(tmp_path, plugins()), "problem")
    assert problem.startswith("PermissionError: ")
    assert "Permission denied" in problem


def test_poses_come_before_photos_when_both_are_there(tmp_path: Path) -> None:
    write_scene(synthesize(), tmp_path)
    write_transforms(tmp_path, "transforms.json", 1)
    assert [loader.name for loader, _ in readable(tmp_path, plugins())] == ["colmap", "transforms", "photos"]
