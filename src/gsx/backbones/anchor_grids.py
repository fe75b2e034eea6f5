"""Where anchors can be: on one grid (Scaffold-GS), or on a grid for each level of detail (Octree-GS)."""

import logging
from typing import Any, Protocol, runtime_checkable

import torch
from torch import Tensor

from gsx.backbones.anchor_options import AnchorOptions
from gsx.backbones.decoding import Representation
from gsx.backbones.growth import grow_by_depth, grow_by_level
from gsx.backbones.growth_options import Quirks
from gsx.backbones.level_options import faithful
from gsx.backbones.levels import Levels, all_levels_from, derive, drawn, facts_of, initial_nodes, note_of, warnings_of
from gsx.backbones.voxels import automatic_voxel, voxel_nodes
from gsx.core.data.camera import Camera
from gsx.core.shapes import Float, Int
from gsx.core.training.backbone import BackboneContext
from gsx.core.training.parameter_table import ParameterTable
from gsx.core.training.schedule import Schedule

logger = logging.getLogger(__name__)


@runtime_checkable
class AnchorGrid(Protocol):
    """Places of anchors: those of the beginning, those a camera draws, those that come."""

    def start(
        self, points: Float[Tensor, "P 3"]
    ) -> tuple[Float[Tensor, "N 3"], dict[str, Tensor], Int[Tensor, "Q"], Int[Tensor, "Q"]]:
        """(positions, columns of the table, anchor and point of each point-anchor pair)."""
        ...

    def visible(self, table: ParameterTable, camera: Camera, step: int) -> tuple[Int[Tensor, "A"], Float[Tensor, "N"]]:
        """(rows that the camera draws at its distance, weight of each row's opacity)."""
        ...

    def grow(
        self, table: ParameterTable, representation: Representation, least: float, room: int, step: int
    ) -> tuple[int, int]:
        """Add anchors where offsets seen in more than `least` steps ask for them, at most `room`; (how many, how many
        had no room)."""
        ...

    def columns(self, table: ParameterTable) -> dict[str, Float[Tensor, "N"]]:
        """Columns of the published files after positions."""
        ...

    def header(self, table: ParameterTable) -> dict[str, Float[Tensor, "N"]]:
        """Columns before the values of anchors with networks (Scaffold-GS and Octree-GS, save_ply)."""
        ...

    def plan(self, table: ParameterTable) -> dict[str, Any]:
        """What was derived from the scene."""
        ...

    def notes(self) -> list[str]:
        """Comments of splat files."""
        ...


def grid_of(
    options: AnchorOptions, context: BackboneContext, schedule: Schedule, points: Float[Tensor, "P 3"]
) -> AnchorGrid:
    """The grid that the options ask for: of levels, or of one voxel size."""
    quirks, levels = options.switches(), faithful(options.levels, options.fidelity)
    if levels is None:
        voxel = options.voxel or automatic_voxel(points, quirks.voxel == "squared")
        return VoxelGrid(voxel, options, quirks, context.generator)
    cameras = [view.camera for view in context.scene.train]
    return LevelGrids(derive(points, cameras, levels, all_levels_from(levels, schedule)), options, quirks)


