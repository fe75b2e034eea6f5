"""Opacities compensated for dilation, the 2D filter of Mip-Splatting."""

import math
from dataclasses import replace

import pytest
import torch
from raster_scenes import (
    any_path,
    changed,
    errors_of,
    front_camera,
    gradients,
    leaves,
    random_splats,
    render_with_gradients,
    truth_of,
)

from gsx.core.data.camera import Camera, look_at
from gsx.core.gaussians.splats import Splats
from gsx.core.rasterizer import rasterize
from gsx.core.rasterizer.geometry import LEAST_SHARE, log_compensation
from gsx.core.rasterizer.intersections import intersect_tiles
from gsx.core.rasterizer.projection import project
from gsx.engine.compiling import available

MIP = any_path(cull="tight", dilation=0.1, compensate=True, unrolled=2)
PATHS = ["eager", pytest.param("compiled", marks=pytest.mark.skipif(not available(), reason="no working compiler"))]


def axis_camera() -> Camera:
    """Looks along +y from the origin; its axis meets the middle of the middle pixel."""
    return look_at([0, 0, 0], [0, 1, 0], fov_x=1.0, width=33, height=33)


def axis_splat(variance: float, opacity: float = 0.9, depth: float = 2.0) -> Splats:
    """A disc of `variance` px^2 that faces `axis_camera`."""
    scale = math.sqrt(variance) * depth / axis_camera().fx
    return Splats(
        means=torch.tensor([[0.0, depth, 0.0]]),
        scales=torch.tensor([[scale, 0.0, scale]]),
        quats=torch.tensor([[1.0, 0, 0, 0]]),
        log_opacities=torch.tensor([math.log(opacity)]),
        colours=torch.ones(1, 3),
    )


def small_splats(seed: int, count: int = 200) -> Splats:
    """Of 0.1 to 10 px: compensation takes from a hundredth to nearly everything."""
    splats = random_splats(count, seed, size=0.03)
    return changed(splats, log_opacities=splats.log_opacities / 10)


def degenerate_splats() -> Splats:
    """Needles, discs, lines and points, one with every scale of 0; a half of them opaque."""
    sizes = [1e-30, 1e-9, 1e-4, 3e-2, 1.0, 1e4]
    scales = [[a, b, c] for a in (0.0, *sizes) for b in (0.0, 1e-6, 1e-2) for c in (0.0, 0.05, 30.0)]
    splats = changed(random_splats(len(scales), seed=3), scales=torch.tensor(scales))
    return changed(splats, log_opacities=splats.log_opacities * (torch.arange(len(scales)) % 2))


@pytest.mark.parametrize("path", PATHS)
@pytest.mark.parametrize(
    ("variance", "coefficient"), [(0.01, 0.091), (0.05, 0.333), (0.1, 0.5), (1.0, 0.909), (10.0, 0.990)]
)
def test_the_centre_of_a_disc_has_the_opacity_of_the_specification(
    path: str, variance: float, coefficient: float
) -> None:
    alpha = rasterize(axis_splat(variance), axis_camera(), replace(MIP, path=path)).alpha[16, 16]
    assert float(alpha) == pytest.approx(0.9 * coefficient, abs=5e-4)
    assert float(alpha) == pytest.approx(0.9 * variance / (variance + 0.1), rel=1e-5)


@pytest.mark.parametrize("path", PATHS)
@pytest.mark.parametrize(("cull", "dilation"), [("published", 0.1), ("tight", 0.1), ("tight", 0.3)])
def test_picture_and_gradient_are_those_of_the_truth(cull: str, path: str, dilation: float) -> None:
    splats, rules = small_splats(seed=5), replace(MIP, cull=cull, path=path, dilation=dilation)
    truth = truth_of(splats, front_camera(), rules)
    plain = truth_of(splats, front_camera(), replace(rules, compensate=False))
    assert (truth.image - plain.image).abs().max() > 0.1
    errors = errors_of(splats, front_camera(), rules, truth)
    assert errors.largest <= 1e-5
    assert errors.gradient <= 1e-4


