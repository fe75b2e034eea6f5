"""Differentiable projection kernel, eager or compiled (docs/explanation/numerics.md; 3D-GS section 3.2).

Vectors are tuples of columns, one tensor [M] per component: on a CPU three times as fast as rows of three.
"""

from functools import reduce
from itertools import combinations
from operator import add
from typing import TypeAlias

import torch
from torch import Tensor
from torch.nn.functional import logsigmoid

from gsx.core.shapes import Float

Columns: TypeAlias = tuple[Tensor, ...]
"""Components of M vectors, each [M], or [] if shared by all."""
LEAST_SHARE = 1e-30
"""Floor of |S| / (|S + d I| - |S|) in the compensation: an opacity of 1 becomes 1e-15, which is not drawn."""


def dot(a: Columns, b: Columns) -> Tensor:
    """Returns a . b, [M]."""
    return reduce(add, (x * y for x, y in zip(a, b, strict=True)))


def cross(a: Columns, b: Columns) -> Columns:
    """Returns a x b."""
    (ax, ay, az), (bx, by, bz) = a, b
    return ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx


def minors(a: Columns, b: Columns) -> Columns:
    """Returns all a_i b_j - a_j b_i of vectors of any length; of three components, those of a x b."""
    if len(a) == 3:
        return cross(a, b)
    return tuple(a[i] * b[j] - a[j] * b[i] for i, j in combinations(range(len(a)), 2))


def plus(a: Columns, factor: Tensor | float, b: Columns) -> Columns:
    """Returns a + factor b."""
    return tuple(x + factor * y for x, y in zip(a, b, strict=True))


def scaled(a: Columns, factors: Columns) -> Columns:
    """Returns the products of the components."""
    return tuple(x * factor for x, factor in zip(a, factors, strict=True))


def unit(quats: Float[Tensor, "M 4"]) -> Columns:
    """Returns q / max(|q|, 1e-12)."""
    # the largest part first: the square of a long quaternion would overflow
    largest = quats.detach().abs().amax(1).clamp_min(1e-12)
    parts = tuple(part / largest for part in quats.unbind(1))
    length = dot(parts, parts).clamp_min(1).sqrt()
    return tuple(part / length for part in parts)


def rotate_back(quat: Columns, vector: Columns) -> Columns:
    """Returns R(q)^T v for unit quaternions (w, x, y, z); the zero quaternion is the identity."""
    w, *axis = quat
    half = cross(tuple(axis), vector)
    return plus(plus(vector, -2 * w, half), 2, cross(tuple(axis), half))


def screen_axes(
    slopes: Columns, stretches: Columns, sizes: Columns, quats: Columns, rotation: Float[Tensor, "3 3"]
) -> tuple[Columns, Columns]:
    """Returns the rows p, q of J W R diag(s), px; `slopes`: x/z and y/z, `sizes`: scales in px at the splat's depth."""
    right, down, forward = (row.unbind() for row in rotation)
    p, q = (
        scaled(rotate_back(quats, tuple(stretch * part for part in plus(row, -slope, forward))), sizes)
        for row, slope, stretch in zip((right, down), slopes, stretches, strict=True)
    )
    return p, q


def covariance_and_factor(p: Columns, q: Columns, dilation: Float[Tensor, "1"]) -> tuple[Columns, Columns, Columns]:
    """Returns the dilated covariance (xx, xy, yy) = P P^T + d I, its factor U, and two parts of determinant / yy.

    p, q are the rows of P. The determinant is |p x q|^2 + d (|p|^2 + |q|^2) + d^2 by Lagrange's identity, without
    cancellation. The parts are the determinant before dilation, and the part from dilation.
    """
    pp, pq, qq = dot(p, p), dot(p, q), dot(q, q)
    xx, yy = pp + dilation, qq + dilation
    areas = minors(p, q)
    area = scaled(areas, (yy.rsqrt(),) * len(areas))  # p x q / sqrt(yy)
    bare, added = dot(area, area), dilation * (pp / yy + 1)  # determinants / yy: squares of px, not fourth powers
    u0 = (2 * (bare + added)).rsqrt()
    return (xx, pq, yy), (u0, -pq / yy * u0, (2 * yy).rsqrt()), (bare, added)


