"""Scenes far from (0, 0, 0): what loaders read in double precision is trained around an origin."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pytest
import torch
from refusals import refused
from small_scene import small_scene, spread
from synthetic_colmap import synthesize, write_photos, write_scene

from gsx.builtin import plugins
from gsx.core.data.camera import look_at
from gsx.core.data.images import write_image
from gsx.core.data.scene import Scene
from gsx.experiments.runs.compose import compose
from gsx.experiments.runs.load_scene import load_scene
from gsx.formats.origin import NO_ORIGIN, chosen_origin, comment_of, origin_of_positions, stated_in
from gsx.formats.ply import write_ply
from gsx.scenes.origin import around_origin, focus_of, origin_of

UTM = (500_000.0, 5_400_000.0, 300.0)
ECEF = (4_075_580.5, 931_853.25, 4_801_568.125)
NOWHERE = (0.0, 0.0, 0.0)


def moved_model(offset: tuple[float, float, float]) -> Any:
    model = synthesize(frames=6)
    model.transform(pycolmap.Sim3d(1.0, pycolmap.Rotation3d(), np.array(offset)))
    return model


def colmap(folder: Path, offset: tuple[float, float, float], text: bool) -> list[str]:
    write_scene(moved_model(offset), folder, text=text)
    return ["scene=colmap"]


def frames_of(model: Any, folder: Path) -> list[dict[str, Any]]:
    """Frames of transforms files, of OpenGL cameras."""
    write_photos(model, folder)
    frames = []
    for image in sorted(model.images.values(), key=lambda image: image.name):
        pose = image.cam_from_world().inverse()
        axes = np.diag([1.0, -1.0, -1.0])
        matrix = np.concatenate([pose.rotation.matrix() @ axes, pose.translation[:, None]], 1)
        frames.append({"file_path": image.name, "transform_matrix": [*matrix.tolist(), [0.0, 0.0, 0.0, 1.0]]})
    return frames


def columns_of(model: Any, kind: type) -> dict[str, np.ndarray]:
    points = np.array([model.point3D(number).xyz for number in sorted(model.points3D)])
    return {axis: points[:, i].astype(kind) for i, axis in enumerate("xyz")}


def transforms(folder: Path, offset: tuple[float, float, float], kind: type = np.float64) -> list[str]:
    model = moved_model(offset)
    content = {"fl_x": 80.0, "fl_y": 82.0, "cx": 30.0, "cy": 25.0, "frames": frames_of(model, folder)}
    (folder / "transforms.json").write_text(json.dumps(content | {"ply_file_path": "points.ply"}))
    write_ply(folder / "points.ply", columns_of(model, kind))
    return ["scene=transforms"]


def blender(folder: Path, offset: tuple[float, float, float]) -> list[str]:
    frames, angle = frames_of(moved_model(offset), folder), 2 * np.arctan(32 / 80)
    for split, part in (("train", frames[1:]), ("test", frames[:1])):
        (folder / f"transforms_{split}.json").write_text(json.dumps({"camera_angle_x": angle, "frames": part}))
    return ["scene=blender", "scene.random_points=400"]


def bungee(folder: Path, offset: tuple[float, float, float]) -> list[str]:
    """Cameras that look down from 2 to 7; heights count from the ground."""
    (folder / "images").mkdir()
    poses = []
    for i in range(6):
        place = [offset[0] + i % 3 - 1, offset[1] + i // 3, 2.0 + i]
        matrix = np.concatenate([np.eye(3), np.array(place)[:, None], [[48], [64], [64]]], 1)
        poses.append([*matrix.flatten().tolist(), 0.1, 10.0])
        write_image(folder / "images" / f"{i}.png", torch.full((3, 48, 64), i / 10))
    (folder / "poses_enu.json").write_text(json.dumps({"poses": poses, "scene_scale": 0.01}))
    return ["scene=bungee", "scene.random_points=2000"]


def loaded(folder: Path, words: list[str], *more: str) -> Scene:
    return load_scene(compose([*words, f"scene.path={folder}", *more], plugins()))


def positions(scene: Scene) -> tuple[torch.Tensor, torch.Tensor]:
    """Cameras and points in the coordinates of the files."""
    views, origin = [*scene.train, *scene.test], torch.tensor(scene.origin, dtype=torch.float64)
    return torch.stack([view.camera.centre for view in views]) + origin, scene.points.positions.double() + origin


FORMATS = {
    "colmap": lambda folder, offset: colmap(folder, offset, text=False),
    "colmap as text": lambda folder, offset: colmap(folder, offset, text=True),
    "transforms": transforms,
    "blender": blender,
    "bungee": bungee,
}


@pytest.mark.parametrize("offset", [UTM, ECEF], ids=["utm", "ecef"])
@pytest.mark.parametrize("make", FORMATS.values(), ids=FORMATS)
def test_a_moved_scene_is_the_scene_moved(tmp_path: Path, make: Callable[..., list[str]], offset: Any) -> None:
    """Within a ten-thousandth of its size, 5; float32 has steps of 0.5 there."""
    (tmp_path / "here").mkdir()
    (tmp_path / "there").mkdir()
    scene = loaded(tmp_path / "here", make(tmp_path / "here", NOWHERE))
    moved = loaded(tmp_path / "there", make(tmp_path / "there", offset))
    assert scene.origin == NO_ORIGIN
    assert any(moved.origin)
    assert all(abs(ours - theirs) < 10 for ours, theirs in zip(moved.origin[:2], offset[:2], strict=True))
    assert moved.points.positions.dtype == torch.float32
    assert moved.points.positions.abs().max() < 50
    cameras, points = positions(moved)
    there = torch.tensor(offset, dtype=torch.float64)
    there[2] = 0 if make is bungee else there[2]
    torch.testing.assert_close(cameras - there, positions(scene)[0], atol=1e-6, rtol=0)
    if make in (blender, bungee):  # random, around what cameras look at: not quite (0, 0, 0)
        torch.testing.assert_close(
            (points - there).median(0).values, positions(scene)[1].median(0).values, atol=0.8, rtol=0
        )
    else:
        torch.testing.assert_close(points - there, positions(scene)[1], atol=1e-5, rtol=0)
        assert len(points.unique(dim=0)) == len(points)
    assert moved.extent == pytest.approx(scene.extent, rel=1e-6)
    assert any("trained around" in note for note in moved.notes)
    assert not any("trained around" in note for note in scene.notes)
    assert [view.group for view in moved.train] == [view.group for view in scene.train]


def test_points_in_single_precision_are_named(tmp_path: Path) -> None:
    """nerfstudio's and Open3D's PLY hold floats: what is lost there cannot be had again."""
    notes = loaded(tmp_path, transforms(tmp_path, UTM, np.float32)).notes
    assert any("stored in single precision, in steps of 0.5 units" in note for note in notes)


def test_units_multiply_the_origin(tmp_path: Path) -> None:
    scene = loaded(tmp_path, transforms(tmp_path, UTM), "scene.unit=0.1")
    cameras, _ = positions(scene)
    expected = positions(loaded(tmp_path, ["scene=transforms"]))[0] * 0.1
    torch.testing.assert_close(cameras, expected, atol=1e-7, rtol=0)


def test_views_that_are_computed_stay_where_they_are() -> None:
    """Their truth depends on where a camera stands."""
    scene = small_scene(spread(20))
    away = [replace(view, camera=look_at([1e6 + i, 4, 1], [1e6, 0, 0], fov_x=0.9, width=24, height=16))
            for i, view in enumerate(scene.train)]  # fmt: skip
    assert origin_of(replace(scene, train=away)) == NO_ORIGIN


def test_an_ordinary_scene_is_left_alone() -> None:
    scene = small_scene(spread(20))
    assert around_origin(scene, NO_ORIGIN) is scene


@pytest.mark.parametrize(
    ("middle", "scale", "origin"),
    [
        ((1.0, 2.0, 3.0), 1.0, NO_ORIGIN),
        ((31.0, 0.0, -31.9), 1.0, NO_ORIGIN),
        ((-40.3, 0.2, 5.0), 1.0, (-40.0, 0.0, 5.0)),
        ((500123.4, 5400987.6, 312.0), 250.0, (500100.0, 5401000.0, 300.0)),
        ((12.3456, 0.0, 0.0), 0.03, (12.35, 0.0, 0.0)),
        ((12.0, 0.0, 0.0), 0.0, (12.0, 0.0, 0.0)),
    ],
)
def test_origins_are_round_and_only_where_they_are_needed(
    middle: tuple[float, float, float], scale: float, origin: tuple[float, float, float]
) -> None:
    assert chosen_origin(torch.tensor(middle, dtype=torch.float64), scale) == pytest.approx(origin, abs=1e-12)


def test_points_alone_have_an_origin_where_most_are_far() -> None:
    cloud = spread(99).double()
    assert origin_of_positions(cloud) == NO_ORIGIN
    assert origin_of_positions(cloud + torch.tensor(UTM)) == pytest.approx(UTM, abs=0.5)
    assert origin_of_positions(cloud[:0]) == NO_ORIGIN


def test_a_stated_origin_is_read_to_its_last_bit() -> None:
    origin = (500000.1, -5.4e6, 1 / 3)
    assert stated_in(f"comment {comment_of(origin)}\n".encode()) == origin
    for other in (b"comment gsx origin of all things\n", b"gsx origin 1 nan 2", b"", b"ply"):
        assert stated_in(other) == NO_ORIGIN


def test_the_point_that_cameras_look_at() -> None:
    goal = [5e5 + 0.25, 5.4e6, 300.0]
    eyes = [[goal[0] + x, goal[1] + y, goal[2] + 1] for x, y in ((3, 0), (0, 4), (-3, 1))]
    cameras = [look_at(eye, goal, fov_x=0.9, width=24, height=16) for eye in eyes]
    torch.testing.assert_close(focus_of(cameras), torch.tensor(goal, dtype=torch.float64), atol=1e-6, rtol=0)


def rounded_poses(file: Path) -> None:
    """Write quaternions and translations of a text model with six decimals, as some exporters do."""
    lines = []
    for line in file.read_text().splitlines():
        words = line.split()
        pose = not line.startswith("#") and len(words) == 10 and "." in words[9]
        lines.append(" ".join([words[0], *(f"{float(w):.6f}" for w in words[1:8]), *words[8:]]) if pose else line)
    file.write_text("\n".join(lines) + "\n")


def test_adjustment_finds_cameras_whose_turns_text_has_rounded(tmp_path: Path) -> None:
    """COLMAP states translations from world to camera: a turn by 1e-6 moves a camera of UTM coordinates by 5 units."""
    words, model = colmap(tmp_path, UTM, text=True), tmp_path / "sparse" / "0"
    exact = positions(loaded(tmp_path, words))[0]
    for name in ("frames.txt", "rigs.txt"):
        (model / name).unlink(missing_ok=True)
    rounded_poses(model / "images.txt")
    refused(r"scene\.adjust=auto estimates them anew", loaded, tmp_path, words)
    torch.testing.assert_close(positions(loaded(tmp_path, words, "scene.adjust=auto"))[0], exact, atol=0.01, rtol=0)
