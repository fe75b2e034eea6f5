"""Supersampling: renders finer than photos, reduced by the photos' filter before the loss.

Photos of neighbouring cameras sample a scene between each other's pixels; a loss on reduced renders uses that.
Sources: NeRF-SR (Wang et al. 2022), SRGS (Feng et al. 2024).
"""

from dataclasses import dataclass
from typing import Annotated

from gsx.core.ranges import Range, Share
from gsx.core.training.module import ModuleContext, TrainingModule


@dataclass(frozen=True, kw_only=True)
class SupersamplingOptions:
    """Options; values in conf/module/supersampling.yaml."""

    factor: Annotated[int, Range(1, 16)] = 1
    """Resolution of renders relative to photos, also in evaluation, viewer and reports; published: 1."""
    start: Share = 0.0
    """Share of the steps at the photos' own resolution before that."""

    def __post_init__(self) -> None:
        if self.start == 1:
            raise ValueError("training.supersampling.start is 1.0; set a share of the steps below 1")


class Supersampling(TrainingModule):
    """Finer renders for the last steps."""

    options: SupersamplingOptions

    def __init__(self, options: SupersamplingOptions, context: ModuleContext) -> None:
        super().__init__(options, context)
        self.last_plain = round(options.start * context.iterations) if options.factor > 1 else 0
        """Last step that renders at the photos' own resolution."""

    def raster_scale(self, step: int) -> int:
        """Returns the resolution of the renders of a step relative to photos."""
        return self.options.factor if step > self.last_plain else 1

    def milestones(self) -> list[int]:
        """Returns the last step that renders at the photos' own resolution."""
        return [self.last_plain]