def log_compensation(bare: Float[Tensor, "M"], added: Float[Tensor, "M"]) -> Float[Tensor, "M"]:
    """Returns ln sqrt(|S| / |S + d I|) for |S| = bare and |S + d I| = bare + added (Mip-Splatting, forward.cu).

    The ratio is the sigmoid of ln(bare / added): exact near 0 and near 1; constant below the floor.
    """
    return logsigmoid((bare / added).clamp_min(LEAST_SHARE).log()) / 2


def log_exchange(
    p: Columns,
    q: Columns,
    bare: Float[Tensor, "M"],
    added: Float[Tensor, "M"],
    yy: Float[Tensor, "M"],
    drawn: Float[Tensor, "1"],
) -> Float[Tensor, "M"]:
    """Returns ln sqrt(|S + drawn I| / |S + d I|), which keeps a splat's mass if its dilation is d, not `drawn`.

    `bare`, `added` and yy are those of `covariance_and_factor` for d.
    """
    before = bare + drawn * ((dot(p, p) + dot(q, q) + drawn) / yy)
    return (before.log() - (bare + added).log()) / 2


def shape_of(
    p: Columns, q: Columns, dilation: Float[Tensor, "1"], compensate: bool, drawn: Float[Tensor, "1"] | None
) -> tuple[Float[Tensor, "M 3"], Float[Tensor, "M 3"], Float[Tensor, "M"] | None]:
    """Returns dilated covariances, their factors, and ln of the opacity factor or None, as `geometry`."""
    covariances, conic_factors, determinants = covariance_and_factor(p, q, dilation)
    compensation = log_compensation(*determinants) if compensate else None
    if drawn is not None:
        bare, added = determinants
        compensation = log_exchange(p, q, bare, added, covariances[2], drawn)
    return torch.stack(covariances, 1), torch.stack(conic_factors, 1), compensation


def geometry(
    points: Float[Tensor, "M 3"],
    scales: Float[Tensor, "M 3"],
    quats: Float[Tensor, "M 4"],
    rotation: Float[Tensor, "3 3"],
    intrinsics: Float[Tensor, "4"],
    dilation: Float[Tensor, "1"],
    compensate: bool,
    drawn: Float[Tensor, "1"] | None,
    low: Float[Tensor, "2"],
    high: Float[Tensor, "2"],
) -> tuple[Float[Tensor, "M 2"], Float[Tensor, "M 3"], Float[Tensor, "M 3"], Float[Tensor, "M"] | None]:
    """Returns screen means (px of the frame), dilated covariances, their factors, and ln of the opacity factor or None.

    `points`: means in camera coordinates, float64; `intrinsics`: (fx, fy, cx, cy) on the frame, float64; `dilation`,
    px^2; the opacity factor compensates all of it (`compensate`), or its difference from `drawn`, the dilation in
    training; `low`, `high`: bounds of x/z and y/z in the Jacobian.
    """
    x, y, z = points.unbind(1)
    fx, fy, cx, cy = intrinsics
    slopes = x / z, y / z
    means = slopes[0] * fx + cx, slopes[1] * fy + cy
    clamped = tuple(s.to(scales).clamp(a, b) for s, a, b in zip(slopes, low, high, strict=True))
    # scales in px at their depth come first, so that nothing overflows
    longest = torch.maximum(fx, fy).detach()
    stretches, magnification = ((fx / longest).to(scales), (fy / longest).to(scales)), (longest / z).to(scales)
    sizes = scaled(scales.unbind(1), (magnification,) * 3)
    p, q = screen_axes(clamped, stretches, sizes, unit(quats), rotation)
    return torch.stack(means, 1).to(scales), *shape_of(p, q, dilation, compensate, drawn)
