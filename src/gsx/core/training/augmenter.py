"""What an augmenter is built from, and what it may tell beside its terms; the protocol itself is `run.Augmenter`."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from gsx.augmenters.checked_regenerator import CheckedRegenerator
from gsx.core.data.scene import Scene
from gsx.core.training.run import Augmenter

__all__ = ["Augmenter", "AugmenterContext", "Foretold", "Replacing"]


@dataclass(frozen=True, eq=False, kw_only=True)
class AugmenterContext:
    """What an augmenter is built from."""

    name: str
    scene: Scene
    iterations: int
    seed: int
    regenerator: Callable[[str], CheckedRegenerator]
    """The regenerator of a role, `upscale` or `restore`."""


@runtime_checkable
class Replacing(Protocol):
    """An augmenter whose terms take the place of a part of the photographs' own loss."""

    def share(self) -> float:
        """The largest part, from 0; those of all augmenters of a run add up to less than 1."""
        ...


@runtime_checkable
class Foretold(Protocol):
    """Options of an augmenter that tell, before there is a scene, where it begins; plans over many runs ask."""

    def begins(self, iterations: int) -> int:
        """What `Augmenter.begins` will say in a run of that length."""
        ...
