"""Photographs made worse in a known way, so that the truth of what mends them is known (research alone)."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol, runtime_checkable

import torch
from torch import Tensor

from gsx.core.data.camera import Camera
from gsx.core.data.scene import FromFile, ImageSource, Masked, Scene, View
from gsx.core.errors import ConfigError
from gsx.core.seeds import derived_seed
from gsx.core.shapes import Bool, Float, UInt8

BALANCE = 0.25
"""Spread of a channel's own gain, of that of the exposure."""


@runtime_checkable
class Disturbable(Protocol):
    """Options of a scene whose photographs may be made worse."""

    @property
    def disturb(self) -> Mapping[str, float]:
        """By what, and how much."""
        ...


@dataclass(frozen=True, eq=False)
class Exposed:
    """A source whose values are multiplied, channel by channel, and saturate."""

    source: ImageSource
    gains: Float[Tensor, "3"]

    def image(self, camera: Camera) -> UInt8[Tensor, "3 H W"]:
        """The truth at another exposure."""
        scaled = self.source.image(camera) * self.gains[:, None, None]
        return scaled.round().clamp(0, 255).to(torch.uint8)

    def max_zoom(self, camera: Camera) -> float:
        """That of the source."""
        return self.source.max_zoom(camera)

    def counted(self, camera: Camera) -> Bool[Tensor, "H W"] | None:
        """That of the source."""
        return self.source.counted(camera) if isinstance(self.source, Masked) else None


@dataclass(frozen=True, eq=False)
class ExposedFile(Exposed):
    """The same of a source that reads a file."""

    @property
    def path(self) -> Path:
        """The file that the source reads."""
        assert isinstance(self.source, FromFile)
        return self.source.path


def gains_of(name: str, spread: float) -> Float[Tensor, "3"]:
    """Gains of the photograph of that name: the same in every run, whatever the seed."""
    drawn = torch.randn(4, generator=torch.Generator().manual_seed(derived_seed("disturbed exposure", name)))
    return (spread * (drawn[0] + BALANCE * drawn[1:])).exp()


def exposed(views: Sequence[View], spread: float) -> list[View]:
    """Views at exposures of their own."""
    out = []
    for view in views:
        kind = ExposedFile if isinstance(view.source, FromFile) else Exposed
        out.append(replace(view, source=kind(view.source, gains_of(view.name, spread))))
    return out


def disturbed(scene: Scene, by: Mapping[str, float]) -> Scene:
    """The scene with its training photographs made worse, and a note that says so; test photographs stay as they are.

    by: `exposure`: standard deviation of log gains of display values, one a photograph; channels differ by a quarter.

    Raises:
        ConfigError: there is no such disturbance.
    """
    if unknown := sorted(set(by) - {"exposure"}):
        raise ConfigError(f"scene.disturb.{unknown[0]}: photographs can be disturbed in exposure alone")
    spread = by.get("exposure", 0.0)
    if spread == 0:
        return scene
    percent = 100 * (math.exp(spread) - 1)
    note = f"disturbed: exposures of training photographs are spread by {percent:.0f} % (scene.disturb.exposure)"
    return replace(
        scene,
        train=exposed(scene.train, spread),
        notes=[*scene.notes, note],
        provenance=scene.provenance | {"disturbed": {"exposure": spread}},
    )
