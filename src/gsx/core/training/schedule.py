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
        """Returns the step at the same fraction of this run as a published step."""
        return round(published * self.iterations / self.published_iterations)

    def interval(self, published: int, passes: float = 1.0) -> int:
        """Rescales a published interval; in a shortened run it is never below `passes` over the views."""
        floor = min(published, math.ceil(passes * self.views))
        return max(1, self.step(published), floor)

    def shortened(self, exponent: float) -> float:
        """Returns how many times fewer steps this run takes than the published one, to a power; 1 for longer runs."""
        return max(1.0, self.published_iterations / max(1, self.iterations)) ** exponent


def log_linear(step: int, steps: int, first: float, last: float) -> float:
    """Interpolates logarithms from `first` at step 0 to `last` at `steps`, held there (3D-GS); no steps: `last`."""
    fraction = min(max(step / steps, 0.0), 1.0) if steps > 0 else 1.0
    return math.exp((1 - fraction) * math.log(first) + fraction * math.log(last))
