"""Number formats and forms of the exponent against the float64 truth: each within a bound, and not far below it."""

import functools
import math
from dataclasses import replace

import pytest
import torch
from raster_scenes import (
    SMOOTH,
    Errors,
    changed,
    errors_of,
    front_camera,
    leaves,
    random_splats,
    render_with_gradients,
    soft_splats,
    truth_of,
)

from gsx.core.gaussians.splats import Splats
from gsx.core.rasterizer import RasterSettings, rasterize
from gsx.core.rasterizer.composite import composite, make_blocks, make_tables
from gsx.core.rasterizer.grid import TileGrid
from gsx.core.rasterizer.intersections import intersect_tiles
from gsx.core.rasterizer.precision import Precision
from gsx.core.rasterizer.projection import project
from gsx.engine.compiling import available

SEEDS = range(3)
FORMS = ("squares", "direct", "expanded")


@functools.cache
def truth(seed: int, alpha_min: float = 1 / 255):
    return truth_of(random_splats(seed=seed), front_camera(), RasterSettings(cull="tight", alpha_min=alpha_min))


@functools.cache
def worst(exponent: str, evaluation: str, accumulation: str, dtype: torch.dtype = torch.float32) -> Errors:
    """Largest errors over the seeds."""
    rules = RasterSettings(cull="tight", exponent=exponent, evaluation=evaluation, accumulation=accumulation)
    found = [errors_of(changed(random_splats(seed=s), dtype=dtype), front_camera(), rules, truth(s)) for s in SEEDS]
    return Errors(max(e.largest for e in found), max(e.mean for e in found), max(e.gradient for e in found))


# exponent, evaluation, accumulation: largest and mean image error, relative error of the worst field's gradient
BOUNDS = [
    ("squares", "float32", "float32", 2e-6, 1e-7, 1.5e-6),
    ("direct", "float32", "float32", 2e-6, 1e-7, 1.5e-6),
    ("expanded", "float32", "float32", 2e-6, 1e-7, 2.5e-6),
    ("squares", "float16", "float32", 8e-3, 1e-4, 4e-3),
    ("direct", "float16", "float32", 6e-3, 7e-5, 3e-3),
    ("expanded", "float16", "float32", 1.2e-2, 2e-4, 8e-3),
    ("squares", "bfloat16", "float32", 1.2e-2, 8e-4, 2.5e-2),
    ("direct", "bfloat16", "float32", 8e-3, 6e-4, 1.2e-2),
    ("expanded", "bfloat16", "float32", 6e-2, 1.2e-3, 7e-2),
    ("squares", "float32", "float16", 2e-3, 1.5e-4, 1.5e-3),
    ("squares", "float32", "bfloat16", 1.3e-2, 1e-3, 1e-2),
    ("direct", "float16", "float16", 6e-3, 1.5e-4, 3e-3),
    ("expanded", "bfloat16", "bfloat16", 6e-2, 1.6e-3, 7e-2),
]


@pytest.mark.parametrize(("exponent", "evaluation", "accumulation", "largest", "mean", "gradient"), BOUNDS)
def test_image_and_gradients_are_within_the_bound_of_their_format(
    exponent: str, evaluation: str, accumulation: str, largest: float, mean: float, gradient: float
) -> None:
    errors = worst(exponent, evaluation, accumulation)
    assert largest / 8 < errors.largest <= largest
    assert mean / 8 < errors.mean <= mean
    assert gradient / 8 < errors.gradient <= gradient


@pytest.mark.parametrize("exponent", FORMS)
@pytest.mark.parametrize("knob", ["evaluation", "accumulation"])
def test_narrower_formats_are_worse(knob: str, exponent: str) -> None:
    def errors(format: str) -> Errors:
        return worst(exponent, **({"evaluation": "float32", "accumulation": "float32"} | {knob: format}))

    single, half, brain = errors("float32"), errors("float16"), errors("bfloat16")
    assert 100 * single.mean < half.mean < brain.mean / 3
    assert 100 * single.gradient < half.gradient < brain.gradient / 2


@pytest.mark.parametrize("evaluation", ["float16", "bfloat16"])
def test_in_16_bits_offsets_beat_squares_and_squares_the_polynomial(evaluation: str) -> None:
    direct, squares, expanded = (worst(form, evaluation, "float32") for form in ("direct", "squares", "expanded"))
    assert direct.mean < 0.9 * squares.mean < 0.8 * expanded.mean
    assert direct.gradient < 0.8 * expanded.gradient


@pytest.mark.parametrize("exponent", FORMS)
@pytest.mark.parametrize(("evaluation", "accumulation"), [("float32", "float32"), ("float64", "float64")])
def test_float64_splats_are_never_rounded_to_float32(exponent: str, evaluation: str, accumulation: str) -> None:
    errors = worst(exponent, evaluation, accumulation, torch.float64)
    assert errors.largest < 1e-14
    assert errors.gradient < 1e-12


