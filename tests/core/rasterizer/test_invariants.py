"""Identities that hold whatever the scene: work sizes, crops, motions, order, statistics."""

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from reference_rasterizer import render_reference
from torch.nn.functional import logsigmoid

from gsx.core.data.camera import Camera, look_at
from gsx.core.errors import InputError
from gsx.core.gaussians.quaternions import rotation_matrices
from gsx.core.gaussians.splats import Splats
from gsx.core.rasterizer import RasterSettings, rasterize


def scene(count: int = 200, seed: int = 0, channels: int = 3) -> Splats:
    g = torch.Generator().manual_seed(seed)
    return Splats(
        means=torch.randn(count, 3, generator=g),
        scales=torch.exp(torch.randn(count, 3, generator=g) * 0.7 - 2.5),
        quats=torch.randn(count, 4, generator=g),
        log_opacities=logsigmoid(2 * torch.randn(count, generator=g)),
        colours=torch.rand(count, channels, generator=g),
    )


def camera(width: int = 83, height: int = 61) -> Camera:
    return look_at([0, -4, 1], [0, 0, 0], fov_x=0.9, width=width, height=height)


@pytest.mark.parametrize("cull", ["published", "tight"])
@pytest.mark.parametrize(
    ("tile", "chunk", "batch"), [(4, 5, 3000), (16, 16, 1 << 18), (8, 1, 1 << 12), (2, 7, 1 << 16)]
)
def test_work_sizes_do_not_change_the_image(tile: int, chunk: int, batch: int, cull: str) -> None:
    base = rasterize(scene(), camera(), RasterSettings(cull=cull)).image
    other = rasterize(
        scene(), camera(), RasterSettings(cull=cull, tile_size=tile, chunk=chunk, batch_values=batch)
    ).image
    assert torch.allclose(base, other, atol=3e-6)


@pytest.mark.parametrize("cull", ["published", "tight"])
@pytest.mark.parametrize(
    "window", [(0, 0, 40, 30), (16, 32, 48, 29), (13, 7, 50, 40), (-20, -9, 60, 50), (70, 50, 40, 40)]
)
def test_render_of_a_crop_is_the_crop_of_the_render_bit_for_bit(window: tuple[int, int, int, int], cull: str) -> None:
    rules = RasterSettings(cull=cull)
    left, top, width, height = window
    whole, part = rasterize(scene(), camera(), rules).image, rasterize(scene(), camera().crop(*window), rules).image
    x0, y0, x1, y1 = max(left, 0), max(top, 0), min(left + width, 83), min(top + height, 61)
    assert torch.equal(part[:, y0 - top : y1 - top, x0 - left : x1 - left], whole[:, y0:y1, x0:x1])


@pytest.mark.parametrize("cull", ["published", "tight"])
@pytest.mark.parametrize("window", [(-20, -9, 60, 50), (70, 50, 40, 40)])
def test_beyond_the_frame_a_crop_is_that_of_the_truth(window: tuple[int, int, int, int], cull: str) -> None:
    cropped, rules = camera().crop(*window), RasterSettings(cull=cull)
    truth = render_reference(scene(), cropped, rules)[0]
    assert torch.allclose(rasterize(scene(), cropped, rules).image.double(), truth, atol=1e-5)


def test_zoomed_render_averages_back_to_the_render() -> None:
    # wide splats: the dilation, which does not scale with the raster, hardly matters
    splats = scene(60)
    splats = Splats(**(vars(splats) | {"scales": splats.scales * 4}))
    base = rasterize(splats, camera(), RasterSettings(cull="tight", dilation=1e-4)).image
    fine = rasterize(splats, camera().zoom(4), RasterSettings(cull="tight", dilation=16e-4)).image
    averaged = torch.nn.functional.avg_pool2d(fine[None], 4)[0]
    assert (averaged - base).abs().max() < 0.02
    assert (averaged - base).abs().mean() < 1e-3


