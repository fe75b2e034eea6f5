"""Choice of views: some of all, evenly spread, each once, and the neighbour of one."""

import math
from collections.abc import Sequence
from typing import TypeVar

import torch

from gsx.core.data.camera import Camera
from gsx.core.data.scene import View

T = TypeVar("T")

LARGEST_TURN = 45.0
"""Largest angle between the viewing directions of neighbours, degrees."""


def evenly(items: Sequence[T], count: int) -> list[T]:
    """Returns up to `count` items, the middles of as many equal parts."""
    count = min(count, len(items))
    return [items[(2 * part + 1) * len(items) // (2 * count)] for part in range(count)]


def distinct(views: Sequence[View]) -> list[View]:
    """Returns each view once, by name: some protocols repeat views."""
    return list({view.name: view for view in views}.values())


def neighbour(camera: Camera, others: Sequence[Camera]) -> int | None:
    """Returns the index of the nearest other camera that looks the same way, at another place; None: there is none.

    Two cameras look the same way if their directions differ by at most LARGEST_TURN.
    """
    if not others:
        return None
    distances = torch.stack([other.centre.double() for other in others]).sub(camera.centre.double()).norm(dim=1)
    same_way = torch.stack([other.rotation[2].double() for other in others]) @ camera.rotation[2].double()
    distances[(same_way < math.cos(math.radians(LARGEST_TURN))) | (distances == 0)] = math.inf
    return int(distances.argmin()) if distances.min() < math.inf else None
