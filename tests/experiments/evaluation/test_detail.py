"""Detail above the Nyquist frequency of training, against sums by hand and cosines whose frequency is known."""

import math

import pytest
import torch
from torch import Tensor

from gsx.core.data.reduction import Reduction
from gsx.core.quality.metrics import bicubic
from gsx.experiments.evaluation.detail import Detail, corner, dct, details_of, explained, interior, powers


def detail_of(image: Tensor, truth: Tensor, factor: float) -> Detail | None:
    return details_of({"it": image}, truth, factor).get("it")


@pytest.mark.parametrize(
    ("values", "squares"),
    [
        ((1, 0, 0, 0), (0.25, 0.4268, 0.25, 0.0732)),
        ((1, 1, 0, 0), (1, 0.8536, 0, 0.1464)),
        ((1, -1, 1, -1), (0, 0.5858, 0, 3.4142)),
    ],
)
def test_squares_of_a_transform_by_hand(values: tuple[float, ...], squares: tuple[float, ...]) -> None:
    assert dct(torch.tensor(values, dtype=torch.float64)).square().tolist() == pytest.approx(squares, abs=5e-5)


@pytest.mark.parametrize("size", [2, 7, 64])
def test_the_transform_is_the_sum_of_cosines(size: int) -> None:
    values = torch.rand(3, size, dtype=torch.float64, generator=torch.Generator().manual_seed(size))
    n = torch.arange(size, dtype=torch.float64)
    cosines = torch.cos(math.pi * (n + 0.5) * n[:, None] / size) * math.sqrt(2 / size)
    cosines[0] /= math.sqrt(2)
    torch.testing.assert_close(dct(values), values @ cosines.T)


def test_an_impulse_has_the_energies_of_the_specification() -> None:
    """0.1 at (5, 7) of 16 x 16, split at x2: 8.2229e-6 below and 3.08396e-5 above, together the MSE."""
    impulse = torch.zeros(3, 16, 16, dtype=torch.float64)
    impulse[:, 5, 7] = 0.1
    below, whole = powers(impulse, [corner(16, 16, 2, end) for end in (1, math.inf)])
    assert (below, whole - below) == pytest.approx((8.2229e-6, 3.08396e-5), rel=1e-5)


def test_a_corner_is_as_wide_and_high_as_its_frequencies() -> None:
    """A wave across is in the corner that is wide enough, however low that is, and nowhere else."""
    n = torch.arange(20, dtype=torch.float64)
    wave = torch.cos(math.pi * (n + 0.5) * 12 / 20).expand(1, 8, 20)
    assert powers(wave, [(1, 13), (8, 12), (8, 20)]) == pytest.approx([0.5, 0, 0.5], abs=1e-12)
    assert corner(8, 20, 2, 1) == (4, 10)
    assert corner(9, 20, 2, 1.5) == (7, 15)


def grating(cycles: float, size: int = 160) -> Tensor:
    """Even about every border of the interior: so many half-waves, in it, of a DCT's own frequency."""
    window = interior(size, 2)
    inner = window.stop - window.start
    x = torch.arange(size, dtype=torch.float64) - window.start + 0.5
    wave = 0.5 + 0.3 * torch.cos(math.pi * round(2 * cycles * inner) * x / inner)
    return wave.expand(3, size, size)


def test_a_lost_grating_is_lost_where_it_is() -> None:
    """At x2 a quarter cycle per pixel is the Nyquist frequency of training; 0.3 can be recovered, 0.45 cannot."""
    for cycles, share in ((0.2, (1, 0, 0)), (0.3, (0, 1, 1)), (0.45, (0, 1, 0))):
        truth = grating(cycles)
        found = detail_of(torch.full_like(truth, 0.5), truth, 2)
        assert found is not None
        power = 0.3**2 / 2
        assert (found.low, found.high, found.recoverable) == pytest.approx([power * s for s in share], abs=1e-9)
        assert found.truth_high == pytest.approx(power * share[1], abs=1e-9)
        assert explained([found])["explained"] == pytest.approx(0.0, abs=1e-6) or share[1] == 0


def test_truth_explains_all_and_invented_detail_counts_against() -> None:
    truth = grating(0.3)
    same, opposite, half = (detail_of(image, truth, 2) for image in (truth, 1 - truth, (truth + 0.5) / 2))
    assert same
    assert opposite
    assert half
    assert explained([same])["explained"] == 1
    assert explained([same])["psnr_high"] == math.inf
    assert explained([opposite])["explained"] == pytest.approx(-3)
    assert explained([half])["explained"] == pytest.approx(0.75)
    assert explained([same, opposite])["explained"] == pytest.approx(-1)


def test_a_shifted_grating_explains_less_the_finer_it_is() -> None:
    """1 - 2 (1 - cos 2 pi f delta): a quarter pixel of f = 0.3 has 0.782."""
    size, cycles = 640, 0.3
    x = torch.arange(size, dtype=torch.float64)
    truth, shifted = (
        (0.5 + 0.3 * torch.cos(2 * math.pi * cycles * (x + delta))).expand(3, size, size) for delta in (0, 0.25)
    )
    found = detail_of(shifted, truth, 2)
    assert found
    assert explained([found])["explained"] == pytest.approx(1 - 2 * (1 - math.cos(2 * math.pi * cycles / 4)), abs=0.02)


def test_an_enlarged_picture_explains_next_to_nothing() -> None:
    """Of 1/f noise, reduced by the bicubic filter and enlarged by it: a few hundredths, at both zooms."""
    generator = torch.Generator().manual_seed(1)
    size = 256
    frequency = torch.fft.fftfreq(size)[:, None].hypot(torch.fft.rfftfreq(size)[None]).clamp_min(1 / size)
    noise = torch.fft.irfft2(torch.fft.rfft2(torch.randn(3, size, size, generator=generator)) / frequency)
    truth = (0.5 + 0.1 * noise / noise.std()).clamp(0, 1)
    for factor, most in ((2, 0.08), (4, 0.06)):
        low = Reduction(filter="bicubic").reduce(truth, factor)
        found = detail_of(bicubic(low, size, size), truth, factor)
        assert found
        assert 0 < explained([found])["explained"] < most


def test_small_pictures_and_training_pictures_have_no_figure() -> None:
    picture = torch.rand(3, 60, 60, generator=torch.Generator().manual_seed(0))
    assert detail_of(picture, picture, 1) is None
    assert detail_of(picture, picture, 4) is None
    assert isinstance(detail_of(picture, picture, 2), Detail)
    assert interior(1000, 2) == slice(20, 980)
