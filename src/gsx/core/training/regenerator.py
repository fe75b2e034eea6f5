"""What redraws a picture: an upscaler, a restorer. It knows nothing of Gaussians."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, runtime_checkable

import torch
from torch import Tensor

from gsx.core.data.camera import Camera
from gsx.core.data.reduction import Reduction
from gsx.core.data.scene import View
from gsx.core.quality.metrics import psnr
from gsx.core.shapes import Float

LARGEST_DRIFT = 2 / 255
"""Mean colours that differ by more are put right."""
LEAST_SLOPE = 1e-3
"""Pictures with gentler slopes than this in some direction, display values per px, show no displacement in it."""
ACTIONS = ("drop", "warn", "off")


@dataclass(frozen=True, kw_only=True)
class Check:
    """A limit, and what happens to a picture beyond it."""

    limit: float
    action: str
    """drop; warn: it is kept, counted and told; off: nothing is looked at."""

    def __post_init__(self) -> None:
        if self.action not in ACTIONS:
            raise ValueError(f"the action of a check is '{self.action}'; choose drop, warn or off (in YAML 'off')")
        if not self.limit >= 0:
            raise ValueError(f"the limit of a check is {self.limit}; give at least 0")

    @property
    def active(self) -> bool:
        """Whether anything happens beyond the limit."""
        return self.action != "off"


@dataclass(frozen=True, kw_only=True)
class Checks:
    """What a redrawn picture has to keep of what it was made from; values in conf/checks."""

    colour: Check
    """Largest change of the mean colour, 8-bit levels, after `colour_matched`."""
    agreement: Check
    """Least PSNR between an enlarged picture, reduced again, and its input, dB."""
    displacement: Check
    """Largest displacement, px of the input."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Request:
    """A picture to redraw, and all that is known about it."""

    image: Float[Tensor, "3 h w"]
    """Display values in [0, 1]."""
    scale: int
    """The result is this many times as wide and high."""
    reduction: Reduction = Reduction()
    """By which a result becomes `image`: the scene's. The default: box averages of display values."""
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
class RegeneratorContext:
    """What a regenerator may learn from before its first call: training views only."""

    views: Sequence[View]
    reduction: Reduction = Reduction()
    """How the scene's pictures come from finer ones."""
    render: Callable[[Camera], Float[Tensor, "3 h w"]]
    """The model as it is now."""
    held_out: Callable[[float], list[Float[Tensor, "3 h w"]]]
    """The views, in order, as models show them that were fitted to the other half of the views alone, each for that
    share of the steps that the run has taken (`halves`): what to learn repair from. Costs that training, once."""
    step: int
    seed: int
    device: torch.device
    folder: Path
    """Where what was learnt can be kept; a resumed run finds it there."""


@runtime_checkable
class Regenerator(Protocol):
    """Redraws pictures."""

    def prepare(self, context: RegeneratorContext) -> dict[str, float]:
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


def colour_drift(request: Request, result: Float[Tensor, "3 H W"]) -> Float[Tensor, "3"]:
    """By how much the mean colour of a result differs from that of its input."""
    return result.cpu().float().mean((1, 2)) - request.image.cpu().mean((1, 2))


def colour_matched(request: Request, result: Float[Tensor, "3 H W"]) -> Float[Tensor, "3 H W"]:
    """The result, its mean colour put right where it is more than LARGEST_DRIFT off."""
    drift = colour_drift(request, result)
    return result if float(drift.abs().max()) <= LARGEST_DRIFT else result.cpu() - drift[:, None, None]


def unusable(request: Request, result: Tensor) -> str:
    """Why a result is no picture of what was asked for; empty for one that is."""
    expected = (3, *request.result_size)
    if tuple(result.shape) != expected:
        return f"it is {tuple(result.shape)} and should be {expected}"
    if not bool(torch.isfinite(result).all()):
        return "it holds values that are not finite"
    return ""


def strayed(request: Request, result: Float[Tensor, "3 H W"], checks: Checks) -> dict[str, str]:
    """How a result differs from its input by more than a check allows, in words by the check's name.

    Looked at without the rim of the window, which was reduced from pixels beyond it.
    """
    reduction = request.reduction
    low = reduction.inner(reduction.reduce(result.cpu().float().clamp(0, 1), request.scale))
    given = reduction.inner(request.image.cpu())
    drift = 255 * float((low.mean((1, 2)) - given.mean((1, 2))).abs().max())
    agreement = psnr(low, given) if request.scale > 1 else math.inf
    shift = displacement(low, given) if checks.displacement.active else 0.0
    words = {
        "colour": (drift > checks.colour.limit, f"its mean colour is {drift:.1f} levels off"),
        "agreement": (agreement < checks.agreement.limit, f"reduced it is {agreement:.1f} dB from its input"),
        "displacement": (shift > checks.displacement.limit, f"it is displaced by {shift:.2f} px"),
    }
    return {name: told for name, (beyond, told) in words.items() if beyond and getattr(checks, name).active}


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
