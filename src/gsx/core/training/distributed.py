"""One run on several processes: what they tell each other (docs/clusters.md). A process by itself tells nobody.

They exchange words (small objects) and tensors. A rank that leaves, for an error or at its end, says so in place of its
next word, so that nobody waits for it in vain; tensors are therefore exchanged only right after words.
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

T = TypeVar("T")

PATIENCE = timedelta(days=2)
"""How long ranks wait for the first, which makes pseudo views and evaluates alone."""


@dataclass(frozen=True, kw_only=True)
class Ranks:
    """The processes that train one model: here one alone, whose exchanges give back what it puts in."""

    rank: int = 0
    size: int = 1

    @property
    def first(self) -> bool:
        """Whether this one writes files and speaks."""
        return self.rank == 0

    def share(self, batch: Sequence[T]) -> Sequence[T]:
        """This rank's part of a batch of a multiple of `size`; the parts of all ranks, in order, are the batch."""
        each = len(batch) // self.size
        return batch[self.rank * each : (self.rank + 1) * each]

    def all_gather(self, word: T) -> list[T]:
        """The word of every rank, in order.

        Raises:
            TrainingError: one of them has left.
        """
        return [word]

    def add(self, tensors: Iterable[Tensor]) -> None:
        """Replace each tensor by its sum over all ranks; as many and as large ones on each."""

    def gathered(self, parts: Sequence[dict[str, Tensor]], device: torch.device) -> list[dict[str, Tensor]]:
        """The parts of all ranks, in order, on the device. They may differ in number and size."""
        return list(parts)

    def broadcast(self, make: Callable[[], T]) -> T:
        """What the first rank makes, on all of them; the others wait."""
        return self.all_gather(make() if self.first else None)[0]  # type: ignore[return-value]

    def rank0_first(self, make: Callable[[], T]) -> T:
        """What every rank makes for itself, the first before the others, which find in caches what it has kept."""
        if self.first:
            made = make()
            self.all_gather(None)
            return made
        self.all_gather(None)
        return make()


class Joined(Ranks):
    """Processes that torchrun has started."""

    def all_gather(self, word: T) -> list[T]:
        """The word of every rank, in order; see `Ranks`."""
        words = exchange(word)
        for rank, other in enumerate(words):
            if isinstance(other, Left):
                raise TrainingError(f"process {rank} of {self.size} has stopped: {other.reason}")
        return words

    def add(self, tensors: Iterable[Tensor]) -> None:
        """Sums in the same order on every rank; exact for two of them, rounded in some order for more."""
        for tensor in tensors:
            dist.all_reduce(tensor)

    def gathered(self, parts: Sequence[dict[str, Tensor]], device: torch.device) -> list[dict[str, Tensor]]:
        """Shapes first, then every tensor from its rank to the others."""
        shapes = [{name: (value.shape, value.dtype) for name, value in part.items()} for part in parts]
        out: list[dict[str, Tensor]] = []
        for rank, listed in enumerate(self.all_gather(shapes)):
            empty = [{name: torch.empty(*of[:1], dtype=of[1], device=device) for name, of in p.items()} for p in listed]
            held = list(parts) if rank == self.rank else empty
            for part in held:
                for name, tensor in part.items():
                    part[name] = tensor.contiguous()
                    if tensor.numel():
                        dist.broadcast(part[name], rank)
            out += held
        return out


# -- coming and going --------------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class Left:
    """The last word of a rank."""

    code: int
    reason: str


def ranks_here() -> Ranks:
    """The group that this process has joined; itself alone where it has not."""
    if not (dist.is_available() and dist.is_initialized()):
        return Ranks()
    return Joined(rank=dist.get_rank(), size=dist.get_world_size())


def as_one(action: Callable[[], int], explained: Callable[[BaseException], int]) -> NoReturn:
    """Do something with the other processes of torchrun, and end with the exit code of the first, once all are done.

    `explained` shows an error and returns its code, or raises it again.
    """
    gpus = torch.cuda.is_available() and dist.is_nccl_available()
    dist.init_process_group("cpu:gloo,cuda:nccl" if gpus else "gloo", timeout=PATIENCE)
    code, reason = 1, "it was done"
    try:
        code = action()
    except BaseException as error:
        reason = first_line(error)
        code = explained(error)
    finally:
        code = leave(Left(code=code, reason=reason))
    end(code)


def end(code: int) -> NoReturn:
    """End this process at once: while its interpreter is taken down, threads of the group now and then abort it."""
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)


def leave(word: Left) -> int:
    """Say a last word until all others have said theirs; returns the first rank's code."""
    said: list[Any] = [None]
    try:
        while not all(isinstance(other, Left) for other in said):
            said = exchange(word)
    except (TrainingError, KeyboardInterrupt):  # nobody is there to hear it, or nobody wants to wait
        return word.code
    return said[0].code


def exchange(word: Any) -> list[Any]:
    """The word of every process, in order of ranks.

    Raises:
        TrainingError: one of them has died without a last word.
    """
    words = [None] * dist.get_world_size()
    try:
        dist.all_gather_object(words, word)
    except RuntimeError as error:
        raise TrainingError(
            "another process of this run has died without a word (killed, perhaps for want of memory): go on with gsx "
            "resume RUN, on all of them"
        ) from error
    return words
