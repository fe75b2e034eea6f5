"""Colours of a lower SH degree that come nearest to a model's own, where training views see them.

With another colour c' of row k a picture changes by w (c' - c), w the blending weights of k: by W |c' - c|^2 where that
is squared and summed over pixels, W the sum of w^2. Summed over views it is least where the coefficients x of c' solve
(sum W Y Y^T) x = sum W Y c, Y the harmonics towards each view. Cutting bands off instead leaves what they are in the
mean over these views to nobody, most of what they are: where all views lie to one side of a surface, bands do what the
constant colour could do. Reduced-3DGS (Papantonakis et al. 2024) takes means for degree 0, and cuts for the others.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from gsx.core.data.camera import offsets_from
from gsx.core.data.scene import View
from gsx.core.gaussians.bands import BAND_0, harmonics_along
from gsx.core.gaussians.sh import colour_of_constant
from gsx.core.shapes import Bool, Float
from gsx.core.training.backbone import Backbone, Drawn
from gsx.core.training.importance import (
    Compared,
    Forming,
    Look,
    blending_squares,
    by_row,
    difference,
    draws_of_each,
    random_signs,
    render_probe,
    rounding_of,
)
from gsx.core.training.parameter_table import ParameterTable

RIDGE = 1e-3
"""Towards coefficients as they are, of the mean of what is summed over views: for directions that no view sees."""
AT_ONCE = 1 << 17
"""Rows whose equations are solved at a time."""


@dataclass(frozen=True, eq=False, kw_only=True)
class ColourFits:
    """Sums over views for the colours of N rows less their constant ones; n coefficients, the constant one first."""

    grams: Float[Tensor, "n n N"]
    """W Y Y^T."""
    products: Float[Tensor, "n 3 N"]
    """W Y c."""
    norms: Float[Tensor, "N"]
    """W |c|^2."""
    own: Float[Tensor, "n 3 N"]
    """Coefficients as they are."""
    shown: Float[Tensor, "N"]
    """How many views show the row."""
    error: float
    """Squared error of the views, with that of the rounding of their photographs."""


def colour_fits(
    model: Backbone[Any],
    views: Sequence[View],
    form: Forming,
    background: Float[Tensor, "3"],
    step: int,
    generator: torch.Generator,
    degree: int,
    compared: Compared,
) -> ColourFits:
    """What views say of the colours of a table with bands, for fits up to a degree."""
    own = own_coefficients(model.table, degree)
    count, n = len(model.table), len(own)
    grams, products = own.new_zeros(n, n, count), own.new_zeros(n, 3, count)
    norms, shown, error = own.new_zeros(count), own.new_zeros(count), 0.0
    for view in views:
        drawn, seen = render_probe(model, view.camera, form, background, step)
        weights = weights_of(seen, view, draws_of_each(views), generator)
        basis, colours = basis_of(drawn, seen, degree), colours_less_constant(model.table, drawn, seen)
        weighted = weights * basis
        grams += by_row(drawn, weighted[:, None] * basis, count)
        products += by_row(drawn, weighted[:, None] * colours, count)
        norms += by_row(drawn, weights * colours.square().sum(0), count)
        shown += by_row(drawn, seen.visible, count) > 0
        error += float(difference(seen.image, view, compared).double().square().sum()) + rounding_of(view)
    return ColourFits(grams=grams, products=products, norms=norms, own=own, shown=shown, error=error)


def own_coefficients(table: ParameterTable, degree: int) -> Float[Tensor, "n 3 N"]:
    """Coefficients up to a degree less the constant ones, which are zero then."""
    rest = table["sh_rest"].detach()[:, : (degree + 1) ** 2 - 1]
    return torch.cat([torch.zeros_like(table["sh_dc"].detach()), rest], 1).permute(1, 2, 0)


def weights_of(seen: Look, view: View, draws: int, generator: torch.Generator) -> Float[Tensor, "M"]:
    """Squared blending weights of what a camera draws, summed over pixels that count."""
    signs = (random_signs(seen.image.detach(), generator, view.counted()) for _ in range(draws))
    return torch.stack([blending_squares(seen, one) for one in signs]).mean(0)


def basis_of(drawn: Drawn, seen: Look, degree: int) -> Float[Tensor, "n M"]:
    """Harmonics towards a camera."""
    offsets = offsets_from(drawn.splats.means.detach(), seen.camera.centre)
    constant = torch.full_like(offsets[:, 0], BAND_0)[None]
    return torch.cat([constant, harmonics_along(offsets, degree)]) if degree else constant


def colours_less_constant(table: ParameterTable, drawn: Drawn, seen: Look) -> Float[Tensor, "3 M"]:
    """Colours as a camera sees them less what they are without bands."""
    constant = table["sh_dc"].detach()[:, 0]
    constant = constant if drawn.rows is None else constant[drawn.rows]
    return (seen.colours.detach() - colour_of_constant(constant)).T


# -- solutions ---------------------------------------------------------------------------------------------------------


def fitted(fits: ColourFits, degree: int) -> Float[Tensor, "n 3 N"]:
    """Coefficients of a degree that change the pictures least, less the constant ones as they are."""
    n = (degree + 1) ** 2
    grams, products = fits.grams[:n, :n].permute(2, 0, 1), fits.products[:n].permute(2, 0, 1)
    own = fits.own[:n].permute(2, 0, 1)
    parts = zip(grams.split(AT_ONCE), products.split(AT_ONCE), own.split(AT_ONCE), strict=True)
    return torch.cat([solved(*part) for part in parts]).permute(1, 2, 0)


def solved(
    grams: Float[Tensor, "N n n"], products: Float[Tensor, "N n 3"], own: Float[Tensor, "N n 3"]
) -> Float[Tensor, "N n 3"]:
    """Of each row's equations, with the ridge; rows that no view shows keep their own."""
    mean = grams.diagonal(dim1=1, dim2=2).mean(1).clamp_min(torch.finfo(grams.dtype).tiny)[:, None, None]
    ridge = RIDGE * torch.eye(grams.shape[1], dtype=grams.dtype, device=grams.device)
    return torch.linalg.solve(grams / mean + ridge, products / mean + RIDGE * own)


def squared_change(fits: ColourFits, coefficients: Float[Tensor, "n 3 N"]) -> Float[Tensor, "N"]:
    """By how much the pictures change with these coefficients, squared and summed over pixels and views."""
    n = len(coefficients)
    forward = torch.einsum("ijk,jck->ick", fits.grams[:n, :n], coefficients)
    return (fits.norms + (coefficients * (forward - 2 * fits.products[:n])).sum((0, 1))).clamp_min(0)


@torch.no_grad()
def take_coefficients(table: ParameterTable, rows: Bool[Tensor, "N"], coefficients: Float[Tensor, "n 3 N"]) -> None:
    """Give rows of a table these coefficients; bands above them, and all moments, stay as they are."""
    found = coefficients.permute(2, 0, 1)[rows]
    table["sh_dc"][rows] += found[:, :1]
    table["sh_rest"][rows, : found.shape[1] - 1] = found[:, 1:]
