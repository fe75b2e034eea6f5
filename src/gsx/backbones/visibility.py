"""Visibility of free Gaussians: those that a camera draws, their scales and opacities."""

from dataclasses import dataclass
from typing import Any

from torch import Tensor
from torch.nn.functional import logsigmoid

from gsx.backbones.mip import filtered
from gsx.core.data.camera import Camera
from gsx.core.data.scene import PointCloud
from gsx.core.shapes import Float, Int
from gsx.core.training.parameter_table import ParameterTable

LARGEST_LOG_SCALE = 30.0
"""Upper bound of log-scales: squares of e^30 world units stay finite in float32."""
LEAST_WEIGHT = 1e-37
"""Lower bound of fading weights whose logarithm is taken."""


@dataclass(frozen=True, eq=False, kw_only=True)
class VisibleGaussians:
    """Gaussians that a camera draws."""

    values: dict[str, Tensor]
    """Parameters and columns, M rows."""
    rows: Int[Tensor, "M"] | None = None
    """Rows of the table; None: all."""
    weights: Float[Tensor, "M"] | None = None
    """Factors of the opacities; None: 1."""


def everything(table: ParameterTable) -> VisibleGaussians:
    """Returns all Gaussians."""
    return VisibleGaussians(values={**table.parameters, **table.columns})


def extents(table: ParameterTable, visible: VisibleGaussians) -> tuple[Float[Tensor, "M 3"], Float[Tensor, "M"]]:
    """Returns scales and log-opacities for drawing, after the 3D filter."""
    scales = visible.values["log_scales"].clamp(max=LARGEST_LOG_SCALE).exp()
    log_opacities = logsigmoid(visible.values["opacity_logits"])
    if visible.weights is not None:
        log_opacities = log_opacities + visible.weights.clamp_min(LEAST_WEIGHT).log()
    return filtered(table, visible.rows, scales, log_opacities)


class Visibility:
    """Visibility without levels: every camera draws all Gaussians."""

    by_level = False

    def start(self, points: PointCloud) -> tuple[PointCloud, dict[str, Tensor]]:
        """Returns (a point for each initial Gaussian, columns of the table)."""
        return points, {}

    def visible(self, table: ParameterTable, camera: Camera, step: int) -> VisibleGaussians:
        """Returns the Gaussians that the camera draws."""
        return everything(table)

    def columns(self, table: ParameterTable) -> dict[str, Tensor]:
        """Returns additional columns of a splat file, in place of normals."""
        return {}

    def plan(self, table: ParameterTable) -> dict[str, Any]:
        """Returns facts about the scene for log and report."""
        return {}

    def notes(self) -> list[str]:
        """Returns comments for the export."""
        return []
