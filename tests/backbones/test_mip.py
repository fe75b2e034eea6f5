"""Mip-Splatting's filters on gs3d against the published rules."""

import json
import math
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path

import pytest
import torch
from hypothesis import Phase, given, settings
from hypothesis import strategies as st
from small_scene import published_options, small_gs3d, small_scene, spread
from tiny import LIGHT, final_tensors, same_ending, stopped_at, tiny_run, tiny_settings
from torch import Tensor
from torch.nn.functional import logsigmoid

from gsx.backbones import mip
from gsx.backbones.density import mean_absolute, mean_gradient, quantile, zero_statistics
from gsx.backbones.density_control import candidates
from gsx.backbones.gs3d import GS3D
from gsx.backbones.mip import MATCHED, MipOptions, filter_sizes, pseudo_view_sizes, several_views
from gsx.builtin import plugins
from gsx.core.data.camera import Camera, look_at
from gsx.core.data.reduction import Reduction
from gsx.core.data.scene import Scene
from gsx.core.errors import ConfigError, InputError
from gsx.core.gaussians.splats import Splats, splats_of
from gsx.core.quality.losses import photometric
from gsx.core.quality.metrics import psnr
from gsx.core.rasterizer import RasterSettings, ScreenStatistics, rasterize, rasterize_tiled
from gsx.core.training.parameter_table import gradients, restore_table, table_tensors
from gsx.core.training.pseudo_views import PseudoView
from gsx.core.training.render import render
from gsx.core.training.run import Run
from gsx.experiments.runs.build import build
from gsx.experiments.runs.compose import compose
from gsx.experiments.runs.export import export
from gsx.experiments.runs.load_scene import load_scene
from gsx.experiments.runs.open import open_run
from gsx.formats.ply import read_ply
from gsx.formats.smoothing import logit_of_log, smoothed
from gsx.formats.splat_files import read_gaussians

OPTIONS = MipOptions(variance=0.2, kernel=0.1, margin=0.15, near=0.2, every=100, stop=29900)
UNIT = math.sqrt(0.2)
DENSE = (*LIGHT, "iterations=12", "backbone.density.every=400", "backbone.density.reset_passes=1",
         "backbone.density.gradient=1e-6", "training.checkpoint_every=4", "backbone.density.absolute=true")  # fmt: skip


def axis_camera(fx: float = 100.0, *, cx: float = 50.0, fy: float = 80.0, cy: float = 20.0) -> Camera:
    """100 x 40 px at the world's origin, looking along +z."""
    eye, nowhere = torch.eye(3, dtype=torch.float64), torch.zeros(3, dtype=torch.float64)
    return Camera(rotation=eye, translation=nowhere, fx=fx, fy=fy, cx=cx, cy=cy, width=100, height=40)


def at(column: float, row: float, depth: float, camera: Camera) -> list[float]:
    """The point that `axis_camera` sees at a pixel."""
    return [(column - camera.cx) / camera.fx * depth, (row - camera.cy) / camera.fy * depth, depth]


def mip_options(**density: float):
    """conf/backbone/mip_splatting.yaml, with changes to its density section."""
    return replace(published_options(**density), filter="mip")


def mip_gs3d(scene: Scene, *, iterations: int = 30000, **density: float) -> GS3D:
    return small_gs3d(scene, iterations=iterations, options=mip_options(**density))


def row_values(
    scales: Sequence[float],
    opacities: Sequence[float],
    gradients: Sequence[float] = (),
    absolute: Sequence[float] = (),
    **density: float,
) -> GS3D:
    """Primitives 3 to 33 units before all cameras, statistics of two views each, told apart by sh_dc = row."""
    count = len(scales)
    density = density | {"absolute": bool(absolute)}
    backbone = mip_gs3d(small_scene(spread(count) * torch.tensor([2.0, 30, 2]) + torch.tensor([0.0, 14, 0])), **density)
    table, opacity = backbone.table, torch.tensor(opacities)
    with torch.no_grad():
        table["sh_dc"].copy_(torch.arange(count)[:, None, None].expand(-1, 1, 3))
        table["log_scales"].copy_(torch.tensor(scales).log()[:, None] + torch.tensor([0.0, -0.5, -1.0]))
        table["opacity_logits"].copy_((opacity / (1 - opacity)).log())
    seen = torch.full((count,), 2.0)
    sums = 2 * torch.tensor(list(gradients) or [0.0] * count)
    table.statistics |= {"gradient": sums, "count": seen}
    table.statistics |= {"absolute": 2 * torch.tensor(absolute)} if absolute else {}
    return backbone


def labels(backbone: GS3D) -> list[int]:
    """Original row of every primitive, in order."""
    return backbone.table["sh_dc"].detach()[:, 0, 0].int().tolist()


# -- sizes of the 3D filter (10.1) -------------------------------------------------------------------------------------


def test_shipped_numbers_are_the_published_ones() -> None:
    options = compose(["backbone=mip_splatting"], plugins()).backbone.options
    assert asdict(options.mip) == asdict(OPTIONS)
    assert options.filter == "mip"
    assert not options.density.absolute


