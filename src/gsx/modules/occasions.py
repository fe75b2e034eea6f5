"""When a run asks what its photographs have wrong, and which of them it asks first."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Protocol, TypeVar, runtime_checkable

import torch

from gsx.core.data.scene import View
from gsx.core.seeds import derived_seed

Photograph = TypeVar("Photograph")
"""Its view, or its number."""
WHEN = ("never", "auto", "always")
"""Whether it does: auto mends what is found, always mends without asking."""


@runtime_checkable
class Asking(Protocol):
    """Options that say when a run asks."""

    @property
    def when(self) -> str: ...
    @property
    def start(self) -> float: ...
    @property
    def until(self) -> float: ...
    @property
    def times(self) -> int: ...


def occasions(own: Asking, iterations: int) -> list[int]:
    """The steps before which it asks, at shares of the steps that grow by the same factor: a model that knows little
    yet changes most; none where it never does."""
    if own.when == "never":
        return []
    last = max(1, own.times - 1)
    shares = [own.start * (own.until / own.start) ** (number / last) for number in range(own.times)]
    return sorted({max(1, round(share * iterations)) + 1 for share in shares})


def due_at(number: int, steps: Sequence[int], last: int, needed: bool) -> bool:
    """Whether it asks before a step: of these the first, and where that found a need the others; not again where a step
    is taken anew. last: the one before which it asked last."""
    return number in steps and number > last and (number == steps[0] or needed)


def refuse_wrong(name: str, own: Asking) -> None:
    """Raise ValueError for options below `training.NAME` that say nothing of when."""
    if own.when not in WHEN:
        raise ValueError(f"training.{name}.when is '{own.when}'; choose from {', '.join(WHEN)}")
    if not 0 < own.start < 1 or not own.start <= own.until < 1:
        raise ValueError(
            f"training.{name}.start is {own.start} and training.{name}.until {own.until}: give shares of the steps "
            "between 0 and 1, the second one not smaller"
        )


@dataclass(eq=False)
class MadeOf:
    """What was made of training views: the same for the same ones, until it is forgotten."""

    made: list[tuple[Sequence[View], list[View]]] = field(default_factory=list)

    def views(self, views: Sequence[View], make: Callable[[], list[View]]) -> list[View]:
        """What was made of these, or is now."""
        for asked, made in self.made:
            if asked is views:
                return made
        self.made.append((views, make()))
        return self.made[-1][1]


def some_photographs(views: Sequence[Photograph], count: int, purpose: str) -> list[Photograph]:
    """At most so many: the same in every run."""
    generator = torch.Generator().manual_seed(derived_seed(purpose))
    order = torch.randperm(len(views), generator=generator)[:count]
    return [views[number] for number in order.tolist()]
