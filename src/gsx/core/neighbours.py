"""Nearest neighbours of points, exactly."""

import torch
from torch import Tensor

from gsx.core.shapes import Float

CHUNK_VALUES = 1 << 24
"""Distances held at once."""
SHORTLIST = 8
"""Candidates taken by rounded distance before the exact ones are compared."""


def mean_square_distance(points: Float[Tensor, "P 3"], neighbours: int = 3) -> Float[Tensor, "P"]:
    """Mean of the squared distances to the nearest other points, exact search (spec 1.4).

    With fewer than `neighbours` other points it is the mean over those there are; a single point gives 0.
    """
    count = min(neighbours, len(points) - 1)
    if count == 0:
        return torch.zeros_like(points[:, 0])
    centred = points - points.mean(0)
    squares = centred.square().sum(1)
    rows = max(1, CHUNK_VALUES // len(points))
    means = [chunk_means(centred, squares, rows_of, count) for rows_of in torch.arange(len(points)).split(rows)]
    return torch.cat(means)


def chunk_means(points: Tensor, squares: Tensor, rows: Tensor, count: int) -> Float[Tensor, "R"]:
    """The same for some rows: a shortlist by |a|^2 + |b|^2 - 2 a.b, then exact differences."""
    rows = rows.to(points.device)
    rounded = squares - 2 * points[rows] @ points.T
    rounded[torch.arange(len(rows), device=points.device), rows] = torch.inf
    size = min(max(SHORTLIST, count), len(points) - 1)
    candidates = rounded.topk(size, dim=1, largest=False).indices
    exact = (points[rows, None] - points[candidates]).square().sum(2)
    return exact.topk(count, dim=1, largest=False).values.mean(1)
