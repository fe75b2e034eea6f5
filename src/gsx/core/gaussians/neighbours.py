"""Nearest neighbours of points, exactly: a grid for the many, direct comparison for the few it cannot settle."""

import torch
from torch import Tensor

from gsx.core.shapes import Float, Int

LEAST_SQUARE_DISTANCE = 1e-7
"""Lower bound of the squared neighbour distance that sets initial sizes, scene units^2 (3D-GS, simple-knn)."""
CHUNK_VALUES = 1 << 24
"""Distances held at once by direct comparison."""
DIRECT = 2048
"""Up to this many points are compared with all others directly."""
SAMPLE = 256
"""Points whose neighbours set the first cell size."""
BATCH = 20_000
"""Points looked up in the grid at once."""
STRIDES = (1 << 42, 1 << 21, 1)
"""Cell numbers of neighbouring cells differ; those of far cells may collide, which only adds candidates."""


def mean_square_distance(points: Float[Tensor, "P 3"], neighbours: int = 3) -> Float[Tensor, "P"]:
    """Mean of the squared distances to the nearest other points, exact search (3D-GS, simple-knn).

    With fewer than `neighbours` other points it is the mean over those there are; a single point gives 0.
    """
    count = min(neighbours, len(points) - 1)
    if count == 0:
        return torch.zeros_like(points[:, 0])
    nearest = points.new_empty(len(points), count)
    pending = torch.arange(len(points), device=points.device)
    cell = 0.0
    if len(points) > DIRECT:  # a length that settles the densest: the lowest decile of a sample's distances
        sample = torch.linspace(0, len(points) - 1, SAMPLE, device=points.device).long()
        cell = float(direct_squares(points, sample, count)[:, -1].quantile(0.1).sqrt()) or 1.0
    while len(pending) > DIRECT:
        found = torch.cat([near_squares(points, rows, cell, count) for rows in pending.split(BATCH)])
        settled = found[:, -1] <= cell**2  # whatever lies within one cell's length was among the candidates
        nearest[pending[settled]] = found[settled]
        pending, cell = pending[~settled], 2 * cell
    nearest[pending] = direct_squares(points, pending, count)
    return nearest.mean(1)


def direct_squares(points: Float[Tensor, "P 3"], rows: Int[Tensor, "R"], count: int) -> Float[Tensor, "R count"]:
    """Squared distances of some rows to their nearest other points, ascending."""
    parts = []
    for part in rows.split(max(1, CHUNK_VALUES // len(points))):
        distance = torch.cdist(points[part], points, compute_mode="donot_use_mm_for_euclid_dist")
        distance[torch.arange(len(part), device=points.device), part] = torch.inf
        parts.append(distance.topk(count, dim=1, largest=False).values.square())
    return torch.cat(parts) if parts else points.new_empty(0, count)


def near_squares(
    points: Float[Tensor, "P 3"], rows: Int[Tensor, "R"], cell: float, count: int
) -> Float[Tensor, "R count"]:
    """The same among points in the 27 cells around each row; inf where there are too few."""
    owner, candidate = candidates(points, rows, cell)
    square = (points[rows[owner]] - points[candidate]).square().sum(1)
    by_distance = square.argsort(stable=True)
    order = by_distance[owner[by_distance].argsort(stable=True)]
    owner, square = owner[order], square[order]
    before = torch.searchsorted(owner, torch.arange(len(rows), device=rows.device))
    rank = torch.arange(len(owner), device=rows.device) - before[owner]
    found = points.new_full((len(rows), count), torch.inf)
    kept = rank < count
    found[owner[kept], rank[kept]] = square[kept]
    return found


def candidates(
    points: Float[Tensor, "P 3"], rows: Int[Tensor, "R"], cell: float
) -> tuple[Int[Tensor, "C"], Int[Tensor, "C"]]:
    """(number within `rows`, other point) for all points in the 27 cells around each row."""
    strides = torch.tensor(STRIDES, device=points.device)
    numbers = ((points.double() / cell).floor().long() * strides).sum(1)
    sorted_numbers, order = numbers.sort(stable=True)
    steps = torch.cartesian_prod(*[torch.tensor([-1, 0, 1], device=points.device)] * 3)
    wanted = (numbers[rows, None] + (steps * strides).sum(1)).flatten()
    first = torch.searchsorted(sorted_numbers, wanted)
    lengths = torch.searchsorted(sorted_numbers, wanted, right=True) - first
    slot = torch.repeat_interleave(torch.arange(len(wanted), device=points.device), lengths)
    within = torch.arange(len(slot), device=points.device) - (lengths.cumsum(0) - lengths)[slot]
    owner, candidate = slot // len(steps), order[first[slot] + within]
    other = candidate != rows[owner]
    return owner[other], candidate[other]
