"""COLMAP models as plain data: checking and reading `cameras`, `images`, `points3D` (3D-GS).

pycolmap reads every layout (binary and text, 3.x and 4.x with rigs and frames) but does not notice where a binary
file ends: what lies past the end comes out as noise. The files are therefore walked record by record beforehand
(gsx.scenes.colmap_records).
"""

import copy
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from shutil import copyfile
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gsx.core.data.scene import PointCloud
from gsx.core.errors import InputError
from gsx.core.files import refuse_lfs_pointer
from gsx.core.shapes import Bool, Float
from gsx.formats.origin import in_single_where_resolved
from gsx.scenes.colmap_folders import model_files
from gsx.scenes.colmap_poses import pose_conflict, unmatched
from gsx.scenes.colmap_records import U64, check_binary, contradiction
from gsx.scenes.colmap_text import write_as_binary
from gsx.scenes.points import read_points
from gsx.scenes.pose_files import some_names

OBSERVATIONS_PER_IMAGE = 1000  # read of each image: the reprojection check is a median over all images
QUATERNION_TOLERANCE = 0.01  # of its length, 1: text formats round


@dataclass(frozen=True, eq=False, kw_only=True)
class ModelImage:
    """A registered image and its observations."""

    name: str
    """Path relative to the image folder, with `/`."""
    camera_id: int
    rotation: Float[Tensor, "3 3"]
    """camera_from_world, float64."""
    translation: Float[Tensor, "3"]
    """camera_from_world, float64."""
    keypoints: Float[Tensor, "K 2"]
    """Observed positions in pixels of the model's camera, pixel centres at +0.5, float64; evenly drawn from all."""
    observed: Float[Tensor, "K 3"]
    """The world points at these keypoints, float64."""
    errors: Float[Tensor, "K"]
    """Their mean reprojection errors, px, float64; NaN: unknown."""
    lost: int = 0
    """Number of observations without their point, which has been removed from the model."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Model:
    """A COLMAP model; `cameras` are pycolmap cameras by id, `images` are sorted by name."""

    folder: Path
    cameras: dict[int, Any]
    images: list[ModelImage]
    points: PointCloud
    mean_error: float
    """Mean reprojection error of the points that state a finite one, in pixels; NaN: none does."""
    notes: list[str]
    conflict: str = ""
    """A note where its files contradict each other about poses; also among `notes`."""


def read_model(folder: Path) -> Model:
    """Read a model; InputError: a file is missing or corrupt, a camera model is unknown, or there are no points."""
    file = model_files(folder)["points3D"]
    reconstruction, notes, conflict = reconstruction_of(folder)
    notes += [conflict] * bool(conflict)
    positions: Positions | None = None
    if file.suffix.lower() == ".ply":  # which does not say which images observe its points
        points = read_points(file)
        why = "as there is no points3D.bin: cameras cannot be checked by observations"
        notes.append(f"Points are those of {file.name}, {why}.")
    else:
        points, positions, dropped = _points(reconstruction, file)
        notes += [f"Dropped {dropped} points with coordinates that are not finite."] * bool(dropped)
    registered = [reconstruction.image(number) for number in reconstruction.reg_image_ids()]
    images = sorted((_image(image, positions, file) for image in registered), key=lambda image: image.name)
    if names := [image.name for image in images if image.lost]:  # as where a script has removed some
        lost = f"Images observe points that {file.name} lacks, as where points were removed from it alone"
        notes.append(f"{lost}: these observations are left out ({len(names)} images: {some_names(names)}).")
    errors = np.array([point.error for point in reconstruction.points3D.values() if point.has_error()])
    finite = errors[np.isfinite(errors)]
    if left := len(errors) - len(finite):
        notes.append(f"The mean reprojection error leaves out {left} points whose own is not finite.")
    return Model(
        folder=folder,
        cameras={number: copy.copy(camera) for number, camera in sorted(reconstruction.cameras.items())},
        images=images,
        points=points,
        mean_error=float(finite.mean()) if len(finite) else math.nan,
        notes=notes,
        conflict=conflict,
    )


Positions = Mapping[int, Float[Tensor, "4"]]
"""World points and their mean reprojection errors (NaN: unknown) by their id, float64."""


def _points(reconstruction: Any, file: Path) -> tuple[PointCloud, Positions, int]:
    """Return the finite points of a model, all positions by id, and the number of points left out."""
    numbers = sorted(reconstruction.points3D)
    points = [reconstruction.point3D(number) for number in numbers]
    known = _stack([[*point.xyz, point.error if point.has_error() else math.nan] for point in points], 4)
    positions = known[:, :3]
    usable = _usable(positions)
    if not usable.any():
        raise InputError(
            f"{file} holds no points with finite coordinates, but training starts from points: "
            "triangulate the model (colmap point_triangulator) or reconstruct the photos with scene=photos."
        )
    colours = torch.from_numpy(np.array([point.color for point in points]))
    cloud = PointCloud(in_single_where_resolved(positions[usable]), colours[usable])
    return cloud, dict(zip(numbers, known, strict=True)), int((~usable).sum())


def error_words(mean_error: float) -> str:
    """Describe the mean reprojection error of a model; NaN: it states none."""
    return "no reprojection error stated" if math.isnan(mean_error) else f"mean reprojection error {mean_error:.2f} px"


@contextmanager
def binary_model(files: Mapping[str, Path]) -> Iterator[tuple[Path, list[str]]]:
    """Yield a folder with the binary files of a model under COLMAP's names, and notes on its text."""
    folders = {file.parent for file in files.values()}
    if all(file.name == f"{name}.bin" for name, file in files.items()) and len(folders) == 1:
        yield folders.pop(), []
        return
    with TemporaryDirectory(prefix="gsx-colmap-") as made:
        folder = Path(made)
        texts = {name: file for name, file in files.items() if file.suffix.lower() == ".txt"}
        notes = write_as_binary(texts, folder)
        for name, file in files.items():
            if file.suffix.lower() == ".bin":
                copyfile(file, folder / f"{name}.bin")
        if files["points3D"].suffix.lower() == ".ply":
            (folder / "points3D.bin").write_bytes(U64.pack(0))
        yield folder, notes


