"""An SH degree for each Gaussian.

A Gaussian of degree 3 has 59 numbers, 45 of them in three bands that a matt surface does not need. Once, late in the
run, colours of every lower degree are fitted in training views (`backbones.colour_fits`). Each Gaussian keeps the
degree with the least squared change of the pictures plus the price of its numbers.
"""

import logging
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from gsx.backbones.capacity import error_exponent
from gsx.backbones.colour_fits import ColourFits, fitted, squared_change, take_coefficients
from gsx.core.shapes import Bool, Float, Int
from gsx.core.training.parameter_table import ParameterTable, edit

logger = logging.getLogger(__name__)


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
