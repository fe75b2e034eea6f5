"""Lenses whose polynomial ends within the photo: keypoints without a ray, and pictures that would be mirrored."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pytest
import torch
from refusals import refused
from synthetic_colmap import colmap_options, synthesize, write_scene
from torch import Tensor

from gsx.core.data.images import write_image
from gsx.scenes import bundle
from gsx.scenes.adjust import fit_line
from gsx.scenes.colmap import FORMAT, load
from gsx.scenes.colmap_model import read_model
from gsx.scenes.keypoint_fit import shift_of
from gsx.scenes.lens_folds import LEAST_SHARE, largest_rectangle
from gsx.scenes.posed import lens_notes, shot_through
from gsx.scenes.transforms import lens_of
from gsx.scenes.undistort import pinhole_of, rays_of, undistort

SIZE = (200, 150)
WIDE = [120.0, 100.0, 75.0, -0.18]  # SIMPLE_RADIAL f, cx, cy, k: grows up to 1.36, 108.9 px; a corner is at 125
FOLDED = [120.0, 100.0, 75.0, -0.25]  # grows up to 1.155, 92.4 px: less than the half width
CORNER = (187.6, 140.7)  # 109.5 px from the principal point
TURN = 1 / math.sqrt(0.75)
"""Slope at which r (1 - r^2 / 4) stops growing."""


def observed_at(
    reconstruction: Any, place: tuple[float, float], count: int = 1, images: slice = slice(1)
) -> tuple[Any, list[str]]:
    """The reconstruction with the first `count` observations of some images moved to one place, and their names."""
    chosen = [reconstruction.images[number] for number in sorted(reconstruction.images)][images]
    for image in chosen:
        for index in image.get_observation_point2D_idxs()[:count]:
            image.points2D[index].xy = np.array(place)
    return reconstruction, [image.name for image in chosen]


def wide(**changes: Any) -> Any:
    return synthesize("SIMPLE_RADIAL", WIDE, size=SIZE, **changes)


def test_a_keypoint_without_a_ray_is_left_out(tmp_path: Path) -> None:
    """The issue's input. The others fit exactly."""
    reconstruction, _ = observed_at(wide(), CORNER)
    assert not np.isfinite(next(iter(reconstruction.cameras.values())).cam_from_img([CORNER])).any()
    folder = write_scene(reconstruction, tmp_path)
    assert load(colmap_options(tmp_path)).notes[-1] == (
        "Reprojection error 0.00 px (median of 249 observations, at the model's resolution); "
        "keypoints for which the lens has no ray, left out: 1."
    )
    assert shift_of(read_model(folder)) == pytest.approx(0, abs=1e-6)
    assert any("fit       pictures are 0.00 px" in line and "left out: 1" in line for line in FORMAT.facts(tmp_path))


def test_a_keypoint_without_a_ray_hides_no_wrong_focal_length(tmp_path: Path) -> None:
    """Of a focal length too long by 3 %, with one such keypoint in every image and without."""
    found = []
    for count in (0, 1):
        reconstruction, _ = observed_at(wide(), CORNER, count, slice(None))
        for camera in reconstruction.cameras.values():
            camera.params = [1.03 * WIDE[0], *WIDE[1:]]
        found.append(shift_of(read_model(write_scene(reconstruction, tmp_path / str(count)))))
    assert found[0] > 0.5
    assert found[1] == pytest.approx(found[0], rel=0.1)
    scene = load(colmap_options(tmp_path / "1", adjust="auto"))
    assert "Bundle adjustment" in scene.notes[0]
    assert scene.train[0].camera.fx == pytest.approx(WIDE[0], rel=2e-3)


def test_an_image_without_any_ray_is_named(tmp_path: Path) -> None:
    reconstruction, (name,) = observed_at(wide(), CORNER, 50)
    write_scene(reconstruction, tmp_path)
    note = load(colmap_options(tmp_path)).notes[-1]
    assert "median of 200 observations" in note
    assert note.endswith(f"; keypoints for which the lens has no ray, left out: 50; no keypoint is left of {name}.")


def test_where_no_keypoint_has_a_ray_points_in_view_are_counted(tmp_path: Path) -> None:
    reconstruction, _ = observed_at(wide(), CORNER, 50, slice(None))
    folder = write_scene(reconstruction, tmp_path)
    note = load(colmap_options(tmp_path)).notes[-1]
    assert note.startswith("No keypoint can check the cameras; 100% of its points are in view; keypoints for which")
    assert fit_line(read_model(folder)).startswith(
        "too few observations; keypoints for which the lens has no ray, left out: 250"
    )


