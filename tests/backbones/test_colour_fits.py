"""Colours of a lower degree that change pictures least, against renders with these, with others, and with bands cut."""

import math
from collections.abc import Sequence
from dataclasses import replace

import pytest
import torch
from small_scene import Grey, published_options, small_gs3d, small_scene, spread
from torch import Tensor

from gsx.backbones.gs3d import GS3D
from gsx.backbones.sh_degrees import (
    ColourFits,
    coefficients_of,
    colour_fits,
    fitted,
    squared_change,
    take_coefficients,
)
from gsx.core.data.camera import look_at
from gsx.core.data.scene import View
from gsx.core.rasterizer import rasterize
from gsx.core.training import importance
from gsx.core.training.importance import Probe

STEP = 30000
"""All bands have been learnt."""


def model_seen_from(angles: Sequence[float], rows: int = 1) -> GS3D:
    """Gaussians with bands of all degrees, seen from these directions."""
    scene = small_scene(spread(rows))
    corners = [(4 * math.cos(angle), 4 * math.sin(angle), math.sin(3 * angle)) for angle in angles]
    cameras = [look_at(corner, [0, 0, 0], fov_x=0.9, width=24, height=16) for corner in corners]
    scene = replace(scene, train=[View(f"view{i}", camera, Grey()) for i, camera in enumerate(cameras)])
    model = small_gs3d(scene, options=published_options())
    with torch.no_grad():
        model.table["opacity_logits"].fill_(1.0)
        model.table["log_scales"].fill_(-1.5)
        model.table["sh_rest"].normal_(0, 0.1, generator=torch.Generator().manual_seed(1))
    return model


AROUND = [i * 2 * math.pi / 12 for i in range(12)]
ONE_SIDE = [0.05 * i for i in range(12)]


def fits_of(model: GS3D, degree: int = 2) -> ColourFits:
    context = model.context
    probe = Probe(model=model, views=context.views, step=STEP)
    return colour_fits(probe, context.scene.train, torch.Generator().manual_seed(0), degree)


def pictures(model: GS3D) -> Tensor:
    with torch.no_grad():
        cameras = [view.camera for view in model.context.scene.train]
        return torch.stack([rasterize(model.draw(one, STEP).splats, one, model.raster).image for one in cameras])


def change_with(model: GS3D, coefficients: Tensor, before: Tensor) -> float:
    """Squared change of all pictures where the colours are of that degree."""
    kept = {name: model.table[name].detach().clone() for name in ("sh_dc", "sh_rest")}
    with torch.no_grad():
        model.table["sh_rest"].zero_()
    take_coefficients(model.table, torch.ones(len(model.table), dtype=torch.bool), coefficients)
    after = pictures(model)
    with torch.no_grad():
        for name, value in kept.items():
            model.table[name].copy_(value)
    return float((after - before).double().square().sum())


@pytest.fixture(scope="module")
def alone() -> tuple[GS3D, ColourFits, Tensor]:
    """(one Gaussian, its fits with signs drawn often, its pictures)."""
    model = model_seen_from(AROUND)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(importance, "DRAWS", 12 * 300)
        return model, fits_of(model), pictures(model)


@pytest.mark.parametrize("degree", [0, 1, 2])
def test_colours_of_that_degree_are_kept(degree: int) -> None:
    """Bands above are zero: the fit is what is there."""
    model = model_seen_from(AROUND, rows=3)
    with torch.no_grad():
        model.table["sh_rest"][:, (degree + 1) ** 2 - 1 :] = 0
    fits = fits_of(model)
    torch.testing.assert_close(fitted(fits, degree), coefficients_of(model.table, degree), atol=1e-5, rtol=0)
    assert float(squared_change(fits, fitted(fits, degree)).max()) < 1e-7


@pytest.mark.parametrize("degree", [0, 1, 2])
def test_the_change_told_is_that_of_pictures(degree: int, alone: tuple[GS3D, ColourFits, Tensor]) -> None:
    """Of one Gaussian: for the fit, and for bands cut off."""
    model, fits, before = alone
    for coefficients in (fitted(fits, degree), coefficients_of(model.table, degree)):
        actual = change_with(model, coefficients, before)
        assert actual > 1e-3
        assert float(squared_change(fits, coefficients)) == pytest.approx(actual, rel=0.1)


@pytest.mark.parametrize("degree", [0, 1, 2])
def test_no_other_coefficients_change_pictures_less(degree: int, alone: tuple[GS3D, ColourFits, Tensor]) -> None:
    """Renders with the fit moved a little along each coefficient, to either side."""
    model, fits, before = alone
    best = fitted(fits, degree)
    least = change_with(model, best, before)
    for index in range(len(best)):
        for moved in (-0.03, 0.03):
            other = best.clone()
            other[index] += moved
            assert change_with(model, other, before) > least


def test_what_bands_are_in_the_mean_is_not_lost() -> None:
    """Seen from one side, bands do what a constant colour can do: cutting them off costs most of what they are."""
    model = model_seen_from(ONE_SIDE, rows=3)
    fits, before = fits_of(model), pictures(model)
    cut, fit = (change_with(model, one, before) for one in (coefficients_of(model.table, 0), fitted(fits, 0)))
    assert fit < 0.25 * cut
    assert change_with(model, fitted(fits, 1), before) < 0.1 * fit


def test_rows_that_no_view_shows_keep_what_they_have() -> None:
    model = model_seen_from(AROUND, rows=2)
    with torch.no_grad():
        model.table["means"][1] = torch.tensor([0.0, 0.0, 100.0])
    fits = fits_of(model)
    assert fits.views.tolist() == [12, 0]
    for degree in range(3):
        own = coefficients_of(model.table, degree)
        torch.testing.assert_close(fitted(fits, degree)[..., 1], own[..., 1])


def test_rows_take_their_colours_and_others_stay() -> None:
    model = model_seen_from(AROUND, rows=3)
    before = {name: model.table[name].detach().clone() for name in ("sh_dc", "sh_rest")}
    rows = torch.tensor([True, False, True])
    found = fitted(fits_of(model), 1)
    take_coefficients(model.table, rows, found)
    torch.testing.assert_close(model.table["sh_dc"][rows], before["sh_dc"][rows] + found[:1, :, rows].permute(2, 0, 1))
    torch.testing.assert_close(model.table["sh_rest"][rows, :3], found[1:, :, rows].permute(2, 0, 1))
    assert torch.equal(model.table["sh_rest"][:, 3:], before["sh_rest"][:, 3:])
    for name, value in before.items():
        assert torch.equal(model.table[name][1], value[1])
