"""Points by stereo: on a textured plane and a nearer one, whose depths are known, and by hand-worked numbers."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from gsx.core.data.camera import Camera, look_at
from gsx.core.data.scene import PointCloud, Scene, View
from gsx.scenes import stereo
from gsx.scenes.stereo import (
    DEPTHS,
    Reduced,
    add_stereo_points,
    best_partners,
    correlations,
    patch_means,
    peak,
    reduced,
)

SIDE = 64


class Wall:
    """Photos of the plane z = 0, with a pattern, and of a square before it at z = -1; an `ImageSource`."""

    def image(self, camera: Camera) -> Tensor:
        rays = stereo.camera_rays(camera).T @ camera.rotation.double()
        centre = camera.centre.double()
        colours = torch.zeros(len(rays), dtype=torch.float64)
        for height in (0.0, -1.0):
            x, y = (centre + rays * ((height - centre[2]) / rays[:, 2])[:, None])[:, :2].T
            inside = (x.abs().maximum(y.abs()) < 0.6) | (height == 0)
            colours = torch.where(inside, pattern(x + 7 * height, y), colours)
        return (colours.clamp(0, 1) * 255).round().byte().reshape(1, camera.height, camera.width).expand(3, -1, -1)

    def max_zoom(self, camera: Camera) -> float:
        return 1.0


def pattern(x: Tensor, y: Tensor) -> Tensor:
    """Smooth, without a period that neighbours could confuse."""
    waves = [(3.1, 1.7, 0.3), (-2.3, 4.1, 1.1), (5.3, -3.7, 2.2), (7.9, 6.1, 0.7), (-9.7, 2.9, 1.9)]
    return 0.5 + sum(0.12 * torch.sin(a * x + b * y + c) for a, b, c in waves)


def camera_at(x: float, y: float) -> Camera:
    return look_at((x, y, -5.0), (0.3 * x, 0.3 * y, 0.0), up=(0, -1, 0), fov_x=0.9, width=SIDE, height=SIDE)


def wall_scene() -> Scene:
    places = [(x, y) for x in (-0.5, 0.0, 0.5) for y in (-0.3, 0.3)]
    views = [View(f"{number}", camera_at(*place), Wall()) for number, place in enumerate(places)]
    x, y = torch.meshgrid(torch.linspace(-2, 2, 7), torch.linspace(-2, 2, 7), indexing="ij")
    positions = torch.stack([x, y, torch.zeros_like(x)], -1).reshape(-1, 3)
    positions[24, 2] = -1.0
    points = PointCloud(positions, torch.full((49, 3), 9, dtype=torch.uint8))
    return Scene(name="wall", train=views, test=views[:1], points=points, background=torch.zeros(3), extent=1.0)


@pytest.fixture(scope="module")
def filled() -> Scene:
    return add_stereo_points(wall_scene(), 3000, torch.Generator().manual_seed(0))


def test_points_lie_on_the_surfaces_and_have_their_colours(filled: Scene) -> None:
    positions, colours = filled.points.positions[49:], filled.points.colours[49:]
    assert 1000 < len(positions) <= 3000
    near = (positions[:, :2].abs().amax(1) < 0.45) & (positions[:, 2] < -0.5)
    heights = torch.where(near, -1.0, 0.0)
    off = (positions[:, 2] - heights).abs()
    assert float(off.median()) < 0.02  # of a distance of 5
    assert float((off < 0.1).float().mean()) > 0.9
    assert int(near.sum()) > 50
    flat = ~near & (off < 0.02)
    expected = (pattern(positions[flat, 0].double(), positions[flat, 1].double()) * 255).float()
    assert float((colours[flat, 0].float() - expected).abs().median()) < 6


def test_the_first_points_stay_and_a_note_counts(filled: Scene) -> None:
    assert torch.equal(filled.points.positions[:49], wall_scene().points.positions)
    assert "points measured by stereo are added to 49 (scene.stereo)" in filled.notes[-1]


def test_same_seed_same_points(filled: Scene) -> None:
    again = add_stereo_points(wall_scene(), 3000, torch.Generator().manual_seed(0))
    assert torch.equal(filled.points.positions, again.points.positions)


def test_masked_pixels_give_no_points() -> None:
    class Masked(Wall):
        def counted(self, camera: Camera) -> Tensor:
            return torch.zeros(camera.height, camera.width, dtype=torch.bool)

    scene = wall_scene()
    masked = replace(scene, train=[replace(view, source=Masked()) for view in scene.train])
    assert len(add_stereo_points(masked, 3000, torch.Generator()).points) == 49


def test_photos_without_common_points_give_none() -> None:
    scene = wall_scene()
    few = replace(scene, points=PointCloud(scene.points.positions[:3], scene.points.colours[:3]))
    assert len(add_stereo_points(few, 100, torch.Generator()).points) == 3


def test_a_photo_correlates_with_itself_at_any_depth_and_with_none_outside() -> None:
    photo = reduced(wall_scene().train[0])
    same = correlations(photo, photo, torch.tensor([2.0, 5.0]))
    assert float(same[:, 4:-4, 4:-4].min()) == pytest.approx(1, abs=1e-3)
    away = replace(photo.camera, translation=photo.camera.translation + torch.tensor([100.0, 0.0, 0.0]))
    assert bool((correlations(photo, Reduced(away, photo.image, photo.counted), torch.tensor([5.0])) == -1).all())


def test_reduced_photos_have_their_cameras_and_masks() -> None:
    class Half(Wall):
        def counted(self, camera: Camera) -> Tensor:
            return torch.arange(camera.width).expand(camera.height, -1) >= 101

    camera = replace(camera_at(0, 0), width=301, height=200)
    small = reduced(View("wide", camera, Half()))
    assert small.camera.size == (150, 100) == (small.image.shape[2], small.image.shape[1])
    assert small.camera.fx == pytest.approx(camera.fx / 2)
    assert small.counted.sum(1).tolist() == [99] * 100


def test_patch_means_by_hand() -> None:
    values = torch.zeros(1, 9, 9)
    values[0, 0, 0] = 1.0
    means = patch_means(values)
    assert float(means[0, 0, 0]) == pytest.approx(1 / 16)  # 4 x 4 pixels at the corner
    assert float(means[0, 3, 3]) == pytest.approx(1 / 49)
    assert float(means[0, 4, 4]) == pytest.approx(0, abs=1e-7)


def test_the_peak_of_a_parabola() -> None:
    places = torch.arange(DEPTHS).float()
    scores = 1 - (places - 40.3).square()[:, None, None] / 100
    index = scores.argmax(0)
    assert float(index + peak(scores, index)) == pytest.approx(40.3, abs=1e-3)
    rising = places[:, None, None].clone()
    assert float(peak(rising, rising.argmax(0))) == 0


def test_partners_share_points_at_useful_angles() -> None:
    degrees = torch.deg2rad(torch.tensor([0.0, 0.1, 5.0, 60.0]))
    rays = torch.stack([degrees.sin(), torch.zeros(4), degrees.cos()], 1)[:, None].double().expand(-1, 10, -1)
    shown = torch.ones(4, 10, dtype=torch.bool)
    assert best_partners(0, rays, shown)[:2] == [2, 1]
    shown[2] = False
    assert 2 not in best_partners(0, rays, shown)