def test_the_size_worked_by_hand_in_the_specification() -> None:
    camera = look_at([0, -5, 0], [0, 0, 0], fov_x=2 * math.atan(0.5), width=1000, height=800)  # focal 1000, depth 5
    assert filter_sizes(torch.zeros(1, 3), [camera], OPTIONS).item() == pytest.approx(0.002236, abs=5e-7)


@pytest.mark.parametrize("cx", [50.0, 10.0, -30.0])
def test_points_count_up_to_fifteen_percent_beside_the_raster(cx: float) -> None:
    camera = axis_camera(cx=cx, cy=33.0)
    pixels = [(-14.9, 20.0), (-15.1, 20.0), (114.9, 20.0), (115.1, 20.0), (50.0, -5.9), (50.0, -6.1), (50.0, 45.9),
              (50.0, 46.1)]  # fmt: skip
    points = torch.tensor([at(*pixel, depth=2.0, camera=camera) for pixel in pixels] + [at(50, 20, 7.0, camera)])
    seen, unseen = 2 * UNIT / 100, 7 * UNIT / 100  # what no camera sees takes the largest depth of what one does
    expected = torch.tensor([seen, unseen] * 4 + [unseen])
    torch.testing.assert_close(filter_sizes(points, [camera], OPTIONS), expected)


def test_points_near_a_camera_or_behind_it_are_not_seen_by_it() -> None:
    points = torch.tensor([[0.0, 0, 0.1999], [0, 0, 0.2001], [0, 0, -3.0], [0, 0, 0.0], [0, 0, 4.0]])
    expected = torch.tensor([4, 0.2001, 4, 4, 4]) * UNIT / 100
    torch.testing.assert_close(filter_sizes(points, [axis_camera()], OPTIONS), expected)


def test_depths_are_held_above_a_thousandth() -> None:
    points = torch.tensor([[0.0, 0, 5e-4]])
    sizes = filter_sizes(points, [axis_camera()], replace(OPTIONS, near=0.0))
    assert sizes.item() == pytest.approx(0.001 * UNIT / 100)


def test_the_largest_focal_counts_even_of_a_camera_that_sees_nothing() -> None:
    cameras = [axis_camera(), axis_camera(400.0, cx=-1e6), axis_camera(200.0, fy=9000.0, cy=-1e6)]  # only fx counts
    sizes = filter_sizes(torch.tensor([[0.0, 0, 2.0]]), cameras, OPTIONS)
    assert sizes.item() == pytest.approx(2 * UNIT / 400)


def test_by_the_paper_a_camera_counts_by_its_own_focal_length_and_depth() -> None:
    """Focal length 100 at depth 2 and 400 at depth 10: 50 px per unit, where the release has 400 / 2."""
    near = replace(look_at([0, -2, 0], [0, 0, 0], fov_x=1.0, width=100, height=100), fx=100.0, fy=100.0)
    far = replace(look_at([0, -10, 0], [0, 0, 0], fov_x=1.0, width=100, height=100), fx=400.0, fy=400.0)
    for rate, expected in (("paper", 0.00894), ("release", 0.00224)):
        sizes = filter_sizes(torch.zeros(1, 3), [near, far], replace(OPTIONS, rate=rate))
        assert sizes.item() == pytest.approx(expected, abs=5e-6), rate


def test_by_the_paper_a_long_lens_sharpens_only_what_it_sees() -> None:
    points = torch.tensor([[0.0, 0, 0], [1.5, 0, 0], [900.0, 0, 0]])
    whole = look_at([0, -4, 0], [0, 0, 0], fov_x=1.0, width=100, height=100)
    window = whole.zoom(4).narrow(0.25)
    options = replace(OPTIONS, rate="paper")
    before, after = (filter_sizes(points, cameras, options) for cameras in ([whole], [whole, window]))
    torch.testing.assert_close(after[0], before[0] / 4)
    assert torch.equal(after[1:], before[1:])  # seen by the first alone; seen by none
    released = filter_sizes(points, [whole, window], OPTIONS)
    torch.testing.assert_close(released, before / 4)


def test_depth_along_the_axis_counts_and_of_many_the_least() -> None:
    near = look_at([0, -2, 0], [0, 0, 0], fov_x=1.0, width=100, height=100)
    far = look_at([0, -9, 0], [0, 0, 0], fov_x=1.0, width=100, height=100)
    sizes = filter_sizes(torch.tensor([[0.9, 0, 0.0]]), [far, near, far], OPTIONS)
    assert sizes.item() == pytest.approx(2 / near.fx * UNIT)  # not the distance, 2.19


def sizes_in_loops(points: Tensor, cameras: Sequence[Camera]) -> list[float]:
    """Spec 10.1 a point and a camera at a time, in double precision."""
    nearest: list[float] = []
    for point in points.double():
        depths = []
        for camera in cameras:
            x, y, z = (camera.rotation @ point + camera.translation).tolist()
            held = max(z, 0.001)
            u, v = x / held * camera.fx + camera.cx, y / held * camera.fy + camera.cy
            inside = -0.15 * camera.width <= u <= 1.15 * camera.width
            if z > 0.2 and inside and -0.15 * camera.height <= v <= 1.15 * camera.height:
                depths.append(held)
        nearest.append(min(depths, default=math.inf))
    largest = max(depth for depth in nearest if depth < math.inf)
    focal = max(camera.fx for camera in cameras)
    return [min(depth, largest) / focal * UNIT for depth in nearest]