def reconstruction_of(folder: Path) -> tuple[Any, list[str], str]:
    """Read a folder as pycolmap.Reconstruction; returns it, notes, and a note on contradictory poses.

    Raises:
        InputError: a file is missing, truncated or corrupt, or files contradict each other.
    """
    import pycolmap

    files = model_files(folder)
    for name, file in files.items():
        refuse_lfs_pointer(file)
        if file.suffix.lower() == ".bin":
            check_binary(name, file)
    with binary_model(files) as (binary, notes):
        try:
            found = pycolmap.Reconstruction(binary)
        except (ValueError, IndexError, KeyError, RuntimeError, MemoryError) as problem:
            remedy = "copy or make the model again"
            if "frames" in files:
                poses, frames, rigs = (files[name].name for name in ("images", "frames", "rigs"))
                remedy += f", or remove {frames} and {rigs} to use the poses in {poses}"
            raise InputError(
                f"pycolmap cannot read the COLMAP model {folder} ({', '.join(file.name for file in files.values())}): "
                f"{contradiction(binary) or unmatched(binary) or plain(problem)}; {remedy}."
            ) from None
        return found, notes, pose_conflict(binary, files, found)


def plain(problem: Exception) -> str:
    """Return pycolmap's words for a failed check without its place in COLMAP's source."""
    words = re.sub(r"^\[[\w.]+:\d+\]\s*(Check failed: )?", "", str(problem).strip("'\" \n"))
    return "its files contradict each other" if words.startswith(("unordered_map", "vector::")) else words


def _usable(positions: Float[Tensor, "P 3"]) -> Bool[Tensor, "P"]:
    """Return which points are finite in float32; false for NaN as well."""
    return (positions.abs() <= torch.finfo(torch.float32).max).all(dim=1)


def _image(image: Any, positions: Positions | None, file: Path) -> ModelImage:
    """Return an image with its observations (None: without); InputError for a point that `file`, a text, lacks."""
    indices = [] if positions is None else image.get_observation_point2D_idxs()
    step = -(-len(indices) // OBSERVATIONS_PER_IMAGE) or 1
    drawn, positions = [image.point2D(index) for index in indices[::step]], positions or {}
    lost = [point.point3D_id for point in drawn if point.point3D_id not in positions]
    name = _name(image, file)
    if lost and file.suffix.lower() == ".txt":  # a binary file states how many points it has
        raise InputError(f"{file} is truncated: {name} observes its point {lost[0]}; copy or make the model again.")
    keypoints = [point for point in drawn if point.point3D_id in positions]
    known = _stack([positions[point.point3D_id] for point in keypoints], 4)
    observed = known[:, :3]
    usable, pose = _usable(observed), image.cam_from_world()
    length = pose.rotation.norm()
    if not abs(length - 1) <= QUATERNION_TOLERANCE:
        quaternion = f"a quaternion of length {length:.3g} instead of 1"
        raise InputError(
            f"The model {file.parent} turns {name} by {quaternion}: correct its pose, or make the model again."
        )
    return ModelImage(
        name=name,
        camera_id=image.camera_id,
        rotation=torch.from_numpy(pose.rotation.matrix().copy()),
        translation=torch.from_numpy(pose.translation.copy()),
        keypoints=_stack([point.xy for point in keypoints], 2)[usable],
        observed=observed[usable],
        errors=known[usable, 3],
        lost=len(lost),
    )


def _name(image: Any, file: Path) -> str:
    """Return the name of an image's photo, with `/` for the backslashes of Windows; InputError: it is no text."""
    try:
        return str(image.name).replace("\\", "/")
    except UnicodeDecodeError as error:
        name = f"bytes that are no UTF-8 ({error.object!r})"
        remedy = "rename the photo and reconstruct again."
        raise InputError(f"The model {file.parent} names an image by {name}: {remedy}") from None


def _stack(rows: Sequence[Any], width: int) -> Float[Tensor, "K W"]:
    """Stack rows of numbers to a float64 matrix, even none."""
    return torch.from_numpy(np.array(rows, dtype=np.float64).reshape(-1, width))
