"""Choice of held-out views: some of all, evenly spread, and the neighbour of each."""

import math
from collections.abc import Sequence
from typing import TypeVar

import torch

from gsx.core.data.camera import Camera

T = TypeVar("T")

LARGEST_TURN = 45.0
"""Largest angle between the viewing directions of neighbours, degrees."""


def evenly(items: Sequence[T], count: int) -> list[T]:
    """Returns up to `count` items, the middles of as many equal parts."""
    count = min(count, len(items))
    return [items[(2 * part + 1) * len(items) // (2 * count)] for part in range(count)]


def neighbours(cameras: Sequence[Camera], count: int) -> list[tuple[int, int]]:
    """Pairs up to `count` cameras, evenly spread, with the nearest one that looks the same way; leaves out the lone.

    Two cameras look the same way if their directions differ by at most LARGEST_TURN.
    """
    if len(cameras) < 2:
        return []
    centres = torch.stack([camera.centre.double() for camera in cameras])
    directions = torch.stack([camera.rotation[2].double() for camera in cameras])
    distances = (centres[:, None] - centres).norm(dim=2).fill_diagonal_(math.inf)
    distances[directions @ directions.T < math.cos(math.radians(LARGEST_TURN))] = math.inf
    chosen = evenly(range(len(cameras)), count)
    return [(number, int(distances[number].argmin())) for number in chosen if distances[number].min() < math.inf]
