"""An SH degree for each Gaussian: as many bands of colour as its pictures need.

A Gaussian with colours of degree 3 is 59 numbers, 45 of them in three bands of which a matt surface needs none. Once,
late in the run, the colours of every lower degree that come nearest to its own are found in training views; what these
change by, squared and summed, is what the bands above are worth (`backbones.colour_fits`). Against it stands what
their numbers cost, by the price of a doubling of all numbers. The degree at which both together are least is kept.
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
    """SH degrees of N rows, with their colours."""

    degrees: Int[Tensor, "N"]
    coefficients: Float[Tensor, "n 3 N"]
    """Of the degrees below the highest, less the constant ones as they are; zero above a row's own."""
    highest: int
    """Degree that has been learnt."""

    def to(self, device: torch.device | str) -> "ChosenDegrees":
        """Moves it to a device."""
        return replace(self, degrees=self.degrees.to(device), coefficients=self.coefficients.to(device))


def numbers_of(degree: int, other: int) -> Int[Tensor, "D"]:
    """Returns how many numbers a Gaussian has with colours of each degree up to `degree`; `other`: without colours."""
    return other + 3 * torch.arange(1, degree + 2).square()


def least_degrees(
    squares: Float[Tensor, "D N"],
    views: Float[Tensor, "N"],
    error_share: float,
    price: float,
    numbers: Int[Tensor, "D"],
) -> Int[Tensor, "N"]:
    """Returns the degree of each Gaussian that costs least; the highest where no view shows it.

    squares: squared change of a picture with colours of each degree, in the mean over the views that show the row.
    error_share: squared error of a view over what it shows; price: dB that a doubling of all numbers has to bring.
    """
    share = (numbers / numbers[-1]).to(squares)
    cost = squares + error_exponent(price) * error_share * share[:, None]
    return torch.where(views > 0, cost.argmin(0), len(numbers) - 1)


def kept_bands(degrees: Int[Tensor, "N"], count: int) -> Bool[Tensor, "N B"]:
    """Marks coefficients behind the constant one, of `count`, whose band is within the degree of a row."""
    band = torch.arange(1, count + 1, device=degrees.device).sqrt().floor()
    return band <= degrees[:, None]


def choose_degrees(fits: ColourFits, price: float, numbers: Int[Tensor, "D"]) -> ChosenDegrees:
    """Chooses the degree of each row that costs least, with its colours of that degree."""
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
    """Gives rows the chosen degrees and colours; it zeroes the bands above, with their moments."""
    before, degrees = table["sh_degree"], chosen.degrees.to(table["sh_degree"])
    lowered = degrees < chosen.highest
    table.columns["sh_degree"] = torch.where(lowered, degrees, before)  # higher bands may not have begun to learn
    take_coefficients(table, lowered, chosen.coefficients)
    clear_bands(table)
    counts = torch.bincount(table["sh_degree"].long(), minlength=chosen.highest + 1).tolist()
    listed = ", ".join(f"{count} of degree {degree}" for degree, count in enumerate(counts))
    logger.info("step %d: SH degrees at a price of %.2f dB per doubling of numbers: %s", step, price, listed)
    return {f"degree_{degree}": count for degree, count in enumerate(counts)}


def clear_bands(table: ParameterTable) -> None:
    """Zeroes the bands that rows do not have, and their moments."""
    kept = kept_bands(table["sh_degree"], table["sh_rest"].shape[1])[..., None]
    edit(table, "sh_rest", lambda old: old * kept, lambda moment: moment * kept)


def hold_bands(table: ParameterTable) -> None:
    """Zeroes gradients of bands that rows do not have."""
    rest = table["sh_rest"]
    if rest.grad is not None:
        rest.grad *= kept_bands(table["sh_degree"], rest.shape[1])[..., None]
