"""Points where structure from motion found none, at depths of those seen beside."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from gsx.core.data.camera import Camera, look_at
from gsx.core.data.scene import PointCloud, Scene, View
from gsx.scenes import filling
from gsx.scenes.filling import fill_gaps, gaps_of, in_front, in_view

EYES = [(x, -6.0, z) for x in (-1.0, 0.0, 1.0) for z in (-0.5, 0.5)]


class Columns:
    """Red grows to the right; the left half may not count."""

    masked = False

    def image(self, camera: Camera) -> Tensor:
        red = torch.arange(camera.width).expand(camera.height, -1)
        return torch.stack([red, torch.zeros_like(red), torch.zeros_like(red)]).to(torch.uint8)

    def max_zoom(self, camera: Camera) -> float:
        return 1.0

    def counted(self, camera: Camera) -> Tensor | None:
        counted = torch.ones(camera.height, camera.width, dtype=torch.bool)
        counted[:, : camera.width // 2] = False
        return counted if self.masked else None


def wall(count: int, seed: int = 0, gap: float = 1.0) -> Tensor:
    """Points of the plane y = 0, none of them in the middle square of that half side."""
    generator = torch.Generator().manual_seed(seed)
    plane = (torch.rand(count, 2, generator=generator) - 0.5) * 5
    plane = plane[plane.abs().amax(1) > gap]
    return torch.stack([plane[:, 0], torch.zeros(len(plane)), plane[:, 1]], 1)


def scene_of(positions: Tensor, source: Columns | None = None) -> Scene:
    cameras = [look_at(eye, [0, 0, 0], fov_x=0.8, width=120, height=90) for eye in EYES]
    return Scene(
        name="wall",
        train=[View(f"v{i}", camera, source or Columns()) for i, camera in enumerate(cameras)],
        test=[],
        points=PointCloud(positions, torch.zeros(len(positions), 3, dtype=torch.uint8)),
        background=torch.zeros(3),
        extent=1.0,
    )


def added(scene: Scene, count: int, seed: int = 0) -> tuple[Tensor, Tensor, Scene]:
    more = fill_gaps(scene, count, torch.Generator().manual_seed(seed))
    old = len(scene.points)
    assert torch.equal(more.points.positions[:old], scene.points.positions)
    return more.points.positions[old:], more.points.colours[old:], more


def test_they_lie_on_the_wall_in_the_gap_with_the_colours_of_the_picture() -> None:
    scene = scene_of(wall(1500))
    where, what, more = added(scene, 120)
    assert len(where) == 120
    assert where[:, 1].abs().max() < 0.35  # depths are those of points as far off as the gap is wide
    off = where[:, [0, 2]].abs().amax(1)
    assert ((off < 1.05) | (off > 2.4)).float().mean() > 0.9  # in the gap, or beside the wall
    assert (off < 1.05).sum() > 50
    reds = torch.stack([(view.camera.project(where)[0][:, 0].floor() - what[:, 0]).abs() for view in scene.train])
    assert reds.amin(0).max() <= 1, "the colour is that of the pixel in the view that added it"
    assert not what[:, 1:].any()
    assert more.notes[-1] == f"120 points added to {len(scene.points):,} where training views show none (scene.fill)"
    assert torch.equal(added(scene, 120)[0], where)
    assert not torch.equal(added(scene, 120, seed=1)[0], where)


def test_a_camera_sees_its_unprojected_pixels_where_they_were() -> None:
    camera = replace(look_at([1, -5, 2], [0, 0, 0], fov_x=0.8, width=120, height=90), cx=50.0, cy=41.0)
    pixels, depths = torch.tensor([[3.0, 80.0], [119.0, 2.0], [50.0, 41.0]]), torch.tensor([1.0, 4.0, 9.0])
    back, deep = camera.project(camera.unproject(pixels, depths))
    assert torch.allclose(back, pixels, atol=1e-3)
    assert torch.allclose(deep, depths, atol=1e-4)
    assert torch.allclose(
        camera.unproject(pixels[2:], depths[2:])[0], (camera.centre + 9 * camera.rotation[2]).float(), atol=1e-5
    )


def test_points_behind_what_is_seen_tell_no_depth() -> None:
    near = wall(1500, gap=0.0)
    behind = near + torch.tensor([0.0, 6.0, 0.0])  # twice as far
    camera = scene_of(near).train[0].camera
    pixels, depths = in_view(camera, torch.cat([near, behind]))
    seen = in_front(pixels, depths)
    assert seen[depths < 8].all()
    assert seen[depths > 9].float().mean() < 0.2  # by chance none of the nearest eight is in front


def test_nothing_is_added_where_masked_or_where_nothing_is_known() -> None:
    source = Columns()
    source.masked = True
    where, what, _ = added(scene_of(wall(1500), source), 300)
    assert len(where) > 0
    assert what[:, 0].min() >= 60
    few = scene_of(wall(10))
    assert fill_gaps(few, 300, torch.Generator().manual_seed(0)) is few
    assert gaps_of(few.train[0], few.points, 5, torch.Generator().manual_seed(0)) is None


def test_many_points_are_looked_at_a_part_at_a_time(monkeypatch: pytest.MonkeyPatch) -> None:
    """Random points of NeRF-synthetic scenes are 100,000: all distances at once would be 40 GB."""
    generator = torch.Generator().manual_seed(0)
    pixels, depths = 100 * torch.rand(300, 2, generator=generator), 1 + torch.rand(300, generator=generator)
    whole = in_front(pixels, depths)
    monkeypatch.setattr(filling, "MOST_DISTANCES", 300 * 7)
    assert torch.equal(in_front(pixels, depths), whole)
    assert 0 < int(whole.sum()) < 300
    scene, largest, apart = scene_of(wall(300)), 0, torch.cdist

    def watched(places: torch.Tensor, pixels: torch.Tensor) -> torch.Tensor:
        nonlocal largest
        largest = max(largest, len(places) * len(pixels))
        return apart(places, pixels)

    monkeypatch.setattr(torch, "cdist", watched)
    gaps_of(scene.train[0], scene.points, 1000, generator)
    assert 0 < largest <= 300 * 7
