"""Scenes whose cameras stand in one place: what their extent is taken from."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
import pytest
import torch
from small_scene import small_scene, spread
from synthetic_colmap import synthesize, write_scene

from gsx.builtin import plugins
from gsx.core.data.camera import Camera, look_at
from gsx.core.data.images import write_image
from gsx.core.data.scene import PointCloud, Scene, View, extent_of
from gsx.core.errors import InputError
from gsx.experiments.runs.capture import capture_lines
from gsx.experiments.runs.compose import compose
from gsx.experiments.runs.inspect import describe
from gsx.experiments.runs.load_scene import in_one_place, load_scene, measured

PLACE = (0.1, 0.2, 0.3)
NOTE = "all training cameras stand at one place"


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("GSX_CACHE", str(tmp_path / "cache"))


def turned(place: tuple[float, float, float], jitter: float, count: int = 8) -> list[Camera]:
    """Cameras all around, looking outwards, their centres off by so much (standard deviation)."""
    offsets = jitter * np.random.default_rng(0).normal(size=(count, 3))
    eyes = np.array(place) + offsets
    ahead = [np.array([np.cos(turn), np.sin(turn), 0.1]) for turn in 2 * np.pi * np.arange(count) / count]
    pairs = zip(eyes, ahead, strict=True)
    return [look_at(eye.tolist(), (eye + way).tolist(), fov_x=1.2, width=24, height=16) for eye, way in pairs]


def scene_of(cameras: list[Camera], positions: torch.Tensor) -> Scene:
    base = small_scene(positions)
    views = [View(f"view{i}", camera, base.train[0].source) for i, camera in enumerate(cameras)]
    return replace(base, train=views, extent=extent_of(cameras))


def around(place: tuple[float, float, float], distance: float) -> torch.Tensor:
    """Points at a distance from a place, in all directions."""
    ways = torch.randn(200, 3, generator=torch.Generator().manual_seed(0))
    return torch.tensor(place) + distance * ways / ways.norm(dim=1, keepdim=True)


@pytest.mark.parametrize("distance", [0.05, 3.0, 1e3])
@pytest.mark.parametrize("jitter", [0.0, 1e-16, 1e-6])
@pytest.mark.parametrize("place", [(0.0, 0.0, 0.0), PLACE])
def test_a_tripod_takes_its_extent_from_the_points(
    place: tuple[float, float, float], jitter: float, distance: float
) -> None:
    cameras = turned(place, jitter * distance)
    scene = measured(scene_of(cameras, around(place, distance)))
    assert scene.extent == pytest.approx(1.1 * distance, rel=1e-3)
    assert scene.notes[-1].startswith(NOTE)


@pytest.mark.parametrize("baseline", [1e-4, 1e-3, 1e-2, 1.0])
def test_a_small_true_baseline_keeps_the_published_extent(baseline: float) -> None:
    """Close-ups: cameras moved by a thousandth of the distance."""
    cameras = turned(PLACE, 3 * baseline)
    scene = measured(scene_of(cameras, around(PLACE, 3.0)))
    assert scene.extent == extent_of(cameras)
    assert not scene.notes


def test_a_loaders_own_extent_is_kept() -> None:
    assert measured(replace(scene_of(turned(PLACE, 0.0), around(PLACE, 3.0)), extent=2.5)).extent == 2.5


def test_without_points_nothing_says_how_large_it_is() -> None:
    scene = measured(scene_of(turned(PLACE, 1e-6), torch.zeros(0, 3)))
    assert scene.extent == 0
    far = scene_of([replace(camera, translation=2.0 * camera.translation) for camera in turned(PLACE, 1.0)], spread(0))
    assert measured(far) is far


def test_no_ring_is_made_up() -> None:
    scene = scene_of(turned(PLACE, 1e-6), around(PLACE, 3.0))
    assert in_one_place([view.camera for view in scene.train], scene.points)
    assert not any(line.startswith("around") for line in capture_lines(scene))


def tripod(folder: Path, jitter: float) -> Path:
    """A COLMAP scene whose cameras have all been moved to one place; keypoints are where they see the points."""
    reconstruction, generator = synthesize(frames=6), np.random.default_rng(0)
    for point in reconstruction.points3D.values():
        point.xyz = point.xyz + np.array([0.0, 0.0, 9.0])
    for number, frame in reconstruction.frames.items():
        turn = pycolmap.Rotation3d(np.array([0.0, 0.0, np.sin(0.1 * number), np.cos(0.1 * number)]))
        centre = np.array(PLACE) + jitter * generator.normal(size=3)
        frame.rig_from_world = pycolmap.Rigid3d(turn, -(turn.matrix() @ centre))
    for image in reconstruction.images.values():
        for keypoint in image.points2D:
            if keypoint.has_point3D():
                keypoint.xy = image.project_point(reconstruction.points3D[keypoint.point3D_id].xyz)
    write_scene(reconstruction, folder)
    return folder


@pytest.mark.parametrize("jitter", [0.0, 1e-6])
def test_runs_and_gsx_scenes_say_it(tmp_path: Path, jitter: float) -> None:
    folder = tripod(tmp_path / "tripod", jitter)
    scene = load_scene(compose(["scene=colmap", f"scene.path={folder}"], plugins()))
    distance = (scene.points.positions.double() - torch.tensor(PLACE).double()).norm(dim=1).median()
    assert scene.extent == pytest.approx(1.1 * float(distance), rel=1e-4)
    lines = describe(folder, plugins())
    source = "1.1 x the median distance of the points: cameras stand in one place"
    assert f"extent    {scene.extent:.4g} scene units ({source})" in lines
    assert any(line.startswith(f"note      {NOTE}") for line in lines)


@pytest.mark.parametrize("jitter", [0.0, 1e-6])
def test_random_points_between_cameras_in_one_place_are_refused(tmp_path: Path, jitter: float) -> None:
    frames = []
    for number, camera in enumerate(turned(PLACE, jitter)):
        pose = np.eye(4)
        pose[:3, :3] = camera.rotation.T.numpy() @ np.diag([1.0, -1.0, -1.0])
        pose[:3, 3] = camera.centre.numpy()
        write_image(tmp_path / f"{number}.png", torch.rand(3, 16, 24, generator=torch.Generator().manual_seed(number)))
        frames.append({"file_path": f"{number}.png", "transform_matrix": pose.tolist()})
    (tmp_path / "transforms.json").write_text(json.dumps({"fl_x": 20.0, "w": 24, "h": 16, "frames": frames}))
    given = ["scene=transforms", f"scene.path={tmp_path}"]
    with pytest.raises(InputError, match=r"stand within .* units .*, as on a tripod.*scene\.points to a PLY"):
        load_scene(compose(given, plugins()))
    if jitter:
        large = load_scene(compose([*given, "scene.unit=1e6"], plugins()))  # these are its units, then
        assert large.extent > 0.5


def test_points_are_only_as_far_as_they_are(tmp_path: Path) -> None:
    """Cameras in one place and all points in it give nothing."""
    scene = replace(scene_of(turned((0.0, 0.0, 0.0), 0.0), torch.zeros(5, 3)))
    assert measured(scene).extent == 0
    assert isinstance(scene.points, PointCloud)
