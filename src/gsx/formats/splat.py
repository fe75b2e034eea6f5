"""`.splat`: 32 bytes a splat without a header (antimatter15/splat, MIT).

Three float32 of the position, three of the linear scale, four bytes of colour and opacity, four of the quaternion
(w, x, y, z). No spherical harmonics, no filter. Axes are those of training worlds.
"""

import numpy as np

from gsx.core.errors import InputError
from gsx.core.gaussians.sh import BAND_0
from gsx.core.shapes import Float, UInt8
from gsx.formats.arrays import Arrays, unit_quaternions

ROW = np.dtype([("mean", "<f4", 3), ("scale", "<f4", 3), ("colour", "u1", 4), ("quat", "u1", 4)])
ZERO = 128
"""Byte of a quaternion component 0; a step is 1/128, as in the format's viewer."""
SMALLEST_SCALE = 1e-30
"""Scale in place of 0, whose logarithm is infinite."""


def decode_splat(content: bytes) -> Arrays:
    """Decodes a file, rows with NaN or inf included; InputError: its length is no positive multiple of a row."""
    if not content:
        raise InputError("it is empty: copy or export it anew")
    if len(content) % ROW.itemsize:
        raise InputError(
            f"it has {len(content):,} bytes, no multiple of the {ROW.itemsize} that a splat has: copy or export it anew"
        )
    rows = np.frombuffer(content, ROW)
    return Arrays(
        means=rows["mean"].astype(float),
        log_scales=log_scales_of(rows["scale"].astype(float)),
        quats=unit_quaternions((rows["quat"].astype(float) - ZERO) / ZERO),
        opacities=rows["colour"][:, 3] / 255,
        sh_dc=constants_of(rows["colour"][:, :3]),
        sh_rest=np.zeros((len(rows), 0, 3)),
    )


def log_scales_of(scales: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "N 3"]:
    """Returns logarithms of linear scales; NaN for negative ones."""
    with np.errstate(invalid="ignore"):
        return np.log(np.where(scales == 0, SMALLEST_SCALE, scales))


def constants_of(colours: UInt8[np.ndarray, "N 3"]) -> Float[np.ndarray, "N 3"]:
    """Returns constant-band coefficients of colours in bytes."""
    return (colours / 255 - 0.5) / BAND_0