@pytest.mark.parametrize("seed", range(3))
def test_sizes_are_those_of_a_loop_over_points_and_cameras(seed: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    eyes = (4 * torch.rand(7, 3, generator=generator) - 2).tolist()
    cameras = [look_at(eye, [0, 0, 0], fov_x=0.4 + 0.1 * i, width=90, height=60) for i, eye in enumerate(eyes)]
    cameras = [replace(camera, cx=45 - 9.0 * i, cy=30 + 5.0 * i) for i, camera in enumerate(cameras)]
    points = 3 * torch.randn(400, 3, generator=generator)
    expected = torch.tensor(sizes_in_loops(points, cameras))
    assert 10 < int((expected < expected.max()).sum()) < 390  # seen and unseen points
    torch.testing.assert_close(filter_sizes(points, cameras, OPTIONS), expected, rtol=1e-5, atol=1e-7)


def test_where_nothing_is_seen_the_error_says_what_to_do() -> None:
    with pytest.raises(InputError, match=r"none of 3 primitives is visible in any of 2 .*backbone\.filter=none"):
        filter_sizes(torch.tensor([[0.0, 0, -1.0]] * 3), [axis_camera()] * 2, OPTIONS)


def test_no_points_have_no_sizes() -> None:
    assert filter_sizes(torch.zeros(0, 3), [axis_camera()], OPTIONS).shape == (0,)


# -- ours: several views, pseudo views ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("distances", "most", "factor"),
    [
        ([2.0] * 9, 4.0, 1.0),
        ([2.0] * 18, 4.0, 2**0.5),
        ([2.0] * 18, 1.4, 1.4),
        ([2.0] + [4.0] * 8, 4.0, 1.0),  # 1 + 8 / 4 views: fewer than nine narrow nothing
        ([2.0] * 9 + [4.0] * 108, 4.0, 2.0),
    ],
)
def test_views_narrow_the_filter_by_a_third_of_the_root_of_their_number(
    distances: list[float], most: float, factor: float
) -> None:
    cameras = [look_at([0, -d, 0], [0, 0, 0], fov_x=1.0, width=100, height=100) for d in distances]
    points, options = torch.tensor([[0.0, 0, 0], [0, -900, 0]]), replace(OPTIONS, views=most)
    found = several_views(points, cameras, filter_sizes(points, cameras, options), options)
    assert found.tolist() == pytest.approx([factor, 1.0])  # what no camera sees stays as it is


def test_pseudo_views_narrow_what_they_see_by_as_much_as_their_pixels_count() -> None:
    photograph = look_at([0, -4, 0], [0, 0, 0], fov_x=1.0, width=100, height=100)
    window = photograph.zoom(4).crop(150, 150, 100, 100)
    points = torch.tensor([[0.0, 0, 0], [1.5, 0, 0], [0, -900, 0]])
    sizes = filter_sizes(points, [photograph], OPTIONS)
    for weight, exponent in ((None, 1.0), (255, 1.0), (0, 0.0), (102, 0.4)):
        pixels = None if weight is None else torch.full((100, 100), weight, dtype=torch.uint8)
        target = torch.zeros(3, 100, 100, dtype=torch.uint8)
        view = PseudoView(camera=window, target=target, parent=0, pixel_weight=pixels)
        found = pseudo_view_sizes(points, view, sizes, OPTIONS)
        assert found.tolist() == pytest.approx([float(sizes[0]) / 4**exponent, torch.inf, torch.inf])


def test_a_coarser_pseudo_view_widens_nothing() -> None:
    photograph = look_at([0, -4, 0], [0, 0, 0], fov_x=1.0, width=100, height=100)
    view = PseudoView(camera=photograph.zoom(0.5), target=torch.zeros(3, 50, 50, dtype=torch.uint8), parent=0)
    sizes = filter_sizes(torch.zeros(1, 3), [photograph], OPTIONS)
    assert torch.equal(pseudo_view_sizes(torch.zeros(1, 3), view, sizes, OPTIONS), sizes)


# -- how the filter enters (10.3) --------------------------------------------------------------------------------------


def test_smoothing_keeps_what_an_opacity_integrates_to() -> None:
    generator = torch.Generator().manual_seed(0)
    scales, sizes = (torch.exp(2 * torch.randn(50, n, generator=generator).double()) for n in (3, 1))
    faint = -torch.rand(50, generator=generator).double()
    wide, log_opacities = smoothed(scales, faint, sizes[:, 0])
    torch.testing.assert_close(wide, (scales.square() + sizes.square()).sqrt(), rtol=1e-14, atol=0)
    covariance = torch.diag_embed(scales.square())
    widened = covariance + sizes.square()[:, :, None] * torch.eye(3).double()
    share = (torch.linalg.det(covariance) / torch.linalg.det(widened)).sqrt()
    torch.testing.assert_close(log_opacities.exp(), faint.exp() * share, rtol=1e-12, atol=0)


