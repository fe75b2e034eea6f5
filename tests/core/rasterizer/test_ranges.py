"""Every knob over its range against the float64 truth; channels from 1 to 64; the cap per tile."""

import functools

import pytest
import torch
from raster_scenes import changed, errors_of, front_camera, leaves, random_splats, render_with_gradients, truth_of

from gsx.core.data.camera import look_at
from gsx.core.gaussians.splats import Splats
from gsx.core.rasterizer import RasterSettings, rasterize
from gsx.core.rasterizer.intersections import cap_tiles, intersect_tiles
from gsx.core.rasterizer.projection import project


@functools.cache
def truth(cull: str = "tight", alpha_min: float = 1 / 255, stop: float = 1e-4):
    rules = RasterSettings(cull=cull, alpha_min=alpha_min, transmittance_stop=stop)
    return truth_of(dense_splats(), front_camera(), rules)


def dense_splats() -> Splats:
    """Many enough, and opaque enough, that pixels reach the transmittance stop."""
    splats = random_splats(300, seed=2, size=0.15)
    return changed(splats, log_opacities=splats.log_opacities / 3)


def assert_close(rules: RasterSettings, **of_truth: object) -> None:
    errors = errors_of(dense_splats(), front_camera(), rules, truth(rules.cull, **of_truth))
    assert errors.largest <= 1e-5
    assert errors.gradient <= 1e-4


@pytest.mark.parametrize(
    ("cull", "tile"), [("published", 4), ("published", 16), *(("tight", tile) for tile in (1, 4, 7, 8, 16, 32, 100))]
)
def test_every_tile_size(cull: str, tile: int) -> None:
    assert_close(RasterSettings(cull=cull, tile_size=tile))


@pytest.mark.parametrize("chunk", [1, 2, 3, 16, 64, 1000])
def test_every_chunk(chunk: int) -> None:
    assert_close(RasterSettings(cull="tight", chunk=chunk))


@pytest.mark.parametrize("alpha_min", [0.05, 1e-3, 1e-4, 1e-6])
def test_every_cut_off(alpha_min: float) -> None:
    assert_close(RasterSettings(cull="tight", alpha_min=alpha_min), alpha_min=alpha_min)


@pytest.mark.parametrize("stop", [0.0, 1e-6, 1e-3, 1e-2, 0.5])
def test_every_stop(stop: float) -> None:
    assert_close(RasterSettings(cull="tight", transmittance_stop=stop), stop=stop)


def test_the_cut_off_and_the_stop_do_matter_here() -> None:
    default = truth()
    for other in (truth(alpha_min=1e-4), truth(stop=1e-2), truth(stop=0.0)):
        assert (other.image - default.image).abs().max() > 1e-4


def test_without_a_stop_opaque_stacks_stay_finite_until_nothing_passes() -> None:
    # 0.01^500 is 0 in every format
    splats = changed(
        random_splats(500),
        means=torch.zeros(500, 3),
        scales=torch.tensor([0.8, 1.0, 1.3]).expand(500, 3),
        log_opacities=torch.zeros(500),
    )
    rules = RasterSettings(cull="tight", transmittance_stop=0.0)
    rendering, found = render_with_gradients(splats, front_camera(), rules)
    assert float(rendering.alpha.detach().max()) == pytest.approx(1, abs=2e-3)
    assert all(torch.isfinite(value).all() for value in found.values())
    errors = errors_of(splats, front_camera(), rules, truth_of(splats, front_camera(), rules))
    assert errors.largest <= 1e-5
    assert errors.gradient <= 1e-4


@pytest.mark.parametrize("channels", [1, 3, 7, 64])
def test_any_number_of_real_channels(channels: int) -> None:
    splats = random_splats(100, channels=channels)
    g = torch.Generator().manual_seed(channels)
    splats = changed(splats, colours=5 * torch.randn(100, channels, generator=g))
    rules = RasterSettings(cull="tight")
    errors = errors_of(splats, front_camera(), rules, truth_of(splats, front_camera(), rules))
    assert errors.largest <= 2e-5
    assert errors.gradient <= 1e-4


# -- the cap per tile ----------------------------------------------------------------------------------------------


def wide_splats(count: int = 12) -> Splats:
    """Every splat covers the whole picture of `small_camera`."""
    splats = random_splats(count)
    return changed(splats, means=splats.means * 0.3, scales=torch.full_like(splats.scales, 2.0))


def small_camera():
    return look_at([0, -4, 1], [0, 0, 0], fov_x=0.2, width=8, height=8)


@pytest.mark.parametrize("cap", [1, 3, 11, 12, 50])
def test_a_capped_tile_shows_its_nearest_splats_alone(cap: int) -> None:
    splats = wide_splats()
    depths = splats.means @ small_camera().rotation[2].float()
    nearest = depths.argsort()[:cap]
    alone = Splats(**{name: value[nearest] for name, value in vars(splats).items()})
    rules = RasterSettings(cull="tight", transmittance_stop=0.0)
    truth = truth_of(alone, small_camera(), rules)
    rules = RasterSettings(cull="tight", transmittance_stop=0.0, tile_cap=cap)
    rendering, found = render_with_gradients(splats, small_camera(), rules)
    assert rendering.intersections == min(cap, 12)
    assert (rendering.image - truth.image).abs().max() <= 1e-6
    for name, value in found.items():
        chosen = value[nearest]
        assert (chosen - truth.gradients[name]).norm() <= 1e-5 * truth.gradients[name].norm() + 1e-7
        assert float(value.norm()) == pytest.approx(float(chosen.norm()), rel=1e-5)  # nothing for the others


@pytest.mark.parametrize("cap", [0, 1, 5, 40, 10**6])
def test_capped_lists_are_the_fronts_of_the_lists(cap: int) -> None:
    rules = RasterSettings(cull="tight")
    screen = project(dense_splats(), front_camera(), rules)
    full = intersect_tiles(screen, front_camera(), rules)
    cut = cap_tiles(full, cap)
    lists = [
        full.splats[a:b].tolist() for a, b in zip(full.starts[:-1].tolist(), full.starts[1:].tolist(), strict=True)
    ]
    expected = [items[: cap or None] for items in lists]
    assert cut.splats.tolist() == [splat for items in expected for splat in items]
    assert cut.tiles.tolist() == [tile for tile, items in enumerate(expected) for _ in items]
    assert cut.starts.diff().tolist() == [len(items) for items in expected]
    assert torch.equal(cut.radii, full.radii)


@pytest.mark.parametrize("cap", [1, 5, 40])
def test_capped_pairs_are_found_by_splat_as_well(cap: int) -> None:
    rules = RasterSettings(cull="tight")
    screen = project(dense_splats(), front_camera(), rules)
    cut = cap_tiles(intersect_tiles(screen, front_camera(), rules), cap)
    assert sorted(cut.slots.tolist()) == list(range(len(cut.splats)))
    by_splat = torch.empty_like(cut.splats)
    by_splat[cut.slots.long()] = cut.splats
    assert torch.equal(by_splat, torch.repeat_interleave(cut.order, cut.counts.long()))


def test_a_capped_crop_is_the_crop_of_the_capped_render() -> None:
    rules = RasterSettings(cull="tight", tile_cap=6)
    whole = rasterize(dense_splats(), front_camera(), rules).image
    part = rasterize(dense_splats(), front_camera().crop(13, 7, 40, 30), rules).image
    assert torch.equal(part, whole[:, 7:37, 13:53])
    assert not torch.equal(whole, rasterize(leaves(dense_splats()), front_camera(), RasterSettings(cull="tight")).image)
