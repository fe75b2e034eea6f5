"""Processes that train one run together (docs/how-to/sweeps-and-clusters.md)."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import TypeVar

import torch
from torch import Tensor

T = TypeVar("T")


@dataclass(frozen=True, kw_only=True)
class Ranks:
    """Process group of one process, whose exchanges return their input; base class of larger groups."""

    rank: int = 0
    size: int = 1

    @property
    def first(self) -> bool:
        """True on the rank that writes files and logs."""
        return self.rank == 0

    def share(self, batch: Sequence[T]) -> Sequence[T]:
        """Returns this rank's part of a batch, whose length is a multiple of `size`."""
        each = len(batch) // self.size
        return batch[self.rank * each : (self.rank + 1) * each]

    def all_gather(self, value: T) -> list[T]:
        """Returns the objects of all ranks, in order.

        Raises:
            TrainingError: a process has ended.
        """
        return [value]

    def add(self, tensors: Iterable[Tensor]) -> None:
        """Replaces each tensor by its sum over all ranks; number and shapes must agree."""

    def gathered(self, parts: Sequence[dict[str, Tensor]], device: torch.device) -> list[dict[str, Tensor]]:
        """Returns the tensors of all ranks, in order, on the device; number and shapes may differ."""
        return list(parts)

    def broadcast(self, make: Callable[[], T]) -> T:
        """Runs `make` on rank 0 and returns its result on all ranks."""
        return self.all_gather(make() if self.first else None)[0]  # type: ignore[return-value]

    def rank0_first(self, make: Callable[[], T]) -> T:
        """Runs `make` on every rank, on rank 0 first so that the others find its caches."""
        if not self.first:
            self.all_gather(None)
            return make()
        made = make()
        self.all_gather(None)
        return made