def test_a_primitive_of_the_size_of_the_filter_has_the_opacity_of_the_specification() -> None:
    log_opacities = smoothed(torch.full((1, 3), 0.1), torch.zeros(1), torch.tensor([0.1]))[1]
    assert log_opacities.exp().item() == pytest.approx(0.354, abs=5e-4)


def test_smoothing_is_differentiable_in_scales_and_opacities() -> None:
    generator = torch.Generator().manual_seed(1)
    scales = (0.05 + torch.rand(4, 3, generator=generator).double()).requires_grad_()
    log_opacities = (-torch.rand(4, generator=generator).double()).requires_grad_()
    sizes = torch.tensor([1e-3, 0.1, 1.0, 30.0]).double()
    assert torch.autograd.gradcheck(lambda s, o: smoothed(s, o, sizes), (scales, log_opacities))


@pytest.mark.parametrize("size", [1e-6, 1e-3, 10.0])
@pytest.mark.parametrize("scale", [0.0, 1e-45, 1e-40, 1e-38, 1e-30, 1e-20, 1e-10, 1e-3, 1e13])
def test_smoothing_is_finite_down_to_nothing(scale: float, size: float) -> None:
    scales, log_opacities = torch.full((2, 3), scale, requires_grad=True), torch.zeros(2, requires_grad=True)
    wide, faint = smoothed(scales, log_opacities, torch.full((2,), size))
    (wide.sum() + faint.sum()).backward()
    assert all(torch.isfinite(value).all() for value in (wide, faint, scales.grad))
    assert log_opacities.grad.tolist() == [1.0, 1.0]
    if 1e-20 <= scale <= 1e-3:  # d/ds of ln s - ln(s^2 + f^2) / 2, plus that of the width
        wide64 = math.hypot(scale, size)
        expected = torch.full((2, 3), 1 / scale - scale / wide64**2 + scale / wide64)
        torch.testing.assert_close(scales.grad, expected, rtol=1e-4, atol=0)
        torch.testing.assert_close(faint.detach(), torch.full((2,), 3 * math.log(scale / wide64)))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_logit_of_a_logarithm_undoes_logsigmoid(dtype: torch.dtype) -> None:
    log_opacities = -torch.logspace(math.log10(80), -7, 500, dtype=torch.float64).to(dtype)
    again = logsigmoid(logit_of_log(log_opacities))
    torch.testing.assert_close(again, log_opacities, rtol=1e-5 if dtype == torch.float32 else 1e-9, atol=0)
    logits = torch.linspace(-80, 15, 200, dtype=dtype)
    torch.testing.assert_close(logit_of_log(logsigmoid(logits)), logits, rtol=1e-5, atol=1e-5)
    assert torch.isfinite(logit_of_log(torch.tensor([0.0, -0.0, -1e-45, -200.0], dtype=dtype))).all()


def test_splats_are_smoothed_by_the_sizes_of_the_cameras() -> None:
    backbone = row_values([0.01, 0.1, 0.5], [0.2, 0.5, 0.9])
    cameras = [view.camera for view in small_scene(spread(1)).train]
    sizes = torch.tensor(sizes_in_loops(backbone.table["means"].detach(), cameras))
    splats = backbone.draw(cameras[0], 1).splats
    scales = backbone.table["log_scales"].detach().exp()
    expected = (scales.square() + sizes[:, None].square()).sqrt()
    torch.testing.assert_close(splats.scales.detach(), expected)
    opacities = torch.tensor([0.2, 0.5, 0.9]) * (scales / expected).prod(1)
    torch.testing.assert_close(splats.log_opacities.detach().exp(), opacities)


# -- when the sizes are computed (10.2) --------------------------------------------------------------------------------


@pytest.mark.parametrize("background", [0.0, 1.0])  # the reset at 500 on white is no density event
def test_sizes_are_computed_when_published(monkeypatch: pytest.MonkeyPatch, background: float) -> None:
    steps: list[int] = []
    step = 0

    def counted(*arguments: object) -> Tensor:
        steps.append(step)
        return filter_sizes(*arguments)

    monkeypatch.setattr(mip, "filter_sizes", counted)
    backbone = mip_gs3d(small_scene(spread(3), background=background))
    for step in range(1, 30001):
        if step % 100 in (0, 1, 50, 99):
            backbone.densify_and_prune(step)
    assert steps == [0, *range(600, 15000, 100), *range(15100, 29900, 100)]


def test_without_the_filter_nothing_is_computed() -> None:
    backbone = small_gs3d(small_scene(torch.tensor([[0.0, -40, 0]] * 3)))  # behind all cameras: mip would refuse
    assert backbone.table.columns == {}


def test_an_event_leaves_the_sizes_of_the_new_means() -> None:
    backbone = row_values([0.5, 0.001, 0.5, 0.5], [0.5] * 4, [1.0, 1.0, 0.0, 0.0])
    before = backbone.table["filter"].clone()
    assert backbone.densify_and_prune(600) == {"cloned": 1, "split": 1, "pruned": 0}
    cameras = [view.camera for view in small_scene(spread(1)).train]
    expected = torch.tensor(sizes_in_loops(backbone.table["means"].detach(), cameras))
    torch.testing.assert_close(backbone.table["filter"], expected)
    assert not torch.isin(expected, before).all()


