"""Gaussian Blending against numbers worked by hand, integrals by quadrature, and renders through much finer pixels."""

import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from raster_scenes import any_path, changed, front_camera, gradients, leaves, random_splats, soft_splats
from tiny import LIGHT, tiny_run
from torch import Tensor

from gsx.core.data.camera import Camera, look_at
from gsx.core.files import read_json
from gsx.core.gaussians.splats import Splats
from gsx.core.rasterizer import rasterize, rasterize_tiled
from gsx.engine.compiling import available
from gsx.engine.pixel_windows import Met as MetSplat
from gsx.engine.pixel_windows import axes, behind_splat, splat_gradients

WINDOW = any_path(pixel="window", compensate=True, dilation=0.1)
RULES = (1 / 256, 0.99, 1e-4)
Matrix = tuple[float, float, float]


def fresh(dtype: torch.dtype = torch.float64) -> tuple[Tensor, ...]:
    """One pixel, centre at the origin."""
    one, zero = torch.ones(1, 1, dtype=dtype), torch.zeros(1, 1, dtype=dtype)
    return one, zero, zero, one, one


def row_of(mean: tuple[float, float], covariance: Matrix, opacity: float) -> Tensor:
    xx, xy, yy = covariance
    half_inverse = torch.tensor([[1 / math.sqrt(2 * (xx * yy - xy * xy) / yy), 0.0, 0.0]], dtype=torch.float64)
    shape = axes(torch.tensor([covariance], dtype=torch.float64), half_inverse)
    ends = torch.tensor([[*mean]], dtype=torch.float64), torch.tensor([[opacity]], dtype=torch.float64)
    return torch.cat([ends[0], shape, ends[1]], 1)


def blended(*splats: tuple[tuple[float, float], Matrix, float]) -> tuple[list[float], list[float]]:
    """(mean alphas, window behind all: light, x, y, wide, high)."""
    window, alphas = fresh(), []
    for mean, covariance, opacity in splats:
        alpha, *window = behind_splat(*window, row_of(mean, covariance, opacity), *RULES)
        alphas.append(float(alpha))
    return alphas, [float(part) for part in window]


A = ((0.0, 0.0), (0.25, 0.0, 0.16), 0.8)
B = ((-0.5, 0.0), (0.0625, 0.0, 1.0), 0.9)
G = ((0.4, 0.0), (0.0625, 0.0, 1.0), 0.9)
H = (
    ((-0.5, 0.1), (0.0625, 0.0, 1.0), 0.9),
    ((0.4, -0.2), (0.3, 0.0, 0.1), 0.8),
    ((0.1, 0.2), (0.2, 0.0, 0.5), 0.6),
)


@pytest.mark.parametrize(
    ("splats", "alphas", "window"),
    [
        ((A,), (0.5412964,), (0.4587036, 0, 0, 1.072112, 1.107291)),
        ((B,), (0.2706565,), (0.7293435, 0.1115452, 0, 0.8476494, 1.0060916)),
        ((B, B), (0.2706565, 0.1444827), (0.6239659, 0.158704, 0, 0.791199, 1.008919)),
        ((((0.2, -0.1), (0.5, 0.2, 0.3), 0.7),), (0.4920257,), (0.5079743, -0.049506, 0.052691, 1.023312, 1.038368)),
        ((((3.0, 1.0), (400.0, 0.0, 300.0), 0.5),), (0.4935832,), (0.5064168, 0, 0, 1, 1)),
        ((B, G), (0.2706565, 0.4492060), (0.4017180, -0.025878, 0, 0.713001, 1.019673)),
        (H, (0.2694152, 0.4189799, 0.4701253), (0.2249236, 0.066143, 0.061302, 0.899172, 1.067410)),
    ],
)
def test_numbers_worked_by_hand(splats, alphas: tuple[float, ...], window: tuple[float, ...]) -> None:
    found, behind = blended(*splats)
    assert found == pytest.approx(alphas, abs=2e-6)
    assert behind == pytest.approx(window, abs=2e-6)


