"""What free Gaussians are composed of: which of them a camera draws, how density control makes new ones."""

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

import torch
from torch import Tensor
from torch.nn.functional import logsigmoid

from gsx.backbones.density import mean_absolute, mean_gradient, withheld, within_room
from gsx.backbones.gs3d_options import Density
from gsx.backbones.mip import Filter
from gsx.backbones.sampling import quantile, sampled_means
from gsx.backbones.sky import not_sky
from gsx.core.data.camera import Camera
from gsx.core.data.scene import PointCloud
from gsx.core.shapes import Bool, Float, Int
from gsx.core.training.backbone import Backbone, DrawnSplats
from gsx.core.training.parameter_table import ParameterTable, append_rows, detached_rows, keep_rows

if TYPE_CHECKING:
    from gsx.backbones.density_control import DensityControl

LARGEST_LOG_SCALE = 30.0
"""Scales are held below e^30 world units, so that their squares stay finite in float32."""
LEAST_WEIGHT = 1e-37
"""A Gaussian that has yet to fade in counts as this much of its opacity: the logarithm is finite."""


def children(rows: dict[str, Tensor], shrink: float, generator: torch.Generator) -> dict[str, Tensor]:
    """One child of each parent: drawn from the parent's Gaussian, `shrink` times smaller (3D-GS, densify_and_split)."""
    return rows | {"means": sampled_means(rows, generator), "log_scales": rows["log_scales"] - math.log(shrink)}


@dataclass(frozen=True, eq=False, kw_only=True)
class Shown:
    """Parameters of what a camera draws of N Gaussians."""

    values: dict[str, Tensor]
    """Parameters and columns, M rows."""
    rows: Int[Tensor, "M"] | None = None
    """Rows of the table; None: all of them."""
    weights: Float[Tensor, "M"] | None = None
    """Factors of the opacities; None: 1."""


def everything(table: ParameterTable) -> Shown:
    """All Gaussians."""
    return Shown(values={**table.parameters, **table.columns})


def extents(table: ParameterTable, shown: Shown, filter_: Filter) -> tuple[Float[Tensor, "M 3"], Float[Tensor, "M"]]:
    """Scales and log-opacities as they are drawn, after the 3D filter if there is one."""
    scales = shown.values["log_scales"].clamp(max=LARGEST_LOG_SCALE).exp()
    log_opacities = logsigmoid(shown.values["opacity_logits"])
    if shown.weights is not None:
        log_opacities = log_opacities + shown.weights.clamp_min(LEAST_WEIGHT).log()
    return filter_.smoothed(scales, log_opacities, table, shown.rows)


@runtime_checkable
class Visibility(Protocol):
    """Which Gaussians a camera draws."""

    def start(self, points: PointCloud) -> tuple[PointCloud, dict[str, Tensor]]:
        """(one point for each Gaussian at the start, columns of the table)."""
        ...

    def shown(self, table: ParameterTable, camera: Camera, step: int) -> Shown:
        """What the camera draws."""
        ...

    def columns(self, table: ParameterTable) -> dict[str, Tensor]:
        """Columns of a splat file beside the standard ones; they stand where normals would be."""
        ...

    def plan(self, table: ParameterTable) -> dict[str, Any]:
        """What was derived from the scene, for the log and the report."""
        ...

    def notes(self) -> list[str]:
        """Comments for the export."""
        ...


class AllVisible:
    """Every camera draws every Gaussian."""

    def start(self, points: PointCloud) -> tuple[PointCloud, dict[str, Tensor]]:
        """The points themselves."""
        return points, {}

    def shown(self, table: ParameterTable, camera: Camera, step: int) -> Shown:
        """All of them."""
        return everything(table)

    def columns(self, table: ParameterTable) -> dict[str, Tensor]:
        """None."""
        return {}

    def plan(self, table: ParameterTable) -> dict[str, Any]:
        """Nothing."""
        return {}

    def notes(self) -> list[str]:
        """None."""
        return []


@runtime_checkable
class Densification(Protocol):
    """What happens at a density event."""

    resets: bool
    """Whether opacities are reset while it runs."""

    def densify(self, control: "DensityControl", model: Backbone[Any], step: int) -> dict[str, float]:
        """Make new ones; returns how many in which way, and how many a cap has withheld."""
        ...

    def undone(self, table: ParameterTable) -> ParameterTable | None:
        """The table as it would be had the last event added nothing; None: it did. Asked where capacity is adaptive."""
        ...

    def regulariser(self, drawn: DrawnSplats) -> Float[Tensor, ""] | None:
        """A term of the loss of a view, or None."""
        ...


class CloneSplit:
    """3D-GS: clone small and split large Gaussians with large gradients (Kerbl et al. 2023, section 5.2)."""

    resets = True

    def densify(self, control: "DensityControl", model: Backbone[Any], step: int) -> dict[str, float]:
        """Split parents go; each leaves two children (3D-GS, densify_and_clone and densify_and_split)."""
        table = model.table
        options, gradient = control.options, mean_gradient(table)
        wanted = candidates(table, gradient, options) & not_sky(table)
        room = control.capacity.room(table, int(wanted.sum()), step)  # each adds one
        chosen = within_room(wanted, gradient, room)
        large = largest_scales(table) > options.split_extent * control.extent
        cloned, split = chosen & ~large, chosen & large
        clone_and_split(table, cloned, split, options.split_shrink, control.generator)
        return {"cloned": int(cloned.sum()), "split": int(split.sum())} | withheld(wanted, chosen)

    def undone(self, table: ParameterTable) -> ParameterTable | None:
        """Not told: capacity is never adaptive with it."""
        return None

    def regulariser(self, drawn: DrawnSplats) -> Float[Tensor, ""] | None:
        """None."""
        return None


def candidates(table: ParameterTable, gradient: Float[Tensor, "N"], options: Density) -> Bool[Tensor, "N"]:
    """Primitives to clone or split: by mean gradient, and as many again by mean absolute gradient (Mip-Splatting).

    Ours: never those without any gradient. Where none has one the published rule would choose all.
    """
    chosen = gradient >= options.gradient
    if not options.absolute:
        return chosen
    absolute = mean_absolute(table)
    quiet = 1 - int(chosen.sum()) / len(chosen)
    return chosen | ((absolute >= quantile(absolute, quiet)) & (absolute > 0))


def largest_scales(table: ParameterTable) -> Float[Tensor, "N"]:
    """Largest standard deviation of each primitive, world units."""
    return table["log_scales"].detach().amax(1).exp()


def clone_and_split(
    table: ParameterTable,
    cloned: Bool[Tensor, "N"],
    split: Bool[Tensor, "N"],
    shrink: float,
    generator: torch.Generator,
) -> None:
    """Rows become: survivors, clones, first children, second children."""
    raw = detached_rows(table)
    parents = {name: value[split] for name, value in raw.items()}
    twins = [children(parents, shrink, generator) for _ in range(2)]
    added = {name: torch.cat([value[cloned], *(twin[name] for twin in twins)]) for name, value in raw.items()}
    append_rows(table, added)
    new = torch.ones(len(table) - len(split), dtype=torch.bool, device=split.device)
    keep_rows(table, torch.cat([~split, new]))
