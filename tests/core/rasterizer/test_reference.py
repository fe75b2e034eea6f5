"""The eager rasterizer against the float64 truth, and the truth against numbers worked by hand."""

import math

import pytest
import torch
from extremes.comparison import undecided
from reference_rasterizer import render_reference
from torch.nn.functional import logsigmoid

from gsx.core.data.camera import look_at
from gsx.core.gaussians.splats import Splats
from gsx.core.rasterizer import RasterSettings, rasterize

FIELDS = ("means", "scales", "quats", "log_opacities", "colours")


def random_fields(count: int, seed: int, channels: int = 3) -> dict[str, torch.Tensor]:
    g = torch.Generator().manual_seed(seed)
    return {
        "means": torch.randn(count, 3, generator=g),
        "scales": torch.exp(torch.randn(count, 3, generator=g) * 0.7 - 2.5),
        "quats": torch.randn(count, 4, generator=g),
        "log_opacities": logsigmoid(2 * torch.randn(count, generator=g)),
        "colours": torch.rand(count, channels, generator=g),
    }


def centre_splat(scale: float, opacity: float, *, depth: float = 2.0, count: int = 1) -> Splats:
    """Isotropic splats on the axis of `axis_camera`, all at the same place, colour 1."""
    return Splats(
        means=torch.tensor([[0.0, depth, 0.0]]).repeat(count, 1),
        scales=torch.full((count, 3), scale),
        quats=torch.tensor([[1.0, 0, 0, 0]]).repeat(count, 1),
        log_opacities=torch.full((count,), math.log(opacity)),
        colours=torch.ones(count, 1),
    )


def axis_camera(size: int = 33):
    """Looks along +y from the origin; its axis meets the middle of the middle pixel (odd size)."""
    return look_at([0, 0, 0], [0, 1, 0], fov_x=1.0, width=size, height=size)


@pytest.mark.parametrize("cull", ["published", "tight"])
@pytest.mark.parametrize("seed", range(8))
def test_random_scene_matches_float64_truth(seed: int, cull: str) -> None:
    fields, settings = random_fields(150, seed), RasterSettings(cull=cull)
    camera = look_at([0, -4, 1], [0, 0, 0], fov_x=0.9, width=50, height=38)
    background = torch.tensor([0.2, 0.5, 0.9])
    fast = {name: value.clone().requires_grad_() for name, value in fields.items()}
    slow = {name: value.double().requires_grad_() for name, value in fields.items()}
    rendering = rasterize(Splats(**fast), camera, settings, background=background, depth=True)
    image, alpha, depth = render_reference(Splats(**slow), camera, settings, background=background)
    decided = ~undecided(Splats(**slow), camera, settings, 1e-5)
    assert decided.double().mean() > 0.999
    assert ((rendering.image - image).abs() * decided).max() <= 2e-5
    assert ((rendering.alpha - alpha).abs() * decided).max() <= 2e-5
    assert ((rendering.depth - depth).abs() * decided).max() <= 1e-4  # depths are about 4
    weight = torch.rand(image.shape, generator=torch.Generator().manual_seed(seed)) * decided
    (rendering.image * weight + rendering.depth * 0.1 * decided).sum().backward()
    (image * weight.double() + depth * 0.1 * decided).sum().backward()
    for name in FIELDS:
        error = (fast[name].grad - slow[name].grad).norm() / slow[name].grad.norm()
        assert error <= 1e-3, name


def test_the_two_cull_rules_differ_where_three_sigma_cuts_a_visible_tail() -> None:
    # sigma 10 px: alpha is still 0.011 at 3 sigma, and a tile border lies between 3 and 3.33 sigma
    camera = look_at([0, 0, 0], [0, 1, 0], fov_x=2 * math.atan(0.5), width=96, height=96)
    splat = centre_splat(10 / 96 * 2.0, 0.99)
    published = rasterize(splat, camera, RasterSettings(cull="published")).image
    tight = rasterize(splat, camera, RasterSettings(cull="tight")).image
    assert 1 / 255 <= float((tight - published).abs().max()) < 0.012
    truth = render_reference(splat, camera, RasterSettings(cull="published"))[0]
    assert (published - truth).abs().max() < 1e-5


def small_scene(seed: int) -> tuple[dict[str, torch.Tensor], RasterSettings]:
    """Six splats whose alphas stay off every threshold, so that finite differences mean something."""
    fields = {name: value.double() for name, value in random_fields(6, seed).items()}
    fields["scales"] = fields["scales"] * 0 + torch.tensor([0.5, 0.7, 0.4], dtype=torch.float64)
    fields["log_opacities"] = torch.full((6,), math.log(0.5), dtype=torch.float64)
    return fields, RasterSettings(cull="tight", alpha_min=1e-9, tile_size=4, chunk=4)


