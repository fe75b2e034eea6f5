"""An SH degree for each Gaussian.

A Gaussian of degree 3 has 59 numbers, 45 of them in three bands that a matt surface does not need. Once, late in the
run, colours of every lower degree are fitted in training views by least squares. Each Gaussian keeps the degree with
the least squared change of the pictures plus the price of its numbers.

Another colour c' of row k changes a picture by w (c' - c), w its blending weights; squared and summed over pixels, by
W |c' - c|^2, W the sum of w^2. The sum over views is least if the coefficients x of c' solve
(sum W Y Y^T) x = sum W Y c, Y the harmonics towards each view. Dropping bands instead loses their mean over the views.
Reduced-3DGS (Papantonakis et al. 2024) uses means for degree 0, and drops bands for the others.
"""

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from gsx.backbones.capacity import error_exponent
from gsx.core.data.camera import offsets_from
from gsx.core.data.scene import View
from gsx.core.gaussians.bands import BAND_0, harmonics_along
from gsx.core.gaussians.sh import colour_of_constant
from gsx.core.shapes import Bool, Float, Int
from gsx.core.training.importance import Probe, ProbeRender, draws_per_view, random_signs, rounding_of
from gsx.core.training.parameter_table import ParameterTable, edit

RIDGE = 1e-3
"""Weight of the current coefficients, over the mean diagonal of a system: for directions that no view sees."""
CHUNK = 1 << 17
"""Rows whose systems are solved at a time."""
logger = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False, kw_only=True)
class ColourFits:
    """Sums over views for the colours of N rows minus their constant ones; n coefficients, the constant one first."""

    grams: Float[Tensor, "n n N"]
    """W Y Y^T."""
    products: Float[Tensor, "n 3 N"]
    """W Y c."""
    norms: Float[Tensor, "N"]
    """W |c|^2."""
    current: Float[Tensor, "n 3 N"]
    """Current coefficients."""
    views: Float[Tensor, "N"]
    """Number of views that show the row."""
    error: float
    """Squared error of the views plus that of rounding their photos."""


def colour_fits(probe: Probe, views: Sequence[View], generator: torch.Generator, degree: int) -> ColourFits:
    """Sums the systems of all rows over some views, for fits up to a degree."""
    table = probe.model.table
    current = coefficients_of(table, degree)
    count, n = len(table), len(current)
    grams, products = current.new_zeros(n, n, count), current.new_zeros(n, 3, count)
    norms, shows, error = current.new_zeros(count), current.new_zeros(count), 0.0
    for view in views:
        render = probe.render(view.camera)
        weights = weights_of(render, view, draws_per_view(views), generator)
        basis, constant = basis_of(render, degree), table["sh_dc"].detach()[:, 0]
        constant = constant if render.rows is None else constant[render.rows]
        colours = (render.colours.detach() - colour_of_constant(constant)).T
        weighted = weights * basis
        grams += render.by_row(weighted[:, None] * basis)
        products += render.by_row(weighted[:, None] * colours)
        norms += render.by_row(weights * colours.square().sum(0))
        shows += render.visible_rows()
        error += float(probe.squared_error(render.image, view)) + rounding_of(view)
    return ColourFits(grams=grams, products=products, norms=norms, current=current, views=shows, error=error)


def coefficients_of(table: ParameterTable, degree: int) -> Float[Tensor, "n 3 N"]:
    """Returns coefficients up to a degree, with 0 for the constant one."""
    rest = table["sh_rest"].detach()[:, : (degree + 1) ** 2 - 1]
    return torch.cat([torch.zeros_like(table["sh_dc"].detach()), rest], 1).permute(1, 2, 0)


def weights_of(render: ProbeRender, view: View, draws: int, generator: torch.Generator) -> Float[Tensor, "M"]:
    """Estimates each splat's squared blending weights, summed over pixels that count."""
    signs = (random_signs(render.image.detach(), generator, view.counted()) for _ in range(draws))
    return torch.stack([render.blending_squares(one) for one in signs]).mean(0)


def basis_of(render: ProbeRender, degree: int) -> Float[Tensor, "n M"]:
    """Evaluates each splat's harmonics towards the camera."""
    offsets = offsets_from(render.splats.means.detach(), render.camera.centre)
    constant = torch.full_like(offsets[:, 0], BAND_0)[None]
    return torch.cat([constant, harmonics_along(offsets, degree)]) if degree else constant


# -- solutions ---------------------------------------------------------------------------------------------------------


def fitted(fits: ColourFits, degree: int) -> Float[Tensor, "n 3 N"]:
    """Solves for the coefficients of a degree that change pictures least, minus the current constant ones."""
    n = (degree + 1) ** 2
    grams, products = fits.grams[:n, :n].permute(2, 0, 1), fits.products[:n].permute(2, 0, 1)
    current = fits.current[:n].permute(2, 0, 1)
    parts = zip(grams.split(CHUNK), products.split(CHUNK), current.split(CHUNK), strict=True)
    return torch.cat([solved(*part) for part in parts]).permute(1, 2, 0)