def by_quadrature(mean: tuple[float, float], covariance: Matrix, opacity: float, window: list[float]) -> list[float]:
    """Alpha and the window behind, from sums over 400 x 400 points of the window turned onto the splat's axes."""
    light, x, y, wide, high = window
    matrix = torch.tensor([[covariance[0], covariance[1]], [covariance[1], covariance[2]]], dtype=torch.float64)
    _, vectors = torch.linalg.eigh(matrix)
    first = vectors[:, 1]
    sides = (wide, high) if abs(first[0]) > abs(first[1]) else (high, wide)
    line = (torch.arange(400, dtype=torch.float64) + 0.5) / 400 - 0.5
    s, t = torch.meshgrid(line * sides[0], line * sides[1], indexing="ij")
    places = torch.tensor([x, y]).double() + s[..., None] * first + t[..., None] * vectors[:, 0]
    offset = places - torch.tensor(mean, dtype=torch.float64)
    alpha = opacity * torch.exp(-0.5 * ((offset @ torch.linalg.inv(matrix)) * offset).sum(-1))
    left = (1 - alpha) / (1 - alpha).sum()
    middle = (left[..., None] * places).sum((0, 1))
    away = places - middle
    spread = [float((left * (away @ axis) ** 2).sum() * 12) ** 0.5 for axis in (first, vectors[:, 0])]
    if abs(first[0]) <= abs(first[1]):
        spread.reverse()
    return [float(alpha.mean()), light * (1 - float(alpha.mean())), *middle.tolist(), *spread]


def test_windows_are_those_of_quadrature() -> None:
    """Five stacks of five random splats: each step from the window that the steps before have left."""
    g = torch.Generator().manual_seed(3)
    for _ in range(5):
        window = fresh()
        for _ in range(5):
            long, short = (0.3 + torch.rand(2, generator=g)).tolist()
            angle, opacity = float(torch.rand(1, generator=g)) * 3.1, 0.2 + 0.6 * float(torch.rand(1, generator=g))
            c, s = math.cos(angle), math.sin(angle)
            covariance = (long * c * c + short * s * s, (long - short) * c * s, long * s * s + short * c * c)
            mean = tuple((torch.rand(2, generator=g) - 0.5).tolist())
            truth = by_quadrature(mean, covariance, opacity, [float(part) for part in window])
            alpha, *window = behind_splat(*window, row_of(mean, covariance, opacity), *RULES)
            assert [float(alpha), *map(float, window)] == pytest.approx(truth, abs=3e-5)


def test_a_splat_far_away_changes_nothing_and_single_precision_says_the_same() -> None:
    far = row_of((40.0, 3.0), (0.25, 0.0, 0.16), 0.8)
    alpha, *window = behind_splat(*fresh(), far, *RULES)
    assert float(alpha) == 0
    assert all(torch.equal(a, b) for a, b in zip(window, fresh(), strict=True))
    exact, single = fresh(), fresh(torch.float32)
    for splat in H:
        _, *exact = behind_splat(*exact, row_of(*splat), *RULES)
        _, *single = behind_splat(*single, row_of(*splat).float(), *RULES)
    for a, b in zip(exact, single, strict=True):
        assert float(b) == pytest.approx(float(a), abs=1e-5)


def test_gradients_of_one_splat_are_those_worked_by_hand() -> None:
    """d alpha / d opacity, mean and standard deviations of A and B; covariances by the heat equation."""
    for splat, by_opacity, by_x, sigmas in (
        (A, 0.6766205, 0.0, (0.3151699, 0.5697743)),
        (B, 0.2706565 / 0.9, 0.8635756, None),
    ):
        (_, (xx, _, yy), opacity), row = splat, row_of(*splat)
        alpha, *_ = behind_splat(*fresh(), row, *RULES)
        zero = torch.zeros(1, dtype=torch.long)
        met = MetSplat(zero, zero, zero, row, fresh(), alpha)
        found = splat_gradients(met, torch.ones_like(alpha))[0, 0].tolist()
        assert found[5] / opacity == pytest.approx(by_opacity, abs=1e-6)
        assert found[0] == pytest.approx(by_x, abs=1e-6)
        if sigmas:
            assert [2 * found[2] * math.sqrt(xx), 2 * found[4] * math.sqrt(yy)] == pytest.approx(sigmas, abs=1e-6)


