"""Distortion of slopes by a lens of COLMAP, eager or compiled.

Functions work on columns. Coefficients are floats, or tensors of no dimension, which compiled code takes as arguments.
"""

from collections.abc import Sequence
from typing import NamedTuple, TypeAlias

import torch
from torch import Tensor

from gsx.core.shapes import Bool, Float

Number: TypeAlias = float | Tensor
Slopes: TypeAlias = tuple[Tensor, Tensor]
"""x and y of points on a plane."""
NEAR_AXIS = 1e-6
"""Square of a slope below which angle / slope is a series."""


class Form(NamedTuple):
    """Terms of a lens, constants of compiled code."""

    fisheye: bool
    radial: int
    """Number of coefficients, from that of r^2 on."""
    divisor: int
    tangential: bool
    prism: bool
    turned: bool


class Coefficients(NamedTuple):
    """Coefficients of a lens (`Distortion`)."""

    radial: Sequence[Number]
    divisor: Sequence[Number]
    tangential: Sequence[Number]
    prism: Sequence[Number]
    turn: Sequence[Number]
    steepest: Number
    """Largest slope of a ray."""

    @staticmethod
    def of(numbers: Float[Tensor, "16"]) -> "Coefficients":
        """Returns the coefficients in a tensor, in this order."""
        n = numbers.unbind()
        return Coefficients(n[:4], n[4:7], n[7:9], n[9:11], n[11:15], n[15])


def in_view(lens: Coefficients, x: Tensor, y: Tensor, z: Tensor) -> Bool[Tensor, "*P"]:
    """Marks points in camera coordinates before the camera and within the steepest ray."""
    return (z > 0) & (x * x + y * y <= (lens.steepest * z).square())


def bent(lens: Coefficients, form: Form, x: Tensor, y: Tensor, z: Tensor) -> Slopes:
    """Returns distorted slopes of points in camera coordinates that the lens shows."""
    x, y = turned(lens, form, x, y, back=True)
    x, y = x / z, y / z
    if form.fisheye:
        factor = angle_by_slope(x * x + y * y)
        x, y = x * factor, y * factor
    return turned(lens, form, *distorted(lens, form, x, y))


def turned(lens: Coefficients, form: Form, x: Tensor, y: Tensor, *, back: bool = False) -> Slopes:
    """Returns places turned from the lens's axes to the camera's, or back."""
    if not form.turned:
        return x, y
    a, b, c, d = lens.turn
    return (a * x + c * y, b * x + d * y) if back else (a * x + b * y, c * x + d * y)


def angle_by_slope(squares: Float[Tensor, "*P"]) -> Float[Tensor, "*P"]:
    """Returns angles from the axis over slopes, by squares of slopes."""
    near = squares < NEAR_AXIS
    slopes = torch.where(near, 1.0, squares).sqrt()
    return torch.where(near, 1 - squares / 3 + squares.square() / 5, slopes.atan() / slopes)


def distorted(lens: Coefficients, form: Form, x: Tensor, y: Tensor) -> Slopes:
    """Returns places on the plane moved by the lens."""
    (p1, p2), (s1, s2), squares = lens.tangential, lens.prism, x * x + y * y
    factor = radial_factor(lens, form, squares)
    across, down = x * factor, y * factor
    if form.tangential:
        across = across + 2 * p1 * x * y + p2 * (squares + 2 * x * x)
        down = down + 2 * p2 * x * y + p1 * (squares + 2 * y * y)
    if form.prism:
        across, down = across + s1 * squares, down + s2 * squares
    return across, down


def radial_factor(lens: Coefficients, form: Form, squares: Float[Tensor, "*P"]) -> Float[Tensor, "*P"]:
    """Returns the factor of the radius."""
    above = polynomial((1.0, *lens.radial[: form.radial]), squares)
    return above / polynomial((1.0, *lens.divisor[: form.divisor]), squares) if form.divisor else above


def factor_slope(lens: Coefficients, form: Form, squares: Float[Tensor, "*P"]) -> Float[Tensor, "*P"]:
    """Returns the derivative of `radial_factor` by the squared radius."""
    parts = (lens.radial[: form.radial], lens.divisor[: form.divisor])
    above, below = (polynomial([n * k for n, k in enumerate(part, 1)] or [0.0], squares) for part in parts)
    change = above - radial_factor(lens, form, squares) * below
    return change / polynomial((1.0, *lens.divisor[: form.divisor]), squares)


def jacobian(lens: Coefficients, form: Form, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Returns the derivatives of `distorted` by row: (ax, ay, dx, dy)."""
    (p1, p2), (s1, s2), squares = lens.tangential, lens.prism, x * x + y * y
    factor, slope = radial_factor(lens, form, squares), factor_slope(lens, form, squares)
    both = 2 * x * y * slope + 2 * (p1 * x + p2 * y)
    return (
        factor + 2 * x * x * slope + 2 * p1 * y + 6 * p2 * x + 2 * s1 * x,
        both + 2 * s1 * y,
        both + 2 * s2 * x,
        factor + 2 * y * y * slope + 2 * p2 * x + 6 * p1 * y + 2 * s2 * y,
    )


def polynomial(coefficients: Sequence[Number], squares: Float[Tensor, "*P"]) -> Float[Tensor, "*P"]:
    """Returns c0 + c1 s + c2 s^2 + ..."""
    *others, highest = coefficients
    value = torch.zeros_like(squares) + highest
    for coefficient in reversed(others):
        value = value * squares + coefficient
    return value
