"""Regenerators: upscalers and restorers of pictures, which know nothing of Gaussians."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import torch
from torch import Tensor

from gsx.core.data.camera import Camera
from gsx.core.data.reduction import Reduction
from gsx.core.data.scene import View
from gsx.core.shapes import Float


@dataclass(frozen=True, eq=False, kw_only=True)
class Request:
    """A picture to regenerate, with its origin."""

    image: Float[Tensor, "3 h w"]
    """Display values in [0, 1]."""
    scale: int
    """Factor of the result's width and height."""
    reduction: Reduction = Reduction()
    """Filter that reduces a result to `image`; the default is a box average of display values."""
    camera: Camera
    """Camera of `image`."""
    view: View
    """Training view it was made from."""
    number: int
    """Index of that view."""
    photo: bool
    """True: `image` is cut from the photo; False: it is rendered."""
    seed: int
    strength: float
    """Share of the picture that may change, 0 to 1, for regenerators with such a setting."""
    strongest: float
    """Largest strength of all events."""
    prompt: str
    step: int

    @property
    def result_size(self) -> tuple[int, int]:
        """(height, width) of the result, px."""
        height, width = self.image.shape[1:]
        return height * self.scale, width * self.scale


@dataclass(frozen=True, eq=False, kw_only=True)
class RegeneratorContext:
    """Training views and renders that a regenerator may learn from."""

    views: Sequence[View]
    reduction: Reduction = Reduction()
    """Filter that made the scene's pictures from finer ones."""
    render: Callable[[Camera], Float[Tensor, "3 h w"]]
    """Renders the current model."""
    held_out: Callable[[float], list[Float[Tensor, "3 h w"]]]
    """Renders all views by models that learned the other half, for that share of the run's steps so far (`halves`):
    examples of faulty renders. Costs that training, once."""
    step: int
    seed: int
    device: torch.device
    folder: Path
    """Folder for learned files; a resumed run finds them there."""
    raise_if_stopping: Callable[[], None] = lambda: None
    """Raises `Stopped` if the run is stopping; call it regularly in long work."""


@runtime_checkable
class Regenerator(Protocol):
    """An upscaler or restorer of pictures."""

    def prepare(self, context: RegeneratorContext) -> dict[str, float]:
        """Learns from the scene, if anything; returns metrics for the log. Called at every event."""

    def regenerate(self, requests: Sequence[Request]) -> list[Float[Tensor, "3 H W"]]:
        """Returns a picture for each request, in order; display values."""


@runtime_checkable
class NamesCode(Protocol):
    """Options of a regenerator that runs code outside installed packages."""

    def named_code(self) -> str:
        """Returns the module or file that it runs; empty: none. Runs with such code resume only in trusted folders."""


@runtime_checkable
class HasProvenance(Protocol):
    """A regenerator with a pretrained model."""

    def provenance(self) -> dict[str, Any]:
        """Returns what identifies the model: its name, its files and their digests."""


@runtime_checkable
class Checkable(Protocol):
    """A regenerator that checks its requests before training."""

    def check(self, views: Sequence[View], scales: Sequence[int], moved: bool) -> None:
        """Raises an error if it cannot regenerate these views at these scales.

        Args:
            views: Training views.
            scales: Factors of the pictures' sides.
            moved: True: other poses are rendered as well.

        Raises:
            ConfigError, InputError: it cannot.
        """
