"""Thin places and where to photograph them from: cameras before a plane with a gap, and on a circle."""

import math
from collections.abc import Sequence
from dataclasses import replace

import pytest
import torch
from small_scene import Grey
from torch import Tensor

from gsx.core.data.camera import Camera, look_at
from gsx.core.data.scene import View
from gsx.experiments.evaluation.thin_places import Retake, retakes_of
from gsx.experiments.evaluation.view_coverage import scene_coverage


def plane(camera: Camera) -> tuple[Tensor, Tensor]:
    """Depth and alpha of the plane z = 0."""
    slopes = slopes_of(camera)
    depth = -camera.centre[2] / (slopes @ camera.rotation)[..., 2]
    return depth, torch.ones_like(depth)


def slopes_of(camera: Camera) -> Tensor:
    y, x = torch.meshgrid(torch.arange(camera.height) + 0.5, torch.arange(camera.width) + 0.5, indexing="ij")
    return torch.stack([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, torch.ones_like(x)], -1)


def cylinder(camera: Camera) -> tuple[Tensor, Tensor]:
    """Depth and alpha of the cylinder of radius 1 around z."""
    directions, centre = slopes_of(camera).to(camera.rotation) @ camera.rotation, camera.centre
    a = directions[..., :2].square().sum(-1)
    b = (directions[..., :2] * centre[:2]).sum(-1)
    inside = b.square() - a * (centre[:2].square().sum() - 1)
    depth = (-b - inside.clamp(min=0).sqrt()) / a
    alpha = (inside > 0).float()
    return depth * alpha, alpha


def facing(x: float) -> Camera:
    """Looks along +z from z = -4; its frame on z = 0 is 2 wide and 1 high."""
    return Camera(
        rotation=torch.eye(3), translation=torch.tensor([-x, 0.0, 4.0]), fx=80.0, fy=80.0, cx=20, cy=10,
        width=40, height=20, near=0.01,
    )  # fmt: skip


def around(degrees: float) -> Camera:
    """Looks at the axis from a distance of 4."""
    angle = math.radians(degrees)
    return look_at([4 * math.cos(angle), 4 * math.sin(angle), 0], [0, 0, 0], fov_x=0.7, width=40, height=30)


def retakes(cameras: Sequence[Camera], draw, test: Sequence[Camera] = ()) -> list[Retake]:
    train = [View(f"{number}.jpg", camera, Grey()) for number, camera in enumerate(cameras)]
    held_out = [View(f"t{number}.jpg", camera, Grey()) for number, camera in enumerate(test)]
    return retakes_of(scene_coverage(train, held_out, draw, 1e6))


ROW = [0.25 * step for step in range(8)] + [4.0 + 0.25 * step for step in range(8)]
"""Places of cameras: frames cover [-1, 2.75] and [3, 6.75] of the plane, thinly at both ends of each."""


def test_a_gap_is_photographed_between_its_sides() -> None:
    """Its sides are 7.jpg at 1.75 and 8.jpg at 4; both rows end at their other sides."""
    found = retakes([facing(x) for x in ROW], plane)
    (gap,) = [one for one in found if one.neighbour is not None]
    assert gap.words in {
        "between 7.jpg and 8.jpg, towards the right half of 7.jpg",
        "between 8.jpg and 7.jpg, towards the left half of 8.jpg",
    }
    assert {one.words for one in found if one.neighbour is None} == {
        "from near 0.jpg, towards its left half",
        "from near 15.jpg, towards its right half",
    }


def test_the_camera_of_a_gap_stands_between_and_looks_at_it() -> None:
    (gap,) = [one for one in retakes([facing(x) for x in ROW], plane) if one.neighbour is not None]
    assert gap.camera.centre[0] == pytest.approx((1.75 + 4) / 2, abs=1e-5)
    pixels, depth = gap.camera.project(gap.place.point[None].float())
    assert pixels[0].tolist() == pytest.approx([20, 10], abs=0.01)
    assert depth[0] > 0
    assert gap.camera.rotation[1, 1] > 0.9


def test_the_share_of_a_thin_half_is_that_of_its_frame() -> None:
    """Frames at 0.25, 0.5, 0.75 begin at -0.75, -0.5, -0.25: of [-1, 0] three others show a quarter."""
    place = retakes([facing(0.25 * step) for step in range(8)], plane)[0].place
    assert (place.view.name, place.part) in {("0.jpg", "left half"), ("7.jpg", "right half")}
    assert place.share == pytest.approx(0.75, abs=0.06)
    assert place.excess == pytest.approx((place.share - 0.5) / 2)


def test_a_circle_without_a_gap_needs_nothing() -> None:
    assert retakes([around(10 * step) for step in range(36)], cylinder) == []


def test_a_gap_of_a_circle_is_photographed_between_its_sides() -> None:
    """Cameras from 0 to 240 degrees, 15 apart: what faces the other 120 is thin, from both ends."""
    found = retakes([around(15 * step) for step in range(17)], cylinder)
    assert {one.place.view.name for one in found} <= {"0.jpg", "1.jpg", "15.jpg", "16.jpg"}
    assert len(found) == 2
    for one in found:
        angle = math.degrees(math.atan2(one.place.point[1], one.place.point[0])) % 360
        assert abs((angle - 300 + 180) % 360 - 180) < 75


def test_a_view_behind_is_a_place_of_its_own() -> None:
    """A held-out photo of the back of a plane, which no training photo shows."""
    behind = replace(
        facing(0.5), rotation=torch.diag(torch.tensor([-1.0, 1, -1])), translation=torch.tensor([0.5, 0, 4.0])
    )
    first = retakes([facing(0.1 * step) for step in range(12)], plane, [behind])[0]
    assert (first.place.view.name, first.place.held_out, first.place.share) == ("t0.jpg", True, 1.0)
    assert first.words == "around t0.jpg"
    assert first.reason == "fewer than 3 other training photos show 100% of that photo"


def test_sky_is_no_place() -> None:
    def sky(camera: Camera) -> tuple[Tensor, Tensor]:
        return torch.zeros(camera.height, camera.width), torch.zeros(camera.height, camera.width)

    assert retakes([facing(0.0), facing(5.0)], sky) == []


def test_places_seen_from_several_photos_are_listed_once() -> None:
    """Two photos of one spot, and no others."""
    found = retakes([facing(0.0), facing(0.01), facing(20.0)], plane)
    assert [round(float(one.place.point[0])) for one in found] == [0, 20]


def test_a_small_object_before_nothing_is_a_place() -> None:
    """A strip of 0.8 in a frame of 2, which one photo shows: all of what is there is thin."""

    def strip(camera: Camera) -> tuple[Tensor, Tensor]:
        depth, _ = plane(camera)
        across = camera.centre[0] + depth * slopes_of(camera)[..., 0]
        alpha = (across.abs() < 0.4).float()
        return depth * alpha, alpha

    (found,) = retakes([facing(0.0), facing(20.0)], strip)
    assert (found.place.view.name, found.place.part, found.place.share) == ("0.jpg", "", 1.0)
    assert found.place.excess == pytest.approx(0.4 * 0.5, abs=0.03)