# -- density control (10.5) --------------------------------------------------------------------------------------------


def cameras_of(backbone: GS3D) -> list[Camera]:
    return backbone.filter.context.views.raster_cameras(1)


def drawn_opacities(backbone: GS3D) -> Tensor:
    return backbone.draw(cameras_of(backbone)[0], 1).splats.log_opacities.detach().exp()


def test_a_reset_caps_what_is_drawn() -> None:
    backbone = row_values([2.0, 0.1, 3.0, 0.02], [0.9, 0.5, 0.002, 0.9])
    before, raw = drawn_opacities(backbone), backbone.table["opacity_logits"].detach().clone()
    assert [bool(opacity > 0.01) for opacity in before] == [True, False, False, False], "the test needs both kinds"
    backbone.control.reset_opacities(backbone.table)
    after = backbone.table["opacity_logits"].detach()
    assert torch.equal(after[1:], raw[1:])  # 0.5 and 0.9 raw: drawn fainter than 0.01
    assert drawn_opacities(backbone)[0].item() == pytest.approx(0.01, rel=1e-5)
    assert after[0].sigmoid().item() > 0.01


LOGITS_AND_SCALES = st.lists(st.tuples(st.floats(-90, 90), st.floats(-20, 3)), min_size=1, max_size=20)


@settings(deadline=None, max_examples=30, phases=[Phase.explicit, Phase.generate])
@given(LOGITS_AND_SCALES, st.sampled_from([0.01, 1.0]))
def test_a_reset_never_raises_an_opacity(rows: list[tuple[float, float]], highest: float) -> None:
    backbone = row_values([1.0] * len(rows), [0.5] * len(rows), reset_opacity=highest)
    with torch.no_grad():
        backbone.table["opacity_logits"].copy_(torch.tensor([logit for logit, _ in rows]))
        backbone.table["log_scales"].copy_(torch.tensor([scale for _, scale in rows])[:, None].expand(-1, 3))
    before = backbone.table["opacity_logits"].detach().clone()
    backbone.control.reset_opacities(backbone.table)
    after = backbone.table["opacity_logits"].detach()
    assert torch.isfinite(after).all()
    assert (after <= before).all()
    assert (drawn_opacities(backbone) <= highest * (1 + 1e-5)).all()


def test_a_reset_uses_the_sizes_of_the_event_before_it() -> None:
    backbone = row_values([2.0, 2.0], [0.9, 0.9])
    backbone.table.columns["filter"] = torch.zeros(2) + 1e-6  # stale
    assert backbone.densify_and_prune(3000)["opacity_resets"] == 1
    torch.testing.assert_close(drawn_opacities(backbone), torch.full((2,), 0.01))


def test_without_the_filter_a_reset_caps_raw_opacities() -> None:
    backbone = small_gs3d(small_scene(spread(3)))
    with torch.no_grad():
        backbone.table["opacity_logits"].copy_(torch.tensor([2.0, -4.5, -6.0]))
    backbone.control.reset_opacities(backbone.table)
    expected = torch.tensor([-4.5951199, -4.5951199, -6.0])
    torch.testing.assert_close(backbone.table["opacity_logits"].detach(), expected)


def test_size_and_opacity_tests_are_of_raw_values() -> None:
    # the filter is at least 0.07: all would be drawn larger than 0.01 and fainter than 0.005, and more than one huge
    backbone = row_values([0.0099, 0.0101, 0.01, 0.099, 0.11], [0.0051, 0.5, 0.0049, 0.5, 0.5], [1.0, 1.0, 0, 0, 0])
    assert float(backbone.table["filter"].min()) > 0.05
    assert float(drawn_opacities(backbone)[0]) < 0.005
    assert float(backbone.draw(cameras_of(backbone)[0], 1).splats.scales.detach()[3].max()) > 0.1
    assert backbone.densify_and_prune(3100) == {"cloned": 1, "split": 1, "pruned": 2}
    assert labels(backbone) == [0, 3, 0, 1, 1]


def test_children_are_drawn_from_raw_scales() -> None:
    backbone = row_values([0.02, 0.001], [0.5, 0.5], [1.0, 0.0])
    parent = backbone.table["means"].detach()[0].clone()
    assert backbone.densify_and_prune(600)["split"] == 1
    offsets = (backbone.table["means"].detach()[1:] - parent).norm(dim=1)
    assert 0 < float(offsets.max()) < 0.1  # five raw standard deviations; the filter is several times that
    torch.testing.assert_close(backbone.table["log_scales"].detach()[1:, 0].exp(), torch.full((2,), 0.02 / 1.6))


# -- absolute gradients (10.5) -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("fraction", [0.0, 0.1, 0.25, 0.5, 0.9, 1.0])
@pytest.mark.parametrize("count", [1, 2, 7, 1000])
def test_the_quantile_interpolates_linearly(count: int, fraction: float) -> None:
    values = torch.rand(count, generator=torch.Generator().manual_seed(count))
    assert quantile(values, fraction) == pytest.approx(float(values.quantile(fraction)))


