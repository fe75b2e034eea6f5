"""Depth maps of photographs: their files, and their values in scene units on the raster of a view.

A map with a scale of its own, as networks make them, is fitted to points of the scene: z = a m + b, or 1 / z = a m + b.
"""

from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from gsx.core.data.images import decode, is_reduction
from gsx.core.data.scene import PointCloud, Scene, View
from gsx.core.errors import InputError
from gsx.core.files import is_file
from gsx.core.shapes import Float
from gsx.scenes.filling import in_front, in_view
from gsx.scenes.masked import candidates, folder_of
from gsx.scenes.options import SceneOptions
from gsx.scenes.orientation import Remap, Turned
from gsx.scenes.photo_source import PhotoSource
from gsx.scenes.undistort import StoredUndistortion

FOLDER = "depths"
"""Folder of maps, at the place of a folder of masks."""
SUFFIXES = (".npy", ".exr", ".png", ".tif", ".tiff")
MILLIMETRE = 0.001
"""Unit of whole numbers, m (nerfstudio, depth_unit_scale_factor)."""
MOST_POINTS = 2000
"""Most points of unknown visibility that a map is fitted to."""
STRICTLY_BEHIND = 1.05
"""Such a point is hidden if it is this many times as far as its nearest neighbour in the picture."""
FEWEST = 10
"""Fewest points on a map that it is fitted to."""
MOST_PAIRED = 1000
"""Most points whose pairs are compared for the first line of a fit."""
ROUNDS, LEAST = 50, 1e-4
"""Rounds of reweighting of a fit, and the least relative error that lowers a weight."""
POOR = 0.2
"""Median relative error on the points from which on a map contradicts them."""


# -- files -------------------------------------------------------------------------------------------------------------


def depth_file(name: str, options: SceneOptions) -> Path | None:
    """Return the file of a photo's depth map: a.npy or a.jpg.npy for a.jpg, or other suffixes; None: there is none."""
    folder = folder_of(options, FOLDER)
    if not folder.is_dir():
        return None
    places = [file for one in (name, f"{name}.any") for file in candidates(folder, one, SUFFIXES)]
    return next((file for file in places if file.suffix.lower() in SUFFIXES and is_file(file)), None)


def read_values(file: Path) -> np.ndarray:
    """Read the numbers of a NumPy file or of an image's only channel, [h, w]; InputError: there is no such thing."""
    if not is_file(file):
        raise InputError(f"The depth map '{file}' does not exist: restore it, or set training.depth.when=never.")
    if file.suffix.lower() == ".npy":
        try:
            values = np.load(file, allow_pickle=False).squeeze()
        except (OSError, ValueError, EOFError) as problem:
            raise InputError(f"The depth map '{file}' cannot be read ({problem}): save it by numpy.save.") from None
    else:
        values = decode(file)[0].squeeze()
    if values.ndim != 2 or values.dtype.kind not in "iuf":
        raise InputError(
            f"The depth map '{file}' has the shape {list(values.shape)} of {values.dtype}: save one number per pixel, "
            "not colours."
        )
    return values


def read_map(file: Path, source: PhotoSource, options: SceneOptions) -> Float[Tensor, "h w"]:
    """Read a photo's map, in scene units or their inverse, undistorted and upright as the photo; 0 where unknown.

    Raises:
        InputError: it cannot be read, has another shape than the photograph, or holds no depth.
    """
    stored = read_values(file)
    height, width = stored.shape
    if source.expected_size is not None and not is_reduction((width, height), source.expected_size):
        photo = f"'{source.path}' is {source.expected_size[0]} x {source.expected_size[1]}"
        raise InputError(f"The depth map '{file}' is {width} x {height}, but {photo}: give it the photo's shape.")
    inverse = options.depth_values == "disparity"
    unit = options.unit * (options.depth_unit or (MILLIMETRE if stored.dtype.kind in "iu" and not inverse else 1.0))
    values = torch.from_numpy(stored.astype(np.float64) * (1 / unit if inverse else unit)).float()
    values = torch.where(values.isfinite() & (values > 0), values, 0.0)
    if not bool(values.any()):
        raise InputError(f"The depth map '{file}' holds no number above 0: write distances ahead, or remove it.")
    return straightened(values, source.remap)


def straightened(values: Float[Tensor, "h w"], remap: Remap | None) -> Float[Tensor, "H W"]:
    """Turn and undistort a map as its photograph, without interpolation; 0 where it has no value."""
    inner = remap.remap if isinstance(remap, Turned) else remap
    nearest = inner.nearest if isinstance(inner, StoredUndistortion) else None
    change = replace(remap, remap=nearest) if isinstance(remap, Turned) else nearest
    return values if change is None else change(values[None])[0]


