"""One run on the processes of torchrun (docs/how-to/sweeps-and-clusters.md).

A rank that leaves, by an error or at its end, sends a `Departure` in place of its next object, so that no rank waits in
vain; tensors are therefore exchanged only right after objects.
"""

import os
import sys
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from datetime import timedelta
from typing import Any, NoReturn, TypeVar

import torch
import torch.distributed as dist
from torch import Tensor

from gsx.core.errors import TrainingError, first_line
from gsx.core.training.distributed import Ranks

T = TypeVar("T")

PATIENCE = timedelta(days=2)
"""Longest wait of ranks for rank 0, which makes pseudo views and evaluates alone."""


class Joined(Ranks):
    """Processes that torchrun has started."""

    def all_gather(self, value: T) -> list[T]:
        """Returns the object of every rank, in order; see `Ranks`."""
        values = exchange(value)
        for rank, other in enumerate(values):
            if isinstance(other, Departure):
                raise TrainingError(f"process {rank} of {self.size} has stopped: {other.reason}")
        return values

    def add(self, tensors: Iterable[Tensor]) -> None:
        """Sums in the same order on every rank; exact for two of them, rounded in some order for more."""
        for tensor in tensors:
            dist.all_reduce(tensor)

    def gathered(self, parts: Sequence[dict[str, Tensor]], device: torch.device) -> list[dict[str, Tensor]]:
        """Exchanges shapes first, then every tensor from its rank to the others."""
        shapes = [{name: (value.shape, value.dtype) for name, value in part.items()} for part in parts]
        out: list[dict[str, Tensor]] = []
        for rank, listed in enumerate(self.all_gather(shapes)):
            empty = [{name: torch.empty(*of[:1], dtype=of[1], device=device) for name, of in p.items()} for p in listed]
            received = list(parts) if rank == self.rank else empty
            for part in received:
                for name, tensor in part.items():
                    part[name] = tensor.contiguous()
                    if tensor.numel():
                        dist.broadcast(part[name], rank)
            out += received
        return out


# -- start and end -----------------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class Departure:
    """The last object that a rank sends."""

    code: int
    reason: str


def current_ranks() -> Ranks:
    """Returns the group that this process has joined; itself alone where it has not."""
    if not (dist.is_available() and dist.is_initialized()):
        return Ranks()
    return Joined(rank=dist.get_rank(), size=dist.get_world_size())


def run_together(action: Callable[[], int], explain: Callable[[BaseException], int]) -> NoReturn:
    """Runs an action with the other processes of torchrun and exits with rank 0's code, once all are done.

    `explain` prints an error and returns its code, or raises it again.
    """
    gpus = torch.cuda.is_available() and dist.is_nccl_available()
    dist.init_process_group("cpu:gloo,cuda:nccl" if gpus else "gloo", timeout=PATIENCE)
    code, reason = 1, "it was done"
    try:
        code = action()
    except BaseException as error:
        reason = first_line(error)
        code = explain(error)
    finally:
        code = leave(Departure(code=code, reason=reason))
    end(code)


def end(code: int) -> NoReturn:
    """Ends this process at once: threads of the group sometimes abort an interpreter that shuts down."""
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)


def leave(departure: Departure) -> int:
    """Sends its departure until all others have sent theirs; returns the first rank's code."""
    received: list[Any] = [None]
    try:
        while not all(isinstance(other, Departure) for other in received):
            received = exchange(departure)
    except (TrainingError, KeyboardInterrupt):  # another rank is gone, or the user stops waiting
        return departure.code
    return received[0].code


def exchange(value: Any) -> list[Any]:
    """Returns the object of every process, in order of ranks.

    Raises:
        TrainingError: one of them has ended without its departure.
    """
    values = [None] * dist.get_world_size()
    try:
        dist.all_gather_object(values, value)
    except RuntimeError as error:
        raise TrainingError(
            "another process of this run exited unexpectedly (out of memory?): run gsx resume RUN with all processes"
        ) from error
    return values
