"""What is left out before projection is what would have touched nothing."""

import math
from dataclasses import replace

import pytest
import torch
from raster_scenes import any_path, changed, front_camera, random_splats

from gsx.core.gaussians.splats import Splats
from gsx.core.rasterizer import RasterSettings, projection
from gsx.core.rasterizer.intersections import intersect_tiles
from gsx.core.rasterizer.projection import project
from gsx.core.rasterizer.selection import lens_of, select
from gsx.engine.backend import COMPILED
from gsx.engine.compiling import available

RULES = [
    any_path(),
    any_path(cull="tight", alpha_min=1e-6),
    any_path(cull="tight", dilation=0.1, compensate=True, tile_size=32),
    any_path(pixel="window"),
    any_path(zoomed="magnified", training_focal=20.0),
]
CAMERAS = {
    "whole": front_camera(),
    "crop": front_camera(280, 208).crop(100, 60, 48, 40),
    "whose rotation is twice one": replace(front_camera(), rotation=2 * front_camera().rotation),
    "beside its frame": front_camera(140, 104).crop(-20, 60, 90, 60),
}


def scattered() -> Splats:
    """Opaque needles, discs and balls of 1e-5 to 3 units, far to all sides of the camera, behind it and before it."""
    generator = torch.Generator().manual_seed(4)
    splats = random_splats(3000, seed=4)
    means = splats.means + 12 * (torch.rand(3000, 3, generator=generator) - 0.5)
    exponents = -5 + 5.5 * torch.rand(3000, 3, generator=generator)
    return changed(splats, means=means, scales=10**exponents, log_opacities=torch.zeros(3000))


@pytest.mark.parametrize("name", CAMERAS)
@pytest.mark.parametrize("rules", RULES)
def test_splats_left_out_have_no_radius_and_no_tile(
    rules: RasterSettings, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    splats, camera = scattered(), CAMERAS[name]
    some = project(splats, camera, rules)

    def without_edges(*given: object) -> torch.Tensor:
        numbers = lens_of(*given)  # type: ignore[arg-type]
        numbers[10:14] = torch.tensor([-math.inf, math.inf] * 2)
        return numbers

    monkeypatch.setattr(projection, "lens_of", without_edges)
    every = project(splats, camera, rules)
    left_out = torch.ones(len(splats), dtype=torch.bool).index_fill(0, some.ids, False)[every.ids]
    assert 0.15 < float(left_out.float().mean()) < 0.98
    pairs = intersect_tiles(every, camera, rules)
    assert not bool((pairs.radii > 0)[left_out].any())
    assert not bool(left_out[pairs.splats.long()].any())
    fewer = intersect_tiles(some, camera, rules)
    assert len(pairs.splats) > 100
    assert torch.equal(some.ids[fewer.splats.long()], every.ids[pairs.splats.long()])
    assert torch.equal(fewer.starts, pairs.starts)


def test_most_of_what_a_camera_does_not_show_is_left_out() -> None:
    splats = changed(scattered(), scales=torch.full((3000, 3), 0.01))
    camera = CAMERAS["crop"]
    shown = project(splats, camera, any_path())
    touching = int((intersect_tiles(shown, camera, any_path()).radii > 0).sum())
    assert touching > 20
    assert len(shown.ids) < 4 * touching  # of 1,500 before the camera; a tile around the raster stays


@pytest.mark.skipif(not available(), reason="no working compiler")
def test_the_compiled_choice_is_the_eager_one() -> None:
    splats = scattered()
    with torch.no_grad():
        splats.means[5] = torch.nan
        splats.means[6], splats.scales[6] = torch.tensor([0.0, 0.0, 0.0]), 1e30
        splats.log_opacities[7] = 1.0
    for camera in CAMERAS.values():
        intrinsics = torch.tensor([camera.fx, camera.fy, camera.cx + camera.frame.left, camera.cy + camera.frame.top])
        numbers = lens_of(camera, intrinsics.double(), 0.3, any_path())
        rows = (camera.to_camera(splats.means), *vars(splats).values(), numbers)
        good, shown = select(*rows)
        assert not good[5:8].any()
        assert torch.equal(COMPILED.kernel(select)(*rows)[0], good)
        assert torch.equal(COMPILED.kernel(select)(*rows)[1], shown)
