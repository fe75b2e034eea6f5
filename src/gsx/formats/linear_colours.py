"""Conversion of harmonics of linear light to sRGB, in which gsx trains and blends."""

import logging
from dataclasses import replace

import numpy as np
import torch

from gsx.core.data.resize import display_from_linear
from gsx.core.gaussians.bands import BAND_0
from gsx.core.gaussians.sh import harmonics
from gsx.core.shapes import Float
from gsx.formats.arrays import Arrays
from gsx.formats.turned import DIRECTIONS, spread_directions

logger = logging.getLogger(__name__)

AT_ONCE = 4096
"""Splats converted at a time."""


def srgb_of_linear(arrays: Arrays, name: str) -> Arrays:
    """Converts colours of splats from linear light to sRGB, and logs the error with the file's name.

    Exact for degree 0; higher degrees are least-squares fits over evenly spread directions. Blends of splats differ.
    """
    basis = basis_of(arrays.degree)
    linear = np.concatenate([arrays.sh_dc[:, None], arrays.sh_rest], 1)
    fit, squares, most = np.linalg.pinv(basis), 0.0, 0.0
    coefficients = np.empty_like(linear)
    for start in range(0, len(linear), AT_ONCE):
        rows = slice(start, start + AT_ONCE)
        light = torch.from_numpy(np.maximum(0.5 + basis @ linear[rows], 0))
        colours = display_from_linear(light, limited=False).numpy()  # beyond 1 by the same formula
        coefficients[rows] = fit @ (colours - 0.5)
        errors = np.maximum(0.5 + basis @ coefficients[rows], 0) - colours
        squares, most = squares + float((errors**2).sum()), max(most, float(np.abs(errors).max()))
    rms = (squares / max(len(linear) * len(basis) * 3, 1)) ** 0.5
    logger.warning("%s: colours are of linear light and become sRGB, each to within %.4f RMS (at most %.4f); blends of "
                   "splats differ from those in linear light", name, rms, most)  # fmt: skip
    return replace(arrays, sh_dc=coefficients[:, 0], sh_rest=coefficients[:, 1:])


def basis_of(degree: int) -> Float[np.ndarray, "D B"]:
    """Returns all harmonics up to a degree in evenly spread directions, the constant one first."""
    if not degree:
        return np.full((1, 1), BAND_0)
    rest = harmonics(spread_directions(DIRECTIONS), degree).numpy()
    return np.concatenate([np.full((len(rest), 1), BAND_0), rest], 1)
