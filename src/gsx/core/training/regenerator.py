"""What redraws a picture: an upscaler, a restorer. It knows nothing of Gaussians."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, runtime_checkable

import torch
from torch import Tensor

from gsx.core.data.camera import Camera
from gsx.core.data.reduction import Reduction
from gsx.core.data.scene import View
from gsx.core.shapes import Float


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
    """The largest strength of any event."""
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
    refuse_if_stopping: Callable[[], None] = lambda: None
    """To be called now and then by what takes long: leaves it by an exception when the run was asked to stop."""


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
class NamesCode(Protocol):
    """Options of a regenerator that runs code which is part of no installed package."""

    def named_code(self) -> str:
        """Module or file that it runs; empty: none. A run folder that names some is gone on with only where it is
        trusted."""
        ...


@runtime_checkable
class Refusing(Protocol):
    """A regenerator that can say before training that it will not do."""

    def check(self, views: Sequence[View], scales: Sequence[int], moved: bool) -> None:
        """Raise ConfigError or InputError if it cannot redraw these training views at these scales; `moved`: other
        places are asked for as well."""
        ...
