"""Gaussians through a lens against moments of samples that pycolmap projects, the pinhole path, and differences."""

import math
from dataclasses import replace

import pycolmap
import pytest
import torch
from raster_scenes import SMOOTH, any_path, changed, front_camera, random_splats, render_with_gradients, soft_splats

from gsx.core.data.camera import Camera, pinhole
from gsx.core.gaussians.quaternions import rotation_matrices
from gsx.core.gaussians.splats import Splats
from gsx.core.rasterizer import RasterSettings, rasterize
from gsx.core.rasterizer.projection import project
from gsx.engine.backend import COMPILED
from gsx.engine.compiling import CompiledOnce, available
from gsx.lenses import Distortion, lens_of
from gsx.lenses.unscented import project_through_lens

BARE = RasterSettings(dilation=1e-6, cull="tight", alpha_min=1e-9)
FISHEYE = Distortion(fisheye=True, radial=(0.02, -0.01, 0.005, -0.001))


def with_lens(camera: Camera, lens: Distortion) -> Camera:
    return replace(camera, lens=lens, rotation=camera.rotation.double(), translation=camera.translation.double())


def colmap_camera(camera: Camera) -> pycolmap.Camera:
    params = [camera.fx, camera.fy, camera.cx, camera.cy, 0.02, -0.01, 0.005, -0.001]
    return pycolmap.Camera(model="OPENCV_FISHEYE", width=camera.width, height=camera.height, params=params)


def wide_splats(camera: Camera, size: float) -> Splats:
    """Eight splats from one side of a wide picture to the other, 2.5 units ahead."""
    ends = torch.tensor([[-1.3, -0.9, 1.0], [1.3, 1.1, 1.0]]).double()
    shares = torch.linspace(0, 1, 8, dtype=torch.float64)[:, None]
    local = 2.5 * (ends[0] + shares * (ends[1] - ends[0]))
    made = random_splats(8, size=size)
    fields = {name: getattr(made, name).double() for name in ("scales", "quats", "log_opacities", "colours")}
    return Splats(means=(local - camera.translation) @ camera.rotation, **fields)


