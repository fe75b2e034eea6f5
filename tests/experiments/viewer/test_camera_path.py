"""Camera paths: through the keyframes, smooth between them, and read from files of ours and of nerfstudio."""

import json
import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from gsx.cli.dispatch import main
from gsx.core.data.images import read_image
from gsx.core.errors import InputError
from gsx.core.gaussians.splats import Gaussians
from gsx.experiments.viewer.camera_path import CameraPath, Keyframe, read_camera_path, write_camera_path
from gsx.formats.splat_files import write_gaussians

QUARTER = (math.sqrt(0.5), 0.0, math.sqrt(0.5), 0.0)
"""A quarter turn about y."""


def path() -> CameraPath:
    frames = [
        Keyframe(0.0, (0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), math.radians(60)),
        Keyframe(1.0, (1.0, 0.0, 0.0), QUARTER, math.radians(60)),
        Keyframe(2.0, (2.0, 0.0, 0.0), QUARTER, math.radians(30)),
    ]
    return CameraPath(size=(80, 60), fps=4.0, keyframes=tuple(frames))


def test_keyframes_are_met_and_straight_ways_stay_straight() -> None:
    cameras = path().cameras()
    assert len(cameras) == 9
    for at, camera in enumerate(cameras):  # evenly spaced keyframes on a line: even speed
        assert torch.allclose(camera.centre, torch.tensor([at / 4, 0, 0], dtype=torch.float64), atol=1e-12)
    assert cameras[0].fy == pytest.approx(30 / math.tan(math.radians(30)))
    assert cameras[8].fy == pytest.approx(30 / math.tan(math.radians(15)))
    assert cameras[6].fy == pytest.approx(math.sqrt(cameras[4].fy * cameras[8].fy))
    # half way of a quarter turn is an eighth: x and z of the forward axis are equal
    forward = cameras[2].rotation[2]
    assert float(forward[0]) == pytest.approx(math.sqrt(0.5))
    assert float(forward[2]) == pytest.approx(math.sqrt(0.5))
    assert path().cameras(zoom=2)[0].size == (160, 120)


def test_the_way_ends_at_its_last_keyframe_whatever_its_length() -> None:
    """2.05 s of four frames a second are nine frames, of which the last would lie 0.2 s beyond."""
    frames = [replace(frame, time=frame.time * 2.15 / 2) for frame in path().keyframes]
    cameras = replace(path(), keyframes=tuple(frames)).cameras()
    assert len(cameras) == 10
    assert torch.allclose(cameras[-1].centre, torch.tensor([2.0, 0, 0], dtype=torch.float64), atol=1e-12)


def test_a_file_is_read_as_it_was_written(tmp_path: Path) -> None:
    write_camera_path(tmp_path / "a.json", path())
    again = read_camera_path(tmp_path / "a.json")
    assert again.size == (80, 60)
    for mine, read in zip(path().keyframes, again.keyframes, strict=True):
        assert read.fov == pytest.approx(mine.fov)
        assert (read.time, read.position, read.wxyz) == (mine.time, mine.position, mine.wxyz)


