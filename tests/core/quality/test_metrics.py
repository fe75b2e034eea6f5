"""Image metrics against hand-worked values, torchmetrics and pytorch-msssim."""

import math

import numpy as np
import pytest
import pytorch_msssim
import torch
from torch import Tensor

from gsx.core.quality import metrics
from gsx.core.quality.metrics import ROUNDINGS, SSIM_VARIANTS, bicubic, psnr, quantise, ssim


def pictures(height: int, width: int, noise: float = 0.15, seed: int = 0) -> tuple[Tensor, Tensor]:
    g = torch.Generator().manual_seed(seed)
    image = torch.rand(3, height, width, generator=g)
    return image, (image + noise * torch.randn(3, height, width, generator=g)).clamp(0, 1)


@pytest.mark.parametrize(("error", "decibels"), [(0.1, 20.0), (0.01, 40.0), (1.0, 0.0), (1 / 255, 48.130804)])
def test_psnr_of_a_uniform_error(error: float, decibels: float) -> None:
    image = torch.zeros(3, 4, 5, dtype=torch.float64)
    assert psnr(image, image + error) == pytest.approx(decibels, abs=1e-6)


def test_psnr_pools_pixels_and_channels_before_the_logarithm() -> None:
    image, target = torch.zeros(3, 2, 2), torch.zeros(3, 2, 2)
    target[0, 0, 0] = 0.6  # MSE 0.36 / 12 = 0.03
    assert psnr(image, target) == pytest.approx(-10 * math.log10(0.03), abs=1e-5)


def test_psnr_of_equal_images_is_infinite() -> None:
    image, _ = pictures(3, 4)
    assert psnr(image, image) == math.inf


def test_of_nothing_there_is_no_figure() -> None:
    picture, none = (
        torch.rand(3, 20, 20, generator=torch.Generator().manual_seed(0)),
        torch.zeros(20, 20, dtype=torch.bool),
    )
    assert math.isnan(psnr(picture, 1 - picture, none))
    assert math.isnan(psnr(picture * math.nan, picture))
    rim = none.clone()
    rim[:4] = True  # of no whole window the middle
    assert math.isnan(ssim(picture, 1 - picture, "inria", none))
    assert math.isnan(ssim(picture, 1 - picture, "valid", rim))


def test_psnr_agrees_with_torchmetrics() -> None:
    from torchmetrics.functional.image import peak_signal_noise_ratio  # takes seconds to import

    image, target = pictures(40, 30)
    assert psnr(image, target) == pytest.approx(float(peak_signal_noise_ratio(image, target, data_range=1.0)), abs=1e-4)


@pytest.mark.parametrize(("height", "width"), [(32, 40), (11, 11), (11, 60), (37, 12)])
@pytest.mark.parametrize("noise", [0.02, 0.4])
def test_whole_windows_agree_with_pytorch_msssim(height: int, width: int, noise: float) -> None:
    image, target = (picture.double() for picture in pictures(height, width, noise))
    theirs = pytorch_msssim.ssim(image[None], target[None], data_range=1.0, win_size=11, win_sigma=1.5)
    assert ssim(image, target, "valid") == pytest.approx(float(theirs), abs=1e-6)