@pytest.mark.parametrize(
    ("covariance", "mean", "gradient"),
    [
        ((0.5, 0.2, 0.3), (0.2, -0.3), (0.347170, -0.912083, 0.788218)),
        ((0.4001, 0.00005, 0.4), (0.2, -0.3), (0.229643, -0.173095, 0.299823)),
        ((0.05, 0.01, 0.03), (0.3, 0.2), (1.4377, -1.4551, 2.9230)),
    ],
)
def test_covariance_gradients_have_no_singularity(covariance: Matrix, mean: tuple[float, float], gradient) -> None:
    row, zero = row_of(mean, covariance, 1.0), torch.zeros(1, dtype=torch.long)
    met = MetSplat(zero, zero, zero, row, fresh(), fresh()[0])
    found = splat_gradients(met, torch.ones(1, 1, dtype=torch.float64))[0, 0, 2:5].tolist()
    assert found == pytest.approx(gradient, rel=4e-5)


def small_splats(size: float = 0.01) -> Splats:
    splats = random_splats(300, seed=5, size=size)
    return changed(splats, log_opacities=splats.log_opacities / 4)


def through_fine_pixels(splats: Splats, camera: Camera, times: int) -> Tensor:
    """Point samples without any dilation to speak of, averaged."""
    fine = replace(WINDOW, pixel="sample", compensate=False, dilation=1e-6, cull="tight", alpha_min=1e-4)
    image = rasterize(splats, camera.zoom(times), fine).image
    return torch.nn.functional.avg_pool2d(image, times)


def test_pictures_are_nearer_to_much_finer_ones_than_those_of_samples() -> None:
    splats, camera = small_splats(0.05), front_camera(48, 36)
    truth = through_fine_pixels(splats, camera, 8)
    error = {
        pixel: float((rasterize(splats, camera, replace(WINDOW, pixel=pixel)).image - truth).square().mean().sqrt())
        for pixel in ("window", "sample")
    }
    assert error["window"] < 0.5 * error["sample"]


def test_a_plain_model_keeps_its_dilation_but_for_the_pixel() -> None:
    """Splats much larger than a pixel look as samples draw them; small ones keep the mass that dilation gave them."""
    camera = front_camera(48, 36)
    plain = any_path(pixel="window")
    soft = changed(soft_splats(), dtype=torch.float32)
    for splats, near in ((soft, 0.003), (small_splats(), 0.02)):
        sampled = rasterize(splats, camera, any_path(cull="tight")).image
        assert (rasterize(splats, camera, plain).image - sampled).abs().mean() < near


def test_pieces_and_crops_are_the_picture_bit_for_bit() -> None:
    splats, camera = small_splats(), front_camera()
    whole = rasterize(splats, camera, WINDOW, depth=True)
    assert torch.equal(rasterize(splats, camera.crop(17, 9, 30, 25), WINDOW).image, whole.image[:, 9:34, 17:47])
    tiled = rasterize_tiled(splats, camera, WINDOW, pixels=500, depth=True)
    assert torch.equal(tiled.image, whole.image)
    assert torch.equal(tiled.depth, whole.depth)
    other_tiles = rasterize(splats, camera, replace(WINDOW, tile_size=16)).image
    assert (other_tiles - whole.image).abs().max() <= 2e-3  # light that a grown window has beyond the reach


def test_weights_and_light_left_make_one() -> None:
    splats, white = small_splats(), torch.ones(3)
    colourless = changed(splats, colours=torch.ones_like(splats.colours))
    rendering = rasterize(colourless, front_camera(), WINDOW, background=white, max_weight=True)
    assert (rendering.image - 1).abs().max() <= 1e-6
    most = rendering.screen.max_weights
    assert 0 < float(most.max()) <= 0.99


def test_formats_are_those_that_are_asked_for() -> None:
    """What blending rounds, seen by one splat after the other: in float64 next to nothing of it is left."""
    single, camera = changed(soft_splats(count=60), dtype=torch.float32), front_camera()
    exact = rasterize(changed(single, dtype=torch.float64), camera, WINDOW).image
    off = [
        float((rasterize(single, camera, replace(WINDOW, evaluation=form)).image - exact).abs().mean())
        for form in ("float32", "float64")
    ]
    assert off[1] < off[0] / 2, off
    rendering = rasterize(single, camera, replace(WINDOW, evaluation="float64"), max_weight=True)
    assert rendering.image.dtype == rendering.screen.max_weights.dtype == torch.float32


