"""What free Gaussians are composed of: which of them a camera draws, how density control makes new ones."""

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

import torch
from torch import Tensor

from gsx.backbones.sampling import sampled_means
from gsx.core.data.camera import Camera
from gsx.core.data.scene import PointCloud
from gsx.core.gaussians.splats import Splats
from gsx.core.shapes import Bool, Float, Int
from gsx.core.training.density import ParameterTable, append_rows, detached_rows, keep_rows, withheld, within_room

if TYPE_CHECKING:
    from gsx.backbones.gs3d import GS3D


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


@dataclass(frozen=True, eq=False, kw_only=True)
class DrawnGaussians:
    """Splats of a camera, and the rows of the table that they come from."""

    splats: Splats
    rows: Int[Tensor, "M"] | None
    """None: all of them."""


def everything(table: ParameterTable) -> Shown:
    """All Gaussians."""
    return Shown(values={**table.parameters, **table.columns})


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

    def densify(self, model: "GS3D", step: int) -> dict[str, int]:
        """Clone and split; returns how many of each, and how many a cap has withheld."""
        ...

    def regulariser(self, drawn: DrawnGaussians) -> Float[Tensor, ""] | None:
        """A term of the loss of a view, or None."""
        ...


class CloneSplit:
    """3D-GS: clone small and split large Gaussians with large gradients (Kerbl et al. 2023, section 5.2)."""

    resets = True

    def densify(self, model: "GS3D", step: int) -> dict[str, int]:
        """Split parents go; each leaves two children (3D-GS, densify_and_clone and densify_and_split)."""
        density, gradient = model.options.density, model.statistics.mean_gradient()
        wanted = model.candidates(gradient)
        chosen = within_room(wanted, gradient, model.room())  # each adds one
        large = model.largest_scales() > density.split_extent * model.extent
        cloned, split = chosen & ~large, chosen & large
        clone_and_split(model.table, cloned, split, density.split_shrink, model.generator)
        return {"cloned": int(cloned.sum()), "split": int(split.sum())} | withheld(wanted, chosen)

    def regulariser(self, drawn: DrawnGaussians) -> Float[Tensor, ""] | None:
        """None."""
        return None


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
