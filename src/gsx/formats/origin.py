"""Origins: offsets that are subtracted in float64 from distant positions before they become float32.

Georeferenced scenes have coordinates of millions of metres (UTM, ECEF), where float32 rounds to half a metre.
"""

import re
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from gsx.core.gaussians.splats import Gaussians
from gsx.core.shapes import Float

Origin = tuple[float, float, float]
NO_ORIGIN: Origin = (0.0, 0.0, 0.0)
FAR = 32.0
"""Largest coordinate of a scene's middle over its scale that float32 resolves. Beyond it rounding exceeds 2^-19 scales,
the last step length of 3D-GS' position rate (1.6e-6 extents)."""
STATED = re.compile(rb"gsx origin (\S{1,40}) (\S{1,40}) (\S{1,40})")


def chosen_origin(middle: Float[Tensor, "3"], scale: float) -> Origin:
    """Returns a round origin near the middle of a scene, or `NO_ORIGIN` if the middle is not `FAR`."""
    if not FAR * scale < float(middle.abs().max()) < np.inf:
        return NO_ORIGIN
    digits = int(np.floor(np.log10(max(scale, 1e-6))))
    x, y, z = (round(value, -digits) + 0.0 for value in middle.tolist())  # -0 becomes 0
    return x, y, z


def origin_of_positions(positions: Float[Tensor, "P 3"]) -> Origin:
    """Returns the origin of splats or points, from their median and their median distance from it."""
    if not len(positions):
        return NO_ORIGIN
    middle = positions.double().median(0).values
    return chosen_origin(middle, float((positions.double() - middle).norm(dim=1).median()))


def in_single_where_resolved(positions: Float[Tensor, "P 3"]) -> Float[Tensor, "P 3"]:
    """Converts positions to float32 unless they need an origin."""
    return positions if any(origin_of_positions(positions)) else positions.float()


def around(gaussians: Gaussians, origin: Sequence[float]) -> Gaussians:
    """Subtracts an origin from float64 means; returns float32."""
    means = gaussians.means
    return replace(gaussians, means=(means.double() - float64(origin, means) if any(origin) else means).float())


def away(gaussians: Gaussians, origin: Sequence[float]) -> Gaussians:
    """Adds an origin to means, float64: the inverse of `around`; without an origin returns the same object."""
    if not any(origin):
        return gaussians
    return replace(gaussians, means=gaussians.means.double() + float64(origin, gaussians.means))


def float64(origin: Sequence[float], like: Tensor) -> Float[Tensor, "3"]:
    """Returns an origin as a tensor on the device of another."""
    return torch.tensor(list(origin), dtype=torch.float64, device=like.device)


def rounding_at(positions: Float[Tensor, "P 3"]) -> float:
    """Returns the spacing of float32 numbers at the largest coordinate."""
    return float(np.spacing(np.float32(positions.abs().max()))) if len(positions) else 0.0


def stored_in_single(positions: Float[Tensor, "P 3"]) -> bool:
    """Returns whether all positions are float32 numbers."""
    return bool(len(positions)) and bool((positions.float().double() == positions.double()).all())


def in_words(origin: Sequence[float]) -> str:
    """Returns an origin as text: (500000, 5400000, 300)."""
    return f"({', '.join(number(value) for value in origin)})"


def number(value: float) -> str:
    """Returns the shortest text of a float64; whole numbers without a point."""
    return str(int(value)) if value == int(value) and abs(value) < 1e15 else repr(value)


def comment_of(origin: Sequence[float]) -> str:
    """Returns the file comment that states an origin."""
    return f"gsx origin {' '.join(number(value) for value in origin)} (add it to positions, in double precision)"


def stated_in(head: bytes) -> Origin:
    """Returns the origin that a file's first bytes state by `comment_of`, or `NO_ORIGIN`."""
    found = STATED.search(head)
    try:
        x, y, z = (float(word) for word in found.groups()) if found else NO_ORIGIN
    except ValueError:  # another program's words
        return NO_ORIGIN
    return (x, y, z) if np.isfinite([x, y, z]).all() else NO_ORIGIN