def test_nerfstudio_looks_along_minus_z_with_y_up(tmp_path: Path) -> None:
    """At (1, 2, 3) without rotation: our camera looks along -z of the world, its y axis points down."""
    matrix = [1, 0, 0, 1, 0, 1, 0, 2, 0, 0, 1, 3, 0, 0, 0, 1]
    entry = {"camera_to_world": matrix, "fov": 90, "aspect": 2.0}
    content = {"camera_type": "perspective", "render_width": 200, "render_height": 100, "fps": 10,
               "seconds": 0.2, "camera_path": [entry, entry]}  # fmt: skip
    (tmp_path / "a.json").write_text(json.dumps(content))
    first, second = read_camera_path(tmp_path / "a.json").cameras()
    assert torch.allclose(first.centre, torch.tensor([1.0, 2, 3], dtype=torch.float64))
    assert torch.allclose(first.rotation, torch.diag(torch.tensor([1.0, -1, -1], dtype=torch.float64)))
    assert (first.fy, first.size) == (pytest.approx(50), (200, 100))
    assert first.draws_as(second)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"fps": 0}, "has 0 for fps"),
        ({"fps": -2}, "has -2 for fps"),
        ({"camera_path": None}, "has None where a list should be"),
        ({"x": -1}, r"has a camera_to_world \(entry 0\) that is no rotation"),  # mirrored
        ({"x": 0}, r"has a camera_to_world \(entry 0\) that is no rotation"),
    ],
)
def test_what_no_camera_of_nerfstudio_can_be_is_told(tmp_path: Path, change: dict[str, object], words: str) -> None:
    matrix = [change.pop("x", 1), 0, 0, 1, 0, 1, 0, 2, 0, 0, 1, 3, 0, 0, 0, 1]
    content = {"camera_type": "perspective", "render_width": 20, "render_height": 10, "fps": 10,
               "camera_path": [{"camera_to_world": matrix, "fov": 90}]}  # fmt: skip
    (tmp_path / "a.json").write_text(json.dumps(content | change))
    with pytest.raises(InputError, match=words):
        read_camera_path(tmp_path / "a.json")


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"gsx_camera_path": 2}, "is of version 2, and this gsx reads version 1"),
        ({"keyframes": None}, "has None where a list should be"),
        ({"keyframes": []}, "no keyframes"),
        ({"size": [0, 10]}, "has size"),
        ({"fps": "fast"}, "'fast' where a number"),
        ({"fps": 1e9}, "frames a second"),
        ({"keyframes": [{"time": 0}]}, "lacks 'position'"),
        ({"keyframes": [{"time": 0, "position": [0, 0], "wxyz": [1, 0, 0, 0], "fov": 60}]}, "2 numbers where 3"),
        (
            {"keyframes": [{"time": 0, "position": [0, 0, 0], "wxyz": [0, 0, 0, 0], "fov": 60}]},
            "rotation that is none",
        ),
        ({"keyframes": [{"time": 0, "position": [0, 0, 0], "wxyz": [1, 0, 0, 0], "fov": 180}]}, "between 0 and 180"),
    ],
)
def test_what_no_camera_can_be_is_told(tmp_path: Path, change: dict[str, object], words: str) -> None:
    write_camera_path(tmp_path / "a.json", path())
    (tmp_path / "a.json").write_text(json.dumps(json.loads((tmp_path / "a.json").read_text()) | change))
    with pytest.raises(InputError, match=words):
        read_camera_path(tmp_path / "a.json")


@pytest.mark.parametrize(
    "text", ["", "[]", "{}", "3", '{"camera_path": 5, "fps": 1}', '{"camera_path": [{}], "seconds": 0}', "[" * 100_000]
)
def test_other_files_are_told(tmp_path: Path, text: str) -> None:
    (tmp_path / "a.json").write_text(text)
    with pytest.raises(InputError, match="camera path"):
        read_camera_path(tmp_path / "a.json")


def test_a_splat_file_is_filmed_along_a_path(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A red splat five units ahead: in the middle at first, out of view after a quarter turn."""
    one = Gaussians(
        means=torch.tensor([[0.0, 0, 5]]), log_scales=torch.full((1, 3), -2.0), quats=torch.eye(4)[:1],
        opacity_logits=torch.tensor([4.0]), sh_dc=torch.tensor([[1.77, -1.77, -1.77]]), sh_rest=torch.zeros(1, 0, 3),
    )  # fmt: skip
    write_gaussians(tmp_path / "a.ply", one)
    write_camera_path(tmp_path / "a.json", path())
    words = ["render", str(tmp_path / "a.ply"), "--path", str(tmp_path / "a.json")]
    assert main([*words, "--to", str(tmp_path / "to")]) == 0
    assert capsys.readouterr().out.strip() == str(tmp_path / "to")
    pictures = [read_image(file)[:3] for file in sorted((tmp_path / "to").iterdir())]
    assert len(pictures) == 9
    assert pictures[0][0, 30, 40] > 200
    assert pictures[0][1, 30, 40] < 20
    assert int(pictures[5].max()) == 0
    assert capsys.readouterr().err == ""
    write_camera_path(tmp_path / "a.json", replace(path(), fps=path().fps / 2))
    assert main([*words, "--to", str(tmp_path / "to")]) == 0
    assert "also holds 4 frames of a longer path, from frame_00005.png on" in capsys.readouterr().err
    assert main([*words, "--movie", str(tmp_path / "a.gif")]) == 0
    assert (tmp_path / "a.gif").read_bytes()[:3] == b"GIF"
    assert main(["render", str(tmp_path / "a.ply")]) == 2
    assert "give cameras with --path" in capsys.readouterr().err