class VoxelGrid:
    """Nodes of one grid through the world's origin, all drawn."""

    def __init__(self, voxel: float, options: AnchorOptions, quirks: Quirks, generator: torch.Generator) -> None:
        self.voxel, self.options, self.quirks, self.generator = voxel, options, quirks, generator

    def start(
        self, points: Float[Tensor, "P 3"]
    ) -> tuple[Float[Tensor, "N 3"], dict[str, Tensor], Int[Tensor, "Q"], Int[Tensor, "Q"]]:
        """The nodes next to the points (Scaffold-GS, voxelize_sample)."""
        positions, owner = voxel_nodes(points, self.voxel)
        return positions, {}, owner, torch.arange(len(points))

    def visible(self, table: ParameterTable, camera: Camera, step: int) -> tuple[Int[Tensor, "A"], Float[Tensor, "N"]]:
        """All of them, in full."""
        anchors = table["anchors"]
        return torch.arange(len(anchors), device=anchors.device), torch.ones_like(anchors[:, 0])

    def grow(
        self, table: ParameterTable, representation: Representation, least: float, room: int, step: int
    ) -> tuple[int, int]:
        """Cells of three sizes in turn."""
        growth, stop = self.options.growth, self.quirks.early_stop == "yes"
        return grow_by_depth(table, representation, growth, self.voxel, least, stop, self.generator, room)

    def columns(self, table: ParameterTable) -> dict[str, Float[Tensor, "N"]]:
        """None."""
        return {}

    def header(self, table: ParameterTable) -> dict[str, Float[Tensor, "N"]]:
        """Normals of 0."""
        return dict.fromkeys(("nx", "ny", "nz"), torch.zeros_like(table["anchors"][:, 0]))

    def plan(self, table: ParameterTable) -> dict[str, Any]:
        """Anchors, and the edge of a cell, world units."""
        return {"anchors": {"count": len(table), "voxel": self.voxel}}

    def notes(self) -> list[str]:
        """None."""
        return []


class LevelGrids:
    """Nodes of a grid for each level of detail; a camera draws those of the levels that its distance asks for."""

    def __init__(self, levels: Levels, options: AnchorOptions, quirks: Quirks) -> None:
        self.levels, self.options, self.quirks = levels, options, quirks

    def start(
        self, points: Float[Tensor, "P 3"]
    ) -> tuple[Float[Tensor, "N 3"], dict[str, Tensor], Int[Tensor, "Q"], Int[Tensor, "Q"]]:
        """The nodes next to the points that enough cameras draw; columns `level`, `bias` (Octree-GS, octree_sample)."""
        positions, of, group = initial_nodes(points, self.levels)
        for warning in warnings_of(self.levels, len(of)):
            logger.warning("%s", warning)
        source = torch.arange(len(points)).repeat(self.levels.count)
        return positions, {"level": of, "bias": torch.zeros(len(of))}, group.flatten(), source

    def visible(self, table: ParameterTable, camera: Camera, step: int) -> tuple[Int[Tensor, "A"], Float[Tensor, "N"]]:
        """Those of the levels drawn, faded where the mode says so (Octree-GS, set_anchor_mask)."""
        anchors, level, bias = table["anchors"], table["level"], table["bias"]
        mask, weights = drawn(self.levels, anchors, level, bias, camera, self.levels.highest(step))
        return mask.nonzero()[:, 0], weights

    def grow(
        self, table: ParameterTable, representation: Representation, least: float, room: int, step: int
    ) -> tuple[int, int]:
        """Cells of each anchor's level, and of the next."""
        gate = self.quirks.gate == "open" or self.levels.highest(step) == self.levels.count - 1
        return grow_by_level(table, representation, self.options.growth, self.levels, least, self.quirks, gate, room)

    def columns(self, table: ParameterTable) -> dict[str, Float[Tensor, "N"]]:
        """Levels and their bias (Octree-GS, save_ply)."""
        return {"level": table["level"].float(), "extra_level": table["bias"]}

    def header(self, table: ParameterTable) -> dict[str, Float[Tensor, "N"]]:
        """`info`: the cell of level 0 and the farthest distance in the first rows."""
        zeros = torch.zeros_like(table["anchors"][:, 0])
        facts = zeros.new_tensor([self.levels.cell, self.levels.farthest])
        return {"info": torch.cat([facts, zeros])[: len(zeros)]}

    def plan(self, table: ParameterTable) -> dict[str, Any]:
        """Anchors, and the levels in numbers."""
        return {"anchors": {"count": len(table)}, "levels": facts_of(self.levels, table["level"])}

    def notes(self) -> list[str]:
        """What chooses the levels at a distance."""
        return [note_of(self.levels)]
