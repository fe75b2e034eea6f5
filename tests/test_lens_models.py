"""Lens models against pycolmap's projections, their inverses, derivatives, turns and pixels without a ray."""

import math
from dataclasses import replace

import pycolmap
import pytest
import torch
from refusals import refused

from gsx.core.data.camera import Camera
from gsx.lenses import Distortion, lens_of
from gsx.lenses.rays import pixels_with_rays
from gsx.scenes.orientation import oriented_camera

EXTRA = {
    "OPENCV": 4, "FULL_OPENCV": 8, "OPENCV_FISHEYE": 4, "THIN_PRISM_FISHEYE": 8,
    "SIMPLE_RADIAL": 1, "RADIAL": 2, "SIMPLE_RADIAL_FISHEYE": 1, "RADIAL_FISHEYE": 2,
}  # fmt: skip
"""Numbers of distortion by model."""


def draw(*shape: int, seed: int = 0) -> torch.Tensor:
    """Numbers in [-1, 1], float64."""
    return 2 * torch.rand(*shape, dtype=torch.float64, generator=torch.Generator().manual_seed(seed)) - 1


def camera_of(model: str, bend: list[float]) -> pycolmap.Camera:
    focal = [400.0] if model.startswith(("SIMPLE", "RADIAL")) else [400.0, 420.0]
    return pycolmap.Camera(model=model, width=640, height=480, params=[*focal, 310.0, 250.0, *bend])


def gsx_camera(model: pycolmap.Camera) -> Camera:
    return Camera(
        rotation=torch.eye(3).double(), translation=torch.zeros(3).double(), width=model.width, height=model.height,
        fx=model.focal_length_x, fy=model.focal_length_y, cx=model.principal_point_x, cy=model.principal_point_y,
        lens=lens_of(model),
    )  # fmt: skip


def rays(count: int = 300) -> torch.Tensor:
    """Points up to 45 degrees off the axis, and one on it."""
    slopes = torch.cat([0.7 * draw(count, 2), torch.zeros(1, 2).double()])
    return 3 * torch.cat([slopes, torch.ones(count + 1, 1).double()], 1)


@pytest.mark.parametrize("model", EXTRA)
@pytest.mark.parametrize("seed", range(3))
def test_pixels_are_those_of_pycolmap_and_lead_back(model: str, seed: int) -> None:
    truth, points = camera_of(model, (0.04 * draw(EXTRA[model], seed=seed)).tolist()), rays()
    camera = gsx_camera(truth)
    pixels, depths = camera.project(points)
    torch.testing.assert_close(pixels, torch.from_numpy(truth.img_from_cam(points.numpy())), rtol=0, atol=1e-9)
    torch.testing.assert_close(camera.unproject(pixels, depths), points.float(), rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("model", EXTRA)
def test_derivatives_are_differences(model: str) -> None:
    lens = lens_of(camera_of(model, (0.04 * draw(EXTRA[model], seed=1)).tolist()))
    assert lens is not None
    assert torch.autograd.gradcheck(lens.bend, rays(8).requires_grad_(), eps=1e-6, atol=1e-7)


def test_a_turned_photo_has_the_turned_lens() -> None:
    camera, points = gsx_camera(camera_of("THIN_PRISM_FISHEYE", (0.04 * draw(8)).tolist())), rays()
    x, y = camera.project(points)[0].T
    for orientation, expected in ((3, (640 - x, 480 - y)), (6, (480 - y, x)), (8, (y, 640 - x))):
        pixels = oriented_camera(camera, orientation).project(points)[0]
        torch.testing.assert_close(pixels, torch.stack(expected, 1), rtol=0, atol=1e-9)


def test_pixels_beyond_the_fold_have_no_ray_and_do_not_count() -> None:
    camera = gsx_camera(camera_of("SIMPLE_RADIAL", [-0.5]))  # r - r^3 / 2 grows up to sqrt(2 / 3)
    peak = math.sqrt(2 / 3) * 2 / 3 * 400
    counted = pixels_with_rays(camera)
    assert counted is not None
    y, x = torch.meshgrid(torch.arange(480) + 0.5 - 250, torch.arange(640) + 0.5 - 310, indexing="ij")
    distance = torch.hypot(x, y)
    assert bool(counted[distance < 0.99 * peak].all())
    assert not bool(counted[distance > peak].any())
    assert pixels_with_rays(camera.crop(250, 200, 100, 100)) is None
    assert not bool((pixels_with_rays(camera, reach=3) & (distance > 0.99 * peak - 3)).all())
    assert not bool(camera.sees(torch.tensor([[1.0, 0, 1]])))  # 1 - 1 / 2 lies inside, but mirrored


def test_pinholes_have_no_lens_and_other_models_are_refused() -> None:
    assert lens_of(camera_of("OPENCV", [0.0] * 4)) is None
    fov = pycolmap.Camera(model="FOV", width=64, height=48, params=[50, 50, 32, 24, 0.3])
    refused("not FOV: set scene.lens=undistort", lens_of, fov)
    assert lens_of(camera_of("OPENCV", [0.1, 0, 0, 0])) == Distortion(radial=(0.1, 0, 0, 0))
    camera = gsx_camera(camera_of("OPENCV", [0.1, 0, 0, 0]))
    assert not camera.draws_as(replace(camera, lens=None))