@pytest.mark.parametrize("place", [(math.nan, 3.0), (math.inf, 3.0), (1e300, -1e300)])
@pytest.mark.parametrize("model", ["SIMPLE_RADIAL", "PINHOLE"])
def test_keypoints_that_are_no_numbers_are_left_out(tmp_path: Path, model: str, place: tuple[float, float]) -> None:
    params = WIDE if model == "SIMPLE_RADIAL" else [120.0, 120.0, 100.0, 75.0]
    reconstruction, _ = observed_at(synthesize(model, params, size=SIZE), place)
    folder = write_scene(reconstruction, tmp_path)
    assert load(colmap_options(tmp_path)).notes[-1].startswith("Reprojection error 0.00 px (median of ")
    assert shift_of(read_model(folder)) == pytest.approx(0, abs=1e-6)


def test_points_behind_cameras_count_as_misses_and_are_named(tmp_path: Path) -> None:
    """Point 1 is moved behind every camera that observes it: the cameras look at the origin from 5 units."""
    reconstruction = wide()
    reconstruction.points3D[1].xyz = 100 * reconstruction.images[1].projection_center()
    folder = write_scene(reconstruction, tmp_path)
    model = read_model(folder)
    behind = sum(
        float((image.observed @ image.rotation.T + image.translation)[:, 2].min()) < 0 for image in model.images
    )
    assert behind >= 1
    note = load(colmap_options(tmp_path)).notes[-1]
    assert "median of 250 observations" in note
    assert f"; observed points that lie behind their camera: {behind}" in note
    assert f"; observed points that lie behind their camera: {behind}" in fit_line(model)


def test_most_points_behind_cameras_are_refused(tmp_path: Path) -> None:
    reconstruction = wide()
    for frame in reconstruction.frames.values():
        pose = frame.rig_from_world
        about_y = pycolmap.Rotation3d(np.array([0.0, 1.0, 0.0, 0.0]))
        frame.rig_from_world = pycolmap.Rigid3d(about_y * pose.rotation, about_y.matrix() @ pose.translation)
    write_scene(reconstruction, tmp_path)
    refused("have most of the points that they observe behind them", load, colmap_options(tmp_path))


def test_errors_of_points_that_are_no_numbers_leave_the_mean(tmp_path: Path) -> None:
    reconstruction = wide()
    for number, error in ((1, math.nan), (2, math.inf), (3, 0.5), (4, 1.5)):
        reconstruction.points3D[number].error = error
    stated = [
        point.error for point in reconstruction.points3D.values() if math.isfinite(point.error) and point.error >= 0
    ]
    folder = write_scene(reconstruction, tmp_path)
    model = read_model(folder)
    assert model.mean_error == pytest.approx(np.mean(stated))
    assert model.notes == ["The mean reprojection error leaves out 2 points whose own is not finite."]
    for point in reconstruction.points3D.values():
        point.error = math.nan
    write_scene(reconstruction, tmp_path / "none")
    assert "no reprojection error stated" in next(iter(FORMAT.facts(tmp_path / "none")))


def test_rays_behind_a_fisheye_are_no_rays() -> None:
    """More than half pi from the axis, pycolmap gives the mirrored slope before the camera."""
    camera = pycolmap.Camera(model="SIMPLE_FISHEYE", width=200, height=150, params=[40.0, 100.0, 75.0])
    pixels = torch.tensor([[100.0 + 40 * angle, 75.0] for angle in (1.0, 1.5, 1.6, 2.4)], dtype=torch.float64)
    rays = rays_of(camera, pixels)
    torch.testing.assert_close(rays[:2, 0], torch.tensor([math.tan(1.0), math.tan(1.5)], dtype=torch.float64))
    assert rays[2:].isnan().all()


def test_bends_are_measured_where_there_are_rays(tmp_path: Path) -> None:
    reconstruction, _ = observed_at(wide(), CORNER)
    assert math.isfinite(bundle.bend_of(reconstruction, list(reconstruction.cameras)))
    assert bundle.bend_of(reconstruction, list(reconstruction.cameras)) > 0.1


# lenses that fold inside of the picture

