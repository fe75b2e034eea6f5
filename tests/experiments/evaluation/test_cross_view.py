"""Consistency of neighbouring views: planes with a texture, whose depth and visibility are worked by hand."""

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from evaluating import Painted, close, decibels, run_of
from torch import Tensor

from gsx.core.data.camera import Camera, look_at
from gsx.core.training.backbone import DrawnSplats
from gsx.experiments.evaluation.chosen_views import neighbour
from gsx.experiments.evaluation.cross_view import Consistency, SurfaceView, detail_layer
from gsx.experiments.evaluation.eval_options import EvalOptions
from gsx.experiments.evaluation.evaluator import Evaluator
from gsx.experiments.evaluation.lpips import LpipsOptions
from gsx.experiments.evaluation.warp import Surface, places_in, surface_of, warped

SIZE = 96, 64
NEAR_SIDE = 0.5
"""Half of the side of a square in front of the plane."""


def camera_at(x: float, y: float = 0.0, target: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Camera:
    """Looks at the plane z = 0 from z = -4."""
    return look_at([x, y, -4.0], target, up=(0, -1, 0), fov_x=0.9, width=SIZE[0], height=SIZE[1])


def rays(camera: Camera) -> tuple[Tensor, Tensor]:
    """Centre and directions of the pixels' rays, whose camera z is 1; world coordinates."""
    y, x = torch.meshgrid(torch.arange(camera.height) + 0.5, torch.arange(camera.width) + 0.5, indexing="ij")
    slopes = torch.stack([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, torch.ones_like(x)], -1)
    return camera.centre.double(), slopes.double() @ camera.rotation.double()


def texture(points: Tensor) -> Tensor:
    """Colours of the plane, smooth at the pixels' scale."""
    x, y = 3 * points[..., 0], 3 * points[..., 1]
    return torch.stack([x.sin() * y.cos(), (x + y).sin(), (2 * x - y).cos()]) * 0.4 + 0.5


def plane(camera: Camera, square_at: float | None = None) -> SurfaceView:
    """The plane z = 0 and, at another z, a square before it; depth by intersection of rays."""
    centre, directions = rays(camera)
    depth = -centre[2] / directions[..., 2]
    if square_at is not None:
        nearer = (square_at - centre[2]) / directions[..., 2]
        across = centre[:2] + nearer[..., None] * directions[..., :2]
        depth = torch.where(across.abs().amax(-1) < NEAR_SIDE, nearer, depth)
    surface = surface_of(camera, depth, torch.ones_like(depth))
    picture = texture(centre + depth[..., None] * directions)
    return SurfaceView(surface=surface, stored={"render": picture}, size=(SIZE[1] // 2, SIZE[0] // 2))


def noisy(view: SurfaceView, level: float, seed: int) -> SurfaceView:
    picture = view.stored["render"]
    noise = level * torch.randn(picture.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))
    return replace(view, stored={"render": picture + noise})


def consistency(source: SurfaceView, target: SurfaceView) -> dict[str, Any]:
    found = Consistency()
    found.add(source, target)
    return found.figures()


def test_a_texture_of_the_world_is_consistent() -> None:
    figures = consistency(plane(camera_at(-0.6, 0.1)), plane(camera_at(0.5, -0.2)))
    assert figures["render"] > 40
    assert 0.6 < figures["pixels"] < 1


def test_a_wrong_depth_makes_it_inconsistent() -> None:
    source, target = plane(camera_at(-0.6)), plane(camera_at(0.6))
    wrong = replace(target, surface=replace(target.surface, depth=target.surface.depth * 1.008))
    assert consistency(source, wrong)["render"] < 0.8 * consistency(source, target)["render"]


def test_noise_in_the_target_alone_is_measured_as_it_is() -> None:
    """The mean square of the noise over compared pixels."""
    source, target = plane(camera_at(-0.3)), plane(camera_at(0.3))
    drawn = noisy(target, 0.1, 1)
    indices, _ = places_in(source.surface, target.surface)
    noise = (drawn.stored["render"] - target.stored["render"]).flatten(1)[:, indices]
    assert consistency(source, drawn)["render"] == pytest.approx(-10 * math.log10(noise.square().mean()), abs=0.02)


@pytest.mark.parametrize(("shift", "share"), [(3.0, 1.0), (3.5, 2 * (0.59375**2 + 0.09375**2))])
def test_noise_of_both_views_adds_up(shift: float, share: float) -> None:
    """Bicubic interpolation half way between pixels keeps the sum of its squared weights of the variance."""
    camera = replace(camera_at(0.0), rotation=torch.eye(3), translation=torch.tensor([0.0, 0.0, 4.0]))
    moved = replace(camera, translation=torch.tensor([-shift * 4 / camera.fx, 0.0, 4.0]))
    figures = consistency(noisy(plane(camera), 0.1, 1), noisy(plane(moved), 0.1, 2))
    assert figures["render"] == pytest.approx(-10 * math.log10(0.01 * (1 + share)), abs=0.15)


def test_a_view_warps_into_itself_exactly() -> None:
    """All pixels but two along each border, which bicubic interpolation reads beyond."""
    view = plane(camera_at(0.4, 0.3))
    indices, places = places_in(view.surface, view.surface)
    assert len(indices) == (SIZE[0] - 4) * (SIZE[1] - 4)
    centres = torch.stack([indices % SIZE[0], indices // SIZE[0]]) + 0.5
    assert torch.allclose(places, centres.double(), atol=1e-9, rtol=0)
    picture = view.stored["render"]
    assert torch.allclose(warped(picture, places), picture.flatten(1)[:, indices], atol=1e-9, rtol=0)


def test_what_one_view_hides_is_left_out() -> None:
    """Points of the plane behind the square, from the source's centre, by intersection of their rays with it."""
    source, target = (plane(camera_at(x), square_at=-1.0) for x in (-1.0, 1.0))
    indices, _ = places_in(source.surface, target.surface)
    centre, directions = rays(target.surface.camera)
    points = (centre + target.surface.depth[..., None] * directions).flatten(0, 1)
    seen_from = source.surface.camera.centre.double()
    share = (-1.0 - seen_from[2]) / (points[:, 2] - seen_from[2])
    crossing = (seen_from + share[:, None] * (points - seen_from))[:, :2].abs().amax(-1)
    on_plane = points[:, 2].abs() < 1e-6
    hidden = on_plane & (crossing < NEAR_SIDE)
    compared = torch.zeros(len(points), dtype=torch.bool)
    compared[indices] = True
    assert hidden.sum() > 100
    assert not (compared & hidden).any()
    assert (compared & on_plane).sum() > 1000
    assert (compared & ~on_plane).sum() > 100


def test_pixels_without_cover_and_around_them_are_left_out() -> None:
    camera = camera_at(0.0)
    alpha = torch.ones(SIZE[1], SIZE[0])
    alpha[30, 40] = 0.85
    source = surface_of(camera, 4 * alpha, alpha)
    assert not source.visible[30, 40]
    indices, _ = places_in(source, surface_of(camera, torch.full((SIZE[1], SIZE[0]), 4.0), torch.ones_like(alpha)))
    rows, columns = indices // SIZE[0], indices % SIZE[0]
    assert not (((rows - 30).abs() <= 2) & ((columns - 40).abs() <= 2)).any()
    assert len(indices) == (SIZE[0] - 4) * (SIZE[1] - 4) - 25


def test_depth_is_a_mean_and_masked_pixels_have_none() -> None:
    alpha, counted = torch.full((SIZE[1], SIZE[0]), 0.95), torch.ones(SIZE[1], SIZE[0], dtype=torch.bool)
    counted[:, :10] = False
    surface = surface_of(camera_at(0.0), 2 * alpha, alpha, counted)
    assert torch.allclose(surface.depth[:, 10:], torch.tensor(2.0))
    assert not surface.visible[:, :10].any()


def test_points_behind_the_other_camera_are_left_out() -> None:
    surface = plane(camera_at(0.0)).surface
    beyond = replace(surface.camera, translation=surface.camera.translation - torch.tensor([0.0, 0.0, 8.0]).double())
    behind = Surface(camera=beyond, depth=surface.depth, visible=surface.visible)
    assert len(places_in(behind, surface)[0]) == 0


def test_the_neighbour_is_the_nearest_that_looks_the_same_way_from_elsewhere() -> None:
    """Of those at x = 0, 1, 3; the one at 0.1 looks the other way."""
    cameras = [camera_at(x, target=(x, 0.0, 0.0)) for x in (0.0, 1.0, 3.0)]
    cameras.append(camera_at(0.1, target=(0.1, 0.0, -8.0)))
    assert [neighbour(camera, cameras) for camera in cameras] == [1, 0, 1, None]
    assert neighbour(cameras[0], []) is None


def test_detail_is_what_half_the_size_cannot_hold() -> None:
    x = torch.arange(SIZE[0], dtype=torch.float64).expand(3, SIZE[1], SIZE[0])
    fine, coarse = 0.1 * (-1.0) ** x, 0.1 * torch.sin(2 * math.pi * x / 32)
    size = SIZE[1] // 2, SIZE[0] // 2
    inner = slice(8, -8)
    assert (detail_layer(fine, size) - fine)[..., inner].abs().max() < 0.01
    assert detail_layer(coarse, size)[..., inner].abs().max() < 0.01


def test_detail_of_the_world_is_correlated_and_that_of_each_picture_is_not() -> None:
    """Shifted by whole pixels of both sizes; half of the power of the detail in common is a correlation of a half."""
    camera = replace(camera_at(0.0), rotation=torch.eye(3), translation=torch.tensor([0.0, 0.0, 4.0]))
    moved = replace(camera, translation=torch.tensor([-4 * 4 / camera.fx, 0.0, 4.0]))
    world = 0.1 * torch.randn(3, SIZE[1], SIZE[0] + 4, dtype=torch.float64, generator=torch.Generator().manual_seed(3))
    views = [replace(plane(one), stored={"render": picture}) for one, picture in windows(camera, moved, world)]
    assert consistency(*views)["detail"]["render"] > 0.99
    mixed = [noisy(view, 0.1, seed) for seed, view in enumerate(views)]
    assert consistency(*mixed)["detail"]["render"] == pytest.approx(0.5, abs=0.03)
    alone = [noisy(replace(view, stored={"render": 0 * world[..., 4:]}), 0.1, n) for n, view in enumerate(views)]
    assert abs(consistency(*alone)["detail"]["render"]) < 0.03


def test_the_border_of_a_mask_is_no_detail() -> None:
    plain, masked = plane(camera_at(-0.3)), replace(plane(camera_at(0.3)), masked=True)
    whole = consistency(plain, replace(masked, masked=False))
    assert consistency(plain, masked) == {name: value for name, value in whole.items() if name != "detail"}
    both = Consistency()
    both.add(plain, masked)
    both.add(plain, replace(masked, masked=False))
    assert both.figures()["detail"] == whole["detail"]


def windows(camera: Camera, moved: Camera, world: Tensor) -> list[tuple[Camera, Tensor]]:
    """Both cameras with their windows of a picture of the plane."""
    return [(camera, world[..., :-4]), (moved, world[..., 4:])]


class Solid(Painted):
    """Shows the grey of each view with an alpha of 0.99."""

    def draw(self, camera: Camera, step: int) -> DrawnSplats:
        drawn = super().draw(camera, step)
        splats = drawn.splats
        solid = replace(splats, log_opacities=0 * splats.log_opacities, colours=splats.colours / 2 / 0.99)
        return replace(drawn, splats=solid)


def test_an_evaluation_has_the_consistency_of_its_views(tmp_path: Path) -> None:
    """Views of one grey each: 110 and 70 at x2, 100 and 60 enlarged, 104 and 71 in truth; c has no truth there."""
    run = run_of(tmp_path)
    run.backbone.__class__ = Solid
    lpips = LpipsOptions(trunk="", head="", net="vgg", input_range="unit")
    options = EvalOptions(zoom=[1, 2], quantise=True, ssim="valid", tile_pixels=1 << 20, lpips=lpips)
    zoom = Evaluator(run, options).evaluate()["zoom"]
    found = zoom["2"]["consistency"]
    assert (found["render"], found["enlarged"], found["truth"]) == tuple(map(close, map(decibels, (40, 40, 33))))
    assert 0.1 < found["pixels"] < 1
    assert "consistency" not in zoom["1"]
    none = Evaluator(run, replace(options, pairs=0)).evaluate()["zoom"]
    assert none["2"].keys() == zoom["2"].keys() - {"consistency"}
