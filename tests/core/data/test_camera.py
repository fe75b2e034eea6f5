"""Camera algebra: hand-worked projections, and identities between projecting before and after."""

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from gsx.core.data.camera import Camera, Frame, look_at
from gsx.core.errors import InputError


def camera(**changes: object) -> Camera:
    """Off-centre, with two focal lengths, looking from the side."""
    seen = look_at([3, -2, 1.5], [0.2, 0.1, 0], fov_x=0.8, width=120, height=90)
    return Camera(**(vars(seen) | {"fx": 130.0, "fy": 110.0, "cx": 57.0, "cy": 48.0} | changes))


def points(count: int = 12) -> Tensor:
    return torch.randn(count, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64) * 0.4


def test_projection_worked_by_hand() -> None:
    simple = Camera(
        rotation=torch.eye(3), translation=torch.tensor([0.0, 0, 1]), fx=100, fy=50, cx=30, cy=20, width=60, height=40
    )
    pixels, depth = simple.project(torch.tensor([[1.0, 2, 3], [0, 0, 9], [-0.4, 0.8, 1]]))
    torch.testing.assert_close(pixels, torch.tensor([[55.0, 45.0], [30.0, 20.0], [10.0, 40.0]]))
    torch.testing.assert_close(depth, torch.tensor([4.0, 10.0, 2.0]))


def test_centre_undoes_the_translation() -> None:
    seen = camera()
    torch.testing.assert_close(seen.centre, torch.tensor([3, -2, 1.5], dtype=torch.float64))
    zeros = seen.rotation @ seen.centre + seen.translation
    torch.testing.assert_close(zeros, torch.zeros(3, dtype=torch.float64))


@pytest.mark.parametrize("factor", [0.5, 1.0, 2.0, 3.0])
def test_zoom_multiplies_pixel_positions(factor: float) -> None:
    zoomed = camera().zoom(factor)
    assert zoomed.size == (120 * factor, 90 * factor)
    before, depth = camera().project(points())
    after, same_depth = zoomed.project(points())
    torch.testing.assert_close(after, before * factor)
    assert torch.equal(depth, same_depth)


def test_resize_scales_each_axis_and_keeps_the_field_of_view() -> None:
    resized = camera().resize(48, 180)
    before, _ = camera().project(points())
    after, _ = resized.project(points())
    torch.testing.assert_close(after, before * torch.tensor([0.4, 2.0], dtype=torch.float64))
    assert resized.width / resized.fx == pytest.approx(120 / 130)
    assert resized.size == (48, 180)


def test_resizing_back_gives_the_camera_back() -> None:
    there = camera().resize(37, 61).resize(120, 90)
    assert (there.fx, there.fy, there.cx, there.cy) == pytest.approx((130, 110, 57, 48))


def test_zoom_never_loses_the_last_pixel() -> None:
    assert camera().zoom(1e-4).size == (1, 1)


window = st.tuples(st.integers(-50, 150), st.integers(-50, 150), st.integers(1, 200), st.integers(1, 200))


@settings(max_examples=50, deadline=None)
@given(first=window, second=window)
def test_crops_shift_pixels_and_compose(first: tuple[int, ...], second: tuple[int, ...]) -> None:
    once, twice = camera().crop(*first), camera().crop(*first).crop(*second)
    before, _ = camera().project(points(3))
    after, _ = once.project(points(3))
    torch.testing.assert_close(after, before - torch.tensor(first[:2], dtype=torch.float64))
    assert once.size == first[2:]
    together = camera().crop(first[0] + second[0], first[1] + second[1], *second[2:])
    assert (twice.cx, twice.cy, twice.size, twice.frame) == (together.cx, together.cy, together.size, together.frame)


def test_crops_remember_the_raster_they_were_cut_from() -> None:
    assert camera().frame == Frame(left=0, top=0, width=120, height=90)
    assert camera().crop(10, -5, 30, 40).frame == Frame(left=10, top=-5, width=120, height=90)
    assert camera().crop(10, -5, 30, 40).crop(3, 8, 5, 5).frame == Frame(left=13, top=3, width=120, height=90)


