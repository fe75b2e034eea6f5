"""Seeded random values on a lattice, smooth noise made of them, and angles without library functions."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from gsx.core.shapes import Float, Int
from gsx.scenes.demo.solids import FLAT, sum_of

SIDE = 256  # the lattice repeats after this many cells
LAYER = (37.0, 113.0)  # lattice cells from one layer of solid noise to the next
# Abramowitz and Stegun 4.4.47: atan x for |x| <= 1 within 1e-5 radians
ARCTAN = (0.9998660, -0.3302995, 0.1801410, -0.0851330, 0.0208351)


@dataclass(frozen=True, eq=False)
class Noise:
    """Values in [-1, 1) on a periodic square lattice."""

    table: Float[Tensor, "cells"]
    """SIDE + 1 rows of SIDE + 1 values, the last of each repeating the first."""

    def cell(self, i: Float[Tensor, "*points"], j: Float[Tensor, "*points"]) -> Int[Tensor, "points"]:
        """Return the place in the table of lattice cell (i, j), whole numbers as floats."""
        return ((j.int() & (SIDE - 1)) * (SIDE + 1) + (i.int() & (SIDE - 1))).flatten()

    def at(self, i: Float[Tensor, "*points"], j: Float[Tensor, "*points"]) -> Float[Tensor, "*points"]:
        """Return the value of lattice cell (i, j)."""
        return self.table.index_select(0, self.cell(i, j)).reshape(i.shape)

    def plane(
        self, u: Float[Tensor, "*points"], v: Float[Tensor, "*points"], layer: Tensor | float = 0.0
    ) -> Float[Tensor, "*points"]:
        """Return smooth noise over the plane with features of size 1; every whole-numbered layer is another noise."""
        i, j = u.floor(), v.floor()
        cell = self.cell(i + LAYER[0] * layer, j + LAYER[1] * layer)
        a, b, c, d = (self.table[shift:].index_select(0, cell).reshape(u.shape) for shift in (0, 1, SIDE + 1, SIDE + 2))
        x, y = ease(u - i), ease(v - j)
        return blend(blend(a, b, x), blend(c, d, x), y)

    def solid(self, points: Float[Tensor, "3 points"]) -> Float[Tensor, "points"]:
        """Return smooth noise over space with features of size 1."""
        u, v, height = points
        layer = height.floor()
        return blend(self.plane(u, v, layer), self.plane(u, v, layer + 1.0), ease(height - layer))

    def grain(
        self, u: Float[Tensor, "points"], v: Float[Tensor, "points"], octaves: int, fall: float = 0.7
    ) -> Float[Tensor, "points"]:
        """Return noise of sizes 1, 1/2, 1/4 ..., each octave `fall` times as strong as the one before."""
        scale = torch.tensor([[2.0**octave] for octave in range(octaves)])
        layers = self.plane(u * scale, v * scale)
        return sum_of([layers[0], *(fall**octave * layers[octave] for octave in range(1, octaves))])


def make_noise(generator: torch.Generator) -> Noise:
    """Draw the values from a generator."""
    values = torch.rand(SIDE, SIDE, generator=generator) * 2.0 - 1.0
    rows = torch.cat([values, values[:1]])
    return Noise(torch.cat([rows, rows[:, :1]], dim=1).flatten())


def ease(x: Tensor) -> Tensor:
    """Return 3x^2 - 2x^3 for x already in [0, 1]."""
    return x * x * (3.0 - 2.0 * x)


def blend(a: Tensor, b: Tensor, weight: Tensor) -> Tensor:
    """Return `a` where the weight is 0, `b` where it is 1."""
    return a + (b - a) * weight


def angle(y: Float[Tensor, "points"], x: Float[Tensor, "points"]) -> Float[Tensor, "points"]:
    """Return the angle of (x, y) in (-pi, pi] within 1e-5 radians; a polynomial gives the same bits everywhere."""
    rise, run = y.abs(), x.abs()
    ratio = torch.minimum(rise, run) / torch.maximum(rise, run).clamp(min=FLAT)
    square = ratio * ratio
    series = torch.full_like(ratio, ARCTAN[-1])
    for coefficient in reversed(ARCTAN[:-1]):
        series = series * square + coefficient
    first = ratio * series
    first = torch.where(rise > run, math.pi / 2 - first, first)
    upper = torch.where(x < 0, math.pi - first, first)
    return torch.where(y < 0, -upper, upper)