def test_gradients_of_the_last_splat_are_finite_differences() -> None:
    """What a splat does to windows behind it is left out as published; nothing is behind the last one."""
    splats, camera = soft_splats(count=2), front_camera(20, 16)
    rules = replace(WINDOW, alpha_min=1e-9, transmittance_stop=0.0)
    depths = camera.to_camera(splats.means)[:, 2]
    last = int(depths.argmax())
    weight = torch.rand(3, 16, 20, generator=torch.Generator().manual_seed(1)).double()

    def loss(of: Splats) -> Tensor:
        return (rasterize(of, camera, rules).image * weight).sum()

    live = leaves(splats)
    loss(live).backward()
    for name, found in gradients(live).items():
        if name == "quats":  # the pixel's square is turned with the splat, which the heat form rightly leaves out
            continue
        for place in range(min(3, found[last].numel())):
            values, step = getattr(splats, name), 1e-5
            ahead, back = values.clone(), values.clone()
            ahead[last].view(-1)[place] += step
            back[last].view(-1)[place] -= step
            with torch.no_grad():
                slope = (loss(changed(splats, **{name: ahead})) - loss(changed(splats, **{name: back}))) / (2 * step)
            tolerance = 1e-6 if name in ("colours", "log_opacities") else 0.02
            assert float(found[last].view(-1)[place]) == pytest.approx(float(slope), rel=tolerance, abs=1e-3), name


def test_published_gradients_through_two_splats() -> None:
    """Check G: one pixel, the first splat of colour 1, the second of colour 0.3, no background."""
    camera = look_at([0, 0, 0], [0, 1, 0], fov_x=2 * math.atan(0.5), width=1, height=1)
    # at depth z a unit of the scene is 1 / z px, and the axis meets the middle of the only pixel
    ones = torch.ones(2, dtype=torch.float64)
    depth = torch.tensor([1000.0, 1001.0], dtype=torch.float64)
    means = torch.stack([torch.tensor([-0.5, 0.4]).double() * depth, depth, 0 * ones], 1)
    scales = torch.stack([0.25 * depth, 1e-3 * ones, depth], 1)
    splats = Splats(
        means=means,
        scales=scales,
        quats=torch.tensor([[1.0, 0, 0, 0]] * 2).double(),
        log_opacities=math.log(0.9) * ones,
        colours=torch.tensor([[1.0], [0.3]]).double(),
    )
    live = leaves(splats)
    image = rasterize(live, camera, replace(WINDOW, jacobian_margin=10.0)).image
    assert float(image.detach()) == pytest.approx(0.3689442, abs=2e-5)
    image.sum().backward()
    assert float(live.log_opacities.grad[0]) == pytest.approx(0.2602026 * 0.9, abs=2e-5)
    assert float(live.means.grad[0, 0] * depth[0]) == pytest.approx(0.7471986, abs=1e-4)


@pytest.mark.skipif(not available(), reason="no working compiler on this machine")
def test_the_compiled_step_draws_the_same() -> None:
    splats, camera = small_splats(), front_camera(48, 36)
    eager = rasterize(splats, camera, WINDOW).image
    compiled = rasterize(splats, camera, replace(WINDOW, path="compiled", unrolled=1)).image
    assert (compiled - eager).abs().max() <= 2e-5


def test_a_run_is_trained_and_looked_at_by_windows(tmp_path: Path) -> None:
    words = [*LIGHT, "iterations=4", "scene.points=60", "rasterizer=eager", "backbone=mip_splatting"]
    found = {}
    for pixel in ("sample", "window"):
        tiny_run(tmp_path / pixel, [*words, f"rasterizer.pixel={pixel}"])
        found[pixel] = read_json(tmp_path / pixel / "evaluation.json")
        assert found[pixel]["settings"]["pixel"] == pixel
    assert found["window"]["psnr"] == pytest.approx(found["sample"]["psnr"], abs=0.5)
    assert found["window"]["psnr"] != found["sample"]["psnr"]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"dilation": 0.05}, "above 1/12 px"),
        ({"pixel": "square"}, "rasterizer.pixel is 'square'; choose sample, window"),
    ],
)
def test_windows_that_mean_nothing_are_refused(changes: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        any_path(**({"pixel": "window"} | changes))
