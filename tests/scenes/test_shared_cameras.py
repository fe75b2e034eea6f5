"""Cameras of a COLMAP model that should be one, or two, against the focal lengths that its keypoints were made with."""

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from synthetic_colmap import captured, colmap_options, write_scene

from gsx.core.data.scene import Scene
from gsx.scenes.camera_groups import best_cut, by_lens
from gsx.scenes.colmap import FORMAT, load
from gsx.scenes.colmap_model import read_model
from gsx.scenes.held_out import FOLDS, adjusted, candidates, compare, folds, restored, result
from gsx.scenes.keypoint_fit import focal_change

FOCAL = 700.0
PHOTOS = 16
SPREAD = FOCAL * (1 + 0.03 * np.random.default_rng(2).uniform(-1, 1, PHOTOS))
TWO = [FOCAL if at % 2 else 1.06 * FOCAL for at in range(PHOTOS)]


def loaded(reconstruction: Any, folder: Path, adjust: str = "auto") -> Scene:
    write_scene(reconstruction, folder)
    return load(colmap_options(folder, adjust=adjust, max_reprojection_px=100))


def focal_lengths(scene: Scene) -> np.ndarray:
    """Of all views in order of name, px."""
    return np.array([view.camera.fx for view in sorted([*scene.train, *scene.test], key=lambda view: view.name)])


def cameras_note(scene: Scene) -> str:
    [note] = [note for note in scene.notes if note.startswith("Cameras: ")]
    return note


def test_focal_lengths_of_one_lens_become_one(tmp_path: Path) -> None:
    scene = loaded(captured([FOCAL] * PHOTOS, list(SPREAD)), tmp_path)
    focal = focal_lengths(scene)
    assert "should be one" in cameras_note(scene)
    assert np.ptp(focal) < 1e-6 * FOCAL
    assert focal[0] == pytest.approx(FOCAL, rel=5e-3)
    assert np.std(SPREAD) > 0.01 * FOCAL


def test_lenses_that_differ_keep_their_cameras_bit_for_bit(tmp_path: Path) -> None:
    """Shared cameras are compared and refused by held-out keypoints; the model stays as it was."""
    made = captured(list(SPREAD), list(SPREAD))
    scene, untouched = loaded(made, tmp_path), loaded(made, tmp_path / "never", "never")
    assert "right as they are" in cameras_note(scene)
    assert re.search(r"shared [\d.]+ px \(worse by", cameras_note(scene))
    assert all(one.camera.draws_as(other.camera) for one, other in zip(scene.train, untouched.train, strict=True))
    assert torch.equal(scene.points.positions, untouched.points.positions)


def test_a_run_without_adjustment_names_unusual_focal_lengths(tmp_path: Path) -> None:
    made = captured([FOCAL] * PHOTOS, list(SPREAD))
    assert "scene.adjust=auto compares" in cameras_note(loaded(made, tmp_path, "never"))
    assert any(line.startswith(f"cameras   {PHOTOS} PINHOLE cameras") for line in FORMAT.facts(tmp_path))
    loaded(made, tmp_path)
    assert any(line.startswith("cameras ") and "should be one" in line for line in FORMAT.facts(tmp_path))
    same = loaded(captured([FOCAL] * PHOTOS, [FOCAL] * PHOTOS), tmp_path / "same", "never")
    assert not any(note.startswith("Cameras") for note in same.notes)


def test_two_lenses_with_one_camera_get_two(tmp_path: Path) -> None:
    scene = loaded(captured(TWO, 1.03 * FOCAL), tmp_path)
    assert "should be two" in cameras_note(scene)
    np.testing.assert_allclose(focal_lengths(scene), TWO, rtol=5e-3)
    assert len(set(focal_lengths(scene))) == 2


def test_one_lens_with_one_camera_is_not_split(tmp_path: Path) -> None:
    scene = loaded(captured([FOCAL] * PHOTOS, FOCAL), tmp_path)
    assert not any(note.startswith("Cameras") for note in scene.notes)


def test_models_of_few_observations_are_to_be_made_anew(tmp_path: Path) -> None:
    scene = loaded(captured([FOCAL] * PHOTOS, list(SPREAD), points=20), tmp_path)
    assert "undecided, too few observations: reconstruct the photos with scene=photos" in cameras_note(scene)
    assert focal_lengths(scene) == pytest.approx(SPREAD)