def test_a_window_without_pixels_is_refused() -> None:
    for width, height in ((0, 5), (5, -1)):
        with pytest.raises(InputError, match=f"a window of {width} x {height} px has no pixels"):
            camera().crop(1, 2, width, height)


def test_zoom_and_crop_commute_up_to_the_window() -> None:
    zoomed_crop, cropped_zoom = camera().crop(10, 20, 30, 40).zoom(3), camera().zoom(3).crop(30, 60, 90, 120)
    assert zoomed_crop.frame == cropped_zoom.frame == Frame(left=30, top=60, width=360, height=270)
    assert (zoomed_crop.cx, zoomed_crop.cy) == pytest.approx((cropped_zoom.cx, cropped_zoom.cy))
    assert (zoomed_crop.fx, zoomed_crop.fy, zoomed_crop.size) == (cropped_zoom.fx, cropped_zoom.fy, cropped_zoom.size)


@pytest.mark.parametrize(("fraction", "size", "corner"), [(0.5, (60, 45), (30, 22)), (1.0, (120, 90), (0, 0))])
def test_narrow_is_the_middle_at_the_same_focal_length(
    fraction: float, size: tuple[int, int], corner: tuple[int, int]
) -> None:
    narrow = camera().narrow(fraction)
    assert narrow.size == size
    assert (narrow.fx, narrow.fy) == (130, 110)
    before, _ = camera().project(points())
    after, _ = narrow.project(points())
    torch.testing.assert_close(after, before - torch.tensor(corner, dtype=torch.float64))


@pytest.mark.parametrize("up", [(0, 0, 1), (0.3, -1, 0.2)])
def test_look_at_aims_stands_upright_and_spans_the_field_of_view(up: tuple[float, float, float]) -> None:
    eye, target = torch.tensor([1.0, -3, 2]).double(), torch.tensor([-0.5, 0.5, 0.25]).double()
    seen = look_at(eye.tolist(), target.tolist(), up=up, fov_x=1.2, width=64, height=48)
    torch.testing.assert_close(seen.rotation @ seen.rotation.T, torch.eye(3, dtype=torch.float64))
    assert float(torch.linalg.det(seen.rotation)) == pytest.approx(1)
    torch.testing.assert_close(seen.centre, eye)
    vertical = torch.tensor(up, dtype=torch.float64)
    right, forward = seen.rotation[0], (target - eye) / (target - eye).norm()
    edge = eye + math.cos(0.6) * forward + math.sin(0.6) * right  # half the field of view to the right
    pixels, depth = seen.project(torch.stack([target, target + 0.1 * vertical, edge]))
    torch.testing.assert_close(pixels[0], torch.tensor([32.0, 24.0]).double())
    assert float(depth[0]) == pytest.approx(float((target - eye).norm()))
    assert float(pixels[1, 0]) == pytest.approx(32)  # up in the world is up in the picture, and only up
    assert float(pixels[1, 1]) < 23.9
    assert pixels[2].tolist() == pytest.approx([64, 24])
    assert seen.fx == seen.fy


def test_right_of_the_target_is_right_in_the_picture() -> None:
    seen = look_at([0, -5, 0], [0, 0, 0], fov_x=1, width=10, height=10)
    pixels, _ = seen.project(torch.tensor([[1.0, 0, 0], [0.0, 0, 1]]))
    assert pixels[0].tolist() == pytest.approx([5 + seen.fx / 5, 5])
    assert pixels[1].tolist() == pytest.approx([5, 5 - seen.fx / 5])


@pytest.mark.parametrize(("eye", "target"), [((1, 2, 3), (1, 2, 3)), ((0, 0, 5), (0, 0, 0)), ((0, 0, 0), (0, 0, 2))])
def test_look_at_refuses_degenerate_directions(eye: tuple, target: tuple) -> None:
    with pytest.raises(ValueError, match="general position"):
        look_at(eye, target, fov_x=1, width=8, height=8)
