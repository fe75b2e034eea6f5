"""Grids that anchors lie on: one of them (Scaffold-GS), or one for each level of detail (Octree-GS)."""

import logging
import math
from typing import Any

import torch
from torch import Tensor

from gsx.backbones.anchor_options import AnchorOptions, faithful
from gsx.backbones.decoding import Representation
from gsx.backbones.growth import DepthGrowth, LevelGrowth, nodes_of
from gsx.backbones.levels import Levels, all_levels_from, derive, drawn, facts_of, initial_nodes, note_of, warnings_of
from gsx.backbones.neighbours import LEAST_SQUARE_DISTANCE, mean_square_distance
from gsx.core.data.camera import Camera
from gsx.core.shapes import Float, Int
from gsx.core.training.backbone import BackboneContext
from gsx.core.training.parameter_table import ParameterTable
from gsx.core.training.schedule import Schedule

logger = logging.getLogger(__name__)


class VoxelGrid:
    """One grid through the world's origin, all of whose anchors are drawn; the interface of every grid."""

    def __init__(self, voxel: float, options: AnchorOptions, generator: torch.Generator) -> None:
        self.voxel, self.options, self.quirks, self.generator = voxel, options, options.switches(), generator

    def start(
        self, points: Float[Tensor, "P 3"]
    ) -> tuple[Float[Tensor, "N 3"], dict[str, Tensor], Int[Tensor, "Q"], Int[Tensor, "Q"]]:
        """Returns (nodes nearest to the points, columns of the table, anchor and point of each pair of these).

        Source: Scaffold-GS, voxelize_sample.
        """
        positions, owner = voxel_nodes(points, self.voxel)
        return positions, {}, owner, torch.arange(len(points))

    def visible(self, table: ParameterTable, camera: Camera, step: int) -> tuple[Int[Tensor, "A"], Float[Tensor, "N"]]:
        """Returns (rows that the camera draws at its distance, opacity factor of every row)."""
        anchors = table["anchors"]
        return torch.arange(len(anchors), device=anchors.device), torch.ones_like(anchors[:, 0])

    def grow(
        self, table: ParameterTable, representation: Representation, least: float, room: int, step: int
    ) -> tuple[int, int]:
        """Adds at most `room` anchors where offsets visible in more than `least` steps have large gradients.

        Returns (number added, number without room).
        """
        growth = DepthGrowth(table, representation, self.options.growth, least, room, self.voxel)
        return growth.grow(self.quirks.early_stop == "yes", self.generator)

    def columns(self, table: ParameterTable) -> dict[str, Float[Tensor, "N"]]:
        """Returns the columns of published files that follow the positions."""
        return {}

    def header(self, table: ParameterTable) -> dict[str, Float[Tensor, "N"]]:
        """Returns the file columns before the values of neural anchors (Scaffold-GS, save_ply)."""
        return dict.fromkeys(("nx", "ny", "nz"), torch.zeros_like(table["anchors"][:, 0]))

    def plan(self, table: ParameterTable) -> dict[str, Any]:
        """Returns the number of anchors and the cell length, world units."""
        return {"anchors": {"count": len(table), "voxel": self.voxel}}

    def notes(self) -> list[str]:
        """Returns comments of splat files."""
        return []


class LevelGrids(VoxelGrid):
    """A grid for each level of detail; a camera draws the levels that its distance needs."""

    def __init__(self, levels: Levels, options: AnchorOptions) -> None:
        self.levels, self.options, self.quirks = levels, options, options.switches()

    def start(
        self, points: Float[Tensor, "P 3"]
    ) -> tuple[Float[Tensor, "N 3"], dict[str, Tensor], Int[Tensor, "Q"], Int[Tensor, "Q"]]:
        """Returns the nodes nearest to the points that enough cameras draw; columns `level`, `bias` (octree_sample)."""
        positions, of, group = initial_nodes(points, self.levels)
        for warning in warnings_of(self.levels, len(of)):
            logger.warning("%s", warning)
        source = torch.arange(len(points)).repeat(self.levels.count)
        return positions, {"level": of, "bias": torch.zeros(len(of))}, group.flatten(), source

    def visible(self, table: ParameterTable, camera: Camera, step: int) -> tuple[Int[Tensor, "A"], Float[Tensor, "N"]]:
        """Returns the anchors of the levels drawn, faded by the mode (Octree-GS, set_anchor_mask)."""
        anchors, level, bias = table["anchors"], table["level"], table["bias"]
        mask, weights = drawn(self.levels, anchors, level, bias, camera, self.levels.highest(step))
        return mask.nonzero()[:, 0], weights

    def grow(
        self, table: ParameterTable, representation: Representation, least: float, room: int, step: int
    ) -> tuple[int, int]:
        """Adds anchors in cells of each anchor's level and of the next (Octree-GS, anchor_growing)."""
        gate = self.quirks.gate == "open" or self.levels.highest(step) == self.levels.count - 1
        finest, options = self.levels.size(self.levels.count - 1), self.options.growth
        return LevelGrowth(table, representation, options, least, room, finest, self.levels, self.quirks, gate).grow()

    def columns(self, table: ParameterTable) -> dict[str, Float[Tensor, "N"]]:
        """Returns levels and their bias (Octree-GS, save_ply)."""
        return {"level": table["level"].float(), "extra_level": table["bias"]}

    def header(self, table: ParameterTable) -> dict[str, Float[Tensor, "N"]]:
        """Returns `info`: cell length of level 0 in the first row, farthest distance in the second."""
        zeros = torch.zeros_like(table["anchors"][:, 0])
        facts = zeros.new_tensor([self.levels.cell, self.levels.farthest])
        return {"info": torch.cat([facts, zeros])[: len(zeros)]}

    def plan(self, table: ParameterTable) -> dict[str, Any]:
        """Returns the number of anchors and the figures of the levels."""
        return {"anchors": {"count": len(table)}, "levels": facts_of(self.levels, table["level"])}

    def notes(self) -> list[str]:
        """Returns how a viewer chooses the levels at a distance."""
        return [note_of(self.levels)]


def grid_of(
    options: AnchorOptions, context: BackboneContext, schedule: Schedule, points: Float[Tensor, "P 3"]
) -> VoxelGrid:
    """Builds the grids of the options' levels, or one grid without levels."""
    levels = faithful(options.levels, options.fidelity)
    if levels is None:
        voxel = options.voxel or automatic_voxel(points, options.switches().voxel == "squared")
        return VoxelGrid(voxel, options, context.generator)
    cameras = [view.camera for view in context.scene.train]
    return LevelGrids(derive(points, cameras, levels, all_levels_from(levels, schedule)), options)


def automatic_voxel(points: Float[Tensor, "P 3"], squared: bool) -> float:
    """Returns the median of the mean squared distances to three neighbours, or its root (Scaffold-GS)."""
    squares = mean_square_distance(points)
    median = float(squares.kthvalue(max(1, len(points) // 2)).values.clamp_min(LEAST_SQUARE_DISTANCE))
    return median if squared else math.sqrt(median)


def voxel_nodes(points: Float[Tensor, "P 3"], voxel: float) -> tuple[Float[Tensor, "N 3"], Int[Tensor, "P"]]:
    """Returns (nodes nearest to the points, row of the node of each point) (Scaffold-GS, voxelize_sample)."""
    cells, inverse = torch.unique(nodes_of(points, voxel), dim=0, return_inverse=True)
    return (cells.double() * voxel).float(), inverse