def test_sizes_share_a_focal_length_by_their_scale(tmp_path: Path) -> None:
    """Photos that were reduced by up to 1.5 %."""
    sides = [(640, 480), (636, 477), (632, 474)]
    truth = [FOCAL * sides[at % 3][0] / 640 for at in range(PHOTOS)]
    source = captured(truth, list(SPREAD), sides=sides, noise=0.3)
    listed = candidates(source, dict.fromkeys(range(1, PHOTOS + 1), 0), "one")[:3]
    (_, pixels, by_size), _ = compare(source, listed, tmp_path)
    assert by_size.name == "shared by size"
    assert by_size.gain > pixels.gain + by_size.error
    made = restored(source, adjusted(source, listed[2], tmp_path), listed[2])
    focal = np.array([made.image(at).camera.focal_length_x for at in range(1, PHOTOS + 1)])
    np.testing.assert_allclose(focal, truth, rtol=5e-3)
    assert np.ptp(focal / truth) < 1e-6
    assert [made.image(at).camera.width for at in (1, 2, 3)] == [640, 636, 632]


def test_the_focal_length_of_a_photo_has_its_uncertainty(tmp_path: Path) -> None:
    """By the scatter over photos that differ in noise alone, of focal lengths 1 % too short."""
    model = read_model(write_scene(captured([FOCAL] * 40, 0.99 * FOCAL), tmp_path))
    fits = np.array([focal_change(image, model.cameras[1]) for image in model.images])
    assert fits[:, 0].mean() == pytest.approx(0.01, abs=3 * fits[:, 0].std() / 40**0.5 + 2e-4)
    assert np.median(fits[:, 1]) == pytest.approx(fits[:, 0].std(), rel=0.35)


def test_two_groups_are_told_from_one_that_is_wide() -> None:
    evenly = sorted(np.linspace(-0.02, 0.02, 30))
    assert best_cut(evenly) is None
    cut = best_cut(sorted([*(np.array(evenly[:10]) / 10 - 0.03), *(np.array(evenly[:20]) / 10 + 0.03)]))
    assert cut is not None
    assert -0.03 < cut.value < 0.03
    assert cut.distance == pytest.approx(0.06, abs=2e-3)
    assert best_cut([0.0, 0.0, 0.1, 0.1]) is None


def test_lenses_are_those_of_exif(tmp_path: Path) -> None:
    model = read_model(write_scene(captured(TWO, 1.03 * FOCAL), tmp_path))
    lenses = {f"{at:03}.png": ("maker", "phone", 4.2 if at % 2 else 6.0, 0.0) for at in range(PHOTOS)}
    found = by_lens(model.images, lenses)
    assert found is not None
    assert found[0] == [1 - at % 2 for at in range(PHOTOS)]
    assert "8 at 4.2 mm and 8 at 6 mm" in found[1]
    assert by_lens(model.images, dict(list(lenses.items())[1:])) is None


def test_each_observation_is_held_out_once(tmp_path: Path) -> None:
    model = captured([FOCAL] * 7, FOCAL)
    parts = folds(model, np.random.default_rng(0))
    assert sum(map(len, parts)) == 7 * 45 == len(set().union(*parts))
    held = [sum(number == 1 for number in part.values()) for part in parts]
    assert len(parts) == FOLDS
    assert sorted(held) == [1, 1, 1, 2, 2]


def test_gains_are_paired_and_their_error_is_over_images() -> None:
    """Keypoints of an image err together: two images, one better and one worse, decide nothing."""
    images, baseline = np.repeat([1, 2], 50), np.ones(100)
    tied = result("a", baseline, np.where(images == 1, 0.5, 1.5), images)
    assert abs(tied.gain) < tied.error
    assert not tied.better()
    assert not tied.worse()
    low = np.log(2) - np.log1p(0.25)
    won = result("b", baseline, np.full(100, 0.5), images)
    assert won.gain == pytest.approx(low)
    assert won.better()
    assert result("c", baseline, np.full(100, np.inf), images).worse()
