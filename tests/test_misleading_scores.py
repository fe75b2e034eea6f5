"""Pictures of benchmarks/misleading_scores.py have the faults that it says, and its table says which figure errs."""

import math

import pytest
import torch
from torch import Tensor

from gsx.scenes.demo.cameras import spiral_camera
from gsx.scenes.demo.still_life import make_still_life
from measuring.spoilt import (
    blurred,
    brighter,
    enlarged,
    framed,
    reduced,
    shifted,
    textured,
    with_floater,
    with_gaps,
)
from misleading_scores import CASES, FIGURES, LABELS, VIEWS, compared, spoilt, surface_splats


def noise(height: int = 24, width: int = 32) -> Tensor:
    return torch.rand(3, height, width, generator=torch.Generator().manual_seed(1))


def displacement(picture: Tensor, other: Tensor) -> tuple[int, int]:
    """(down, across) by which `other` lies aside, from the peak of the phase correlation."""
    spectrum = torch.fft.fft2(other.mean(0)) * torch.fft.fft2(picture.mean(0)).conj()
    peak = int(torch.fft.ifft2(spectrum / spectrum.abs()).real.argmax())
    return peak // picture.shape[2], peak % picture.shape[2]


def test_exposure_is_a_gain_of_display_values() -> None:
    picture = 0.9 * noise()
    assert torch.allclose(brighter(picture, 1.07) / picture, torch.tensor(1.07))
    assert float(brighter(noise(), 1.5).max()) == 1


@pytest.mark.parametrize("pixels", [1, 2])
def test_detail_moves_to_the_right_by_whole_pixels(pixels: int) -> None:
    assert displacement(noise(), shifted(noise(), pixels)) == (0, pixels)


@pytest.mark.parametrize("deviation", [0.7, 2.0])
def test_blur_has_its_deviation_and_keeps_the_sum(deviation: float) -> None:
    point = torch.zeros(1, 41, 41)
    point[:, 20, 20] = 1
    spread, places = blurred(point, deviation)[0].sum(0), torch.arange(41) - 20
    assert float(spread.sum()) == pytest.approx(1, abs=1e-5)
    assert math.sqrt(float((spread * places**2).sum())) == pytest.approx(deviation, rel=0.01)


def test_gaps_are_invisible_at_x1() -> None:
    gaps = with_gaps(noise(), 4)
    assert torch.allclose(reduced(gaps, 4), noise().unflatten(1, (-1, 4)).unflatten(3, (-1, 4)).mean((2, 4)), atol=1e-6)
    assert torch.equal(gaps, gaps.clamp(0, 1))
    assert float(gaps[:, 1:3, 1:3].mean()) > float(gaps[:, :4, 0].mean()) + 0.1


def test_invented_texture_is_where_contrast_is_and_another_in_each_picture() -> None:
    picture, generator = torch.full((3, 40, 60), 0.5), torch.Generator().manual_seed(0)
    picture[:, :, 50:] = 0.7
    one, two = (textured(picture, 0.3, generator) - picture for _ in range(2))
    assert float(one[..., :15].abs().max()) < 1e-3 < 0.01 < float(one[..., 45:55].std())
    assert abs(float(torch.corrcoef(torch.stack([one[0].flatten(), two[0].flatten()]))[0, 1])) < 0.2


def test_borders_and_floaters_leave_the_rest_as_it_is() -> None:
    black = framed(noise(), 3)
    assert torch.equal(black[:, 3:-3, 3:-3], noise()[:, 3:-3, 3:-3])
    assert float(black.sum()) == pytest.approx(float(noise()[:, 3:-3, 3:-3].sum()), rel=1e-5)
    picture = noise(100, 140)
    covered = with_floater(picture, 0.6, 0.1)
    assert float((covered[:, 48:52, 68:72] - 0.6).abs().max()) < 0.06
    assert torch.allclose(covered[:, :10, :10], picture[:, :10, :10], atol=1e-4)


def test_every_method_has_pictures_of_its_zooms() -> None:
    first, fine = [noise()] * VIEWS, [noise(96, 128)] * VIEWS
    pictures = spoilt(first, fine, fine)
    for case in CASES:
        for method in (case.worse, case.better):
            assert method in LABELS
            shapes = [one.shape for zoom in case.zooms for one in pictures[f"{method}/x{zoom}"]]
            assert shapes == [(3, 24 * zoom, 32 * zoom) for zoom in case.zooms for _ in range(VIEWS)]
    assert displacement(fine[0], pictures["displaced/x4"][0]) == (0, 2)
    assert torch.equal(pictures["enlarged/x4"][0], enlarged(first[0], 4))


def test_surfaces_lie_on_the_rays_of_their_pixels() -> None:
    camera = spiral_camera(0.3, 16, 12)
    splats = surface_splats(make_still_life(), [camera])
    x, y, z = (splats.means.double() @ camera.rotation.mT.double() + camera.translation.double()).unbind(1)
    across, down = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
    expected = torch.cartesian_prod(torch.arange(16).double() + 0.5, torch.arange(12).double() + 0.5)
    assert torch.allclose(torch.stack([across, down], 1), expected, atol=1e-3)


def test_the_table_names_the_figures_that_err() -> None:
    worse = {"psnr": 31.0, "niqe": 4.0, "ssim": 0.9}
    found = compared(worse, {"psnr": 30.0, "niqe": 3.0, "ssim": 0.90001})
    assert found == {"psnr": "31.00, 30.00", "ssim": "0.9000, 0.9000", "niqe": "4.00, 3.00"} | {
        "misled": "PSNR",
        "right": "NIQE",
    }
    assert all(sign in (1, -1) for _, _, sign in FIGURES.values())
