"""Colours of a lower SH degree that come nearest to those of a model, where training views see them.

With another colour c' of row k a picture changes by w (c' - c), w the blending weights of k: by W |c' - c|^2 where that
is squared and summed over pixels, W the sum of w^2. Summed over views it is least where the coefficients x of c' solve
(sum W Y Y^T) x = sum W Y c, Y the harmonics towards each view. Cutting bands off instead leaves what they are in the
mean over these views to nobody, most of what they are: where all views lie to one side of a surface, bands do what the
constant colour could do. Reduced-3DGS (Papantonakis et al. 2024) takes means for degree 0, and cuts for the others.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from gsx.core.data.camera import offsets_from
from gsx.core.data.scene import View
from gsx.core.gaussians.bands import BAND_0, harmonics_along
from gsx.core.gaussians.sh import colour_of_constant
from gsx.core.shapes import Bool, Float
from gsx.core.training.importance import Probe, ProbeRender, draws_per_view, random_signs, rounding_of
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
    current: Float[Tensor, "n 3 N"]
    """Coefficients as they are."""
    views: Float[Tensor, "N"]
    """How many views show the row."""
    error: float
    """Squared error of the views, with that of the rounding of their photographs."""


def colour_fits(probe: Probe, views: Sequence[View], generator: torch.Generator, degree: int) -> ColourFits:
    """Gathers what views say of the colours of a table with bands, for fits up to a degree."""
    table = probe.model.table
    current = coefficients_of(table, degree)
    count, n = len(table), len(current)
    grams, products = current.new_zeros(n, n, count), current.new_zeros(n, 3, count)
    norms, shows, error = current.new_zeros(count), current.new_zeros(count), 0.0
    for view in views:
        render = probe.render(view.camera)
        weights = weights_of(render, view, draws_per_view(views), generator)
        basis, colours = basis_of(render, degree), colours_less_constant(table, render)
        weighted = weights * basis
        grams += render.by_row(weighted[:, None] * basis)
        products += render.by_row(weighted[:, None] * colours)
        norms += render.by_row(weights * colours.square().sum(0))
        shows += render.visible_rows()
        error += float(probe.squared_error(render.image, view)) + rounding_of(view)
    return ColourFits(grams=grams, products=products, norms=norms, current=current, views=shows, error=error)


def coefficients_of(table: ParameterTable, degree: int) -> Float[Tensor, "n 3 N"]:
    """Returns coefficients up to a degree less the constant ones, which are zero then."""
    rest = table["sh_rest"].detach()[:, : (degree + 1) ** 2 - 1]
    return torch.cat([torch.zeros_like(table["sh_dc"].detach()), rest], 1).permute(1, 2, 0)


def weights_of(render: ProbeRender, view: View, draws: int, generator: torch.Generator) -> Float[Tensor, "M"]:
    """Estimates squared blending weights of each splat, summed over pixels that count."""
    signs = (random_signs(render.image.detach(), generator, view.counted()) for _ in range(draws))
    return torch.stack([render.blending_squares(one) for one in signs]).mean(0)


def basis_of(render: ProbeRender, degree: int) -> Float[Tensor, "n M"]:
    """Evaluates harmonics of each splat towards the camera."""
    offsets = offsets_from(render.splats.means.detach(), render.camera.centre)
    constant = torch.full_like(offsets[:, 0], BAND_0)[None]
    return torch.cat([constant, harmonics_along(offsets, degree)]) if degree else constant


def colours_less_constant(table: ParameterTable, render: ProbeRender) -> Float[Tensor, "3 M"]:
    """Subtracts from colours as the camera sees them what they are without bands."""
    constant = table["sh_dc"].detach()[:, 0]
    constant = constant if render.rows is None else constant[render.rows]
    return (render.colours.detach() - colour_of_constant(constant)).T


# -- solutions ---------------------------------------------------------------------------------------------------------


def fitted(fits: ColourFits, degree: int) -> Float[Tensor, "n 3 N"]:
    """Solves for the coefficients of a degree that change pictures least, less the constant ones as they are."""
    n = (degree + 1) ** 2
    grams, products = fits.grams[:n, :n].permute(2, 0, 1), fits.products[:n].permute(2, 0, 1)
    current = fits.current[:n].permute(2, 0, 1)
    parts = zip(grams.split(AT_ONCE), products.split(AT_ONCE), current.split(AT_ONCE), strict=True)
    return torch.cat([solved(*part) for part in parts]).permute(1, 2, 0)


def solved(
    grams: Float[Tensor, "N n n"], products: Float[Tensor, "N n 3"], current: Float[Tensor, "N n 3"]
) -> Float[Tensor, "N n 3"]:
    """Solves each row's equations with the ridge; rows that no view shows keep their coefficients."""
    mean = grams.diagonal(dim1=1, dim2=2).mean(1).clamp_min(torch.finfo(grams.dtype).tiny)[:, None, None]
    ridge = RIDGE * torch.eye(grams.shape[1], dtype=grams.dtype, device=grams.device)
    return torch.linalg.solve(grams / mean + ridge, products / mean + RIDGE * current)


def squared_change(fits: ColourFits, coefficients: Float[Tensor, "n 3 N"]) -> Float[Tensor, "N"]:
    """Returns the squared change of the pictures with these coefficients, summed over pixels and views."""
    n = len(coefficients)
    forward = torch.einsum("ijk,jck->ick", fits.grams[:n, :n], coefficients)
    return (fits.norms + (coefficients * (forward - 2 * fits.products[:n])).sum((0, 1))).clamp_min(0)


@torch.no_grad()
def take_coefficients(table: ParameterTable, rows: Bool[Tensor, "N"], coefficients: Float[Tensor, "n 3 N"]) -> None:
    """Gives rows of a table these coefficients; bands above them, and all moments, stay as they are."""
    new = coefficients.permute(2, 0, 1)[rows]
    table["sh_dc"][rows] += new[:, :1]
    table["sh_rest"][rows, : new.shape[1] - 1] = new[:, 1:]
