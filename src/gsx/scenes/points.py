"""Initial points of scenes without a reconstruction: from a PLY file, or random (3D-GS)."""

import logging
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from gsx.core.data.scene import PointCloud
from gsx.core.errors import InputError
from gsx.core.gaussians.bands import BAND_0
from gsx.core.shapes import Float, UInt8
from gsx.formats.origin import in_single_where_resolved
from gsx.formats.ply import colours_among, full_scale_of, read_ply

logger = logging.getLogger(__name__)

CONSTANT_BAND = ("f_dc_0", "f_dc_1", "f_dc_2")  # view-independent colour of splats
GREY = 127  # colour of points without one: the published random clouds store this byte


def random_points(
    count: int, low: Float[Tensor, "3"], high: Float[Tensor, "3"], generator: torch.Generator
) -> PointCloud:
    """Return `count` grey points, uniform in the box from `low` to `high`."""
    return grey_points(low + (high - low) * torch.rand(count, 3, generator=generator, dtype=torch.float64))


def grey_points(positions: Float[Tensor, "P 3"]) -> PointCloud:
    """Return grey points."""
    return PointCloud(in_single_where_resolved(positions), torch.full((len(positions), 3), GREY, dtype=torch.uint8))


def stored_points(folder: Path, name: str) -> tuple[PointCloud, str]:
    """Return the points of a PLY file and a note; InputError as `read_points`."""
    cloud = read_points(folder / name)
    return cloud, f"Starts from the {len(cloud)} points of {name}."


def read_points(path: Path) -> PointCloud:
    """Return the finite points of a PLY file, with colours of 8 or 16 bits, in [0, 1] or [0, 255]; InputError: none."""
    columns = read_ply(path)
    if not {"x", "y", "z"} <= set(columns):
        raise InputError(f"'{path}' has no x, y, z but {', '.join(columns)}, give a point cloud.")
    positions = torch.from_numpy(np.stack([columns[axis].astype(np.float64) for axis in "xyz"], axis=1))
    finite = positions.float().isfinite().all(dim=1)  # beyond float32 is infinite, which is left out
    if not finite.any():
        raise InputError(f"'{path}' holds no point with finite coordinates, give another or scene.points=random.")
    colours = colours_in(columns)
    positions = in_single_where_resolved(positions[finite])
    return grey_points(positions) if colours is None else PointCloud(positions, colours[finite])


def colours_in(columns: Mapping[str, np.ndarray]) -> UInt8[Tensor, "P 3"] | None:
    """Return the display RGB of points by the columns of their file, grey where not finite; None: unreadable."""
    values = colours_among(columns)
    if values is None and set(CONSTANT_BAND) <= columns.keys():  # a splat file
        values = (0.5 + BAND_0 * np.stack([columns[name] for name in CONSTANT_BAND], 1)).clip(0, 1)
    if values is None:
        return None
    full = full_scale_of(values)
    if full is None:
        logger.warning("colours from %g to %g have no known unit: points are grey", values.min(), values.max())
        return None
    if values.dtype == np.uint8:
        return torch.from_numpy(values)
    scaled = values.astype(np.float64) * (255 / full) + 0.5
    return torch.from_numpy(np.nan_to_num(scaled, nan=GREY, posinf=255, neginf=0).clip(0, 255).astype(np.uint8))
