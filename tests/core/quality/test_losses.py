"""The photometric loss against explicit windows in float64 numpy, hand-worked values and finite differences."""

import math

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.autograd import gradcheck

from gsx.core.backend import EAGER, Backend
from gsx.core.quality.losses import blur, moments_of, photometric, ssim_map
from gsx.engine.backend import COMPILED
from gsx.engine.compiling import available

needs_compiler = pytest.mark.skipif(not available(), reason="no working compiler")
OFFSET = np.arange(11) - 5
WEIGHTS = np.exp(-(OFFSET[:, None] ** 2 + OFFSET[None] ** 2) / (2 * 1.5**2))
WEIGHTS /= WEIGHTS.sum()


def pictures(*shape: int, seed: int = 0) -> tuple[Tensor, Tensor]:
    g = torch.Generator().manual_seed(seed)
    first = torch.rand(shape, generator=g, dtype=torch.float64)
    return first, (first + 0.2 * torch.randn(shape, generator=g, dtype=torch.float64)).clamp(0, 1)


def ssim_by_windows(image: Tensor, target: Tensor) -> np.ndarray:
    """SSIM of every 11 x 11 window of the zero-padded pictures, one window at a time."""
    x, y = (np.pad(picture.double().numpy(), ((0, 0), (5, 5), (5, 5))) for picture in (image, target))
    result = np.empty(image.shape)
    for channel, row, column in np.ndindex(*image.shape):
        a, b = (picture[channel, row : row + 11, column : column + 11] for picture in (x, y))
        mean_a, mean_b = (WEIGHTS * a).sum(), (WEIGHTS * b).sum()
        var_a, var_b = (WEIGHTS * (a * a)).sum() - mean_a**2, (WEIGHTS * (b * b)).sum() - mean_b**2
        covariance = (WEIGHTS * (a * b)).sum() - mean_a * mean_b
        above = (2 * mean_a * mean_b + 1e-4) * (2 * covariance + 9e-4)
        result[channel, row, column] = above / ((mean_a**2 + mean_b**2 + 1e-4) * (var_a + var_b + 9e-4))
    return result


def test_window_is_the_normalised_gaussian() -> None:
    point = torch.zeros(1, 23, 23, dtype=torch.float64)
    point[0, 11, 11] = 1
    spread = blur(point, 5)[0]
    assert float(spread.sum()) == pytest.approx(1, abs=1e-14)
    ratios = [math.exp(-(k**2) / 4.5) for k in (6, 5, 4, 3, 2, 1, 0, 1, 2, 3, 4, 5, 6)]
    ratios[0] = ratios[-1] = 0.0  # the window ends at 5
    np.testing.assert_allclose(spread[11, 5:18] / spread[11, 11], ratios, rtol=1e-13)
    np.testing.assert_allclose(spread[5:18, 11] / spread[11, 11], ratios, rtol=1e-13)


def test_blur_of_a_point_is_the_window_cut_at_the_border() -> None:
    point = torch.zeros(2, 9, 13, dtype=torch.float64)
    point[0, 1, 6] = 1.0
    expected = np.zeros((2, 9, 13))
    expected[0, :7, 1:12] = WEIGHTS[4:, :]
    np.testing.assert_allclose(blur(point, 5), expected, atol=1e-16)


@pytest.mark.parametrize("shape", [(2, 12, 15), (3, 4, 3), (1, 1, 1)])
def test_map_equals_explicit_windows_zero_padded(shape: tuple[int, int, int]) -> None:
    image, target = pictures(*shape)
    np.testing.assert_allclose(ssim_map(image, target), ssim_by_windows(image, target), rtol=1e-9, atol=1e-12)
    single = ssim_map(image.float(), target.float())
    np.testing.assert_allclose(single, ssim_by_windows(image.float(), target.float()), atol=2e-4)