@pytest.mark.parametrize("pixels", [1, 100, 400, 1 << 16])
def test_strips_of_any_height_add_up_to_the_picture(pixels: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(metrics, "STRIP_PIXELS", pixels)
    image, target = (picture.double() for picture in pictures(33, 40))
    theirs = pytorch_msssim.ssim(image[None], target[None], data_range=1.0, win_size=11, win_sigma=1.5)
    assert ssim(image, target, "valid") == pytest.approx(float(theirs), abs=1e-6)


@pytest.mark.parametrize(("height", "width"), [(32, 40), (8, 20), (6, 6)])
@pytest.mark.parametrize("noise", [0.02, 0.4])
def test_torchmetrics_variant_agrees_with_torchmetrics(height: int, width: int, noise: float) -> None:
    from torchmetrics.functional.image import structural_similarity_index_measure

    image, target = (picture.double() for picture in pictures(height, width, noise))
    theirs = structural_similarity_index_measure(image[None], target[None], data_range=1.0, sigma=1.5)
    assert ssim(image, target, "torchmetrics") == pytest.approx(float(theirs), abs=1e-6)


def test_zero_padded_variant_is_whole_windows_of_the_padded_pictures() -> None:
    image, target = (picture.double() for picture in pictures(20, 17))
    padded = (torch.nn.functional.pad(picture, (5, 5, 5, 5))[None] for picture in (image, target))
    theirs = pytorch_msssim.ssim(*padded, data_range=1.0, win_size=11, win_sigma=1.5)
    assert ssim(image, target, "inria") == pytest.approx(float(theirs), abs=1e-6)
    assert ssim(image, target, "inria") != pytest.approx(ssim(image, target, "torchmetrics"), abs=1e-3)


@pytest.mark.parametrize(("height", "width"), [(3, 40), (10, 10), (40, 1), (10, 11)])
@pytest.mark.parametrize("variant", SSIM_VARIANTS)
def test_pictures_smaller_than_a_window(height: int, width: int, variant: str) -> None:
    image, target = pictures(height, width)
    assert ssim(image, image, variant) == pytest.approx(1, abs=1e-6)
    assert -1 < ssim(image, target, variant) < 0.999


def test_small_pictures_are_extended_by_their_border_to_one_window() -> None:
    image, target = (picture.double() for picture in pictures(8, 20))
    wider = [np.pad(picture.numpy(), ((0, 0), (1, 2), (0, 0)), mode="edge")[None] for picture in (image, target)]
    theirs = pytorch_msssim.ssim(*map(torch.from_numpy, wider), data_range=1.0, win_size=11, win_sigma=1.5)
    assert ssim(image, target, "valid") == pytest.approx(float(theirs), abs=1e-6)


def test_unknown_variant_names_the_known_ones() -> None:
    image, target = pictures(12, 12)
    with pytest.raises(ValueError, match="'gaussian' is unknown; choose from inria, torchmetrics, valid"):
        ssim(image, target, "gaussian")


def test_quantise_rounds_to_the_nearest_byte_and_clamps() -> None:
    values = torch.tensor([-0.3, 0.0, 0.4 / 255, 0.6 / 255, 127.4 / 255, 127.6 / 255, 254.6 / 255, 1.0, 1.7])
    expected = torch.tensor([0.0, 0, 0, 1, 127, 128, 255, 255, 255]) / 255
    assert torch.equal(quantise(values.view(1, 1, -1)), expected.view(1, 1, -1))


def test_quantise_truncates_and_clamps_on_request() -> None:
    values = torch.tensor([-0.3, 0.0, 0.4 / 255, 0.9 / 255, 127.4 / 255, 127.9 / 255, 254.9 / 255, 1.0, 1.7])
    expected = torch.tensor([0.0, 0, 0, 0, 127, 127, 254, 255, 255]) / 255
    assert torch.equal(quantise(values.view(1, 1, -1), "down"), expected.view(1, 1, -1))


@pytest.mark.parametrize("rounding", ROUNDINGS)
def test_bytes_survive_quantising(rounding: str) -> None:
    levels = torch.arange(256).view(1, 16, 16) / 255
    assert torch.equal(quantise(levels, rounding), levels)


def test_bicubic_reproduces_a_ramp_and_clamps_overshoot() -> None:
    ramp = (torch.arange(10, dtype=torch.float64) + 0.5) / 10
    larger = bicubic(ramp.expand(1, 6, 10).contiguous(), 40, 24)
    expected = (torch.arange(40, dtype=torch.float64) + 0.5) / 40
    torch.testing.assert_close(larger[0, 12, 10:30], expected[10:30])  # cubic interpolation is exact on lines
    edge = torch.zeros(1, 6, 10)
    edge[:, :, 5:] = 1
    larger = bicubic(edge, 40, 24)
    assert (float(larger.min()), float(larger.max())) == (0.0, 1.0)
