"""Grid cells as rows of integers: new cells, and the largest values in each (Scaffold-GS, anchor_growing)."""

import math

import torch
from torch import Tensor

from gsx.core.shapes import Float, Int

LARGEST_KEY = 2**63 - 1


def pooled_max(values: Float[Tensor, "M ..."], group: Int[Tensor, "M"], count: int) -> Float[Tensor, "U ..."]:
    """Returns the largest values in each of `count` groups, -inf in empty ones; rows of group -1 are skipped."""
    known = group >= 0
    rows = values[known]
    index = group[known].long().reshape(-1, *[1] * (rows.dim() - 1)).expand_as(rows)
    out = values.new_full((count, *values.shape[1:]), -math.inf)
    return out.scatter_reduce_(0, index, rows, "amax")


def new_cells(candidates: Int[Tensor, "M 3"], taken: Int[Tensor, "T 3"]) -> tuple[Int[Tensor, "U 3"], Int[Tensor, "M"]]:
    """Returns (distinct candidate cells that are not taken, lexicographic; row of each candidate's cell, -1: taken)."""
    if len(candidates) == 0:
        return candidates, candidates.new_empty(0)
    keys = cell_keys(torch.cat([candidates, taken]))
    found, place = keys[: len(candidates)].unique(return_inverse=True)
    fresh = ~torch.isin(found, keys[len(candidates) :])
    number = torch.where(fresh, fresh.cumsum(0) - 1, -1)
    cells = candidates.new_empty(len(found), 3)
    cells[place] = candidates  # equal candidates share one place
    return cells[fresh], number[place]


def cell_keys(cells: Int[Tensor, "M 3"]) -> Int[Tensor, "M"]:
    """Returns one integer per cell, in the lexicographic order of the cells."""
    low, high = cells.amin(0).tolist(), cells.amax(0).tolist()
    _, height, depth = lengths = [last - first + 1 for first, last in zip(low, high, strict=True)]
    if math.prod(lengths) > LARGEST_KEY:
        return cells.unique(dim=0, return_inverse=True)[1]  # slower, for cells far apart
    x, y, z = (cells - cells.amin(0)).unbind(1)
    return (x * height + y) * depth + z
