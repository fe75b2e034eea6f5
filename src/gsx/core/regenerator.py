"""What redraws a picture: an upscaler, a restorer. It knows nothing of Gaussians (spec 6.4)."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, runtime_checkable

import torch
from torch import Tensor

from gsx.core.camera import Camera
from gsx.core.scene import View
from gsx.core.shapes import Float

LARGEST_DRIFT = 2 / 255
"""Largest change of a picture's mean colour (spec 6.4)."""
LEAST_AGREEMENT = 30.0
"""Least PSNR between an upscaled picture, box-averaged, and what it was made from, dB (spec 6.4)."""
LEAST_SLOPE = 1e-3
"""Pictures with gentler slopes than this in some direction, display values per px, show no displacement in it."""
PROJECTIONS = 5
"""Rounds of projection and clamping; each halves what clamping undid (spec 5.3)."""
LARGEST_SHIFT = 0.25
"""Largest displacement, px of the input (spec 1.5)."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Request:
    """A picture to redraw, and all that is known about it."""

    image: Float[Tensor, "3 h w"]
    """Display values in [0, 1]."""
    scale: int
    """The result is this many times as wide and high."""
    camera: Camera
    """That sees `image`."""
    view: View
    """The training view it was made from."""
    number: int
    """Of that view."""
    photo: bool
    """Whether `image` was cut out of the photograph; else it was rendered."""
    seed: int
    strength: float
    """How much may change, 0 to 1, for regenerators that know such a thing."""
    strongest: float
    """The strength at the first event."""
    prompt: str
    step: int

    @property
    def result_size(self) -> tuple[int, int]:
        """(height, width) of the result."""
        height, width = self.image.shape[1:]
        return height * self.scale, width * self.scale


@dataclass(frozen=True, eq=False, kw_only=True)
class Material:
    """What a regenerator may learn from before its first call: training views only."""

    views: Sequence[View]
    render: Callable[[Camera], Float[Tensor, "3 h w"]]
    """The model as it is now."""
    held_out: Callable[[float], list[Float[Tensor, "3 h w"]]]
    """The views, in order, as models show them that were fitted to the other half of the views alone, each for that
    share of the steps that the run has taken (`core.halves`): what to learn repair from. Costs that training, once."""
    step: int
    seed: int
    device: torch.device
    folder: Path
    """Where what was learnt can be kept; a resumed run finds it there."""


@runtime_checkable
class Regenerator(Protocol):
    """Redraws pictures."""

    def prepare(self, material: Material) -> dict[str, float]:
        """Learn from the scene, if there is anything to learn; returns figures for the log. Called at every event."""
        ...

    def regenerate(self, requests: Sequence[Request]) -> list[Float[Tensor, "3 H W"]]:
        """A picture for each request, in order; display values."""
        ...


@runtime_checkable
class Checked(Protocol):
    """A regenerator that can say before training that it will not do."""

    def check(self, views: Sequence[View], scales: Sequence[int], moved: bool) -> None:
        """Raise ConfigError or InputError if it cannot redraw these training views at these scales; `moved`: other
        places are asked for as well."""
        ...


def box_average(image: Float[Tensor, "C H W"], factor: int) -> Float[Tensor, "C h w"]:
    """Means over blocks of factor x factor pixels."""
    return torch.nn.functional.avg_pool2d(image[None], factor)[0] if factor > 1 else image


def as_blocks(image: Float[Tensor, "*C h w"], factor: int) -> Float[Tensor, "*C H W"]:
    """Every pixel as a block of factor x factor."""
    return image.repeat_interleave(factor, -2).repeat_interleave(factor, -1)


def projected(image: Float[Tensor, "3 H W"], low: Float[Tensor, "3 h w"], factor: int) -> Float[Tensor, "3 H W"]:
    """The nearest picture with that box average, clamped to [0, 1]: D D^T = I / a^2, so errors are spread evenly."""
    for _ in range(PROJECTIONS):
        image = (image + as_blocks(low - box_average(image, factor), factor)).clamp(0, 1)
    return image


def colour_drift(request: Request, result: Float[Tensor, "3 H W"]) -> Float[Tensor, "3"]:
    """By how much the mean colour of a result differs from that of its input."""
    return result.cpu().float().mean((1, 2)) - request.image.cpu().mean((1, 2))


def colour_matched(request: Request, result: Float[Tensor, "3 H W"]) -> Float[Tensor, "3 H W"]:
    """The result, its mean colour put right where it is more than LARGEST_DRIFT off (spec 6.4)."""
    drift = colour_drift(request, result)
    return result if float(drift.abs().max()) <= LARGEST_DRIFT else result.cpu() - drift[:, None, None]


def complaint(request: Request, result: Tensor) -> str:
    """Why a result cannot be used; empty for a sound one (spec 6.4)."""
    expected = (3, *request.result_size)
    if tuple(result.shape) != expected:
        return f"it is {tuple(result.shape)} and should be {expected}"
    if not bool(torch.isfinite(result).all()):
        return "it holds values that are not finite"
    low = box_average(result.cpu().float().clamp(0, 1), request.scale)
    given = request.image.cpu()
    drift = float((low.mean((1, 2)) - given.mean((1, 2))).abs().max())
    if drift > 2 * LARGEST_DRIFT:  # what colour matching and clamping leave
        return f"its mean colour is {drift * 255:.1f} levels off"
    error = float((low - given).square().mean())
    if request.scale > 1 and error > 10 ** (-LEAST_AGREEMENT / 10):
        return f"box-averaged it differs from its input by more than {LEAST_AGREEMENT:g} dB"
    shift = displacement(low, given)
    if shift > LARGEST_SHIFT:
        return f"it is displaced by {shift:.2f} px"
    return ""


def displacement(image: Float[Tensor, "3 h w"], reference: Float[Tensor, "3 h w"]) -> float:
    """Length of the shift that explains their difference best to first order, px; 0 where nothing could show one.

    The least-squares solution of image - reference = shift . gradient (Lucas and Kanade 1981).
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
