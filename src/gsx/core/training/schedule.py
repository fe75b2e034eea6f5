"""Published step counts rescaled to the length of a run; learning-rate decay."""

import math
from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class Schedule:
    """Map from steps of a published run to a run of `iterations` steps."""

    iterations: int
    published_iterations: int
    """Length of the published run (3D-GS: 30,000)."""
    views: int
    """Number of training views; statistics need at least one pass over them."""

    def step(self, published: int) -> int:
        """Returns the step at the same fraction of this run as a published step."""
        return round(published * self.iterations / self.published_iterations)

    def interval(self, published: int, passes: float = 1.0) -> int:
        """Returns the rescaled interval, in a shortened run at least `passes` over the views."""
        floor = min(published, math.ceil(passes * self.views))
        return max(1, self.step(published), floor)

    def shortened(self, exponent: float) -> float:
        """Returns (published steps / steps of this run) ** exponent, at least 1."""
        return max(1.0, self.published_iterations / max(1, self.iterations)) ** exponent


def log_linear(step: int, steps: int, first: float, last: float) -> float:
    """Interpolates log-linearly from `first` at step 0 to `last` at `steps` and beyond (3D-GS, general_utils.py)."""
    fraction = min(max(step / steps, 0.0), 1.0) if steps > 0 else 1.0
    return math.exp((1 - fraction) * math.log(first) + fraction * math.log(last))