@pytest.mark.parametrize("exponent", ["direct", "expanded"])
def test_gradients_of_the_other_forms_pass_gradcheck(exponent: str) -> None:
    rules, splats = replace(SMOOTH, exponent=exponent), soft_splats(count=4)

    def render(*values: torch.Tensor) -> torch.Tensor:
        return rasterize(Splats(**dict(zip(vars(splats), values, strict=True))), front_camera(9, 7), rules).image

    assert torch.autograd.gradcheck(render, tuple(vars(leaves(splats)).values()), eps=1e-6, atol=1e-6, rtol=1e-4)


@pytest.mark.parametrize("exponent", FORMS)
@pytest.mark.parametrize("evaluation", ["float32", "float16", "bfloat16"])
def test_absolute_gradient_is_the_same_in_every_form(exponent: str, evaluation: str) -> None:
    def probe(exponent: str, evaluation: str) -> torch.Tensor:
        rules = RasterSettings(cull="tight", exponent=exponent, evaluation=evaluation)
        rendering = rasterize(leaves(random_splats()), front_camera(), rules, absolute_gradient=True)
        rendering.image.square().mean().backward()
        return rendering.screen.absgrad.grad

    exact, found = probe("squares", "float32"), probe(exponent, evaluation)
    bound = {"float32": 1e-5, "float16": 1e-2, "bfloat16": 8e-2}[evaluation]
    assert (found - exact).norm() <= bound * exact.norm()


def blended(screen, dtype: torch.dtype, rules: RasterSettings) -> torch.Tensor:
    """The picture of given screen splats, their numbers held in `dtype`."""
    camera = front_camera()
    values = (screen.means, screen.conic_factors, screen.log_opacities, screen.channels)
    blocks = make_blocks(intersect_tiles(screen, camera, rules), rules.chunk, len(screen.ids))
    return composite(*(v.to(dtype) for v in values), blocks, TileGrid.of(camera, rules.tile_size), rules)


@pytest.mark.parametrize("exponent", FORMS)
def test_float64_work_on_float32_splats_leaves_only_the_rounding_of_the_result(exponent: str) -> None:
    # long needles thinner than a pixel, where the exponent cancels most
    rules = RasterSettings(cull="tight", exponent=exponent, dilation=1e-3)
    splats = random_splats()
    splats = changed(splats, scales=splats.scales * torch.tensor([10.0, 1e-3, 1e-3]))
    screen = project(splats, front_camera(), rules)
    truth = blended(screen, torch.float64, rules)
    wide = replace(rules, evaluation="float64", accumulation="float64")
    rounding = (blended(screen, torch.float32, wide) - truth).abs().max()
    assert rounding <= 2**-24  # half a unit in the last place below 1
    assert (blended(screen, torch.float32, rules) - truth).abs().max() > 10 * rounding


@pytest.mark.parametrize("exponent", FORMS)
def test_tf32_on_a_cpu_is_float32_to_the_bit(exponent: str) -> None:
    def picture(evaluation: str) -> torch.Tensor:
        rules = RasterSettings(exponent=exponent, evaluation=evaluation)
        rendering, found = render_with_gradients(random_splats(), front_camera(), rules)
        return torch.cat([rendering.image.detach().flatten(), *(g.flatten() for g in found.values())])

    assert torch.equal(picture("tf32"), picture("float32"))


def test_tf32_is_allowed_only_while_a_picture_is_drawn() -> None:
    tf32, plain = (Precision.of(RasterSettings(evaluation=name), torch.float32) for name in ("tf32", "float32"))
    before = torch.backends.cuda.matmul.fp32_precision
    assert before != "tf32"  # no other test has left it

    def failing() -> None:
        with tf32.products():
            assert torch.backends.cuda.matmul.fp32_precision == "tf32"
            raise KeyError

    with pytest.raises(KeyError):
        failing()
    assert torch.backends.cuda.matmul.fp32_precision == before
    with plain.products():
        assert torch.backends.cuda.matmul.fp32_precision == before


@pytest.mark.parametrize("accumulation", ["float16", "bfloat16"])
def test_small_gradients_do_not_underflow_in_16_bits(accumulation: str) -> None:
    # a power of two cannot change the relative size of anything: the gradients scale to the bit
    rules = RasterSettings(accumulation=accumulation, evaluation="float16")
    _, usual = render_with_gradients(random_splats(), front_camera(), rules)
    _, tiny = render_with_gradients(random_splats(), front_camera(), rules, factor=2.0**-40)
    for name, value in usual.items():
        assert value.abs().max() > 0
        assert torch.equal(value * 2.0**-40, tiny[name]), name


