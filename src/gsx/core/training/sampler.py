"""Order in which training views are picked."""

from dataclasses import dataclass, field, replace

import torch

from gsx.core.seeds import derived_seed


@dataclass(eq=False)
class Sampler:
    """Random order of training views, reshuffled after each pass (3D-GS, train.py), from the seed alone."""

    count: int
    """Number of training views."""
    seed: int
    order: list[int] = field(default_factory=list)
    """Indices left in the current order, the next one last."""
    orders: int = 0
    """Number of orders drawn so far."""
    batch: int = 1
    """Views per step."""
    current: list[int] = field(default_factory=list)
    """Indices of the views of the current step."""

    def take(self) -> list[int]:
        """Returns the indices of the views of the next step, in order."""
        self.current = [self.next() for _ in range(self.batch)]
        return self.current

    def put_back(self) -> None:
        """Undoes `take`: the same views come next again."""
        self.order += reversed(self.current)
        self.current = []

    def next(self) -> int:
        """Returns the index of the next view."""
        if not self.order:
            generator = torch.Generator().manual_seed(derived_seed("views", self.seed, self.orders))
            self.order, self.orders = torch.randperm(self.count, generator=generator).tolist(), self.orders + 1
        return self.order.pop()

    def coming(self, steps: int) -> set[int]:
        """Returns the indices of the views of the next steps."""
        ahead = replace(self, order=list(self.order))
        return {ahead.next() for _ in range(steps * self.batch)}
