"""Gradients of pose and intrinsics against finite differences."""

from dataclasses import replace

import pytest
import torch
from raster_scenes import SMOOTH, changed, front_camera, random_splats, soft_splats
from reference_rasterizer import render_reference

from gsx.core.data.camera import Camera
from gsx.core.errors import InputError
from gsx.core.rasterizer import RasterSettings, rasterize


def intrinsics_of(camera: Camera) -> torch.Tensor:
    return torch.tensor([camera.fx, camera.fy, camera.cx, camera.cy], dtype=torch.float64)


def cameras() -> dict[str, Camera]:
    """The whole raster of a camera, and an off-centre window of one."""
    return {"whole": front_camera(9, 7), "crop": front_camera(20, 16).crop(6, 5, 9, 7)}


@pytest.mark.parametrize("view", ["whole", "crop"])
def test_pose_and_intrinsics_pass_gradcheck_in_float64(view: str) -> None:
    splats, camera = soft_splats(), cameras()[view]

    def render(rotation: torch.Tensor, translation: torch.Tensor, intrinsics: torch.Tensor) -> torch.Tensor:
        moved = replace(camera, rotation=rotation, translation=translation)
        rendering = rasterize(splats, moved, SMOOTH, intrinsics=intrinsics, depth=True)
        assert rendering.depth is not None
        return torch.cat([rendering.image, rendering.alpha[None], rendering.depth[None]])

    inputs = [value.double().requires_grad_() for value in (camera.rotation, camera.translation)]
    inputs.append(intrinsics_of(camera).requires_grad_())
    assert torch.autograd.gradcheck(render, inputs, eps=1e-6, atol=1e-6, rtol=1e-4)


def test_gradients_follow_the_clamp_of_the_jacobian() -> None:
    # far off the raster: x/z is held at the bound, which moves with the lens, while the tail is in the picture
    splats, camera = soft_splats(count=1), front_camera(9, 7)
    splats = changed(splats, means=torch.tensor([[4.0, 0.5, 0.2]]).double(), scales=2 * splats.scales)
    weight = torch.rand(3, 7, 9, generator=torch.Generator().manual_seed(1)).double()
    slope = (camera.rotation @ splats.means[0] + camera.translation)[0] / 4.5
    assert float(slope) > 1.3 * camera.width / (2 * camera.fx)

    def loss(intrinsics: torch.Tensor) -> torch.Tensor:
        return (rasterize(splats, camera, SMOOTH, intrinsics=intrinsics).image * weight).sum()

    assert torch.autograd.gradcheck(loss, intrinsics_of(camera).requires_grad_(), eps=1e-6, atol=1e-7, rtol=1e-4)


def numbers_moved(camera: Camera, name: str, index: tuple[int, ...], step: float) -> Camera:
    """The camera with one of its numbers changed by `step`."""
    value = getattr(camera, name)
    if not index:
        return replace(camera, **{name: value + step})
    value = value.clone()
    value[index] += step
    return replace(camera, **{name: value})


@pytest.mark.parametrize("view", ["whole", "crop"])
def test_pose_and_intrinsics_agree_with_finite_differences_of_the_reference(view: str) -> None:
    splats, camera = soft_splats(3), cameras()[view]
    weight = torch.rand(3, 7, 9, generator=torch.Generator().manual_seed(1)).double()
    rotation, translation = (v.clone().requires_grad_() for v in (camera.rotation, camera.translation))
    intrinsics = intrinsics_of(camera).requires_grad_()
    moved = replace(camera, rotation=rotation, translation=translation)
    (rasterize(splats, moved, SMOOTH, intrinsics=intrinsics).image * weight).sum().backward()
    found = {("rotation", (i, j)): rotation.grad[i, j] for i in range(3) for j in range(3)}
    found |= {("translation", (i,)): translation.grad[i] for i in range(3)}
    found |= {(name, ()): intrinsics.grad[i] for i, name in enumerate(("fx", "fy", "cx", "cy"))}
    for (name, index), gradient in found.items():
        step = 1e-5
        ends = [
            float((render_reference(splats, numbers_moved(camera, name, index, d), SMOOTH)[0] * weight).sum())
            for d in (-step, step)
        ]
        assert float(gradient) == pytest.approx((ends[1] - ends[0]) / (2 * step), rel=1e-5, abs=1e-6), (name, index)


def test_intrinsics_replace_the_numbers_of_the_camera() -> None:
    camera, other = front_camera(), replace(front_camera(), fx=61.0, fy=75.0, cx=30.0, cy=20.0)
    rules = RasterSettings()
    plain = rasterize(random_splats(), other, rules).image
    given = rasterize(random_splats(), camera, rules, intrinsics=intrinsics_of(other)).image
    assert torch.equal(plain, given)
    assert not torch.equal(plain, rasterize(random_splats(), camera, rules).image)


def test_intrinsics_that_allow_no_picture_are_refused_by_name() -> None:
    with pytest.raises(InputError, match=r"fx=-3\.0.*give focal lengths"):
        rasterize(random_splats(), front_camera(), RasterSettings(), intrinsics=torch.tensor([-3.0, 50.0, 35.0, 26.0]))


def test_float32_pose_and_intrinsics_get_gradients_through_float32_splats() -> None:
    camera, splats = front_camera(), random_splats()
    numbers = [camera.rotation.float(), camera.translation.float(), intrinsics_of(camera).float()]

    def found(dtype: torch.dtype) -> list[torch.Tensor]:
        live = [value.to(dtype).clone().requires_grad_() for value in numbers]
        moved = replace(camera, rotation=live[0], translation=live[1])
        # the cut-off is a step: far down it hardly matters on which side of it a pixel falls
        rules = RasterSettings(cull="tight", alpha_min=1e-6)
        rasterize(changed(splats, dtype=dtype), moved, rules, intrinsics=live[2]).image.square().mean().backward()
        assert all(value.grad.dtype == dtype for value in live)
        return [value.grad for value in live]

    for narrow, wide in zip(found(torch.float32), found(torch.float64), strict=True):
        assert (narrow - wide).norm() <= 1e-4 * wide.norm()