@pytest.mark.parametrize(("size", "off"), [(0.02, 0.02), (0.1, 0.05)])
def test_moments_are_those_of_samples_through_pycolmap(size: float, off: float) -> None:
    camera = with_lens(replace(front_camera(64, 48), fx=29.0, fy=28.0), FISHEYE)
    model, splats = colmap_camera(camera), wide_splats(camera, size)
    screen = project(splats, camera, BARE)
    assert screen.ids.tolist() == list(range(8))
    draws = torch.randn(100_000, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    for row, turn in enumerate(rotation_matrices(splats.quats)):
        places = splats.means[row] + (draws * splats.scales[row]) @ turn.T
        pixels = torch.from_numpy(model.img_from_cam(camera.to_camera(places).numpy()))
        pixels = pixels[pixels.isfinite().all(1)]
        covariance = torch.cov(pixels.T)
        xx, xy, yy = screen.covariances[row]
        found = torch.stack([torch.stack([xx, xy]), torch.stack([xy, yy])])
        deviation = float(covariance.diagonal().mean().sqrt())
        assert float((screen.means[row] - pixels.mean(0)).norm()) < off * deviation
        assert float((found - covariance).norm()) < off * float(covariance.norm())


def test_a_lens_without_distortion_is_a_pinhole_to_second_order() -> None:
    camera, splats = front_camera(), soft_splats(40)
    errors = []
    for share in (0.02, 0.01):
        small = replace(splats, scales=share * splats.scales)
        plain, bent = (project(small, one, BARE) for one in (camera, with_lens(camera, Distortion())))
        assert torch.equal(plain.ids, bent.ids)
        deviations = plain.covariances[:, [0, 2]].sqrt()
        errors.append(float(((plain.means - bent.means) / deviations).norm()))
        torch.testing.assert_close(bent.covariances, plain.covariances, rtol=3 * share, atol=1e-6)
    assert errors[1] < 0.52 * errors[0]  # shifts of means are squares of sizes


@pytest.mark.parametrize("compensate", [False, True])
def test_gradients_pass_gradcheck_in_float64(compensate: bool) -> None:
    camera, splats = with_lens(front_camera(9, 7), FISHEYE), soft_splats()
    rules = replace(SMOOTH, compensate=compensate)

    def render(*values: torch.Tensor) -> torch.Tensor:
        means, scales, quats, rotation, intrinsics = values
        moved = replace(camera, rotation=rotation)
        changed = replace(splats, means=means, scales=scales, quats=quats)
        return rasterize(changed, moved, rules, intrinsics=intrinsics).image

    lens = torch.tensor([camera.fx, camera.fy, camera.cx, camera.cy], dtype=torch.float64)
    inputs = [splats.means, splats.scales, splats.quats, camera.rotation, lens]
    inputs = [value.detach().clone().requires_grad_() for value in inputs]
    assert torch.autograd.gradcheck(render, inputs, eps=1e-6, atol=1e-6, rtol=1e-4)


def test_a_crop_has_the_pixels_of_the_whole_and_a_zoom_the_same_lens() -> None:
    camera, splats = with_lens(front_camera(), FISHEYE), random_splats()
    whole = rasterize(splats, camera, RasterSettings()).image
    part = rasterize(splats, camera.crop(17, 9, 24, 20), RasterSettings()).image
    assert torch.equal(part, whole[:, 9:29, 17:41])
    fine = rasterize(splats, camera.zoom(4), RasterSettings(dilation=16 * 0.3)).image
    coarse = torch.nn.functional.avg_pool2d(fine, 4)
    assert float((coarse - whole).abs().mean()) < 0.01


def test_splats_beyond_the_fold_or_behind_are_not_drawn() -> None:
    lens = lens_of(pycolmap.Camera(model="OPENCV", width=64, height=48, params=[60, 60, 32, 24, -0.3, 0, 0, 0]))
    assert isinstance(lens, Distortion)
    assert lens.limit == pytest.approx(math.sqrt(1 / 0.9), rel=0.01)  # of r - 0.3 r^3, less where areas are 1 %
    camera = replace(pinhole(torch.eye(3), torch.zeros(3), 60.0, 64, 48), lens=lens)
    splats = random_splats(4)
    means = torch.tensor([[0.0, 0, 2], [0.4, 0, 1], [3.0, 0, 1], [0.3, 0, -1]])
    screen = project(replace(splats, means=means, scales=0.01 * torch.ones(4, 3)), camera, RasterSettings())
    assert screen.ids.tolist() == [0, 1]
    assert screen.dropped == 0


@pytest.mark.skipif(not available(), reason="no working compiler")
def test_one_compiled_code_serves_all_lenses_of_a_form_with_pictures_and_gradients_of_float64() -> None:
    kernel = COMPILED.kernel(project_through_lens, FISHEYE.form, variant=(False, False))
    assert isinstance(kernel, CompiledOnce)
    splats, pictures, codes = random_splats(), [], []
    for lens in (FISHEYE, replace(FISHEYE, radial=(0.1, 0.05, -0.02, 0.01))):
        camera = with_lens(front_camera(), lens)
        exact, truth = render_with_gradients(changed(splats, dtype=torch.float64), camera, any_path(cull="tight"))
        rendering, found = render_with_gradients(splats, camera, any_path(cull="tight", path="compiled"))
        assert float((rendering.image - exact.image).detach().abs().max()) < 1e-5
        assert all(float((found[name] - true).norm()) <= 1e-4 * float(true.norm()) for name, true in truth.items())
        pictures.append(exact.image.detach())
        codes.append(sum(map(len, kernel.cached.codes.values())))
    assert codes[0] == codes[1] > 0
    assert float((pictures[0] - pictures[1]).abs().max()) > 0.01
