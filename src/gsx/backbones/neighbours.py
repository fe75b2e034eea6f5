"""Exact nearest neighbours of points: by a grid for most, by all distances for the rest."""

from collections.abc import Sequence

import torch
from torch import Tensor

from gsx.core.shapes import Float, Int

LEAST_SQUARE_DISTANCE = 1e-7
"""Lower bound of the squared neighbour distance that sets initial sizes, scene units^2 (3D-GS, simple-knn)."""
CHUNK_VALUES = 1 << 24
"""Distances held at once by direct comparison."""
DIRECT = 2048
"""Most points that are compared with all others directly."""
SAMPLE = 256
"""Points whose neighbours set the first cell size."""
BATCH = 20_000
"""Points searched in the grid at once."""
STRIDES = (1 << 42, 1 << 21, 1)
"""Strides of cell numbers; numbers of distant cells may collide, which only adds candidates."""
Nearest = tuple[Float[Tensor, "R count"], Int[Tensor, "R count"]]
"""(Squared distances of rows to their nearest other points, ascending; indices of these)."""


def mean_square_distance(points: Float[Tensor, "P 3"], neighbours: int = 3) -> Float[Tensor, "P"]:
    """Returns the mean squared distance to the nearest other points, at most `neighbours`; 0 for a single point."""
    count = max(0, min(neighbours, len(points) - 1))
    return nearest(points, count)[0].mean(1) if count else torch.zeros_like(points[:, 0])


def nearest(points: Float[Tensor, "P 3"], count: int) -> Nearest:
    """Searches the nearest other points of all points; `count` is 1..P - 1."""
    squares = points.new_empty(len(points), count)
    which = torch.empty(len(points), count, dtype=torch.long, device=points.device)
    pending = torch.arange(len(points), device=points.device)
    cell = 0.0
    if len(points) > DIRECT:  # the lowest decile of a sample's distances settles the densest points
        sample = torch.linspace(0, len(points) - 1, SAMPLE, device=points.device).long()
        cell = float(directly(points, sample, count)[0][:, -1].quantile(0.1).sqrt()) or 1.0
    while len(pending) > DIRECT:
        found, others = joined([in_cells(points, rows, cell, count) for rows in pending.split(BATCH)])
        settled = found[:, -1] <= cell**2  # candidates cover one cell's length
        squares[pending[settled]], which[pending[settled]] = found[settled], others[settled]
        pending, cell = pending[~settled], 2 * cell
    if len(pending):
        squares[pending], which[pending] = directly(points, pending, count)
    return squares, which


def joined(parts: Sequence[tuple[Tensor, Tensor]]) -> tuple[Tensor, Tensor]:
    """Concatenates the results of parts of the rows."""
    squares, which = zip(*parts, strict=True)
    return torch.cat(squares), torch.cat(which)


def directly(points: Float[Tensor, "P 3"], rows: Int[Tensor, "R"], count: int) -> Nearest:
    """Searches by the distances of rows to all points."""
    parts = []
    for part in rows.split(max(1, CHUNK_VALUES // len(points))):
        distance = torch.cdist(points[part], points, compute_mode="donot_use_mm_for_euclid_dist")
        distance[torch.arange(len(part), device=points.device), part] = torch.inf
        found = distance.topk(count, dim=1, largest=False)
        parts.append((found.values.square(), found.indices))
    return joined(parts)


def in_cells(points: Float[Tensor, "P 3"], rows: Int[Tensor, "R"], cell: float, count: int) -> Nearest:
    """Searches in the 27 cells around each row; inf if they have too few points."""
    owner, candidate = candidates(points, rows, cell)
    square = (points[rows[owner]] - points[candidate]).square().sum(1)
    by_distance = square.argsort(stable=True)
    order = by_distance[owner[by_distance].argsort(stable=True)]
    owner, candidate, square = owner[order], candidate[order], square[order]
    before = torch.searchsorted(owner, torch.arange(len(rows), device=rows.device))
    rank = torch.arange(len(owner), device=rows.device) - before[owner]
    found = points.new_full((len(rows), count), torch.inf)
    which = torch.zeros(len(rows), count, dtype=torch.long, device=rows.device)
    kept = rank < count
    found[owner[kept], rank[kept]], which[owner[kept], rank[kept]] = square[kept], candidate[kept]
    return found, which


def candidates(
    points: Float[Tensor, "P 3"], rows: Int[Tensor, "R"], cell: float
) -> tuple[Int[Tensor, "C"], Int[Tensor, "C"]]:
    """Returns pairs (index into `rows`, other point) of all points in the 27 cells around each row."""
    strides = torch.tensor(STRIDES, device=points.device)
    numbers = ((points.double() / cell).floor().long() * strides).sum(1)
    sorted_numbers, order = numbers.sort(stable=True)
    steps = torch.cartesian_prod(*[torch.tensor([-1, 0, 1], device=points.device)] * 3)
    targets = (numbers[rows, None] + (steps * strides).sum(1)).flatten()
    first = torch.searchsorted(sorted_numbers, targets)
    lengths = torch.searchsorted(sorted_numbers, targets, right=True) - first
    slot = torch.repeat_interleave(torch.arange(len(targets), device=points.device), lengths)
    within = torch.arange(len(slot), device=points.device) - (lengths.cumsum(0) - lengths)[slot]
    owner, candidate = slot // len(steps), order[first[slot] + within]
    other = candidate != rows[owner]
    return owner[other], candidate[other]
