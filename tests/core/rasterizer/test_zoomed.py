"""Cameras finer or coarser than those of training, for models that are drawn with plain dilation."""

import math
from dataclasses import replace

import pytest
import torch
from raster_scenes import any_path, changed, errors_of, front_camera, random_splats, truth_of

from gsx.core.data.camera import Camera, look_at
from gsx.core.gaussians.splats import Splats
from gsx.core.rasterizer import RasterSettings, rasterize
from gsx.core.rasterizer.projection import project
from gsx.engine.compiling import available

PATHS = ["eager", pytest.param("compiled", marks=pytest.mark.skipif(not available(), reason="no working compiler"))]
PLAIN = any_path(cull="tight", unrolled=2)
"""Of the published dilation of 0.3 px^2."""


def rules_for(camera: Camera, zoomed: str, path: str = "eager") -> RasterSettings:
    """Of a model that was trained by this camera."""
    return replace(PLAIN, zoomed=zoomed, training_focal=camera.fx, path=path)


def small_splats(count: int = 200) -> Splats:
    """Of 0.1 to 10 px; opacities from 0.3 to nearly 1."""
    splats = random_splats(count, seed=7, size=0.03)
    return changed(splats, log_opacities=splats.log_opacities / 5)


def facing(across: float, down: float) -> tuple[Camera, Splats]:
    """(a camera, a faint splat of these variances, px^2, that it looks at straight)."""
    camera = look_at([0, 0, 0], [0, 1, 0], fov_x=1.0, width=33, height=33)
    scales = [2 * math.sqrt(variance) / camera.fx for variance in (across, 0.0, down)]
    return camera, Splats(
        means=torch.tensor([[0.0, 2.0, 0.0]], dtype=torch.float64),
        scales=torch.tensor([scales], dtype=torch.float64),
        quats=torch.tensor([[1.0, 0, 0, 0]], dtype=torch.float64),
        log_opacities=torch.tensor([math.log(0.1)], dtype=torch.float64),
        colours=torch.ones(1, 1, dtype=torch.float64),
    )


@pytest.mark.parametrize(
    ("variances", "factors"),
    [
        ((0, 0), (0.5, 1, 1.3333, 1.4545, 1.4884)),
        ((1, 0.05), (0.6614, 1, 1.1622, 1.2133, 1.2269)),
        ((1, 1), (0.8125, 1, 1.0612, 1.0777, 1.0819)),
    ],
)
def test_a_resampled_splat_keeps_its_mass(variances: tuple[float, float], factors: tuple[float, ...]) -> None:
    """Dilations 0.15, 0.3, 0.9, 3.3, 12.9 px^2 at x1/2 to x8; factors sqrt(|S + 0.3 k^2 I| / |S + d I|), by hand."""
    camera, splat = facing(*variances)
    for k, dilation, factor in zip((0.5, 1, 2, 4, 8), (0.15, 0.3, 0.9, 3.3, 12.9), factors, strict=True):
        finer = replace(camera, fx=k * camera.fx, fy=k * camera.fy)
        screen = project(splat, finer, rules_for(camera, "resampled"))
        assert math.exp(float(screen.log_opacities)) / 0.1 == pytest.approx(factor, abs=6e-5)
        wide = [k * k * variance + dilation for variance in variances]
        assert screen.covariances[0, ::2].tolist() == pytest.approx(wide, rel=1e-6)
        after = math.sqrt(wide[0] * wide[1]) * math.exp(float(screen.log_opacities)) / k**2
        before = math.sqrt((variances[0] + 0.3) * (variances[1] + 0.3)) * 0.1
        assert after == pytest.approx(before, rel=1e-6)


@pytest.mark.parametrize("path", PATHS)
def test_a_magnified_picture_passes_through_the_pixels_of_the_first(path: str) -> None:
    """At x3 every ninth pixel centre is one of x1."""
    camera, splats = front_camera(), small_splats()
    rules = rules_for(camera, "magnified", path)
    first = rasterize(splats, camera, rules).image
    finer = rasterize(splats, camera.zoom(3), rules).image
    plain = rasterize(splats, camera.zoom(3), replace(rules, zoomed="plain")).image
    assert (finer[:, 1::3, 1::3] - first).abs().max() <= 2e-5
    assert (plain[:, 1::3, 1::3] - first).abs().max() > 0.2


@pytest.mark.parametrize("path", PATHS)
@pytest.mark.parametrize("zoomed", ["magnified", "resampled"])
@pytest.mark.parametrize("k", [0.5, 2.0, 4.0])
def test_picture_and_gradient_are_those_of_the_truth(path: str, zoomed: str, k: float) -> None:
    camera, splats = front_camera(), small_splats()
    rules, seen = rules_for(camera, zoomed, path), camera.zoom(k).crop(9, 5, 40, 24)
    truth = truth_of(splats, seen, rules)
    errors = errors_of(splats, seen, rules, truth)
    assert errors.largest <= 1e-5
    assert errors.gradient <= 1e-4
    if (zoomed, k) != ("magnified", 0.5):
        assert (truth.image - truth_of(splats, seen, replace(rules, zoomed="plain")).image).abs().max() > 0.1


@pytest.mark.parametrize("path", PATHS)
@pytest.mark.parametrize("zoomed", ["magnified", "resampled"])
def test_training_cameras_draw_as_published(path: str, zoomed: str) -> None:
    camera, splats = front_camera(), small_splats()
    rules = rules_for(camera, zoomed, path)
    for same in (rules, replace(rules, training_focal=0.0)):
        drawn = rasterize(splats, camera, same).image
        assert torch.equal(drawn, rasterize(splats, camera, replace(PLAIN, path=path)).image)


@pytest.mark.parametrize("zoomed", ["magnified", "resampled"])
def test_a_window_is_the_window_of_the_picture(zoomed: str) -> None:
    camera, splats = front_camera(), small_splats()
    rules, finer = rules_for(camera, zoomed), camera.zoom(2)
    whole = rasterize(splats, finer, rules).image
    assert torch.equal(rasterize(splats, finer.crop(30, 20, 48, 40), rules).image, whole[:, 20:60, 30:78])


def test_nothing_becomes_more_opaque_than_an_alpha_may_be() -> None:
    camera, splat = facing(0.01, 0.01)
    for opacity, most in ((0.9, 0.99), (0.995, 0.995), (0.2, 0.2 * 4.96 / 3.46)):
        opaque = changed(splat, log_opacities=torch.tensor([math.log(opacity)]).double())
        seen = project(opaque, camera.zoom(4), rules_for(camera, "resampled"))
        assert math.exp(float(seen.log_opacities)) == pytest.approx(most, rel=1e-4)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"zoomed": "soft"}, "rasterizer.zoomed is 'soft'; choose plain, magnified, resampled"),
        ({"zoomed": "magnified", "compensate": True}, "models without compensated opacities"),
        ({"zoomed": "resampled", "dilation": 0.1}, "needs a dilation above 0.1"),
        ({"training_focal": -3.0}, "rasterizer.training_focal is -3.0"),
    ],
)
def test_rules_that_mean_nothing_are_refused(changes: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        any_path(**changes)