def test_as_many_again_are_chosen_by_absolute_gradients() -> None:
    # 2 of 5 by mean gradient; the 0.6 quantile of 1 2 3 5 9 lies at place 2.4: 3 + 0.4 * 2 = 3.8
    gradients, sums = [0.1, 0.0002, 0.0001, 0.0, 0.00019], [1.0, 2.0, 9.0, 3.0, 5.0]
    backbone = row_values([0.001] * 5, [0.5] * 5, gradients, sums)
    chosen = candidates(backbone.table, mean_gradient(backbone.table), backbone.options.density)
    assert chosen.tolist() == [True, True, True, False, True]
    sums[4] = 3.79  # the quantile falls with it: 3 + 0.4 * 0.79
    backbone = row_values([0.001] * 5, [0.5] * 5, gradients, sums)
    chosen = candidates(backbone.table, mean_gradient(backbone.table), backbone.options.density)
    assert chosen.tolist() == [True, True, True, False, True]
    options = mip_options(absolute=False)
    chosen = candidates(backbone.table, mean_gradient(backbone.table), options.density)
    assert chosen.tolist() == [True, True, False, False, False]


def test_both_kinds_of_candidates_meet_the_same_size_test() -> None:
    sums = [0.0, 8.0, 9.0, 0.0, 7.0, 7.5]
    scales = [0.02, 0.009, 0.02, 0.02, 0.02, 0.009]
    backbone = row_values(scales, [0.5] * 6, [0.0, 0.0, 0.0, 0.0, 1.0, 1.0], sums)
    assert backbone.densify_and_prune(600) == {"cloned": 2, "split": 2, "pruned": 0}
    assert labels(backbone) == [0, 1, 3, 5, 1, 5, 2, 4, 2, 4]
    assert backbone.table.statistics["absolute"].tolist() == [0.0] * 10


def test_without_any_gradient_nothing_is_chosen() -> None:
    backbone = row_values([0.001] * 3, [0.5] * 3, [0.0] * 3, [0.0] * 3)
    assert backbone.densify_and_prune(600) == {"cloned": 0, "split": 0, "pruned": 0}


def weighted_render(backbone: GS3D, camera: Camera, weights: Tensor, absolute: bool) -> ScreenStatistics:
    """Statistics after the backward pass of a weighted sum of pixels."""
    picture = rasterize(backbone.draw(camera, 1).splats, camera, backbone.raster, absolute_gradient=absolute)
    (picture.image * weights).sum().backward()
    return picture.screen


def test_absolute_sums_are_those_of_a_loop_over_pixels() -> None:
    backbone = mip_gs3d(small_scene(spread(12)), absolute=True)
    with torch.no_grad():
        backbone.table["opacity_logits"].fill_(2.0)
        backbone.table["log_scales"].add_(1.0)
    truth = torch.zeros(12, dtype=torch.float64)
    for number, camera in enumerate(cameras_of(backbone)[:2]):
        small = camera.resize(9, 6)
        weights = torch.randn(3, 6, 9, generator=torch.Generator().manual_seed(number))
        for pixel in range(54):
            alone = torch.zeros(54).index_fill_(0, torch.tensor([pixel]), 1.0).view(6, 9)
            screen = weighted_render(backbone, small, weights * alone, absolute=False)
            by_mean = screen.means2d_offset.grad.double().abs()
            truth.index_add_(0, screen.ids, by_mean[:, 0] * 9 / 2 + by_mean[:, 1] * 6 / 2)
        drawn = backbone.draw(small, 1)
        picture = rasterize(drawn.splats, small, backbone.raster, absolute_gradient=True)
        (picture.image * weights).sum().backward()
        backbone.accumulate(backbone.observe(drawn, picture, number + 1))
    assert backbone.absolute_gradient
    assert backbone.table.statistics["count"].tolist() == [2] * 12
    torch.testing.assert_close(mean_absolute(backbone.table).double(), truth / 2, rtol=1e-4, atol=1e-6)
    assert float((truth / 2).min()) > 0
    assert (mean_absolute(backbone.table) > 1.2 * mean_gradient(backbone.table)).all()


def test_absolute_sums_are_saved_and_restored() -> None:
    first, second = (row_values([0.1] * 3, [0.5] * 3, [1.0] * 3, [3.0, 4, 5]) for _ in range(2))
    zero_statistics(second.table)
    second.table = restore_table(
        second.table, {name: value.clone() for name, value in table_tensors(first.table).items()}
    )
    assert mean_absolute(second.table).tolist() == [3.0, 4, 5]
    assert table_tensors(second.table).keys() >= {"statistics.absolute", "columns.filter"}


# -- rules -------------------------------------------------------------------------------------------------------------


def built(folder: Path, *overrides: str) -> Run:
    composed = tiny_settings(folder, *overrides)
    return build(composed, load_scene(composed), folder)


def test_the_run_is_drawn_with_the_2d_filter(tmp_path: Path) -> None:
    rules = built(tmp_path, "backbone=mip_splatting", "rasterizer.dilation=0.7", "rasterizer.cull=tight").raster
    assert (rules.dilation, rules.compensate, rules.cull) == (0.1, True, "tight")
    assert built(tmp_path, "backbone=mip_splatting", "backbone.mip.kernel=0.3").raster.dilation == 0.3


