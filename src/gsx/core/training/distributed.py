"""Processes that train one run together, and what they exchange (docs/how-to/sweeps-and-clusters.md)."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import TypeVar

import torch
from torch import Tensor

T = TypeVar("T")


@dataclass(frozen=True, kw_only=True)
class Ranks:
    """The processes that train one model: here one alone, whose exchanges return what it puts in."""

    rank: int = 0
    size: int = 1

    @property
    def first(self) -> bool:
        """Returns whether this one writes files and logs."""
        return self.rank == 0

    def share(self, batch: Sequence[T]) -> Sequence[T]:
        """Returns this rank's part of a batch of a multiple of `size`; parts of all ranks in order are the batch."""
        each = len(batch) // self.size
        return batch[self.rank * each : (self.rank + 1) * each]

    def all_gather(self, value: T) -> list[T]:
        """Returns the object of every rank, in order.

        Raises:
            TrainingError: one of them has left.
        """
        return [value]

    def add(self, tensors: Iterable[Tensor]) -> None:
        """Replaces each tensor by its sum over all ranks; as many and as large ones on each."""

    def gathered(self, parts: Sequence[dict[str, Tensor]], device: torch.device) -> list[dict[str, Tensor]]:
        """Returns the parts of all ranks, in order, on the device. They may differ in number and size."""
        return list(parts)

    def broadcast(self, make: Callable[[], T]) -> T:
        """Returns what the first rank makes, on all of them; the others wait."""
        return self.all_gather(make() if self.first else None)[0]  # type: ignore[return-value]

    def rank0_first(self, make: Callable[[], T]) -> T:
        """Returns what every rank makes for itself, the first before the others, which then find its caches."""
        if not self.first:
            self.all_gather(None)
            return make()
        made = make()
        self.all_gather(None)
        return made
