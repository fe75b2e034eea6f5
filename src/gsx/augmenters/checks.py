"""Checks of redrawn pictures against their inputs: size, colour, agreement, displacement."""

import math
from dataclasses import dataclass
from typing import Annotated, Protocol, runtime_checkable

import torch
from torch import Tensor

from gsx.core.quality.metrics import psnr
from gsx.core.ranges import Range
from gsx.core.shapes import Float
from gsx.core.training.regenerator import Request

LARGEST_DRIFT = 2 / 255
"""Largest difference of mean colours that is not corrected."""
MOST_CORRECTIONS = 4
"""Most corrections of a mean colour: reduction in linear light needs several."""
LEAST_SLOPE = 1e-3
"""Least RMS slope in every direction of a measurable displacement, display values per px."""
ACTIONS = ("drop", "warn", "off")


@dataclass(frozen=True, kw_only=True)
class Check:
    """A limit and the action for pictures beyond it."""

    limit: Annotated[float, Range(0, 1e6)]
    action: str
    """drop; warn: keep, count and report the picture; off: no check."""

    def __post_init__(self) -> None:
        if self.action not in ACTIONS:
            raise ValueError(f"the action of a check is '{self.action}'; choose drop, warn or off (in YAML 'off')")


@dataclass(frozen=True, kw_only=True)
class Checks:
    """Limits for redrawn pictures; values in conf/checks."""

    colour: Check
    """Largest change of the mean colour, 8-bit levels, after `match_colour`."""
    agreement: Check
    """Least PSNR between a reduced enlargement and its input, dB."""
    displacement: Check
    """Largest displacement, px of the input."""


@runtime_checkable
class WithChecks(Protocol):
    """Options of an augmenter with its own checks; others use those of the regenerator's role."""

    @property
    def checks(self) -> Checks:
        """Return the limits for its redrawn pictures."""
        ...


def defect(request: Request, result: Tensor) -> str:
    """Describes why a result is no picture of the requested kind; empty: it is."""
    expected = (3, *request.result_size)
    if tuple(result.shape) != expected:
        return f"it is {tuple(result.shape)} and should be {expected}"
    if not result.is_floating_point():
        return f"its values are {str(result.dtype).removeprefix('torch.')} and should be display values in [0, 1]"
    if not bool(torch.isfinite(result).all()):
        return "it holds values that are not finite"
    return ""


def match_colour(request: Request, result: Float[Tensor, "3 H W"]) -> Float[Tensor, "3 H W"]:
    """Corrects a mean colour that differs by more than LARGEST_DRIFT at the input's resolution."""
    for _ in range(MOST_CORRECTIONS):
        low, source = reduced_pair(request, result)
        drift = low.mean((1, 2)) - source.mean((1, 2))
        if float(drift.abs().max()) <= LARGEST_DRIFT:
            break
        result = result - drift[:, None, None]
    return result


def reduced_pair(
    request: Request, result: Float[Tensor, "3 H W"]
) -> tuple[Float[Tensor, "3 h w"], Float[Tensor, "3 h w"]]:
    """Returns (result reduced to its input's size, input) without the rim that outside pixels influence."""
    reduction = request.reduction
    return reduction.inner(reduction.reduce(result, request.scale)), reduction.inner(request.image.cpu())


def violations(request: Request, result: Float[Tensor, "3 H W"], checks: Checks) -> dict[str, str]:
    """Describes violations of the active checks, by check."""
    low, source = reduced_pair(request, result.cpu().float().clamp(0, 1))
    drift = 255 * float((low.mean((1, 2)) - source.mean((1, 2))).abs().max())
    agreement = psnr(low, source) if request.scale > 1 else math.inf
    shift = displacement(low, source) if checks.displacement.action != "off" else 0.0
    measured = {
        "colour": (drift > checks.colour.limit, f"its mean colour is {drift:.1f} levels off"),
        "agreement": (agreement < checks.agreement.limit, f"reduced it is {agreement:.1f} dB from its input"),
        "displacement": (shift > checks.displacement.limit, f"it is displaced by {shift:.2f} px"),
    }
    return {name: text for name, (beyond, text) in measured.items() if beyond and getattr(checks, name).action != "off"}


def displacement(image: Float[Tensor, "3 h w"], reference: Float[Tensor, "3 h w"]) -> float:
    """Estimates the shift between two pictures, px; 0 if slopes are too small.

    Source: Lucas and Kanade 1981; least squares of image - reference = shift . gradient.
    """
    if min(reference.shape[1:]) < 3:
        return 0.0
    grey, other = reference.double().mean(0), image.double().mean(0)
    dx = (grey[1:-1, 2:] - grey[1:-1, :-2]) / 2
    dy = (grey[2:, 1:-1] - grey[:-2, 1:-1]) / 2
    difference = (other - grey)[1:-1, 1:-1]
    slopes = torch.stack([dx.flatten(), dy.flatten()])
    system, right = slopes @ slopes.T, slopes @ difference.flatten()
    if float(torch.linalg.eigvalsh(system)[0]) < LEAST_SLOPE**2 * slopes.shape[1]:
        return 0.0
    return float(torch.linalg.solve(system, right).norm())