@pytest.mark.parametrize("path", [PATHS[0], pytest.param("compiled", marks=pytest.mark.slow)])
def test_float64_splats_are_exact(path: str) -> None:
    wide, rules = changed(small_splats(seed=6), dtype=torch.float64), replace(MIP, path=path)
    errors = errors_of(wide, front_camera(), rules, truth_of(wide, front_camera(), rules))
    assert errors.largest <= 1e-12
    assert errors.gradient <= 1e-10


@pytest.mark.parametrize("path", PATHS)
def test_needles_and_points_are_finite_and_those_of_the_truth(path: str) -> None:
    rules, splats = replace(MIP, path=path, alpha_min=1e-9, unrolled=1), degenerate_splats()
    truth = truth_of(splats, front_camera(), rules, depth=False)
    rendering, found = render_with_gradients(splats, front_camera(), rules, depth=False)
    assert float(rendering.alpha.detach().max()) > 0.1
    assert all(torch.isfinite(value).all() for value in found.values())
    assert (rendering.image.detach() - truth.image).abs().max() <= 1e-4
    for name, true in truth.gradients.items():
        assert (found[name] - true).norm() <= 1e-3 * true.norm()


@pytest.mark.parametrize("path", PATHS)
def test_nothing_is_drawn_of_points_and_their_gradients_are_zero(path: str) -> None:
    splats = leaves(changed(random_splats(20), scales=torch.zeros(20, 3), log_opacities=torch.zeros(20)))
    rendering = rasterize(splats, front_camera(), replace(MIP, path=path, alpha_min=1e-9))
    (rendering.image.sum() + rendering.alpha.sum()).backward()
    assert rendering.alpha.abs().max() == 0
    assert all((value == 0).all() for value in gradients(splats).values())


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_logarithm_is_finite_for_all_determinants_and_constant_below_its_floor(dtype: torch.dtype) -> None:
    bare = torch.tensor([0.0, 1e-38, 1e-29, 1e-12, 1e-3, 1.0, 1e6, 1e15, 1e30], dtype=dtype, requires_grad=True)
    added = torch.tensor(0.1, dtype=dtype)
    gain = log_compensation(bare, added.expand_as(bare))
    gain.sum().backward()
    assert bare.grad is not None
    exact = bare.detach().double().clamp_min(0.1 * LEAST_SHARE)
    assert torch.allclose(gain.exp().double(), (exact / (exact + 0.1)).sqrt(), rtol=1e-5, atol=0)
    assert (bare.grad[:2] == 0).all()
    slope = 0.05 / (exact * (exact + 0.1))  # of ln sqrt(b / (b + 0.1)): no cancellation where the ratio is nearly 1
    assert torch.allclose(bare.grad[2:-1].double(), slope[2:-1], rtol=1e-5, atol=0)
    assert torch.isfinite(bare.grad).all()


def test_bounds_see_the_compensated_opacity_and_the_published_radius_does_not() -> None:
    splats, camera, plain = small_splats(seed=7), front_camera(), replace(MIP, compensate=False)
    fewer, more = (intersect_tiles(project(splats, camera, rules), camera, rules) for rules in (MIP, plain))
    assert len(fewer.splats) < len(more.splats)
    assert torch.equal(fewer.radii, more.radii)
    point = axis_splat(1e-4)  # its opacity falls to 9e-4
    rendering = rasterize(point, axis_camera(), MIP)
    assert rendering.intersections == 0
    assert rendering.screen.visible.all()


def test_without_compensation_the_same_bits_as_ever() -> None:
    splats, plain = small_splats(seed=8), replace(MIP, compensate=False)
    screen, compensated = project(splats, front_camera(), plain), project(splats, front_camera(), MIP)
    assert not any_path().compensate
    assert torch.equal(screen.log_opacities, splats.log_opacities[screen.ids])
    assert (compensated.log_opacities < screen.log_opacities).all()
    for name in ("means", "covariances", "conic_factors"):
        assert torch.equal(getattr(screen, name), getattr(compensated, name))
