"""An SH degree for each Gaussian: as many bands of colour as its pictures need.

A Gaussian with colours of degree 3 is 59 numbers, 45 of them in three bands of which a matt surface needs none. Once,
late in the run, its colours of every lower degree are put in the place of its own in training views; what the picture
changes by, squared and summed, is what the bands above are worth (`core.training.evidence`). Against it stands what
their numbers cost, by the price of a doubling of all numbers. The degree at which both together are least is kept.
"""

import logging

import torch
from torch import Tensor

from gsx.backbones.capacity import error_exponent
from gsx.core.shapes import Bool, Float, Int
from gsx.core.training.evidence import Removal
from gsx.core.training.parameter_table import ParameterTable, edit

logger = logging.getLogger(__name__)


def numbers_of(degree: int, other: int) -> Int[Tensor, "D"]:
    """How many numbers a Gaussian is with colours of each degree 0..`degree`; `other`: with none of them."""
    return other + 3 * torch.arange(1, degree + 2).square()


def least_degrees(
    squares: Float[Tensor, "D N"],
    shown: Float[Tensor, "N"],
    error_share: float,
    price: float,
    numbers: Int[Tensor, "D"],
) -> Int[Tensor, "N"]:
    """The degree of each Gaussian that costs least; the highest where no view shows it.

    squares: of what a picture changes by with colours of a degree, in the mean over the views that show it.
    error_share: the squared error of a view over what it shows; price: dB that a doubling of all numbers has to bring.
    """
    share = (numbers / numbers[-1]).to(squares)
    cost = squares + error_exponent(price) * error_share * share[:, None]
    return torch.where(shown > 0, cost.argmin(0), len(numbers) - 1)


def kept_bands(degrees: Int[Tensor, "N"], count: int) -> Bool[Tensor, "N B"]:
    """Whether each of the `count` coefficients behind the constant one is of a band within the degree of a row."""
    band = torch.arange(1, count + 1, device=degrees.device).sqrt().floor()
    return band <= degrees[:, None]


def judge_degrees(table: ParameterTable, found: Removal, price: float, step: int) -> dict[str, float]:
    """Lower the degrees of rows by what was found of them; the bands above are zeroed with their moments."""
    highest, own = len(found.squares) - 1, table["sh_degree"]
    other = sum(value[0].numel() for name, value in table.parameters.items() if name not in ("sh_dc", "sh_rest"))
    degrees = least_degrees(found.squares, found.shown, found.error_share, price, numbers_of(highest, other)).to(own)
    table.columns["sh_degree"] = torch.where(degrees < highest, degrees, own)  # higher ones may not have begun to learn
    clear_bands(table)
    counts = torch.bincount(table["sh_degree"].long(), minlength=highest + 1).tolist()
    told = ", ".join(f"{count} of degree {degree}" for degree, count in enumerate(counts))
    logger.info("step %d: colours are judged at %.2f dB per doubling of numbers: %s", step, price, told)
    return {f"degree_{degree}": count for degree, count in enumerate(counts)}


def clear_bands(table: ParameterTable) -> None:
    """Zero the bands that rows do not have, and their moments."""
    kept = kept_bands(table["sh_degree"], table["sh_rest"].shape[1])[..., None]
    edit(table, "sh_rest", lambda old: old * kept, lambda moment: moment * kept)


def hold_bands(table: ParameterTable) -> None:
    """Let no gradient move bands that rows do not have."""
    rest = table["sh_rest"]
    if rest.grad is not None:
        rest.grad *= kept_bands(table["sh_degree"], rest.shape[1])[..., None]
