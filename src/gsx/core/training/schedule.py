"""Published step counts, rescaled to the length of this run; learning-rate decay."""

import math
from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class Schedule:
    """Maps steps of a published run onto a run of `iterations` steps."""

    iterations: int
    published_iterations: int
    """Length of the run in which the published numbers hold (3D-GS: 30,000)."""
    views: int
    """Training views: one pass over them is the least that statistics are gathered over."""

    def step(self, published: int) -> int:
        """A published step at the same fraction of this run."""
        return round(published * self.iterations / self.published_iterations)

    def interval(self, published: int, passes: float = 1.0) -> int:
        """A published interval at this run's scale, but in a shortened run never below `passes` over the views."""
        floor = min(published, math.ceil(passes * self.views))
        return max(1, self.step(published), floor)

    def shortened(self, exponent: float) -> float:
        """How many times fewer steps this run takes than the published one, to a power; 1 for longer runs."""
        return max(1.0, self.published_iterations / max(1, self.iterations)) ** exponent


def log_linear(step: int, steps: int, first: float, last: float) -> float:
    """Interpolates from `first` to `last` with the logarithm linear in step / steps, held at `last` (3D-GS), where it
    is from the start if there are no steps."""
    fraction = min(max(step / steps, 0.0), 1.0) if steps > 0 else 1.0
    return math.exp((1 - fraction) * math.log(first) + fraction * math.log(last))