def solved(
    grams: Float[Tensor, "N n n"], products: Float[Tensor, "N n 3"], current: Float[Tensor, "N n 3"]
) -> Float[Tensor, "N n 3"]:
    """Solves each row's system with the ridge; rows that no view shows keep their coefficients."""
    mean = grams.diagonal(dim1=1, dim2=2).mean(1).clamp_min(torch.finfo(grams.dtype).tiny)[:, None, None]
    ridge = RIDGE * torch.eye(grams.shape[1], dtype=grams.dtype, device=grams.device)
    return torch.linalg.solve(grams / mean + ridge, products / mean + RIDGE * current)


def squared_change(fits: ColourFits, coefficients: Float[Tensor, "n 3 N"]) -> Float[Tensor, "N"]:
    """Returns the squared change of the pictures by these coefficients, summed over pixels and views."""
    n = len(coefficients)
    forward = torch.einsum("ijk,jck->ick", fits.grams[:n, :n], coefficients)
    return (fits.norms + (coefficients * (forward - 2 * fits.products[:n])).sum((0, 1))).clamp_min(0)


@torch.no_grad()
def take_coefficients(table: ParameterTable, rows: Bool[Tensor, "N"], coefficients: Float[Tensor, "n 3 N"]) -> None:
    """Assigns coefficients to marked rows; higher bands and all moments stay."""
    new = coefficients.permute(2, 0, 1)[rows]
    table["sh_dc"][rows] += new[:, :1]
    table["sh_rest"][rows, : new.shape[1] - 1] = new[:, 1:]


@dataclass(frozen=True, eq=False, kw_only=True)
class ChosenDegrees:
    """SH degrees of N rows and their colours."""

    degrees: Int[Tensor, "N"]
    coefficients: Float[Tensor, "n 3 N"]
    """Coefficients of the lower degrees minus the current constant ones; 0 above a row's degree."""
    highest: int
    """Degree of the trained colours."""

    def to(self, device: torch.device | str) -> "ChosenDegrees":
        """Moves it to a device."""
        return replace(self, degrees=self.degrees.to(device), coefficients=self.coefficients.to(device))


def numbers_of(degree: int, other: int) -> Int[Tensor, "D"]:
    """Returns the numbers of a Gaussian with each degree up to `degree`; `other`: those that are not colours."""
    return other + 3 * torch.arange(1, degree + 2).square()


def least_degrees(
    squares: Float[Tensor, "D N"],
    views: Float[Tensor, "N"],
    error_share: float,
    price: float,
    numbers: Int[Tensor, "D"],
) -> Int[Tensor, "N"]:
    """Returns the degree of least cost of each Gaussian; the highest if no view shows it.

    squares: squared change of a picture with each degree, mean over the views that show the row.
    error_share: squared error of a view over the rows that it shows; price: dB per doubling of all numbers.
    """
    share = (numbers / numbers[-1]).to(squares)
    cost = squares + error_exponent(price) * error_share * share[:, None]
    return torch.where(views > 0, cost.argmin(0), len(numbers) - 1)


def kept_bands(degrees: Int[Tensor, "N"], count: int) -> Bool[Tensor, "N B"]:
    """Marks which of `count` coefficients after the constant one are within each row's degree."""
    band = torch.arange(1, count + 1, device=degrees.device).sqrt().floor()
    return band <= degrees[:, None]


def choose_degrees(fits: ColourFits, price: float, numbers: Int[Tensor, "D"]) -> ChosenDegrees:
    """Chooses the degree of least cost of each row, and its colours."""
    highest = len(numbers) - 1
    lower = [fitted(fits, degree) for degree in range(highest)]
    squares = torch.stack([squared_change(fits, one) for one in lower] + [torch.zeros_like(fits.norms)])
    share = fits.error / max(1.0, float(fits.views.sum()))
    degrees = least_degrees(squares / fits.views.clamp_min(1), fits.views, share, price, numbers)
    coefficients = torch.zeros_like(fits.current)
    for degree, one in enumerate(lower):
        coefficients[: len(one)] += one * (degrees == degree)
    return ChosenDegrees(degrees=degrees, coefficients=coefficients, highest=highest)


def lower_degrees(table: ParameterTable, chosen: ChosenDegrees, step: int, price: float) -> dict[str, float]:
    """Assigns the chosen degrees and colours, and zeroes higher bands with their moments."""
    before, degrees = table["sh_degree"], chosen.degrees.to(table["sh_degree"])
    lowered = degrees < chosen.highest
    table.columns["sh_degree"] = torch.where(lowered, degrees, before)  # higher bands may be untrained yet
    take_coefficients(table, lowered, chosen.coefficients)
    kept = kept_bands(table["sh_degree"], table["sh_rest"].shape[1])[..., None]
    edit(table, "sh_rest", lambda old: old * kept, lambda moment: moment * kept)
    counts = torch.bincount(table["sh_degree"].long(), minlength=chosen.highest + 1).tolist()
    listed = ", ".join(f"{count} of degree {degree}" for degree, count in enumerate(counts))
    logger.info("step %d: SH degrees at a price of %.2f dB per doubling of numbers: %s", step, price, listed)
    return {f"degree_{degree}": count for degree, count in enumerate(counts)}


def hold_bands(table: ParameterTable) -> None:
    """Zeroes the gradients of bands above each row's degree."""
    rest = table["sh_rest"]
    if rest.grad is not None:
        rest.grad *= kept_bands(table["sh_degree"], rest.shape[1])[..., None]
