"""What an augmenter is built from, and what it may tell beside its terms; the protocol itself is `run.Augmenter`."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

from gsx.core.data.scene import Scene
from gsx.core.training.regenerator import Regenerator
from gsx.core.training.run import Augmenter

__all__ = ["Augmenter", "AugmenterContext", "Foretold", "Replacing", "Telling"]


@dataclass(frozen=True, eq=False, kw_only=True)
class AugmenterContext:
    """What an augmenter is built from."""

    name: str
    scene: Scene
    iterations: int
    seed: int
    regenerator: Callable[[str], Regenerator]
    """The regenerator of a role, `upscale` or `restore`."""


@runtime_checkable
class Telling(Protocol):
    """An augmenter that tells what became of the pictures it asked for; metrics.jsonl and evaluations count them."""

    def told(self, step: int) -> dict[str, Any]:
        """At the first step that asks for new pictures their `event`, and by scale how many were `asked` for, how many
        `dropped`, and `warned` of by check; else empty. JSON-serialisable."""
        ...


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
