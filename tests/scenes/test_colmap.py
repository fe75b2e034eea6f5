"""COLMAP scenes: every layout that is around, every way in which they are broken, against pycolmap's own projection."""

import json
import math
import os
import re
import struct
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pytest
import torch
from refusals import refused
from synthetic_colmap import HEIGHT, WIDTH, colmap_options, synthesize, write_photos, write_scene
from torch import Tensor

from gsx.core.data.camera import Camera
from gsx.core.data.images import read_image, write_image
from gsx.core.data.reduction import Reduction
from gsx.core.data.scene import Scene, View
from gsx.core.errors import ConfigError, InputError
from gsx.engine.cache import add_to_manifest
from gsx.scenes import splits
from gsx.scenes.colmap import load
from gsx.scenes.colmap_folders import count_images
from gsx.scenes.colmap_records import check_binary
from gsx.scenes.posed import Shot
from gsx.scenes.undistort import pinhole_of, sample, undistort, undistort_points

CAPTURES = Path(__file__).parents[3] / "shared" / "scenes"  # real ones, where a developer has them
BENT = [80.0, 32.0, 24.0, 0.05]  # SIMPLE_RADIAL: f, cx, cy, k


def views(scene: Scene) -> list[View]:
    return sorted([*scene.train, *scene.test], key=lambda view: view.name)


def assert_projects_like(scene: Scene, reconstruction: Any, scale: tuple[float, float] = (1, 1)) -> None:
    """Every point in every view where pycolmap projects it, `scale` being the view's size over the model's."""
    by_name = {image.name: image for image in reconstruction.images.values()}
    points = np.array([reconstruction.points3D[number].xyz for number in sorted(reconstruction.points3D)])
    for view in views(scene):
        expected = np.array([by_name[view.name].project_point(point) for point in points]) * scale
        pixels, depth = view.camera.project(torch.from_numpy(points))
        assert (depth > 0).all()
        np.testing.assert_allclose(pixels.numpy(), expected, atol=1e-9)


# layouts


@pytest.mark.parametrize("text", [False, True])
@pytest.mark.parametrize("sparse", ["sparse/0", "sparse", "."])
def test_every_layout_projects_as_pycolmap_does(tmp_path: Path, text: bool, sparse: str) -> None:
    reconstruction = synthesize()
    write_scene(reconstruction, tmp_path, sparse=sparse, text=text)
    scene = load(colmap_options(tmp_path))
    assert len(views(scene)) == 5
    assert_projects_like(scene, reconstruction)
    assert scene.notes == ["Reprojection error 0.00 px (median of 250 observations, at the model's resolution)."]


@pytest.mark.parametrize("text", [False, True])
def test_layout_of_colmap_3_without_rigs_and_frames(tmp_path: Path, text: bool) -> None:
    reconstruction = synthesize(cameras=2, frames=3)
    model = write_scene(reconstruction, tmp_path, text=text)
    for name in ("rigs", "frames"):
        (model / f"{name}{'.txt' if text else '.bin'}").unlink()
    scene = load(colmap_options(tmp_path))
    assert len(views(scene)) == 6
    assert_projects_like(scene, reconstruction)


def test_points_come_in_order_of_their_numbers_with_their_colours(tmp_path: Path) -> None:
    reconstruction = synthesize()
    for number, point in reconstruction.points3D.items():
        point.color = np.array([number, 255 - number, 7], dtype=np.uint8)
    write_scene(reconstruction, tmp_path)
    points = load(colmap_options(tmp_path)).points
    numbers = sorted(reconstruction.points3D)
    assert points.colours.tolist() == [[number, 255 - number, 7] for number in numbers]
    assert points.colours.dtype == torch.uint8
    expected = torch.tensor(np.array([reconstruction.points3D[number].xyz for number in numbers])).float()
    assert torch.equal(points.positions, expected)


def test_the_sub_model_with_most_images_is_taken_and_named(tmp_path: Path) -> None:
    write_scene(synthesize(frames=3), tmp_path, sparse="sparse/0")
    write_scene(synthesize(frames=6), tmp_path, sparse="sparse/1", text=True)
    write_scene(synthesize(frames=2), tmp_path, sparse="sparse/2")
    write_photos(synthesize(frames=6), tmp_path / "images")  # over those of the others, of which one is like another
    scene = load(colmap_options(tmp_path))
    assert len(views(scene)) == 6
    unused = "not used, with images: sparse/0 (3), sparse/2 (2) (scene.model chooses)"
    assert scene.notes[0] == f"Took the model sparse/1 with 6 images; {unused}."
    chosen = load(colmap_options(tmp_path, model="sparse/0"))
    assert len(views(chosen)) == 3