def test_flat_pictures_worked_by_hand() -> None:
    ssim = ssim_map(torch.full((1, 23, 23), 0.5, dtype=torch.float64), torch.full((1, 23, 23), 0.25).double())
    # inside, variances vanish: (2 * 0.125 + 1e-4) / (0.3125 + 1e-4)
    assert float(ssim[0, 11, 11]) == pytest.approx(0.2501 / 0.3126, rel=1e-9)
    # at a corner a quarter of the window plus its axes holds the picture: share s = (0.5 + g0 / 2)^2
    share = (0.5 + math.exp(0) / np.exp(-(OFFSET**2) / 4.5).sum() / 2) ** 2
    a, b, rest = 0.5 * share, 0.25 * share, share * (1 - share)
    expected = (2 * a * b + 1e-4) / (a * a + b * b + 1e-4) * (0.25 * rest + 9e-4) / (0.3125 * rest + 9e-4)
    assert float(ssim[0, 0, 0]) == pytest.approx(expected, rel=1e-9)


def test_equal_pictures_lose_nothing() -> None:
    image, _ = pictures(3, 14, 12)
    torch.testing.assert_close(ssim_map(image, image), torch.ones_like(image), rtol=0, atol=1e-12)
    assert float(photometric(image, image, 0.2)) == pytest.approx(0, abs=1e-12)


@pytest.mark.parametrize("weight", [0.0, 0.2, 1.0])
def test_loss_is_l1_and_one_minus_ssim(weight: float) -> None:
    image, target = pictures(3, 13, 9)
    absolute = np.abs(image.numpy() - target.numpy()).mean()
    expected = (1 - weight) * absolute + weight * (1 - ssim_by_windows(image, target).mean())
    assert float(photometric(image, target, weight)) == pytest.approx(expected, rel=1e-10)


def test_loss_is_a_mean_not_a_sum() -> None:
    image, target = torch.full((3, 20, 30), 0.75), torch.full((3, 20, 30), 0.5)
    assert float(photometric(image, target, 0.0)) == pytest.approx(0.25, rel=1e-6)


def test_the_blur_is_its_own_adjoint() -> None:
    first, second = pictures(2, 7, 12)
    assert float((blur(first, 5) * second).sum()) == pytest.approx(float((first * blur(second, 5)).sum()), rel=1e-12)


@pytest.mark.parametrize("backend", [EAGER, pytest.param(COMPILED, marks=needs_compiler)])
def test_gradient_of_the_loss(backend: Backend) -> None:
    image, target = pictures(3, 8, 6)
    image.requires_grad_()
    for weight in (0.2, 1.0):
        assert gradcheck(lambda picture: photometric(picture, target, weight, backend), (image,))  # noqa: B023


@pytest.mark.parametrize("backend", [EAGER, pytest.param(COMPILED, marks=needs_compiler)])
def test_what_is_known_of_a_target_is_not_found_anew(backend: Backend) -> None:
    image, target = (picture.float() for picture in pictures(3, 14, 9))
    known = moments_of(target, backend=backend)
    assert torch.equal(photometric(image, target, 0.2, backend, known), photometric(image, target, 0.2, backend))
    other = moments_of(1 - target, backend=backend)
    assert not torch.equal(photometric(image, target, 0.2, backend, other), photometric(image, target, 0.2, backend))


@needs_compiler
def test_the_compiled_loss_is_that_of_the_formulas_for_pictures_of_several_sizes() -> None:
    for shape in ((3, 14, 9), (3, 30, 41), (3, 5, 70)):
        image, target = (picture.float() for picture in pictures(*shape))
        found = []
        for backend in (EAGER, COMPILED):
            moved = image.clone().requires_grad_()
            loss = photometric(moved, target, 0.2, backend)
            loss.backward()
            found.append((loss.detach(), moved.grad))
        torch.testing.assert_close(found[1][0], found[0][0], rtol=1e-6, atol=0)
        torch.testing.assert_close(found[1][1], found[0][1], rtol=1e-4, atol=1e-6 / image.numel())
