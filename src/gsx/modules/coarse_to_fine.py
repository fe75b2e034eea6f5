"""Coarse views first: steps on a view of a fraction of the size take a fraction of the time.

Source: DashGaussian (Chen et al. 2025).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

from gsx.core.data.scene import View
from gsx.core.ranges import Range, Share
from gsx.core.training.module import ModuleContext, TrainingModule
from gsx.modules.corrections import ViewCache
from gsx.modules.derived_views import reduce_view


@dataclass(frozen=True, kw_only=True)
class CoarseToFineOptions:
    """Options; values in conf/module/coarse_to_fine.yaml."""

    factor: Annotated[int, Range(1, 64)] = 1
    """Reduction of the first views: a power of two, halved in equal times; published: 1."""
    until: Share = 0.0
    """Share of the steps after which views have the size of photos."""

    def __post_init__(self) -> None:
        if self.factor & (self.factor - 1):
            near = 1 << self.factor.bit_length() - 1
            raise ValueError(f"training.coarse_to_fine.factor is {self.factor}; set a power of two, for example {near}")


class CoarseToFine(TrainingModule):
    """Coarse training views for the first steps."""

    options: CoarseToFineOptions

    def __init__(self, options: CoarseToFineOptions, context: ModuleContext) -> None:
        super().__init__(options, context)
        self.last = round(options.until * context.iterations) if options.factor > 1 else 0
        """Last step on coarse views."""
        self.coarse: dict[int, ViewCache] = {}
        """Coarse views by factor."""

    def factor_at(self, step: int) -> int:
        """Returns the reduction of the views of a step."""
        if step > self.last or self.options.factor == 1:
            return 1
        halvings = math.log2(self.options.factor) * (max(1, step) - 1) / self.last
        return self.options.factor >> math.floor(halvings)

    def transform_views(self, views: Sequence[View], step: int | None) -> Sequence[View]:
        """Returns the views at the size of a step."""
        factor = 1 if step is None else self.factor_at(step)
        if factor == 1:
            return views
        reduction = self.context.scene.reduction
        cache = self.coarse.setdefault(factor, ViewCache())
        return cache.get(views, lambda: [reduce_view(view, reduction, factor) for view in views])

    def milestones(self) -> list[int]:
        """Returns the last step on coarse views."""
        return [self.last]