def test_images_of_a_text_model_are_counted_past_empty_keypoint_lines(tmp_path: Path) -> None:
    for name in ("cameras", "points3D"):
        (tmp_path / f"{name}.txt").touch()
    lines = ["# comment", "1 1 0 0 0 0 0 0 1 a.png", "", "2 1 0 0 0 0 0 0 1 b.png", "1.0 2.0 -1", "3 1 0 0 0 0 0 0 1 c"]
    (tmp_path / "images.txt").write_bytes("\n".join(lines).encode() + b"\xff\n\n")  # a name that is no UTF-8
    assert count_images(tmp_path) == 3


def test_the_sharpest_photographs_may_judge(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whose files are asked, in the order of their names; how sharp they are is told by hand."""
    write_scene(synthesize(frames=6), tmp_path)
    names = sorted(view.name for view in load(colmap_options(tmp_path, split="none")).train)
    ratios = dict(zip(names, (0.5, 1.0, 0.7, 0.9, 0.8, 0.2), strict=True))
    asked = list[str]()

    def sharpness(photographs: list[Path]) -> dict[Path, float]:
        asked.extend(path.name for path in photographs)
        return {path: ratios[path.name] for path in photographs}

    monkeypatch.setattr(splits, "sharpness", sharpness)
    scene = load(colmap_options(tmp_path, split="sharp:3"))
    assert asked == names
    assert [view.name for view in scene.test] == [names[1], names[3]]


def test_names_with_folders_are_found_and_split_by_base_name(tmp_path: Path) -> None:
    reconstruction = synthesize(frames=4)
    for image, name in zip(reconstruction.images.values(), ["b/1.png", "a/2.png", "c/d/3.png", "a/4.png"], strict=True):
        image.name = name
    write_scene(reconstruction, tmp_path)
    scene = load(colmap_options(tmp_path, split="every:2"))
    assert [view.name for view in scene.test] == ["b/1.png", "c/d/3.png"]
    assert [view.name for view in scene.train] == ["a/2.png", "a/4.png"]
    for view in views(scene):
        stored = read_image(tmp_path / "images" / view.name).float() / 255
        assert torch.equal(view.image(), stored)


def test_scene_is_named_after_its_folder_and_black(tmp_path: Path) -> None:
    write_scene(synthesize(frames=3), tmp_path / "garden")
    scene = load(colmap_options(tmp_path / "garden"))
    assert scene.name == "garden"
    assert scene.background.tolist() == [0, 0, 0]


def test_pictures_come_from_finer_ones_by_the_resize_rule(tmp_path: Path) -> None:
    write_scene(synthesize(frames=3), tmp_path)
    assert load(colmap_options(tmp_path)).reduction == Reduction(filter="bicubic")
    changed = colmap_options(tmp_path, resize_filter="lanczos", resize_light="linear")
    assert load(changed).reduction == Reduction(filter="lanczos", light="linear")


def test_extent_is_over_training_cameras_only(tmp_path: Path) -> None:
    reconstruction = synthesize(frames=9)
    write_scene(reconstruction, tmp_path)
    scene = load(colmap_options(tmp_path))
    held_out = {view.name for view in scene.test}
    assert len(held_out) == 2
    images = reconstruction.images.values()
    centres = np.array([image.projection_center() for image in images if image.name not in held_out])
    expected = 1.1 * np.linalg.norm(centres - centres.mean(0), axis=1).max()
    assert scene.extent == pytest.approx(expected, rel=1e-12)


def test_provenance_says_what_an_evaluation_needs_and_is_json(tmp_path: Path) -> None:
    write_scene(synthesize("SIMPLE_RADIAL", BENT), tmp_path / "bent")
    provenance = load(colmap_options(tmp_path / "bent", downscale=2)).provenance
    assert json.loads(json.dumps(provenance)) == provenance
    assert provenance == provenance | {
        "format": "colmap",
        "path": "bent",
        "image_folder": "images",
        "camera_models": ["SIMPLE_RADIAL"],
        "undistortion": "keys-cubic/1",
        "downscale": 2,
        "split": "every:8",
        "background": [0, 0, 0],
        "number_of_images": 5,
    }


# sizes


@pytest.mark.parametrize(("downscale", "size"), [(1, (64, 48)), (3, (21, 16)), (5, (13, 10))])
def test_downscale_keeps_the_field_of_view(tmp_path: Path, downscale: int, size: tuple[int, int]) -> None:
    reconstruction = synthesize()
    write_scene(reconstruction, tmp_path)
    scene = load(colmap_options(tmp_path, downscale=downscale))
    assert {view.camera.size for view in views(scene)} == {size}
    assert {view.image().shape for view in views(scene)} == {(3, size[1], size[0])}
    assert_projects_like(scene, reconstruction, (size[0] / WIDTH, size[1] / HEIGHT))


def test_folder_of_reduced_images_is_the_new_truth(tmp_path: Path) -> None:
    reconstruction = synthesize()
    write_scene(reconstruction, tmp_path)
    write_photos(reconstruction, tmp_path / "images_3", (21, 16))
    scene = load(colmap_options(tmp_path, images="images_3"))
    view = views(scene)[0]
    assert view.camera.size == (21, 16)
    assert view.zoom(2) is None
    assert_projects_like(scene, reconstruction, (21 / WIDTH, 16 / HEIGHT))


@pytest.mark.parametrize("size", [(64, 40), (48, 64), (128, 96)])
def test_photo_of_another_size_is_refused_with_both_sizes(tmp_path: Path, size: tuple[int, int]) -> None:
    reconstruction = synthesize()
    write_scene(reconstruction, tmp_path)
    write_image(tmp_path / "images" / "camera000001_frame000003.png", torch.zeros(3, size[1], size[0]))
    refused(rf"frame000003.*{size[0]} x {size[1]}.*64 x 48", load, colmap_options(tmp_path))


def test_centred_principal_point_moves_views_only(tmp_path: Path) -> None:
    far_off = [80.0, 82.0, 12.0, 25.0]  # 20 px: exact poses must not be refused for it
    write_scene(synthesize(params=far_off), tmp_path)
    exact, moved = (load(colmap_options(tmp_path, principal_point=rule)) for rule in ("exact", "centred"))
    assert {(view.camera.cx, view.camera.cy) for view in views(exact)} == {(12.0, 25.0)}
    assert {(view.camera.cx, view.camera.cy) for view in views(moved)} == {(32.0, 24.0)}
    assert all(torch.equal(a.image(), b.image()) for a, b in zip(views(exact), views(moved), strict=True))
    with pytest.raises(ConfigError, match="centred"):
        load(colmap_options(tmp_path, principal_point="centered"))


# what is missing or broken


def test_missing_photos_are_counted_named_and_skipped(tmp_path: Path) -> None:
    write_scene(synthesize(frames=9), tmp_path)
    for number in (0, 2, 3, 5, 6, 8):
        (tmp_path / "images" / f"camera000001_frame00000{number}.png").unlink()
    refused(r"6 of the 9 images of .*frame000000\.png.* and 1 more\).*missing=0\.67", load, colmap_options(tmp_path))
    scene = load(colmap_options(tmp_path, missing=0.67))
    assert [view.name[-5] for view in views(scene)] == ["1", "4", "7"]
    note = next(note for note in scene.notes if "missing" in note)
    assert "Skipped 6 images" in note
    assert "frame000000.png" in note
    assert "and 1 more" in note


def test_no_photo_at_all_says_where_it_looked(tmp_path: Path) -> None:
    write_scene(synthesize(), tmp_path)
    with pytest.raises(InputError, match=r"None of the 5 images.*images_8.*frame000000.*scene\.images"):
        load(colmap_options(tmp_path, images="images_8"))


def test_a_single_photo_is_refused(tmp_path: Path) -> None:
    write_scene(synthesize(), tmp_path)
    for file in sorted((tmp_path / "images").iterdir())[1:]:
        file.unlink()
    refused(r"1 of them.*at least 2", load, colmap_options(tmp_path))


def test_folder_without_model_names_the_places(tmp_path: Path) -> None:
    refused(r"sparse/0.*scene=photos", load, colmap_options(tmp_path))


def test_incomplete_model_names_the_lacking_file(tmp_path: Path) -> None:
    model = write_scene(synthesize(), tmp_path)
    (model / "points3D.bin").unlink()
    refused(r"lacks points3D\.bin", load, colmap_options(tmp_path))


def test_points_that_are_not_finite_are_dropped_and_counted(tmp_path: Path) -> None:
    reconstruction = synthesize()
    for number, value in zip(sorted(reconstruction.points3D), (np.nan, np.inf, -np.inf, 1e39), strict=False):
        reconstruction.points3D[number].xyz = np.array([0.5, value, 0.5])
    write_scene(reconstruction, tmp_path)
    scene = load(colmap_options(tmp_path))
    assert len(scene.points) == 46
    assert scene.points.positions.isfinite().all()
    assert "Dropped 4 points with coordinates that are not finite." in scene.notes
    assert any("median of 230 observations" in note for note in scene.notes)


@pytest.mark.parametrize("damage", ["none", "nan"])
def test_model_without_usable_points_is_refused(tmp_path: Path, damage: str) -> None:
    reconstruction = synthesize()
    for number in list(reconstruction.points3D):
        if damage == "none":
            reconstruction.delete_point3D(number)
        else:
            reconstruction.points3D[number].xyz = np.full(3, np.nan)
    write_scene(reconstruction, tmp_path)
    refused(r"points3D\.bin.*triangulat", load, colmap_options(tmp_path))


@pytest.mark.parametrize("name", ["cameras", "images", "points3D", "rigs", "frames"])
def test_binary_file_cut_anywhere_is_named(tmp_path: Path, name: str) -> None:
    model = write_scene(synthesize(cameras=2, frames=2), tmp_path)
    file = model / f"{name}.bin"
    check_binary(name, file)
    content = file.read_bytes()
    for length in range(0, len(content), max(1, len(content) // 97)):
        file.write_bytes(content[:length])
        refused(rf"{name}\.bin is truncated: its {length} bytes", check_binary, name, file)
    file.write_bytes(content[:-1])
    refused(rf"{name}\.bin is truncated", load, colmap_options(tmp_path))


@pytest.mark.parametrize("name", ["cameras", "images", "points3D", "rigs", "frames"])
def test_binary_file_that_goes_on_after_its_last_record_is_named(tmp_path: Path, name: str) -> None:
    model = write_scene(synthesize(cameras=2, frames=2), tmp_path)
    file = model / f"{name}.bin"
    content = file.read_bytes()
    file.write_bytes(content + b"\0")
    refused(rf"{name}\.bin goes on for 1 bytes after its \d+ records: .* again", load, colmap_options(tmp_path))
    (count,) = struct.unpack("<Q", content[:8])
    file.write_bytes(struct.pack("<Q", count - 1) + content[8:])
    refused(rf"{name}\.bin goes on for \d+ bytes after its {count - 1} records", load, colmap_options(tmp_path))


@pytest.mark.parametrize("text", [False, True])
def test_unknown_camera_model_is_named(tmp_path: Path, text: bool) -> None:
    model = write_scene(synthesize(), tmp_path, text=text)
    if text:
        (model / "cameras.txt").write_text("1 PINHOLE_PLUS 64 48 1 2 3 4\n")
    else:
        content = bytearray((model / "cameras.bin").read_bytes())
        content[12:16] = struct.pack("<i", 987)
        (model / "cameras.bin").write_bytes(content)
    refused(r"cameras\.txt" if text else r"cameras\.bin.*987", load, colmap_options(tmp_path))


@pytest.mark.parametrize("name", ["cameras", "images"])
def test_text_file_cut_in_half_is_an_error_of_that_model(tmp_path: Path, name: str) -> None:
    model = write_scene(synthesize(), tmp_path, text=True)
    file = model / f"{name}.txt"
    file.write_text(file.read_text()[: file.stat().st_size // 2])
    with pytest.raises(InputError, match=r"cameras, which is not there" if name == "cameras" else r"at line \d+: 79 n"):
        load(colmap_options(tmp_path))


def test_points_that_images_observe_but_the_file_has_lost_are_an_error(tmp_path: Path) -> None:
    model = write_scene(synthesize(), tmp_path, text=True)
    lines = (model / "points3D.txt").read_text().splitlines()
    (model / "points3D.txt").write_text("\n".join(lines[:-7]) + "\n")
    refused(r"points3D\.txt is truncated", load, colmap_options(tmp_path))


# do cameras and observations agree


def test_shifted_poses_are_refused_with_the_error_in_pixels(tmp_path: Path) -> None:
    reconstruction = synthesize()
    model = write_scene(reconstruction, tmp_path, text=True)
    for name in ("images.txt", "frames.txt"):  # tx is written as 0 or thereabouts in both, 80 px stand for depth 5
        lines = (model / name).read_text().splitlines()
        place = 5 if name == "images.txt" else 6
        shifted = [_add(line, place, 0.5) if _is_pose(line, name) else line for line in lines]
        (model / name).write_text("\n".join(shifted) + "\n")
    refused(r"keypoints by (7|8|9)\.?\d* px.*max_reprojection_px=4", load, colmap_options(tmp_path))
    scene = load(colmap_options(tmp_path, max_reprojection_px=20))
    assert any("Reprojection error" in note for note in scene.notes)


def _is_pose(line: str, name: str) -> bool:
    return not line.startswith("#") and (name == "frames.txt" or line.endswith(".png"))


def _add(line: str, place: int, amount: float) -> str:
    words = line.split()
    words[place] = str(float(words[place]) + amount)
    return " ".join(words)


def test_intrinsics_of_another_camera_are_refused_at_any_downscale(tmp_path: Path) -> None:
    reconstruction = synthesize()
    reconstruction.cameras[1].params = np.array([160.0, 164.0, 30.0, 25.0])
    write_scene(reconstruction, tmp_path)
    for downscale in (1, 4):
        refused("miss the observed keypoints", load, colmap_options(tmp_path, downscale=downscale))


def without_observations(reconstruction: Any, folder: Path) -> Path:
    """A text model as tools write it that only know poses and points."""
    model = write_scene(reconstruction, folder, text=True)
    lines = (model / "images.txt").read_text().splitlines()
    poses = [line for line in lines if _is_pose(line, "images.txt")]
    (model / "images.txt").write_text("".join(f"{line}\n\n" for line in poses))
    points = [line.split()[:8] for line in (model / "points3D.txt").read_text().splitlines() if line[0] != "#"]
    (model / "points3D.txt").write_text("\n".join(" ".join(point) for point in points) + "\n")
    return model


def test_model_without_observations_is_checked_by_what_is_in_view(tmp_path: Path) -> None:
    reconstruction = synthesize()
    model = without_observations(reconstruction, tmp_path)
    scene = load(colmap_options(tmp_path))
    assert_projects_like(scene, reconstruction)
    assert "no observations" in scene.notes[-1]
    assert "100% of its points" in scene.notes[-1]
    far = [_add(line, 1, 100.0) for line in (model / "points3D.txt").read_text().splitlines()]
    (model / "points3D.txt").write_text("\n".join(far) + "\n")
    refused("Only 0% of the points", load, colmap_options(tmp_path))


# lenses


def perspective_models() -> list[str]:
    names = [name for name in pycolmap.CameraModelId.__members__ if name not in ("INVALID", "EQUIRECTANGULAR")]
    return [name for name in names if not lens(name).is_perspective_pinhole() or len(lens(name).params) > 4]


def lens(model: str, width: int = 400, height: int = 300) -> Any:
    """A camera with some of every distortion its model has."""
    camera = pycolmap.Camera.create_from_model_name(1, model, 350.0, width, height)
    params = np.array(camera.params)
    params[list(camera.extra_params_idxs())] += 0.5 if model == "FOV" else 0.02
    camera.params = params
    return camera


@pytest.mark.parametrize("model", perspective_models())
def test_keypoints_of_every_lens_land_where_the_pinhole_sees_the_ray(model: str) -> None:
    camera = lens(model)
    pinhole = pinhole_of(camera)
    generator = torch.Generator().manual_seed(0)
    directions = torch.rand(200, 2, generator=generator, dtype=torch.float64) * 0.8 - 0.4
    keypoints = torch.from_numpy(camera.img_from_cam(torch.cat([directions, torch.ones(200, 1)], 1).numpy()))
    assert (keypoints - directions * 350 - torch.tensor([200, 150])).norm(dim=1).max() > 0.5  # it does distort
    focal = torch.tensor([pinhole.focal_length_x, pinhole.focal_length_y])
    centre = torch.tensor([pinhole.principal_point_x, pinhole.principal_point_y])
    straight = undistort_points(camera, pinhole, keypoints)
    torch.testing.assert_close(straight, directions * focal + centre, atol=1e-4, rtol=0)


def blobs(positions: Tensor, width: int, height: int) -> Tensor:
    """A picture with a soft dot of radius 3 px at each position."""
    y, x = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    away = (x - positions[:, 0, None, None]) ** 2 + (y - positions[:, 1, None, None]) ** 2
    return torch.exp(-away / 18).sum(0).clamp(max=1).expand(3, -1, -1)


def centre_of_light(image: Tensor, around: Tensor) -> Tensor:
    """Centroid of brightness within 10 px of a position."""
    left, top = (int(value) - 10 for value in around)
    window = image[0, top : top + 21, left : left + 21].double()
    offset = torch.arange(21, dtype=torch.float64) + 0.5
    total = window.sum()
    return torch.stack([(window.sum(0) * offset).sum() / total + left, (window.sum(1) * offset).sum() / total + top])


@pytest.mark.parametrize("model", ["SIMPLE_RADIAL", "OPENCV", "OPENCV_FISHEYE"])
def test_dots_on_a_straight_grid_are_straight_after_undistortion(model: str) -> None:
    camera = lens(model)
    pinhole = pinhole_of(camera)
    steps = torch.linspace(-0.4, 0.4, 7, dtype=torch.float64)
    grid = torch.cartesian_prod(steps, steps[1:-1] * 0.7)
    bent = torch.from_numpy(camera.img_from_cam(torch.cat([grid, torch.ones(len(grid), 1)], 1).numpy()))
    picture = blobs(bent, camera.width, camera.height)
    result = undistort((picture * 255).round().to(torch.uint8), camera, pinhole, (pinhole.width, pinhole.height))
    focal = torch.tensor([pinhole.focal_length_x, pinhole.focal_length_y])
    expected = grid * focal + torch.tensor([pinhole.principal_point_x, pinhole.principal_point_y])
    found = torch.stack([centre_of_light(result, position) for position in expected])
    assert (found - expected).norm(dim=1).max() < 0.05


def test_the_colour_of_what_is_transparent_is_interpolated_nowhere() -> None:
    """A cut-out disc, the same over black and over white where nothing is opaque."""
    bent = pycolmap.Camera(model="SIMPLE_RADIAL", width=64, height=48, params=[60.0, 32.0, 24.0, -0.1])
    down, across = torch.meshgrid(torch.arange(48), torch.arange(64), indexing="ij")
    alpha = ((across - 32) ** 2 + (down - 24) ** 2 < 200).to(torch.uint8) * 255
    found = []
    for hidden in (0, 255):
        colours = torch.where(alpha > 0, torch.tensor([220, 90, 30], dtype=torch.uint8)[:, None, None], hidden)
        found.append(undistort(torch.cat([colours.to(torch.uint8), alpha[None]]), bent, pinhole_of(bent), (64, 48)))
    assert torch.equal(found[0], found[1])
    assert set(found[0][0][found[0][3] > 60].tolist()) == {220}
    assert int(((found[0][3] > 60) & (found[0][3] < 200)).sum()) > 0


def test_undistortion_agrees_with_colmaps_own(tmp_path: Path) -> None:
    camera = lens("OPENCV")
    y, x = torch.meshgrid(torch.arange(300) + 0.5, torch.arange(400) + 0.5, indexing="ij")
    picture = torch.stack([0.5 + 0.4 * torch.sin(x / 9), 0.5 + 0.4 * torch.cos(y / 7), (x + y) / 700])
    image = (picture * 255).round().to(torch.uint8)
    bitmap = pycolmap.Bitmap.from_array(np.ascontiguousarray(image.permute(1, 2, 0).numpy()))
    reference, pinhole = pycolmap.undistort_image(pycolmap.UndistortCameraOptions(), bitmap, camera)
    result = undistort(image, camera, pinhole_of(camera), (pinhole.width, pinhole.height))
    theirs = torch.from_numpy(reference.to_array()).permute(2, 0, 1).int()
    inner = (result.int() - theirs)[:, 3:-3, 3:-3].abs()
    assert inner.max() <= 2  # bilinear against cubic on gentle waves, and rounding
    assert inner.double().mean() < 0.5


def test_undistorted_scene_projects_its_points_onto_the_right_pixels(tmp_path: Path) -> None:
    reconstruction = synthesize("SIMPLE_RADIAL", [320.0, 160.0, 120.0, 0.3], frames=3, size=(320, 240))
    write_scene(reconstruction, tmp_path)
    number = min(reconstruction.points3D)
    for image in reconstruction.images.values():
        seen = torch.tensor(image.project_point(reconstruction.points3D[number].xyz))[None]
        write_image(tmp_path / "images" / image.name, blobs(seen, 320, 240))
    scene = load(colmap_options(tmp_path, split="none"))
    assert any("SIMPLE_RADIAL" in note and "undistorted" in note for note in scene.notes)
    point = scene.points.positions[:1].double()
    for view in views(scene):
        (expected,), _ = view.camera.project(point)
        assert (centre_of_light(view.image(), expected) - expected).norm() < 0.05


def test_reduced_photos_of_a_lens_are_undistorted_at_their_own_size(tmp_path: Path) -> None:
    reconstruction = synthesize("SIMPLE_RADIAL", BENT)
    write_scene(reconstruction, tmp_path)
    write_photos(reconstruction, tmp_path / "images_2", (32, 24))
    whole, half = (views(load(colmap_options(tmp_path, images=name)))[0] for name in ("images", "images_2"))
    assert half.camera.size == (round(whole.camera.width / 2), round(whole.camera.height / 2))
    assert half.camera.fx / half.camera.width == pytest.approx(whole.camera.fx / whole.camera.width)
    assert half.image().shape[1:] == (half.camera.height, half.camera.width)


def test_lens_without_distortion_leaves_photos_alone(tmp_path: Path, cache: Path) -> None:
    write_scene(synthesize("SIMPLE_RADIAL", [80.0, 30.0, 25.0, 0.0]), tmp_path)
    scene = load(colmap_options(tmp_path))
    view = views(scene)[0]
    assert torch.equal(view.image(), read_image(tmp_path / "images" / view.name).float() / 255)
    assert scene.provenance["undistortion"] is None
    assert not cache.exists()


def test_fisheye_without_coefficients_is_no_pinhole() -> None:
    camera = pycolmap.Camera.create_from_model_name(1, "OPENCV_FISHEYE", 300.0, 320, 240)
    assert pinhole_of(camera).model_name == "PINHOLE"


def test_a_name_that_is_no_text_is_refused(tmp_path: Path) -> None:
    model = write_scene(synthesize(), tmp_path)
    content = (model / "images.bin").read_bytes()
    (model / "images.bin").write_bytes(content.replace(b"camera000001_frame000000", b"camera000001_frame00000\xff", 1))
    refused(r"names an image by bytes that are no UTF-8 .*rename the photo", load, colmap_options(tmp_path))


@pytest.mark.parametrize("text", [False, True])
@pytest.mark.parametrize("prefix", ["", "./", "folder/../"])
def test_an_image_that_is_registered_twice_is_refused(tmp_path: Path, text: bool, prefix: str) -> None:
    reconstruction = synthesize()
    first, second = (image for image in list(reconstruction.images.values())[:2])
    second.name = f"{prefix}{first.name}"
    (tmp_path / "images" / "folder").mkdir(parents=True)
    model = write_scene(reconstruction, tmp_path, text=text)
    with pytest.raises(
        InputError, match=rf"'{model}' has .*{first.name}'.*, perhaps to train on and to test on: remove"
    ):
        load(colmap_options(tmp_path))


@pytest.mark.parametrize("way", ["link", "copy"])
def test_a_photo_of_two_images_is_refused(tmp_path: Path, way: str) -> None:
    write_scene(synthesize(), tmp_path)
    held_out, trained_on = sorted((tmp_path / "images").iterdir())[:2]
    trained_on.unlink()
    if way == "link":
        trained_on.hardlink_to(held_out)
    else:
        trained_on.write_bytes(held_out.read_bytes())
    refused(re.escape(f"'{trained_on}' is '{held_out}' byte for byte"), load, colmap_options(tmp_path))


def changed_pose(tmp_path: Path, **changes: float) -> str:
    """Writes a text model of COLMAP 3 with other numbers for its first image, and returns the name of that."""
    model = write_scene(synthesize(), tmp_path, text=True)
    for name in ("rigs.txt", "frames.txt"):
        (model / name).unlink()
    lines = (model / "images.txt").read_text().splitlines()
    at = next(number for number, line in enumerate(lines) if not line.startswith("#"))
    words = lines[at].split()
    for key, value in changes.items():
        words[("id", "qw", "qx", "qy", "qz", "tx", "ty", "tz").index(key)] = str(value)
    lines[at] = " ".join(words)
    (model / "images.txt").write_text("\n".join(lines) + "\n")
    return words[-1]


def test_a_camera_far_off_all_others_is_refused_by_name(tmp_path: Path) -> None:
    name = changed_pose(tmp_path, tx=1e9)
    with pytest.raises(InputError, match=rf"camera of '.*{name}' is 1\.5e\+08 times as far from .*: correct its pose"):
        load(colmap_options(tmp_path))


@pytest.mark.parametrize("changes", [{"qw": 1e9}, {"qw": 1e300}, {"qw": 0, "qx": 0, "qy": 0, "qz": 0}])
def test_a_quaternion_that_is_no_rotation_is_refused_by_name(tmp_path: Path, changes: dict[str, float]) -> None:
    name = changed_pose(tmp_path, **changes)
    refused(rf"turns {name} by a quaternion of length .* instead of 1: correct", load, colmap_options(tmp_path))


@pytest.mark.parametrize("value", [1e12, 1e300, math.nan, math.inf])
def test_a_lens_beyond_recognition_is_refused(tmp_path: Path, value: float) -> None:
    model = write_scene(synthesize("SIMPLE_RADIAL", BENT), tmp_path)
    content = (model / "cameras.bin").read_bytes()
    (model / "cameras.bin").write_bytes(content[:-8] + struct.pack("<d", value))
    with pytest.raises(
        InputError, match=r"\.png' cannot be undistorted: The SIMPLE_RADIAL camera .*: correct its intr"
    ):
        load(colmap_options(tmp_path))


@pytest.mark.parametrize("field", ["rotation", "translation"])
def test_a_pose_that_is_no_number_is_refused(field: str) -> None:
    good = Camera(rotation=torch.eye(3), translation=torch.zeros(3), fx=1.0, fy=1.0, cx=1.0, cy=1.0, width=2, height=2)
    Shot(name="a", photo=Path("a.png"), whole=good, expected_size=(2, 2))
    bad = replace(good, **{field: getattr(good, field) * math.nan})
    with pytest.raises(InputError, match=r"camera of 'a\.png' is .* rotation that is not finite"):
        Shot(name="a", photo=Path("a.png"), whole=bad, expected_size=(2, 2))


@pytest.mark.parametrize("change", [{"fx": 8e50}, {"fy": 0.0}, {"fx": math.nan}, {"cx": 1e40}, {"cy": math.nan}])
def test_intrinsics_that_no_camera_has_are_refused(change: dict[str, float]) -> None:
    good = Camera(rotation=torch.eye(3), translation=torch.zeros(3), fx=1.0, fy=1.0, cx=1.0, cy=1.0, width=2, height=2)
    with pytest.raises(InputError, match=r"camera of 'a\.png' has .*: correct its intrinsics"):
        Shot(name="a", photo=Path("a.png"), whole=replace(good, **change), expected_size=(2, 2))


def test_panorama_is_refused() -> None:
    with pytest.raises(InputError, match=r"EQUIRECTANGULAR.*perspective views"):
        pinhole_of(pycolmap.Camera.create_from_model_name(1, "EQUIRECTANGULAR", 1.0, 400, 200))


def test_undistorted_photos_are_kept_and_found_again(tmp_path: Path, cache: Path) -> None:
    write_scene(synthesize("SIMPLE_RADIAL", BENT, frames=3), tmp_path)

    def first_view() -> View:
        return views(load(colmap_options(tmp_path)))[0]

    fresh = first_view().image()
    (stored,) = cache.rglob("*.png")
    assert torch.equal(read_image(stored).float() / 255, fresh)
    write_image(stored, torch.zeros_like(fresh))
    assert torch.equal(first_view().image(), fresh)  # what is not as it was written is made again
    write_image(stored, torch.zeros_like(fresh))
    add_to_manifest(stored)
    assert not first_view().image().any()  # taken from the cache
    photo = tmp_path / "images" / first_view().name
    os.utime(photo, ns=(0, 0))
    assert torch.equal(first_view().image(), fresh)  # a replaced photo is undistorted anew
    kinds = {file.suffix for file in cache.rglob("*") if file.is_file()}
    assert kinds == {".png", ".jsonl"}  # nothing half-written


def test_sampling_reproduces_cubics_along_an_axis_to_second_order() -> None:
    x = torch.arange(12, dtype=torch.float64) + 0.5
    photo = (0.3 + 0.05 * x - 0.004 * x**2).expand(1, 5, 12)
    where = torch.tensor([[[4.2, 2.5], [6.75, 1.9], [7.5, 3.1]]], dtype=torch.float64)
    expected = 0.3 + 0.05 * where[..., 0] - 0.004 * where[..., 0] ** 2
    torch.testing.assert_close(sample(photo, where)[0], expected, atol=1e-6, rtol=0)


# real captures


@pytest.mark.parametrize(("name", "count", "points"), [("fox", 50, 12573), ("desk_bottle", 101, 6885)])
def test_real_capture_loads_aligned(name: str, count: int, points: int) -> None:
    if not (CAPTURES / name).is_dir():
        pytest.skip(f"the capture {name} is not here")
    scene = load(colmap_options(CAPTURES / name, downscale=4))
    assert (len(views(scene)), len(scene.points)) == (count, points)
    view = scene.train[7]
    pixels, depth = view.camera.project(scene.points.positions.double())
    inside = (depth > 0) & (pixels > 3).all(1) & (pixels < torch.tensor(view.camera.size) - 3).all(1)
    image, colours = view.image(), scene.points.colours[inside].T / 255

    def mismatch(dx: float, dy: float) -> float:
        column, row = (pixels[inside] + torch.tensor([dx, dy])).long().unbind(1)
        return float((image[:, row, column] - colours).abs().mean())

    shifted = [mismatch(*shift) for shift in [(2, 0), (-2, 0), (0, 2), (0, -2)]]
    assert mismatch(0, 0) < 0.85 * min(shifted)
