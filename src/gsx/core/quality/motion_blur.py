"""By how much a camera moved while a photograph was exposed, by a sharp picture beside it (`core.data.movement`).

Several movements are tried; the one that brings the blurred sharp picture nearest to the photograph is taken.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d

from gsx.core.data.masks import blacked
from gsx.core.data.movement import motion_blurred
from gsx.core.shapes import Bool, Float

DIRECTIONS, LENGTHS = 8, (1.0, 2.5, 6.0)
"""Movements that are tried at first, px of pictures of half the size."""
FINEST = 0.25
"""The last change that is tried along each axis, px."""
MOST = 24.0
"""Longest movement along an axis, px."""


@dataclass(frozen=True)
class Movement:
    """Of a camera during an exposure, and how well it explains the photograph."""

    across: float
    """Px to the right."""
    down: float
    """Px; both with the other sign are the same movement."""
    explained: float
    """Share of the squared difference between photograph and sharp picture that is gone after it; 0 where none is."""

    @property
    def length(self) -> float:
        """Px."""
        return math.hypot(self.across, self.down)

    def times(self, factor: float) -> "Movement":
        """In px so many times as small."""
        return Movement(self.across * factor, self.down * factor, self.explained)


def movement_between(
    sharp: Float[Tensor, "3 H W"], photograph: Float[Tensor, "3 H W"], counted: Bool[Tensor, "H W"] | None = None
) -> Movement:
    """The movement by which a sharp picture comes nearest to a photograph of the same exposure, over pixels that count.

    In pictures of half the size from the best of a few directions and lengths on; then in those given.
    """
    pair = torch.stack([sharp.mean(0), photograph.mean(0)])
    small, left = avg_pool2d(pair[None], 2)[0], counted
    if counted is not None:
        left = avg_pool2d(counted[None].float(), 2)[0] == 1
    start = nearest([(0.0, 0.0), *fan()], small, left)
    across, down = descended(start, (max(0.5, math.hypot(*start) / 4), FINEST), MOST / 2, small, left)
    found = descended((2 * across, 2 * down), (0.5, FINEST), MOST, pair, counted)
    still = error_after((0.0, 0.0), pair, counted)
    explained = 1 - error_after(found, pair, counted) / still if still > 0 else 0.0
    return Movement(*found, explained=max(0.0, explained))


def error_after(
    movement: tuple[float, float], pair: Float[Tensor, "2 H W"], counted: Bool[Tensor, "H W"] | None
) -> float:
    """Squared difference of the second picture from the first after a movement, px, over pixels that count."""
    return float(blacked(motion_blurred(pair[:1], *movement) - pair[1:], counted).double().square().sum())


def nearest(
    movements: Sequence[tuple[float, float]], pair: Float[Tensor, "2 H W"], counted: Bool[Tensor, "H W"] | None
) -> tuple[float, float]:
    """The first of the movements after which the difference is least."""
    return min(movements, key=lambda movement: error_after(movement, pair, counted))


def descended(
    start: tuple[float, float],
    steps: tuple[float, float],
    most: float,
    pair: Float[Tensor, "2 H W"],
    counted: Bool[Tensor, "H W"] | None,
) -> tuple[float, float]:
    """From one movement to ever better ones beside it, by ever smaller steps, from the first to the last; none longer
    than `most` along an axis."""
    where, (step, last) = start, steps
    while step >= last:
        better = nearest([where, *around(where, step, most)], pair, counted)
        step = step / 2 if better == where else step
        where = better
    return where


def fan() -> list[tuple[float, float]]:
    """Movements in all directions."""
    turns = [math.pi * turn / DIRECTIONS for turn in range(DIRECTIONS)]
    return [(length * math.cos(turn), length * math.sin(turn)) for length in LENGTHS for turn in turns]


def around(where: tuple[float, float], step: float, most: float) -> list[tuple[float, float]]:
    """Movements beside one, none longer than `most` along an axis."""
    beside = [(where[0] + x * step, where[1] + y * step) for x in (-1, 0, 1) for y in (-1, 0, 1) if x or y]
    return [there for there in beside if max(map(abs, there)) <= most]
