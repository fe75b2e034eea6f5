"""Colours that PLY files keep as display RGB, under the names and in the units that programs give them."""

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
"""Floats may lie this far beyond [0, 1] and are still of that unit: colours of harmonics are not clipped."""


def colours_among(columns: Mapping[str, np.ndarray]) -> np.ndarray | None:
    """Returns the three colour columns [N, 3], in the type and unit stored; None: there are none."""
    for names in COLOUR_NAMES:
        if set(names) <= columns.keys():
            return np.stack([columns[name] for name in names], axis=1)
    return None


def full_scale_of(values: np.ndarray) -> float | None:
    """Returns the value that stands for full intensity, by type and range; None: nobody writes such colours.

    Bytes have 255. Whole numbers of other types have 255 up to there, 65,535 beyond it. Floats have 1 within
    OVERSHOOT of [0, 1], 255 within [0, 255].
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