LENSES = {
    "SIMPLE_RADIAL": FOLDED,
    "RADIAL": [120.0, 100.0, 75.0, -0.6, 0.15],  # comes back, and grows again farther out
    "OPENCV": [120.0, 120.0, 100.0, 75.0, -0.25, 0.0, 0.03, -0.02],
    "FULL_OPENCV": [120.0, 120.0, 100.0, 75.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.8, 0.0, 0.0],
    "OPENCV_FISHEYE": [80.0, 80.0, 100.0, 75.0, -0.25, 0.0, 0.0, 0.0],
    "SIMPLE_RADIAL_FISHEYE": [80.0, 100.0, 75.0, -0.25],
    "RADIAL_FISHEYE": [80.0, 100.0, 75.0, -0.25, 0.0],
    "THIN_PRISM_FISHEYE": [80.0, 80.0, 100.0, 75.0, -0.25, *[0.0] * 7],
    "RAD_TAN_THIN_PRISM_FISHEYE": [80.0, 80.0, 100.0, 75.0, -0.25, *[0.0] * 11],
}


def camera_of(model: str, params: list[float], size: tuple[int, int] = SIZE) -> Any:
    return pycolmap.Camera(model=model, width=size[0], height=size[1], params=params)


def slopes_of(pinhole: Any) -> Tensor:
    """Slopes of the pixel centres of a pinhole camera, (H, W, 2)."""
    y, x = torch.meshgrid(
        torch.arange(pinhole.height).double() + 0.5, torch.arange(pinhole.width).double() + 0.5, indexing="ij"
    )
    focal = torch.tensor([pinhole.focal_length_x, pinhole.focal_length_y], dtype=torch.float64)
    centre = torch.tensor([pinhole.principal_point_x, pinhole.principal_point_y], dtype=torch.float64)
    return (torch.stack([x, y], -1) - centre) / focal


@pytest.mark.parametrize("model", LENSES)
def test_a_folding_lens_is_cut_to_what_is_not_mirrored(model: str) -> None:
    """Each pixel of the picture is on the photo, right of its left neighbour and below its upper one."""
    camera = camera_of(model, LENSES[model])
    pinhole = pinhole_of(camera)
    slopes = slopes_of(pinhole)
    rays = torch.cat([slopes, torch.ones_like(slopes[..., :1])], -1).reshape(-1, 3)
    pixels = torch.from_numpy(camera.img_from_cam(rays.numpy()))
    assert (pixels >= 0).all()
    assert (pixels <= torch.tensor(SIZE)).all()
    torch.testing.assert_close(rays_of(camera, pixels), rays[:, :2], atol=1e-5, rtol=0)
    grid = pixels.reshape(pinhole.height, pinhole.width, 2)
    across, down = grid[:-1].diff(dim=1), grid[:, :-1].diff(dim=0)
    assert (across[..., 0] * down[..., 1] - across[..., 1] * down[..., 0] > 0).all()


def test_the_cut_is_the_largest_that_the_fold_leaves() -> None:
    """Rays up to the turning point, and to the photo's upper and lower edge: by brute force over half sides."""
    pinhole = pinhole_of(camera_of("SIMPLE_RADIAL", FOLDED))
    slopes = np.linspace(0, TURN, 10**4)
    radii = 120 * slopes * (1 - slopes**2 / 4)
    edge = slopes[np.searchsorted(radii, 75)]

    def largest(reach: float) -> float:
        return float(max(4 * math.sqrt(reach**2 - y * y) * y for y in np.linspace(0.01, edge, 1000)) * 120**2)

    inner = slopes[np.searchsorted(radii, radii[-1] - 2 * math.sqrt(2))]  # interpolated from pixels with a ray
    assert 0.95 * largest(inner) < pinhole.width * pinhole.height < largest(TURN)
    assert (pinhole.width / 240) ** 2 + (pinhole.height / 240) ** 2 < TURN**2


def test_a_cut_picture_shows_the_scene_as_it_is() -> None:
    """Of a photo made ray by ray, white where no ray reaches."""
    camera = camera_of("SIMPLE_RADIAL", FOLDED)

    def scene(slopes: Tensor) -> Tensor:
        return 0.5 + 0.2 * torch.sin(3 * slopes[..., 0]) + 0.2 * torch.cos(2 * slopes[..., 1] + slopes[..., 0])

    y, x = torch.meshgrid(torch.arange(150.0).double() + 0.5, torch.arange(200.0).double() + 0.5, indexing="ij")
    radius = torch.hypot(x - 100, y - 75) / 120
    table = np.linspace(0, TURN, 10**5)
    slope = torch.from_numpy(np.interp(radius, table * (1 - table**2 / 4), table))
    lost = radius > TURN * (1 - TURN**2 / 4) - 1e-3
    ratio = torch.where(radius > 0, slope / radius, 1.0)
    photo = torch.where(lost, 1.0, scene(torch.stack([(x - 100) / 120 * ratio, (y - 75) / 120 * ratio], -1)))
    pinhole = pinhole_of(camera)
    size = (pinhole.width, pinhole.height)
    found = undistort((photo * 255).round().to(torch.uint8).expand(3, -1, -1), camera, pinhole, size)[0] / 255
    expected = scene(slopes_of(pinhole))
    inner = slopes_of(pinhole).norm(dim=-1) < 0.95 * TURN  # nearer to the fold the photo itself is too coarse
    assert (found - expected)[inner].abs().max() < 0.02
    assert (found - expected).abs().max() < 0.2


