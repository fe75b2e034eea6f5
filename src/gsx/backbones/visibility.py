"""Which free Gaussians a camera draws, and how large and opaque."""

from dataclasses import dataclass
from typing import Any

from torch import Tensor
from torch.nn.functional import logsigmoid

from gsx.backbones.mip import Filter
from gsx.core.data.camera import Camera
from gsx.core.data.scene import PointCloud
from gsx.core.shapes import Float, Int
from gsx.core.training.parameter_table import ParameterTable

LARGEST_LOG_SCALE = 30.0
"""Scales are held below e^30 world units, so that their squares stay finite in float32."""
LEAST_WEIGHT = 1e-37
"""A Gaussian that has yet to fade in counts as this much of its opacity: the logarithm is finite."""


@dataclass(frozen=True, eq=False, kw_only=True)
class VisibleGaussians:
    """Parameters of what a camera draws of N Gaussians."""

    values: dict[str, Tensor]
    """Parameters and columns, M rows."""
    rows: Int[Tensor, "M"] | None = None
    """Rows of the table; None: all of them."""
    weights: Float[Tensor, "M"] | None = None
    """Factors of the opacities; None: 1."""


def everything(table: ParameterTable) -> VisibleGaussians:
    """Returns all Gaussians."""
    return VisibleGaussians(values={**table.parameters, **table.columns})


def extents(
    table: ParameterTable, visible: VisibleGaussians, filter_: Filter
) -> tuple[Float[Tensor, "M 3"], Float[Tensor, "M"]]:
    """Returns scales and log-opacities as they are drawn, after the 3D filter if there is one."""
    scales = visible.values["log_scales"].clamp(max=LARGEST_LOG_SCALE).exp()
    log_opacities = logsigmoid(visible.values["opacity_logits"])
    if visible.weights is not None:
        log_opacities = log_opacities + visible.weights.clamp_min(LEAST_WEIGHT).log()
    return filter_.smoothed(scales, log_opacities, table, visible.rows)


class Visibility:
    """Which Gaussians a camera draws: here every camera draws all of them."""

    by_level = False

    def start(self, points: PointCloud) -> tuple[PointCloud, dict[str, Tensor]]:
        """Returns (one point for each Gaussian at the start, columns of the table)."""
        return points, {}

    def visible(self, table: ParameterTable, camera: Camera, step: int) -> VisibleGaussians:
        """Returns what the camera draws."""
        return everything(table)

    def columns(self, table: ParameterTable) -> dict[str, Tensor]:
        """Returns columns of a splat file beside the standard ones; they stand where normals would be."""
        return {}

    def plan(self, table: ParameterTable) -> dict[str, Any]:
        """Returns what was derived from the scene, for the log and the report."""
        return {}

    def notes(self) -> list[str]:
        """Returns comments for the export."""
        return []