def nearest_values(values: Float[Tensor, "h w"], width: int, height: int) -> Float[Tensor, "height width"]:
    """Return the nearest value at the centre of each pixel of a raster."""
    row, column = (
        ((torch.arange(side) + 0.5) / side * own).long()
        for side, own in zip((height, width), values.shape, strict=True)
    )
    return values[row[:, None], column]


# -- the scale of the scene --------------------------------------------------------------------------------------------


def with_depth_maps(scene: Scene, options: SceneOptions) -> Scene:
    """Return the scene whose training views read the depth maps of their photos when they are needed."""

    def mapped(view: View) -> View:
        if not isinstance(view.source, PhotoSource) or (file := view.source.depth) is None:
            return view
        return replace(view, depth_map=partial(scene_depth, view, file, view.source, scene.points, options))

    return replace(scene, train=[mapped(view) for view in scene.train])


def scene_depth(
    view: View, file: Path, source: PhotoSource, points: PointCloud, options: SceneOptions
) -> Float[Tensor, "H W"] | None:
    """Read camera z at the pixels of a view, 0 where unknown; None: see `fitted`.

    Points are those that the view observes or, if that is unknown, all that others do not hide.
    """
    values = nearest_values(read_map(file, source, options), *view.camera.size)
    known, inverse = values > 0, options.depth_values == "disparity"
    pixels, z = depths_of_points(view, points)
    column, row = pixels.long().unbind(1)
    on_map = known[row, column]
    line = fitted(values[row, column][on_map], z[on_map], options, observed=view.sparse is not None)
    if line is None:
        return None
    mapped = line[0] * values + line[1]
    depth = 1 / mapped if inverse else mapped
    return torch.where(known & (mapped > 0) & (depth > view.camera.near), depth, 0.0)


def depths_of_points(view: View, points: PointCloud) -> tuple[Float[Tensor, "K 2"], Float[Tensor, "K"]]:
    """Return (pixels, z) of points that a view observes or, if that is unknown, of those that others do not hide."""
    if view.sparse is not None:
        return view.sparse.pixels, view.sparse.z
    pixels, z = (values[:: -(-len(values) // MOST_POINTS) or 1] for values in in_view(view.camera, points.positions))
    front = in_front(pixels, z, STRICTLY_BEHIND) if len(z) else z > 0
    return pixels[front], z[front]


def fitted(
    values: Float[Tensor, "K"], z: Float[Tensor, "K"], options: SceneOptions, observed: bool
) -> tuple[float, float] | None:
    """Return (a, b) of z = a m + b, or of its inverse; None: the map contradicts the points, or they are too few.

    A metric map is compared with observed points alone.
    """
    metric, aim = options.depth_fit == "none", 1 / z if options.depth_values == "disparity" else z
    if metric and (not observed or len(z) < FEWEST):
        return 1.0, 0.0
    if len(z) < FEWEST:
        return None
    slope, offset = (1.0, 0.0) if metric else robust_line(values, aim, shift=options.depth_fit == "affine")
    error = float(((slope * values + offset - aim).abs() / aim).median())
    return (slope, offset) if slope > 0 and error < POOR else None


def robust_line(x: Float[Tensor, "K"], y: Float[Tensor, "K"], shift: bool = True) -> tuple[float, float]:
    """Return (a, b) of a line y = a x + b with a small sum of errors |a x + b - y| / max(a x + b, y), for y > 0.

    By iteratively reweighted least squares from the line of Theil and Sen. Without `shift` b is 0.
    """
    x, y = x.double(), y.double()
    columns = torch.stack([x, torch.ones_like(x)], 1) if shift else x[:, None]
    line = median_line(x, y) if shift else (y / x).median()[None]
    for _ in range(ROUNDS):
        larger = torch.maximum(columns @ line, y)
        error = (columns @ line - y).abs() / larger
        scale = 1 / (larger * error.clamp_min(LEAST).sqrt())
        weighted = columns * scale[:, None], (y * scale)[:, None]
        line = torch.linalg.lstsq(*weighted, driver="gelsd").solution[:, 0]
    return float(line[0]), float(line[1]) if shift else 0.0


def median_line(x: Float[Tensor, "K"], y: Float[Tensor, "K"]) -> Float[Tensor, "2"]:
    """Return (a, b) of the line with the median slope of pairs of up to MOST_PAIRED points, and the median offset."""
    first, second = torch.combinations(torch.arange(0, len(x), -(-len(x) // MOST_PAIRED))).unbind(1)
    slope = ((y[second] - y[first]) / (x[second] - x[first])).nanmedian().nan_to_num(0.0)
    return torch.stack([slope, (y - slope * x).median()])