@pytest.mark.parametrize("seed", range(2))
def test_gradients_pass_gradcheck_in_float64(seed: int) -> None:
    fields, settings = small_scene(seed)
    camera = look_at([0, -4, 1], [0, 0, 0], fov_x=0.9, width=6, height=5)
    background = torch.tensor([0.3, 0.6, 0.1], dtype=torch.float64, requires_grad=True)

    def render(*values: torch.Tensor) -> torch.Tensor:
        rendering = rasterize(
            Splats(**dict(zip(FIELDS, values, strict=False))), camera, settings, background=values[-1], depth=True
        )
        return torch.cat([rendering.image, rendering.alpha[None], rendering.depth[None]])

    inputs = [fields[name].requires_grad_() for name in FIELDS]
    assert torch.autograd.gradcheck(render, (*inputs, background), eps=1e-6, atol=1e-6, rtol=1e-4)


def test_isotropic_splat_on_a_pixel_shows_its_opacity() -> None:
    image = rasterize(centre_splat(0.1, 0.5), axis_camera(), RasterSettings()).image
    assert float(image[0, 16, 16]) == pytest.approx(0.5, abs=1e-6)


def test_point_splat_is_the_dilation_with_radius_three() -> None:
    # s f / z = 0: covariance 0.3 I, so alpha one pixel off centre is o exp(-1 / 0.6); radius 3
    rendering = rasterize(centre_splat(1e-12, 0.5), axis_camera(), RasterSettings())
    assert int(rendering.screen.radii[0]) == 3
    assert float(rendering.image[0, 16, 17]) == pytest.approx(0.5 * math.exp(-1 / 0.6), rel=1e-5)


def test_two_coincident_splats_blend_front_to_back() -> None:
    image = rasterize(centre_splat(0.1, 0.6, count=2), axis_camera(), RasterSettings()).image
    assert float(image[0, 16, 16]) == pytest.approx(0.6 + 0.4 * 0.6, abs=1e-6)


def test_the_splat_that_would_cross_the_stop_is_not_blended() -> None:
    # 1 - T: 0.9, 0.99, 0.999; the fourth would leave T = 1e-4 (1 - tiny) < 1e-4, so T stays 1e-3
    splats = centre_splat(0.1, 0.9001, count=6)
    rendering = rasterize(splats, axis_camera(), RasterSettings())
    assert float(1 - rendering.alpha[16, 16]) == pytest.approx((1 - 0.9001) ** 3, rel=1e-3)


def test_alpha_is_clamped_but_its_gradient_is_not() -> None:
    logit = torch.tensor([math.log(0.999)], requires_grad=True)
    splat = centre_splat(0.1, 0.999)
    splat = Splats(**(vars(splat) | {"log_opacities": logit}))
    image = rasterize(splat, axis_camera(), RasterSettings()).image
    assert float(image[0, 16, 16].detach()) == pytest.approx(0.99, abs=1e-6)
    image[0, 16, 16].backward()
    assert float(logit.grad) == pytest.approx(0.999, rel=1e-4)  # d(o)/d(log o), straight through


def test_mean_lands_at_the_pinhole_projection() -> None:
    camera = look_at([0, 0, 0], [0, 1, 0], fov_x=1.0, width=41, height=31)
    splats = centre_splat(0.02, 0.9)
    offset = Splats(**(vars(splats) | {"means": torch.tensor([[0.31, 2.0, 0.17]])}))
    image = rasterize(offset, camera, RasterSettings(cull="tight")).image[0]
    y, x = torch.meshgrid(torch.arange(31) + 0.5, torch.arange(41) + 0.5, indexing="ij")
    centroid = torch.stack([(image * x).sum(), (image * y).sum()]) / image.sum()
    expected = torch.tensor([camera.cx + camera.fx * 0.31 / 2, camera.cy - camera.fy * 0.17 / 2])  # z up, y down
    assert torch.allclose(centroid, expected, atol=0.01)


def test_splats_at_or_before_the_near_plane_are_not_drawn() -> None:
    for depth, drawn in ((0.19, False), (0.2, False), (0.21, True), (-1.0, False)):
        rendering = rasterize(centre_splat(0.01, 0.9, depth=depth), axis_camera(), RasterSettings())
        assert bool((rendering.alpha > 0).any()) is drawn, depth
        assert bool(torch.isfinite(rendering.image).all())


def test_no_splats_show_the_background() -> None:
    empty = Splats(**{name: value[:0] for name, value in vars(centre_splat(0.1, 0.5)).items()})
    rendering = rasterize(empty, axis_camera(), RasterSettings(), background=torch.tensor([0.25]))
    assert bool((rendering.image == 0.25).all())