@given(st.integers(0, 10**6), st.floats(0.1, 10))
@settings(max_examples=15, deadline=None)
def test_rigid_motion_and_scaling_of_the_world_change_nothing(seed: int, factor: float) -> None:
    g = torch.Generator().manual_seed(seed)
    turn = rotation_matrices(torch.randn(1, 4, generator=g, dtype=torch.float64))[0]
    shift = torch.randn(3, generator=g, dtype=torch.float64)
    splats = Splats(**{name: value.double() for name, value in vars(scene(40, seed)).items()})
    view = camera(40, 30)
    quats = splats.quats / splats.quats.norm(dim=1, keepdim=True)
    moved = Splats(
        means=factor * splats.means @ turn.T + shift,
        scales=factor * splats.scales,
        quats=turned(turn, quats),
        log_opacities=splats.log_opacities,
        colours=splats.colours,
    )
    rotation = view.rotation @ turn.T
    moved_view = Camera(
        rotation=rotation,
        translation=factor * view.translation - rotation @ shift,
        fx=view.fx, fy=view.fy, cx=view.cx, cy=view.cy, width=40, height=30, near=factor * view.near,
    )  # fmt: skip
    rules = RasterSettings(cull="tight", alpha_min=1e-6)
    a, b = rasterize(splats, view, rules).image, rasterize(moved, moved_view, rules).image
    assert torch.allclose(a, b, atol=1e-4)


def turned(turn: torch.Tensor, quats: torch.Tensor) -> torch.Tensor:
    """Quaternions of turn @ R(q), from the matrices (trace method where it is safe, else by eigenvector)."""
    products = turn @ rotation_matrices(quats)
    result = []
    for m in products:
        # q is the eigenvector of largest eigenvalue of the symmetric 4x4 matrix built from m (Bar-Itzhack 2000)
        k = torch.tensor(
            [
                [m[0, 0] + m[1, 1] + m[2, 2], m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]],
                [m[2, 1] - m[1, 2], m[0, 0] - m[1, 1] - m[2, 2], m[0, 1] + m[1, 0], m[0, 2] + m[2, 0]],
                [m[0, 2] - m[2, 0], m[0, 1] + m[1, 0], m[1, 1] - m[0, 0] - m[2, 2], m[1, 2] + m[2, 1]],
                [m[1, 0] - m[0, 1], m[0, 2] + m[2, 0], m[1, 2] + m[2, 1], m[2, 2] - m[0, 0] - m[1, 1]],
            ],
            dtype=torch.float64,
        )
        result.append(torch.linalg.eigh(k).eigenvectors[:, -1])
    return torch.stack(result)


@given(st.integers(0, 10**6))
@settings(max_examples=15, deadline=None)
def test_order_of_rows_and_sign_and_length_of_quaternions_do_not_matter(seed: int) -> None:
    splats, g = scene(60, seed), torch.Generator().manual_seed(seed)
    rows = torch.randperm(60, generator=g)
    other = {name: value[rows] for name, value in vars(splats).items()}
    other["quats"] = other["quats"] * (torch.rand(60, 1, generator=g) - 0.5)
    # rounding may move an alpha over the cut-off or a radius to the next pixel: rules without those steps
    rules = RasterSettings(cull="tight", alpha_min=1e-6)
    a, b = rasterize(splats, camera(), rules).image, rasterize(Splats(**other), camera(), rules).image
    assert torch.allclose(a, b, atol=2e-5)


def test_any_number_of_channels_and_coverage_in_unit_range() -> None:
    rendering = rasterize(scene(channels=7), camera(), RasterSettings())
    assert rendering.image.shape == (7, 61, 83)
    assert float(rendering.alpha.min()) >= 0
    assert float(rendering.alpha.max()) <= 1 - 1e-4 + 1e-6
    single = rasterize(
        Splats(**(vars(scene(channels=7)) | {"colours": scene(channels=7).colours[:, 3:4]})), camera(), RasterSettings()
    )
    assert torch.allclose(rendering.image[3], single.image[0], atol=1e-6)


def test_transparent_splats_are_not_there() -> None:
    splats = scene()
    ghosts = Splats(**(vars(splats) | {"log_opacities": torch.full((200,), math.log(1 / 256))}))
    assert float(rasterize(ghosts, camera(), RasterSettings()).alpha.max()) == 0


def test_too_many_pairs_are_refused_by_name() -> None:
    with pytest.raises(InputError, match=r"83x61 px needs [\d,]+ splat-tile pairs.*max_pairs=100"):
        rasterize(scene(), camera(), RasterSettings(max_pairs=100))


