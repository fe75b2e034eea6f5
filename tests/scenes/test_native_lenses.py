"""Scenes with scene.lens=native: photos stay, cameras have the lens; the built-in scenes through a fisheye."""

import json
from pathlib import Path
from typing import Any

import pytest
import torch
from refusals import refused
from synthetic_colmap import colmap_options, shipped, synthesize, write_scene

from gsx.core.data.images import read_image
from gsx.core.data.scene import Scene
from gsx.experiments.runs.typed import typed
from gsx.lenses import Distortion
from gsx.scenes import room
from gsx.scenes.colmap import load

FISHEYE = (40.0, 41.0, 30.0, 25.0, 0.05, -0.02, 0.01, 0.0)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    write_scene(synthesize("OPENCV_FISHEYE", FISHEYE), tmp_path)
    return tmp_path


def test_photos_stay_and_points_lie_on_their_keypoints(folder: Path) -> None:
    scene = load(colmap_options(folder, lens="native"))
    view = scene.train[0]
    assert torch.equal(view.picture(), read_image(folder / "images" / view.name))
    assert view.camera.lens == Distortion(fisheye=True, radial=FISHEYE[4:])
    assert view.counted() is None
    assert any("Reprojection error 0.00 px" in note for note in scene.notes)
    assert any("through their lens" in note for note in scene.notes)
    assert scene.provenance["lens"] == "native"
    assert "lens" not in load(colmap_options(folder)).provenance


def test_zoomed_views_keep_the_lens(folder: Path) -> None:
    view = load(colmap_options(folder, lens="native", downscale=2)).train[0]
    fine = view.zoom(2)
    assert fine is not None
    assert torch.equal(fine.picture(), read_image(folder / "images" / view.name))
    point = (view.camera.rotation.T @ (torch.tensor([0.4, -0.3, 1.0]) - view.camera.translation))[None]
    torch.testing.assert_close(fine.camera.project(point)[0], 2 * view.camera.project(point)[0])


def test_a_lens_that_is_not_rendered_is_refused(tmp_path: Path) -> None:
    write_scene(synthesize("FOV", (40.0, 41.0, 30.0, 25.0, 0.4)), tmp_path)
    refused("not FOV: set scene.lens=undistort", load, colmap_options(tmp_path, lens="native"))


def room_through(**changes: Any) -> Scene:
    size = {"width": 48, "height": 36, "train_views": 4, "test_views": 1, "samples": 2, "fisheye": 120.0}
    options = typed(room.RoomOptions, shipped("room") | size | changes, "scene")
    assert isinstance(options, room.RoomOptions)
    return room.load(options)


def test_a_built_in_photo_shows_its_points_through_the_fisheye() -> None:
    scene = room_through(lens="native", points=400)
    camera, picture = scene.train[0].camera, scene.train[0].picture().float()
    assert float(camera.slopes(torch.tensor([[0.0, 18.0]]))[0, 0]) == pytest.approx(-(3**0.5))  # tan 60 degrees
    pixels, depths = camera.project(scene.points.positions)
    depth = scene.train[0].source.exact_depth(camera)  # type: ignore[attr-defined]
    column, row = pixels.nan_to_num(-1).long().clamp(min=0).unbind(1)
    inside = camera.shows(pixels, depths)
    column, row = torch.where(inside, column, 0), torch.where(inside, row, 0)
    seen = inside & ((depth[row, column] - depths).abs() < 0.02 * depths)
    assert int(seen.sum()) > 30
    off = (picture[:, row, column].T - scene.points.colours)[seen].abs().mean()
    assert float(off) < 25  # a pixel averages what a point does not


def test_undistorted_photos_show_the_same_at_the_middle() -> None:
    native, straight = (room_through(lens=lens, points=10).train[0] for lens in ("native", "undistort"))
    assert straight.camera.lens is None
    assert straight.camera.width > native.camera.width
    middle = [torch.tensor([[view.camera.cx, view.camera.cy]]) for view in (native, straight)]
    colours = [
        view.image()[:, int(y) - 2 : int(y) + 2, int(x) - 2 : int(x) + 2].mean((1, 2))
        for view, ((x, y),) in zip((native, straight), middle, strict=True)
    ]
    torch.testing.assert_close(*colours, rtol=0, atol=0.03)
    assert straight.zoom(2).picture().shape == (3, 2 * straight.camera.height, 2 * straight.camera.width)  # type: ignore[union-attr]


def test_provenance_names_the_fisheye() -> None:
    assert json.dumps(room_through(lens="native", points=10).provenance).count("120") == 1
    assert "fisheye" not in room_through(fisheye=0.0, points=10).provenance
