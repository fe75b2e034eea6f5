"""The grid that anchors without levels start from: its cells, and the nodes next to points."""

import math

import torch
from torch import Tensor

from gsx.backbones.growth import nodes_of
from gsx.backbones.neighbours import LEAST_SQUARE_DISTANCE, mean_square_distance
from gsx.core.shapes import Float, Int


def automatic_voxel(points: Float[Tensor, "P 3"], squared: bool) -> float:
    """Returns the median mean squared distance to three neighbours, or its root (Scaffold-GS)."""
    squares = mean_square_distance(points)
    median = float(squares.kthvalue(max(1, len(points) // 2)).values.clamp_min(LEAST_SQUARE_DISTANCE))
    return median if squared else math.sqrt(median)


def voxel_nodes(points: Float[Tensor, "P 3"], voxel: float) -> tuple[Float[Tensor, "N 3"], Int[Tensor, "P"]]:
    """Returns (grid nodes with a point next to them, node of each point) (Scaffold-GS, voxelize_sample)."""
    cells, inverse = torch.unique(nodes_of(points, voxel), dim=0, return_inverse=True)
    return (cells.double() * voxel).float(), inverse
