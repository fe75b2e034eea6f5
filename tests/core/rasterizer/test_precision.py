"""Number formats against the float64 truth: errors lie within a bound, and not far below it."""

import functools
import math
from dataclasses import replace

import pytest
import torch
from raster_scenes import (
    Errors,
    any_path,
    changed,
    errors_of,
    front_camera,
    leaves,
    random_splats,
    truth_of,
)

from gsx.core.rasterizer import RasterSettings, rasterize
from gsx.core.rasterizer.composite import Composite, make_blocks
from gsx.core.rasterizer.grid import TileGrid
from gsx.core.rasterizer.intersections import intersect_tiles
from gsx.core.rasterizer.projection import project
from gsx.engine.compiling import available

SEEDS = range(3)


@functools.cache
def truth(seed: int):
    return truth_of(random_splats(seed=seed), front_camera(), any_path(cull="tight"))


def worst(evaluation: str, accumulation: str, dtype: torch.dtype = torch.float32) -> Errors:
    """Largest errors over the seeds."""
    rules = any_path(cull="tight", evaluation=evaluation, accumulation=accumulation)
    found = [errors_of(changed(random_splats(seed=s), dtype=dtype), front_camera(), rules, truth(s)) for s in SEEDS]
    return Errors(max(e.largest for e in found), max(e.mean for e in found), max(e.gradient for e in found))


# evaluation, accumulation: largest and mean image error, relative error of the worst field's gradient
BOUNDS = [
    ("float32", "float32", 2e-6, 1e-7, 1.5e-6),
]


@pytest.mark.parametrize(("evaluation", "accumulation", "largest", "mean", "gradient"), BOUNDS)
def test_image_and_gradients_are_within_the_bound_of_their_format(
    evaluation: str, accumulation: str, largest: float, mean: float, gradient: float
) -> None:
    errors = worst(evaluation, accumulation)
    assert largest / 8 < errors.largest <= largest
    assert mean / 8 < errors.mean <= mean
    assert gradient / 8 < errors.gradient <= gradient


@pytest.mark.parametrize("format", ["float32", "float64"])
def test_float64_splats_are_never_rounded_to_float32(format: str) -> None:
    errors = worst(format, format, torch.float64)
    assert errors.largest < 1e-14
    assert errors.gradient < 1e-12


def blended(screen, dtype: torch.dtype, rules: RasterSettings) -> torch.Tensor:
    """The picture of given screen splats, their numbers held in `dtype`."""
    camera = front_camera()
    values = (screen.means, screen.conic_factors, screen.log_opacities, screen.channels)
    blocks = make_blocks(intersect_tiles(screen, camera, rules), rules.chunk, len(screen.ids))
    grid = TileGrid.of(camera, rules.tile_size)
    return Composite.apply(*(v.to(dtype) for v in values), None, blocks, grid, rules, None)


def test_float64_work_on_float32_splats_leaves_only_the_rounding_of_the_result() -> None:
    # long needles thinner than a pixel, where the exponent cancels most
    rules = any_path(cull="tight", dilation=1e-3)
    splats = random_splats()
    splats = changed(splats, scales=splats.scales * torch.tensor([10.0, 1e-3, 1e-3]))
    screen = project(splats, front_camera(), rules)
    truth = blended(screen, torch.float64, rules)
    wide = replace(rules, evaluation="float64", accumulation="float64")
    rounding = (blended(screen, torch.float32, wide) - truth).abs().max()
    assert rounding <= 2**-24  # half a unit in the last place below 1
    assert (blended(screen, torch.float32, rules) - truth).abs().max() > 10 * rounding


@pytest.mark.parametrize("path", ["eager", "compiled"] if available() else ["eager"])
@pytest.mark.parametrize("accumulation", ["float32", "float64"])
def test_where_nothing_is_seen_the_picture_is_empty(accumulation: str, path: str) -> None:
    camera, rules = front_camera(20, 15), any_path(accumulation=accumulation, path=path)
    behind = random_splats(seed=0)
    behind = replace(behind, means=behind.means - 1e3 * camera.rotation[2].to(behind.means))
    rendering = rasterize(behind, camera, rules)
    assert not rendering.alpha.any()
    assert rendering.image.dtype == behind.means.dtype


@pytest.mark.parametrize("evaluation", ["float32", "float64"])
@pytest.mark.parametrize("accumulation", ["float32", "float64"])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_every_pair_of_formats_keeps_the_dtype_of_the_splats(
    evaluation: str, accumulation: str, dtype: torch.dtype
) -> None:
    rules = any_path(evaluation=evaluation, accumulation=accumulation)
    splats = leaves(random_splats(20), dtype)
    rendering = rasterize(splats, front_camera(20, 20), rules, depth=True, absolute_gradient=True, max_weight=True)
    (rendering.image.mean() + rendering.depth.mean()).backward()
    results = [rendering.image, rendering.alpha, rendering.depth, rendering.screen.max_weights]
    results += [rendering.screen.absgrad.grad, *(value.grad for value in vars(splats).values())]
    assert all(value.dtype == dtype and torch.isfinite(value).all() for value in results)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"alpha_max": 1 - 1e-8}, "alpha_max=0.99999999 is 1 in evaluation=float32"),
        ({"evaluation": "float64", "alpha_max": 1 - 1e-8}, "alpha_max=0.99999999 is 1 in accumulation=float32"),
        ({"evaluation": "bfloat16"}, "evaluation is 'bfloat16'; choose float32, float64"),
        ({"accumulation": "tf32"}, "accumulation is 'tf32'"),
        ({"transmittance_stop": 1.0}, "transmittance_stop is 1.0"),
        ({"transmittance_stop": -1e-4}, "transmittance_stop is -0.0001"),
        ({"transmittance_stop": math.nan}, "transmittance_stop is nan"),
        ({"jacobian_margin": -0.1}, "jacobian_margin is -0.1"),
        ({"tile_size": 32}, "tile_size is 32; with cull=published it must divide 16"),
        ({"tile_size": 0, "cull": "tight"}, "tile_size is 0"),
        ({"chunk": 0}, "chunk is 0; give a number from 1"),
        ({"tile_cap": -1}, "tile_cap is -1"),
    ],
)
def test_settings_that_cannot_work_are_refused(fields: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        any_path(**fields)
