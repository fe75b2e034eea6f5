"""Bundle adjustment of what a COLMAP model says: against the poses and lenses that its observations were made with."""

import math
import os
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pytest
import torch
from refusals import refused
from synthetic_colmap import PINHOLE, colmap_options, synthesize, write_scene

from gsx.core.data.scene import Scene
from gsx.core.errors import ConfigError
from gsx.scenes import adjust, bundle, keypoint_fit
from gsx.scenes.colmap import FORMAT, load
from gsx.scenes.colmap_model import Model, read_model
from gsx.scenes.keypoint_fit import movements, shift_of


def turned(reconstruction: Any, px: float) -> Any:
    """With every camera turned at random, by so many px along each axis (standard deviation)."""
    generator = np.random.default_rng(0)
    for frame in reconstruction.frames.values():
        pose, turn = frame.rig_from_world, generator.normal(size=3) * px / PINHOLE[0]
        quaternion = np.array([*(turn / 2), 1.0])
        by = pycolmap.Rotation3d(quaternion / np.linalg.norm(quaternion))
        frame.rig_from_world = pycolmap.Rigid3d(by * pose.rotation, by.matrix() @ pose.translation)
    return reconstruction


def zoomed(reconstruction: Any, factor: float) -> Any:
    """With every focal length multiplied."""
    for camera in reconstruction.cameras.values():
        camera.params = [*(factor * np.array(camera.params[:2])), *camera.params[2:]]
    return reconstruction


def straightened(reconstruction: Any) -> Any:
    """With cameras that say nothing of their distortion."""
    for camera in reconstruction.cameras.values():
        camera.model, camera.params = pycolmap.CameraModelId.PINHOLE, camera.params[:4]
    return reconstruction


def noisy(reconstruction: Any, px: float) -> Any:
    """With every keypoint off on its own, by so many px along each axis (standard deviation)."""
    generator = np.random.default_rng(1)
    for image in reconstruction.images.values():
        for keypoint in image.points2D:
            keypoint.xy = keypoint.xy + generator.normal(size=2) * px
    return reconstruction


def model_of(reconstruction: Any, folder: Path) -> Model:
    return read_model(write_scene(reconstruction, folder))


def beside(scene: Scene, truth: Scene) -> float:
    """The largest angle between two cameras, and share of a focal length, by which a scene is wrong: what no choice of
    the world's frame changes."""
    sides = [sorted([*one.train, *one.test], key=lambda view: view.name) for one in (scene, truth)]
    turns = [torch.stack([view.camera.rotation.double() for view in side]) for side in sides]
    between = [rotations[1:] @ rotations[:1].transpose(1, 2) for rotations in turns]
    focal = abs(sides[0][0].camera.fx / sides[1][0].camera.fx - 1)
    return max(focal, float((between[0] - between[1]).abs().max()))


def test_movements_of_whole_pictures_are_told_from_noise_of_keypoints(tmp_path: Path) -> None:
    """A focal length too long by 1 %: a point at r px from the middle is off by r / 100, root of the mean square."""
    exact = synthesize()
    assert shift_of(model_of(exact, tmp_path / "exact")) == pytest.approx(0, abs=1e-6)
    assert shift_of(model_of(noisy(synthesize(), 1.0), tmp_path / "noisy")) < 0.35
    squares = [
        np.square(keypoint.xy - np.array(PINHOLE[2:])).sum()
        for image in exact.images.values()
        for keypoint in image.points2D
    ]
    longer = shift_of(model_of(zoomed(synthesize(), 1.01), tmp_path / "longer"))
    assert 0.7 < longer / (0.01 * math.sqrt(np.mean(squares))) < 1  # those that are off most count least
    # turns about x and y by 2 px of the middle, more of the borders, and about the viewing direction
    assert 2.0 < shift_of(model_of(turned(synthesize(), 2.0), tmp_path / "turned")) < 4.5


def test_movements_are_derivatives_of_directions() -> None:
    """By differences, of points that are turned, moved, seen by another focal length, and bent."""
    generator = torch.Generator().manual_seed(0)
    points = torch.rand(20, 3, generator=generator, dtype=torch.float64) + torch.tensor([-0.5, -0.5, 2.0])

    def directions(by: torch.Tensor) -> torch.Tensor:
        turn = torch.linalg.matrix_exp(torch.tensor([[0, -by[2], by[1]], [by[2], 0, -by[0]], [-by[1], by[0], 0]]))
        moved = points @ turn.T + by[3:6]
        plane = moved[:, :2] / moved[:, 2:]
        return plane * (1 + by[6] + by[7] * plane.square().sum(1, keepdim=True))

    step = 1e-6 * torch.eye(8, dtype=torch.float64)
    expected = torch.stack([(directions(by) - directions(-by)) / 2e-6 for by in step], -1)
    x, y, z = points.T
    torch.testing.assert_close(movements(x / z, y / z, z), expected, rtol=1e-6, atol=1e-8)


def test_models_of_few_observations_tell_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(keypoint_fit, "LEAST", 51)
    write_scene(zoomed(synthesize(), 1.01), tmp_path)
    assert shift_of(read_model(tmp_path / "sparse/0")) is None
    notes = load(colmap_options(tmp_path, adjust="auto")).notes
    assert notes[0] == "Nothing is adjusted: too few observations (scene.adjust=auto)."


