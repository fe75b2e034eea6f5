"""Harmonics of linear light made into harmonics of sRGB, in which gsx trains and blends."""

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
"""Splats whose colours in all directions are held at once."""


def srgb_of_linear(arrays: Arrays, name: str) -> Arrays:
    """Returns splats of which each shows in sRGB the colour that it has in linear light.

    Exact for degree 0. Higher degrees are fitted by least squares over directions spread evenly, and the log has the
    error. Where splats blend, linear light blends otherwise: pictures then differ. name: of the file.
    """
    basis = basis_of(arrays.degree)
    linear = np.concatenate([arrays.sh_dc[:, None], arrays.sh_rest], 1)
    fit, squares, most = np.linalg.pinv(basis), 0.0, 0.0
    coefficients = np.empty_like(linear)
    for start in range(0, len(linear), AT_ONCE):
        rows = slice(start, start + AT_ONCE)
        colours = encoded(np.maximum(0.5 + basis @ linear[rows], 0))
        coefficients[rows] = fit @ (colours - 0.5)
        errors = np.maximum(0.5 + basis @ coefficients[rows], 0) - colours
        squares, most = squares + float((errors**2).sum()), max(most, float(np.abs(errors).max()))
    rms = (squares / max(len(linear) * len(basis) * 3, 1)) ** 0.5
    logger.warning("%s: colours are of linear light and become sRGB, each to within %.4f RMS (at most %.4f); blends of "
                   "splats differ from those in linear light", name, rms, most)  # fmt: skip
    return replace(arrays, sh_dc=coefficients[:, 0], sh_rest=coefficients[:, 1:])


def basis_of(degree: int) -> Float[np.ndarray, "D B"]:
    """Returns all harmonics up to a degree, the constant one first, in directions spread evenly; one for degree 0."""
    if not degree:
        return np.full((1, 1), BAND_0)
    rest = harmonics(spread_directions(DIRECTIONS), degree).numpy()
    return np.concatenate([np.full((len(rest), 1), BAND_0), rest], 1)


def encoded(linear: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
    """Returns sRGB of linear light >= 0, beyond 1 by the same formula."""
    return display_from_linear(torch.from_numpy(linear), limited=False).numpy()
