"""In which order training views are picked."""

from dataclasses import dataclass, field, replace

import torch

from gsx.core.seeds import derived_seed


@dataclass(eq=False)
class Sampler:
    """Training views without replacement, reshuffled when all have been seen (3D-GS, train.py).

    Each order comes from the seed and its number alone, so that the next views are known.
    """

    count: int
    seed: int
    order: list[int] = field(default_factory=list)
    """What is left of the current order, the next one last."""
    begun: int = 0
    """Orders begun so far."""
    batch: int = 1
    """Views of one step."""
    taken: list[int] = field(default_factory=list)
    """Those of the step under way."""

    def take(self) -> list[int]:
        """Indices of the views of the next step, in order."""
        self.taken = [self.next() for _ in range(self.batch)]
        return self.taken

    def put_back(self) -> None:
        """Undo `take`: the same views come next again."""
        self.order += reversed(self.taken)
        self.taken = []

    def next(self) -> int:
        """Index of the next view."""
        if not self.order:
            generator = torch.Generator().manual_seed(derived_seed("views", self.seed, self.begun))
            self.order, self.begun = torch.randperm(self.count, generator=generator).tolist(), self.begun + 1
        return self.order.pop()

    def coming(self, steps: int) -> set[int]:
        """Indices of the views of the next steps."""
        ahead = replace(self, order=list(self.order))
        return {ahead.next() for _ in range(steps * self.batch)}