def test_what_fits_is_left_alone_bit_for_bit(tmp_path: Path, cache: Path) -> None:
    write_scene(synthesize(), tmp_path)
    given, asked = load(colmap_options(tmp_path)), load(colmap_options(tmp_path, adjust="auto"))
    assert asked.notes[0].startswith("Nothing is adjusted: pictures are 0.00 px off")
    assert asked.notes[0].endswith("(scene.adjust=auto, threshold 0.25 px).")
    for one, other in zip(given.train, asked.train, strict=True):
        assert one.camera.draws_as(other.camera)
    assert torch.equal(given.points.positions, asked.points.positions)
    assert not (cache / "adjusted").exists()


@pytest.mark.parametrize("disturb", [lambda found: turned(found, 2.0), lambda found: zoomed(found, 1.03)])
def test_poses_and_focal_lengths_come_back(tmp_path: Path, disturb: Any) -> None:
    """50 exact observations of each image determine all but the frame of the world."""
    write_scene(synthesize(), tmp_path / "exact")
    write_scene(disturb(synthesize()), tmp_path / "wrong")
    truth, wrong = load(colmap_options(tmp_path / "exact")), load(colmap_options(tmp_path / "wrong"))
    mended = load(colmap_options(tmp_path / "wrong", adjust="auto"))
    assert "then pictures are 0.00 px off" in mended.notes[0]
    assert mended.provenance["adjust"] == "auto"
    assert mended.train[0].camera.fx == pytest.approx(PINHOLE[0], rel=1e-4)
    error, before = (beside(scene, truth) for scene in (mended, wrong))
    assert error < 1e-3
    assert before > 100 * error


def test_distortion_is_found_where_cameras_do_not_fit_without(tmp_path: Path) -> None:
    bent = synthesize("OPENCV", (*(10 * x for x in PINHOLE), 0.2, 0.0, 0.0, 0.0), frames=8, size=(640, 480))
    write_scene(straightened(bent), tmp_path)
    scene = load(colmap_options(tmp_path, adjust="auto", max_reprojection_px=20))
    assert "1 cameras got distortion" in scene.notes[0]
    assert any("OPENCV cameras of 640x480 are undistorted" in note for note in scene.notes)


def test_the_distortion_of_other_cameras_is_none_of_these(tmp_path: Path) -> None:
    """A lens that is found to be bent; of a camera that has no photographs nothing is told."""
    bent = synthesize("OPENCV", (*(10 * x for x in PINHOLE), 0.2, 0.0, 0.0, 0.0), frames=8, size=(640, 480))
    write_scene(straightened(bent), tmp_path / "bent")
    found = bundle.bundle_adjusted(tmp_path / "bent" / "sparse" / "0")
    [number] = found.cameras
    assert bundle.bend_of(found, [number]) > 0.25
    assert bundle.bend_of(found, [number + 1]) == 0


def test_no_distortion_is_made_up(tmp_path: Path) -> None:
    write_scene(noisy(turned(synthesize(frames=8), 2.0), 0.3), tmp_path)
    scene = load(colmap_options(tmp_path, adjust="auto"))
    assert "bent" not in scene.notes[0]
    assert scene.provenance["camera_models"] == ["PINHOLE"]


def test_lenses_that_are_no_lenses_are_told(tmp_path: Path) -> None:
    found = synthesize()
    for camera in found.cameras.values():
        camera.model, camera.params = pycolmap.CameraModelId.SIMPLE_RADIAL, [80.0, 32.0, 24.0, 1e9]
    write_scene(found, tmp_path)
    assert any(line.startswith("fit       The SIMPLE_RADIAL camera") for line in FORMAT.facts(tmp_path))


def test_it_is_done_once_and_found_again(tmp_path: Path, cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_scene(turned(synthesize(), 2.0), tmp_path)
    first = load(colmap_options(tmp_path, adjust="always"))
    shutil.rmtree(cache / "adjusted")
    anew = load(colmap_options(tmp_path, adjust="always"))
    assert all(one.camera.draws_as(other.camera) for one, other in zip(first.train, anew.train, strict=True))
    monkeypatch.setattr(adjust, "bundle_adjusted", None)
    again = load(colmap_options(tmp_path, adjust="always"))
    assert all(one.camera.draws_as(other.camera) for one, other in zip(first.train, again.train, strict=True))


def test_other_poses_are_adjusted_anew(tmp_path: Path, cache: Path) -> None:
    """Of which COLMAP 4 keeps some in files of their own."""
    write_scene(turned(synthesize(), 2.0), tmp_path)
    load(colmap_options(tmp_path, adjust="always"))
    (frames,) = (tmp_path / "sparse").rglob("frames.bin")
    os.utime(frames, ns=(1, 1))
    load(colmap_options(tmp_path, adjust="always"))
    assert len(list((cache / "adjusted").glob("*/"))) == 2


def test_the_remedy_is_named_where_cameras_do_not_fit(tmp_path: Path) -> None:
    write_scene(zoomed(synthesize(), 1.5), tmp_path)
    refused(r"scene\.adjust=auto", load, colmap_options(tmp_path))
    assert any("px off the cameras' observations: scene.adjust=auto" in line for line in FORMAT.facts(tmp_path))
    assert load(colmap_options(tmp_path, adjust="auto")).train


def test_wrong_words_and_hopeless_models_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_scene(turned(synthesize(), 2.0), tmp_path)
    with pytest.raises(ConfigError, match=r"scene\.adjust is 'alway'.*Did you mean 'always'"):
        load(colmap_options(tmp_path, adjust="alway"))

    class Hopeless:
        def solve(self) -> Any:
            return pycolmap.BundleAdjustmentSummary()

    monkeypatch.setattr(pycolmap, "create_default_bundle_adjuster", lambda *given: Hopeless())
    refused(r"failed.*scene\.adjust=never", load, colmap_options(tmp_path, adjust="always"))
    assert not list((tmp_path / "cache").rglob("*.bin"))
