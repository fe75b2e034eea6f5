"""Display RGB in PLY files, with the names and units that programs use."""

from collections.abc import Mapping

import numpy as np

COLOUR_NAMES = (
    ("red", "green", "blue"),
    ("diffuse_red", "diffuse_green", "diffuse_blue"),
    ("r", "g", "b"),
    ("R", "G", "B"),
)
"""Names of the three channels, the usual ones first (diffuse_: MeshLab and older scanners)."""
OVERSHOOT = 0.5
"""Floats in [0, 1] may exceed it by this, because colours of harmonics are not clipped."""


def colours_among(columns: Mapping[str, np.ndarray]) -> np.ndarray | None:
    """Returns the colour columns [N, 3] as stored; None: there are none."""
    for names in COLOUR_NAMES:
        if set(names) <= columns.keys():
            return np.stack([columns[name] for name in names], axis=1)
    return None


def full_scale_of(values: np.ndarray) -> float | None:
    """Returns the value of full intensity by type and range; None: unknown unit.

    Bytes have 255, other integers 255 or 65,535, floats 1 within OVERSHOOT of [0, 1], else 255.
    """
    finite = values[np.isfinite(values)] if values.dtype.kind == "f" else values
    if values.dtype == np.uint8 or not finite.size:
        return 255.0 if values.dtype.kind in "iu" else 1.0
    least, most = float(finite.min()), float(finite.max())
    if values.dtype.kind == "f":
        if least >= -OVERSHOOT and most <= 1 + OVERSHOOT:
            return 1.0
        return 255.0 if least >= 0 and most <= 255 else None
    return next((full for full in (255.0, 65535.0) if least >= 0 and most <= full), None)