@pytest.mark.parametrize("accumulation", ["float16", "bfloat16"])
def test_channels_of_any_magnitude_fit_16_bits(accumulation: str) -> None:
    splats, units = random_splats(), torch.tensor([2.0**-30, 1.0, 2.0**30])
    rules = RasterSettings(accumulation=accumulation)
    ordinary, _ = render_with_gradients(splats, front_camera(), rules)
    scaled = changed(splats, colours=splats.colours * units)
    far, _ = render_with_gradients(scaled, front_camera(), rules)
    assert torch.equal(ordinary.image * units[:, None, None], far.image)
    live = leaves(scaled)
    image = rasterize(live, front_camera(), rules).image / units[:, None, None]
    image.square().mean().backward()
    assert all(torch.isfinite(value.grad).all() and value.grad.abs().max() > 0 for value in vars(live).values())
    empty = rasterize(changed(splats, colours=torch.zeros_like(splats.colours)), front_camera(), rules)
    assert float(empty.image.abs().max()) == 0


@pytest.mark.parametrize("path", ["eager", "compiled"] if available() else ["eager"])
@pytest.mark.parametrize("accumulation", ["float16", "bfloat16", "float64"])
def test_where_nothing_is_seen_the_picture_is_empty(accumulation: str, path: str) -> None:
    camera, rules = front_camera(20, 15), RasterSettings(accumulation=accumulation, path=path)
    behind = random_splats(seed=0)
    behind = replace(behind, means=behind.means - 1e3 * camera.rotation[2].to(behind.means))
    rendering = rasterize(behind, camera, rules)
    assert not rendering.alpha.any()
    assert rendering.image.dtype == behind.means.dtype


@pytest.mark.parametrize("evaluation", ["float16", "bfloat16", "float32", "float64"])
@pytest.mark.parametrize("accumulation", ["float16", "bfloat16", "float32", "float64"])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_every_pair_of_formats_keeps_the_dtype_of_the_splats(
    evaluation: str, accumulation: str, dtype: torch.dtype
) -> None:
    rules = RasterSettings(evaluation=evaluation, accumulation=accumulation)
    splats = leaves(random_splats(20), dtype)
    rendering = rasterize(splats, front_camera(20, 20), rules, depth=True, absolute_gradient=True, max_weight=True)
    (rendering.image.mean() + rendering.depth.mean()).backward()
    results = [rendering.image, rendering.alpha, rendering.depth, rendering.screen.max_weights]
    results += [rendering.screen.absgrad.grad, *(value.grad for value in vars(splats).values())]
    assert all(value.dtype == dtype and torch.isfinite(value).all() for value in results)


@pytest.mark.parametrize(("dilation", "tile"), [(0.3, 8), (0.3, 32), (1e-3, 8), (0.02, 16)])
def test_the_bound_of_the_exponent_holds_and_is_reached(dilation: float, tile: int) -> None:
    rules = RasterSettings(cull="tight", dilation=dilation, tile_size=tile)
    splats = random_splats(2000, size=1e-4)
    screen = project(splats, front_camera(), rules)
    pairs = intersect_tiles(screen, front_camera(), rules)
    values = (screen.means, screen.conic_factors, screen.log_opacities, screen.channels)
    tables = make_tables(*values, make_blocks(pairs, 1, len(screen.ids)), TileGrid.of(front_camera(), tile), rules)
    log_alpha, _ = tables.exponent.log_alphas(tables.rows, tables.basis)
    largest = float((tables.rows[:, :, 6:] - log_alpha).max())
    assert 0.5 * rules.largest_exponent < largest <= rules.largest_exponent


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"evaluation": "bfloat16", "alpha_max": 0.9999}, "alpha_max=0.9999 is 1 in evaluation=bfloat16"),
        ({"accumulation": "float16", "alpha_max": 0.9999}, "alpha_max=0.9999 is 1 in accumulation=float16"),
        ({"evaluation": "float16", "alpha_min": 1e-5}, "alpha_min=1e-05 is below the 6.1e-05"),
        ({"accumulation": "bfloat16", "alpha_min": 1e-3}, "an alpha below 2.0e-03 takes nothing"),
        ({"accumulation": "float16", "alpha_min": 1e-4}, "an alpha below 2.4e-04 takes nothing"),
        ({"evaluation": "float16", "dilation": 1e-5}, "float16 cannot hold ln alpha = -6.41e[+]06"),
        ({"evaluation": "half"}, "evaluation is 'half'; choose float32, float64, tf32, bfloat16, float16"),
        ({"accumulation": "tf32"}, "accumulation is 'tf32'"),
        ({"exponent": "polynomial"}, "exponent is 'polynomial'; choose squares, direct, expanded"),
        ({"transmittance_stop": 1.0}, "transmittance_stop is 1.0"),
        ({"transmittance_stop": -1e-4}, "transmittance_stop is -0.0001"),
        ({"transmittance_stop": math.nan}, "transmittance_stop is nan"),
        ({"jacobian_margin": -0.1}, "jacobian_margin is -0.1"),
        ({"tile_size": 32}, "tile_size is 32; with cull=published it must divide 16"),
        ({"tile_size": 0, "cull": "tight"}, "tile_size is 0"),
        ({"chunk": 0}, "at least 1"),
        ({"tile_cap": -1}, "tile_cap is -1"),
    ],
)
def test_settings_that_cannot_work_are_refused(fields: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        RasterSettings(**fields)