@pytest.mark.parametrize("resize_filter", sorted(MATCHED))
def test_a_matched_kernel_passes_what_the_filter_of_the_photographs_passes(resize_filter: str) -> None:
    """Cosines of f cycles per px of a picture 16 times as fine, reduced by the filter, against exp(-2 pi^2 V f^2)."""
    factor, frequencies = 16, [0.125, 0.25, 0.375]
    place = (torch.arange(64 * factor, dtype=torch.float64) + 0.5) / factor
    passed = []
    for f in frequencies:
        fine = torch.cos(2 * math.pi * f * (place - 32)).expand(1, factor, -1)
        low = Reduction(filter=resize_filter).unclamped(fine, factor)[0, 0, 8:-8]
        wave = torch.exp(-2j * math.pi * f * (torch.arange(64)[8:-8] + 0.5 - 32))
        passed.append(2 * float((low * wave).real.mean()))

    def off(variance: float) -> float:
        gaussian = [math.exp(-2 * math.pi**2 * variance * f**2) for f in frequencies]
        return max(abs(own / other - 1) for own, other in zip(passed, gaussian, strict=True))

    assert off(MATCHED[resize_filter]) < 0.08
    assert off(0.3) > 0.25  # as 3D-GS dilates
    assert resize_filter == "bicubic" or off(MATCHED["area" if resize_filter == "lanczos" else "lanczos"]) > 0.09


def test_the_kernel_is_matched_where_asked_for(tmp_path: Path) -> None:
    matched = built(tmp_path, "backbone=mip_splatting", "backbone.mip.kernel=0")
    assert matched.scene.reduction.filter == "area"
    assert matched.raster.dilation == pytest.approx(1 / 12)


@pytest.mark.parametrize("backbone", ["gs3d", "scaffold"])
@pytest.mark.parametrize("rule", ["magnified", "resampled"])
def test_rules_for_zoomed_cameras_know_the_focal_length_of_training(tmp_path: Path, backbone: str, rule: str) -> None:
    run = built(tmp_path, f"backbone={backbone}", f"backbone.filter={rule}", "rasterizer.dilation=0.4")
    assert (run.raster.zoomed, run.raster.dilation, run.raster.compensate) == (rule, 0.4, False)
    assert run.raster.training_focal == max(view.camera.fx for view in run.scene.train)
    assert "filter" not in run.backbone.table.columns
    export(run, tmp_path / "model.ply")
    header = (tmp_path / "model.ply").read_bytes().split(b"end_header")[0].decode()
    written = {
        "magnified": "dilation 0.4 k^2 px^2 for k > 1",
        "resampled": "dilation 0.3 k^2 + 0.1 px^2, opacity x sqrt(",
    }
    assert f"px: {written[rule]}" in header


@pytest.mark.parametrize(
    "overrides",
    [
        ("backbone.filter=magnified", "rasterizer.compensate=true"),
        ("backbone.filter=resampled", "rasterizer.dilation=0.1"),
    ],
)
def test_rules_that_do_not_go_together_are_refused_in_a_sentence(tmp_path: Path, overrides: tuple[str, str]) -> None:
    with pytest.raises(ConfigError, match=overrides[0]):
        built(tmp_path, "backbone=gs3d", *overrides)