def test_a_cut_is_noted_and_fits(tmp_path: Path) -> None:
    write_scene(synthesize("SIMPLE_RADIAL", FOLDED, size=SIZE), tmp_path)
    scene = load(colmap_options(tmp_path))
    (note,) = (note for note in scene.notes if "undistorted" in note)
    width, height = scene.train[0].camera.size
    assert note.startswith(f"Photos of SIMPLE_RADIAL cameras of 200x150 are undistorted to {width}x{height}, cut to")
    assert "92 px from the principal point, and of its 30000 px 19" in note
    assert scene.notes[-1].startswith("Reprojection error 0.00 px (median of 250")
    assert scene.train[0].image().shape == (3, height, width)


@pytest.mark.parametrize("model", ["SIMPLE_RADIAL", "OPENCV"])
def test_lenses_that_do_not_fold_in_the_picture_are_left_to_colmap(model: str) -> None:
    """Some corners of these have no ray, and no picture of COLMAP's reaches there."""
    camera = camera_of(model, WIDE if model == "SIMPLE_RADIAL" else [120.0, 120.0, 100.0, 75.0, -0.18, 0.0, 0.0, 0.0])
    expected = pycolmap.undistort_camera(pycolmap.UndistortCameraOptions(), camera)
    found = pinhole_of(camera)
    assert (found.width, found.height, *found.params) == (expected.width, expected.height, *expected.params)


@pytest.mark.parametrize(
    "params",
    [
        [120.0, 120.0, 50.0, 60.0, -0.25, 0.0, 0.0, 0.0],  # off the middle
        [120.0, 120.0, -10.0, 75.0, -0.15, 0.0, 0.0, 0.0],  # off the photo, as of a part of one
    ],
)
def test_principal_points_may_lie_anywhere(params: list[float]) -> None:
    camera = camera_of("OPENCV", params)
    pinhole = pinhole_of(camera)
    assert pinhole.width * pinhole.height > 0.3 * 200 * 150
    rays = torch.nn.functional.pad(slopes_of(pinhole).reshape(-1, 2), (0, 1), value=1.0)
    pixels = torch.from_numpy(camera.img_from_cam(rays.numpy()))
    torch.testing.assert_close(rays_of(camera, pixels), rays[:, :2], atol=1e-5, rtol=0)


@pytest.mark.parametrize("k", [-1.0, -1e3, -1e9, -1e300])
def test_too_little_of_a_photo_is_refused(tmp_path: Path, k: float) -> None:
    camera = camera_of("SIMPLE_RADIAL", [120.0, 100.0, 75.0, k])
    refused(rf"folds: .* of its 30000 px \(at least {LEAST_SHARE:.0%} .*correct its intri", pinhole_of, camera)


def test_transforms_share_the_cut(tmp_path: Path) -> None:
    write_image(tmp_path / "a.png", torch.zeros(3, 150, 200))
    lens = lens_of({"fl_x": 120, "k1": -0.25, "cx": 100, "cy": 75, "w": 200, "h": 150}, tmp_path / "a.png", "a frame")
    shot = shot_through(lens, "a.png", tmp_path / "a.png", torch.eye(3).double(), torch.zeros(3).double())
    pinhole = pinhole_of(camera_of("SIMPLE_RADIAL", FOLDED))
    assert shot.whole.size == (pinhole.width, pinhole.height)
    assert ", cut to where the lens does not fold" in lens_notes([shot])[0]


def test_the_largest_rectangle_around_a_place() -> None:
    """Against all rectangles, of random masks."""
    generator = torch.Generator().manual_seed(0)
    for _ in range(30):
        usable = torch.rand(7, 9, generator=generator) < 0.85
        usable[3, 4] = True
        areas = {
            (top, bottom, left, right): (bottom - top) * (right - left)
            for top in range(4) for bottom in range(3, 7) for left in range(5) for right in range(4, 9)
            if usable[top : bottom + 1, left : right + 1].all()
        }  # fmt: skip
        assert areas[largest_rectangle(usable, 3, 4)] == max(areas.values())