def test_screen_gradient_is_the_blending_path_only_in_pixels() -> None:
    # moving every mean by a pixel moves the picture by a pixel: compare with finite differences of shifted cameras
    splats = Splats(**{name: value.double() for name, value in vars(scene(1)).items()})
    splats = Splats(**(vars(splats) | {"scales": splats.scales * 0 + 0.3, "means": splats.means * 0.1}))
    weight = torch.rand(3, 61, 83, generator=torch.Generator().manual_seed(5)).double()
    rules = RasterSettings(cull="tight", alpha_min=1e-9)
    live = Splats(**{name: value.clone().requires_grad_() for name, value in vars(splats).items()})
    rendering = rasterize(live, camera(), rules)
    (rendering.image * weight).sum().backward()
    view, step = camera(), 1e-4
    for axis, name in enumerate(("cx", "cy")):
        # the Jacobian does not depend on the principal point while its clamp is inactive
        moved = [
            (rasterize(splats, Camera(**(vars(view) | {name: getattr(view, name) + d})), rules).image * weight).sum()
            for d in (-step, step)
        ]
        expected = float(moved[1] - moved[0]) / (2 * step)
        assert float(rendering.screen.means2d_offset.grad[0, axis]) == pytest.approx(expected, rel=1e-5)
    ndc = rendering.screen.ndc_gradient(rendering.screen.means2d_offset)
    assert torch.allclose(ndc, rendering.screen.means2d_offset.grad * torch.tensor([83 / 2, 61 / 2]))


def test_absolute_gradient_sums_the_absolute_values_over_pixels() -> None:
    # one pixel at a time, the gradient of the mean has one term; their absolute values add up to the statistic
    splats = scene(3)
    view, rules = camera(9, 7), RasterSettings()
    live = Splats(**{name: value.clone().requires_grad_() for name, value in vars(splats).items()})
    rendering = rasterize(live, view, rules, absolute_gradient=True)
    rendering.image.sum().backward()
    total = torch.zeros(3, 2)
    for y in range(7):
        for x in range(9):
            again = rasterize(live, view, rules)
            again.image[:, y, x].sum().backward()
            total += again.screen.means2d_offset.grad.abs()
    assert torch.allclose(rendering.screen.absgrad.grad, total, rtol=1e-3, atol=1e-6)
    assert (rendering.screen.absgrad.grad >= rendering.screen.means2d_offset.grad.abs() - 1e-5).all()


def test_heaviest_weight_is_the_largest_over_all_pixels() -> None:
    splats = scene(20)
    each = Splats(**(vars(splats) | {"colours": torch.eye(20)}))  # channel n shows the weight of splat n
    rendering = rasterize(each, camera(), RasterSettings(), max_weight=True)
    assert torch.allclose(
        rendering.screen.max_weights, rendering.image.flatten(1).amax(1)[rendering.screen.ids], atol=1e-6
    )


def test_same_input_gives_the_same_bits() -> None:
    def once() -> list[torch.Tensor]:
        live = Splats(**{name: value.clone().requires_grad_() for name, value in vars(scene()).items()})
        rendering = rasterize(live, camera(), RasterSettings())
        rendering.image.square().mean().backward()
        return [rendering.image, *(getattr(live, name).grad for name in vars(live))]

    assert all(torch.equal(a, b) for a, b in zip(once(), once(), strict=True))


@pytest.mark.parametrize("name", ["means", "scales", "quats", "log_opacities", "colours"])
@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_non_finite_splats_are_dropped_and_counted(name: str, value: float) -> None:
    clean = scene(50)
    fields = {key: field.clone() for key, field in vars(clean).items()}
    fields[name][7] = value
    rendering = rasterize(Splats(**fields), camera(), RasterSettings())
    without = {key: field[torch.arange(50) != 7] for key, field in vars(clean).items()}
    assert rendering.dropped == 1
    assert torch.equal(rendering.image, rasterize(Splats(**without), camera(), RasterSettings()).image)


def test_opacity_zero_is_no_error() -> None:
    splats = Splats(**(vars(scene(5)) | {"log_opacities": torch.full((5,), -math.inf)}))
    rendering = rasterize(splats, camera(), RasterSettings())
    assert rendering.dropped == 0
    assert float(rendering.alpha.max()) == 0