@pytest.mark.parametrize("backbone", ["backbone=gs3d", "backbone=mip_splatting"])
def test_without_the_filter_the_rules_are_those_asked_for(tmp_path: Path, backbone: str) -> None:
    rules = ("rasterizer.dilation=0.7", "rasterizer.compensate=true")
    run = built(tmp_path, backbone, "backbone.filter=none", *rules)
    assert (run.raster.dilation, run.raster.compensate) == (0.7, True)
    assert built(tmp_path, backbone, "backbone.filter=none").raster == replace(RasterSettings(), path=run.raster.path)


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("backbone.filter=mop", r"backbone\.filter is 'mop'; choose one of none, mip, magnified, resampled"),
        ("backbone.mip.kernel=-1", r"backbone\.mip\.kernel is -1\.0; give a number from 0"),
        ("backbone.mip.variance=-1", r"backbone\.mip\.variance is -1\.0; give a number from 1e-06"),
        ("backbone.mip.rate=best", r"backbone\.mip\.rate is 'best'; choose release or paper"),
    ],
)
def test_wrong_options_are_refused(override: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        compose(["backbone=mip_splatting", override], plugins())


# -- whole runs --------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A tiny run with density events, an opacity reset and updates of the filter on the way."""
    folder = tmp_path_factory.mktemp("runs") / "mip"
    tiny_run(folder, ("backbone=mip_splatting", *DENSE))
    lines = [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]
    assert sum(line.get("cloned", 0) + line.get("split", 0) for line in lines) > 0, "the test needs density events"
    assert any("opacity_resets" in line for line in lines), "the test needs an opacity reset"
    return folder


def test_resume_equals_never_having_stopped(finished: Path, tmp_path: Path) -> None:
    stopped_at(tmp_path / "run", ("backbone=mip_splatting", *DENSE), 2, 5, 7)
    whole = same_ending(finished, tmp_path / "run")
    assert whole.keys() >= {"columns.filter", "statistics.absolute"}


TRUSTED = ("backbone=mip_splatting", *DENSE, "augmenter=upscale", "regenerator/upscale=lanczos",
           "augmenter.upscale.timing.start=10000", "augmenter.upscale.timing.every=4000",
           "augmenter.upscale.scales=[4]", "augmenter.upscale.project=exact", "backbone.mip.pseudo=true",
           "backbone.mip.views=1.4")  # fmt: skip


def test_what_pseudo_views_earned_stays_and_survives_an_interruption(tmp_path: Path) -> None:
    tiny_run(tmp_path / "whole", TRUSTED)
    run = stopped_at(tmp_path / "run", TRUSTED, 7)
    whole = same_ending(tmp_path / "whole", tmp_path / "run")
    sizes = filter_sizes(whole["parameters.means"], [view.camera for view in run.scene.train], OPTIONS)
    narrowed = sizes / whole["columns.filter"]
    assert narrowed.max() > 3  # four times as fine, where windows saw it
    assert (narrowed > 1.5).float().mean() > 0.3


def test_the_exported_file_holds_what_is_drawn(finished: Path) -> None:
    saved = {name: value.double() for name, value in final_tensors(finished).items()}
    raw, size = saved["parameters.log_scales"].exp(), saved["columns.filter"]
    wide = (raw.square() + size[:, None].square()).sqrt()
    opacity = saved["parameters.opacity_logits"].sigmoid() * (raw / wide).prod(1)
    gaussians = read_gaussians(finished / "point_cloud.ply")
    torch.testing.assert_close(gaussians.log_scales.double(), wide.log(), rtol=1e-5, atol=1e-5)
    torch.testing.assert_close(gaussians.opacity_logits.double(), (opacity / (1 - opacity)).log(), rtol=1e-4, atol=1e-4)
    assert not torch.allclose(wide, raw, rtol=0.01)
    assert len(read_ply(finished / "point_cloud.ply")) == 62


def test_the_exported_file_names_its_filters(finished: Path) -> None:
    header = (finished / "point_cloud.ply").read_bytes().split(b"end_header")[0].decode()
    assert "comment screen dilation 0.1 px^2, with opacity compensation" in header
    assert "comment 3D filter fused into scales and opacities" in header
    assert "comment SplatRenderMode: mip" in header


def test_the_exported_file_renders_the_same(finished: Path, tmp_path: Path) -> None:
    run, _ = open_run(finished, plugins())
    with torch.no_grad():  # small and bright, so that the filters show
        run.backbone.table["opacity_logits"].add_(6)
        run.backbone.table["log_scales"].sub_(1.5)
    export(run, tmp_path / "small.ply")
    gaussians = read_gaussians(tmp_path / "small.ply")
    for view in [*run.scene.test, run.scene.train[0]]:
        splats = splats_of(gaussians, view.camera.centre)
        rules = RasterSettings(dilation=0.1, compensate=True)
        again = rasterize_tiled(splats, view.camera, rules, background=run.background).image.clamp(0, 1)
        truth = render(run, view.camera).image
        assert psnr(again, truth) > 60
        rules = replace(rules, compensate=False)
        fat = rasterize_tiled(splats, view.camera, rules, background=run.background).image.clamp(0, 1)
        assert psnr(fat, truth) < 40, "the test needs splats that the filter changes"


# -- extremes ----------------------------------------------------------------------------------------------------------

CLOUDS = {
    "one point": torch.tensor([[0.1, 0.2, 0.3]]),
    "coincident points": torch.full((40, 3), 0.2),
    "cameras in the cloud": torch.cat([spread(60), 3 * spread(60) + torch.tensor([0.1, -4, 1])]),
    "a point in a camera": torch.cat([spread(5), torch.tensor([[0.0, -4, 1]])]),
}


def finite(splats: Splats) -> bool:
    return all(bool(torch.isfinite(value).all()) for value in vars(splats).values())


@pytest.mark.parametrize("name", list(CLOUDS))
def test_training_stays_finite(name: str) -> None:
    scene = small_scene(CLOUDS[name], views=2)
    events = {"start": 0, "every": 1, "reset_every": 2, "reset_passes": 0.5, "gradient": 1e-9, "absolute": True}
    backbone = small_gs3d(scene, iterations=300, options=mip_options(**events))
    for step in range(1, 4):
        camera = scene.train[step % 2].camera
        drawn = backbone.draw(camera, step)
        picture = rasterize(drawn.splats, camera, backbone.raster, absolute_gradient=True)
        assert picture.dropped == 0
        assert torch.isfinite(picture.image).all()
        photometric(picture.image, torch.full_like(picture.image, 0.5), 0.2).backward()
        assert all(torch.isfinite(gradient).all() for gradient in gradients(backbone.table).values())
        backbone.accumulate(backbone.observe(drawn, picture, step))
        backbone.densify_and_prune(step)
        backbone.update(step)
        assert finite(backbone.draw(camera, step).splats)
    assert (backbone.table["filter"] > 0).all()
