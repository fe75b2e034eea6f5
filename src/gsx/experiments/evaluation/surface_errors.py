"""Errors of a model's depth, on views whose true depth is known at every pixel."""

import statistics
from collections.abc import Mapping, Sequence
from typing import Any, Protocol, runtime_checkable

from torch import Tensor

from gsx.core.data.camera import Camera
from gsx.core.shapes import Bool, Float

CLOSE = 0.05
"""Largest relative error of a depth that counts as right."""
LEAST_ALPHA = 1e-6
"""Divisor of pixels that show nothing, whose depth is 0."""


@runtime_checkable
class ExactDepth(Protocol):
    """A source of images that knows where surfaces are."""

    def exact_depth(self, camera: Camera) -> Float[Tensor, "H W"]:
        """Returns camera z of the surface at each pixel's centre, scene units; infinite where there is none."""


def mean_depth(summed: Float[Tensor, "H W"], alpha: Float[Tensor, "H W"]) -> Float[Tensor, "H W"]:
    """Returns the mean depth of a render; summed: blending-weighted sum of camera z."""
    return summed / alpha.clamp_min(LEAST_ALPHA)


def surface_errors(
    depth: Float[Tensor, "H W"], truth: Float[Tensor, "H W"], counted: Bool[Tensor, "H W"] | None
) -> dict[str, dict[str, float]]:
    """Returns the entry `depth` of a view: mean absolute error (scene units), mean relative error, share up to CLOSE.

    Pixels without a surface and masked ones are left out; empty: no pixel is left.
    """
    surface = truth.isfinite() if counted is None else truth.isfinite() & counted
    if not bool(surface.any()):
        return {}
    true = truth[surface].double()
    error = (depth[surface].double() - true).abs()
    relative = error / true
    figures = {"absolute": error.mean(), "relative": relative.mean(), "within": (relative <= CLOSE).double().mean()}
    return {"depth": {name: float(figure) for name, figure in figures.items()}}


def surface_summary(views: Sequence[Mapping[str, Any]]) -> dict[str, dict[str, float]]:
    """Returns the entry `depth` of evaluation.json: means over the views that have errors; empty: none has."""
    known = [view["surface"]["depth"] for view in views if view["surface"]]
    return {"depth": {name: statistics.fmean(one[name] for one in known) for name in known[0]}} if known else {}
