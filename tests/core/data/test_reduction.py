"""One image formation per scene: the filter, its adjoint, the nearest picture that reduces to a given one."""

import pytest
import torch
from torch import Tensor

from gsx.augmenters.redraw import consistent_pixels, exactly_consistent
from gsx.core.data.reduction import TOLERANCE, Reduction, projected
from gsx.core.data.resize import display_from_linear, resize, to_uint8
from gsx.core.quality.metrics import psnr

FILTERS = ["area", "bicubic", "lanczos"]


def photograph(height: int, width: int, seed: int = 0) -> Tensor:
    """Smooth shading, crisp bars and a little noise, in 8 bits: what filters differ on."""
    generator = torch.Generator().manual_seed(seed)
    row, column = torch.meshgrid(torch.arange(float(height)), torch.arange(float(width)), indexing="ij")
    bars = (torch.sin(row / 2.3 + column / 3.1) > 0).float()
    shading = torch.sin(row / 37) * torch.cos(column / 29)
    picture = 0.5 + 0.2 * shading + 0.2 * (bars - 0.5)
    colours = torch.tensor([1.0, 0.9, 0.8])[:, None, None]
    return to_uint8(picture * colours + 0.02 * torch.randn(3, height, width, generator=generator))


def random(*shape: int, seed: int = 0) -> Tensor:
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


@pytest.mark.parametrize("light", ["display", "linear"])
@pytest.mark.parametrize("factor", [2, 3, 4])
@pytest.mark.parametrize("name", FILTERS)
def test_it_is_the_resize_of_photographs_without_its_roundings(name: str, factor: int, light: str) -> None:
    """Borders included; resizing rounds twice at most."""
    photo = photograph(12 * factor, 17 * factor)
    reduced = Reduction(filter=name, light=light).reduce(photo.float() / 255, factor)
    expected = resize(photo, 17, 12, name, light).float()
    assert float((255 * reduced - expected).abs().max()) < 1.2


@pytest.mark.parametrize("factor", [2, 3, 4])
@pytest.mark.parametrize("name", FILTERS)
def test_the_adjoint_is_one_and_what_a_backward_pass_applies(name: str, factor: int) -> None:
    reduction = Reduction(filter=name)
    fine, coarse = random(3, 7 * factor, 9 * factor), random(3, 7, 9, seed=1)
    left, right = (reduction.linear(fine, factor) * coarse).sum(), (fine * reduction.adjoint(coarse, factor)).sum()
    assert float(left) == pytest.approx(float(right), rel=1e-12)
    fine.requires_grad_()
    (reduction.linear(fine, factor) * coarse).sum().backward()
    assert fine.grad is not None
    torch.testing.assert_close(fine.grad, reduction.adjoint(coarse, factor))


@pytest.mark.parametrize("name", FILTERS)
def test_a_window_reduces_like_the_whole_but_for_its_rim(name: str) -> None:
    reduction, whole = Reduction(filter=name), random(3, 48, 64)
    reduced = reduction.reduce(whole, 2)[:, 5:17, 8:24]
    window = reduction.reduce(whole[:, 10:34, 16:48], 2)
    torch.testing.assert_close(reduction.inner(window), reduction.inner(reduced))
    assert reduction.inner(window).shape == (3, 12 - 2 * reduction.rim, 16 - 2 * reduction.rim)
    assert (reduction.rim == 0) == torch.equal(window, reduced)


@pytest.mark.parametrize("factor", [2, 3, 4])
@pytest.mark.parametrize("name", FILTERS)
def test_the_projection_is_the_nearest_picture_that_reduces_to_the_given_one(name: str, factor: int) -> None:
    """x + D^T (D D^T)^-1 (y - D x), by a dense solve in float64; away from black and white nothing is clamped."""
    reduction = Reduction(filter=name)
    fine, low = 0.45 + 0.1 * random(1, 6 * factor, 7 * factor), 0.45 + 0.1 * random(1, 6, 7, seed=1)
    found = projected(fine, low, factor, reduction)
    columns = torch.eye(fine.numel(), dtype=torch.float64).view(-1, *fine.shape)
    dense = reduction.linear(columns, factor).reshape(fine.numel(), -1).T
    missing = low.flatten() - dense @ fine.flatten()
    nearest = fine.flatten() + dense.T @ torch.linalg.solve(dense @ dense.T, missing)
    torch.testing.assert_close(found.flatten(), nearest, rtol=0, atol=2e-4)
    torch.testing.assert_close(reduction.reduce(found, factor), low, rtol=0, atol=TOLERANCE)


@pytest.mark.parametrize("light", ["display", "linear"])
@pytest.mark.parametrize("name", FILTERS)
def test_a_projected_picture_reduces_to_its_input(name: str, light: str) -> None:
    """With black and white in it, where clamping undoes: to a fraction of a level, in 8 bits nearly every pixel."""
    reduction = Reduction(filter=name, light=light)
    photo = photograph(96, 128)
    photo[:, :20, :30], photo[:, 50:, 60:80] = 0, 255
    low = resize(photo, 64, 48, name, light)
    guess = torch.nn.functional.interpolate(low[None].float() / 255, scale_factor=2, mode="bilinear")[0]
    found = projected(guess, low.float() / 255, 2, reduction)
    off = 255 * (reduction.reduce(found, 2) - low.float() / 255).abs()
    assert float(off.quantile(0.95)) < 0.25
    exact = exactly_consistent(guess, low, 2, reduction)
    again = to_uint8(reduction.reduce(exact.float() / 255, 2))
    assert int((again.int() - low.int()).abs().max()) <= (0 if name == "area" and light == "display" else 1)
    share = float(consistent_pixels(exact, low, 2, reduction).float().mean())
    assert share >= (1.0 if name == "area" and light == "display" else 0.99)


@pytest.mark.parametrize("name", ["bicubic", "lanczos"])
def test_the_true_photograph_agrees_by_the_declared_filter_and_not_by_box_averages(name: str) -> None:
    """What a scene of photographs trains on, and its original."""
    photo = photograph(200, 300)
    given = resize(photo, 150, 100, name).float() / 255
    truth = photo.float() / 255
    declared, box = (psnr(r.reduce(truth, 2), given) for r in (Reduction(filter=name), Reduction()))
    assert declared > 55
    assert box < declared - 12


def test_light_has_a_slope_at_black() -> None:
    """Renders that are black everywhere have a finite gradient."""
    image = torch.zeros(3, 8, 8, requires_grad=True)
    Reduction(filter="bicubic", light="linear").reduce(image, 2).sum().backward()
    assert image.grad is not None
    assert bool(torch.isfinite(image.grad).all())
    assert display_from_linear(torch.tensor([0.0, 1.0])).tolist() == pytest.approx([0, 1])


def test_unknown_filters_are_refused() -> None:
    with pytest.raises(ValueError, match="no reduction 'cubic'"):
        Reduction(filter="cubic")
