"""When a run asks what its photographs have wrong, and which of them it asks first."""

from collections.abc import Sequence

import torch

from gsx.core.data.scene import View
from gsx.core.seeds import derived_seed

WHEN = ("never", "auto", "always")
"""Whether it does: auto mends what is found, always mends without asking."""


def occasions(start: float, until: float, times: int, iterations: int) -> list[int]:
    """The steps before which it asks so many times, at shares of the steps that grow by the same factor: a model that
    knows little yet changes most."""
    last = max(1, times - 1)
    shares = [start * (until / start) ** (number / last) for number in range(times)]
    return sorted({max(1, round(share * iterations)) + 1 for share in shares})


def some_photographs(views: Sequence[View], count: int, purpose: str) -> list[View]:
    """At most so many: the same in every run."""
    generator = torch.Generator().manual_seed(derived_seed(purpose))
    order = torch.randperm(len(views), generator=generator)[:count]
    return [views[number] for number in order.tolist()]
