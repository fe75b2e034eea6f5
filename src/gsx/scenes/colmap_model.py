"""COLMAP models as plain data: finding, checking and reading `cameras`, `images`, `points3D` (3D-GS).

pycolmap reads every layout (binary and text, 3.x and 4.x with rigs and frames) but does not notice where a binary
file ends: what lies past the end comes out as noise. The files are therefore walked record by record beforehand
(gsx.scenes.colmap_records).
"""

import copy
import logging
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gsx.core.data.scene import PointCloud
from gsx.core.errors import InputError
from gsx.core.shapes import Bool, Float
from gsx.scenes.colmap_records import U64, check_binary

logger = logging.getLogger(__name__)

REQUIRED = ("cameras", "images", "points3D")
OBSERVATIONS_PER_IMAGE = 1000  # read of each image: the reprojection check is a median over all images

QUATERNION_TOLERANCE = 0.01  # of its length, 1: text formats round


@dataclass(frozen=True, eq=False, kw_only=True)
class ModelImage:
    """A registered image and what it observed."""

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
    """The world points seen there, float64."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Model:
    """A COLMAP model; `cameras` are pycolmap cameras by id, `images` are sorted by name."""

    folder: Path
    cameras: dict[int, Any]
    images: list[ModelImage]
    points: PointCloud
    mean_error: float
    """Mean reprojection error that COLMAP states, in pixels."""
    notes: list[str]


def find_model(path: Path) -> tuple[Path, list[str]]:
    """The model folder below `path` with the most images, and a note where there was a choice.

    Raises:
        InputError: no model in `path`/sparse/*, `path`/sparse or `path`, or a file of it is missing.
    """
    folders = model_folders(path)
    if not folders:
        raise InputError(
            f"No COLMAP model (cameras.bin or cameras.txt) in {path / 'sparse' / '0'}, {path / 'sparse'} or {path}: "
            "scene.path must be the folder that holds sparse/ and images/ (photos only: use scene=photos)."
        )
    counts = {folder: count_images(folder) for folder in folders}
    best = max(folders, key=lambda folder: counts[folder])  # max keeps the first of equals
    if len(folders) == 1:
        return best, []
    others = ", ".join(f"{folder.name} ({counts[folder]})" for folder in folders if folder != best)
    return best, [f"Took sub-model {best.name} with {counts[best]} images; not used, with images: {others}."]


def model_folders(path: Path) -> list[Path]:
    """Folders that hold a model: `sparse/*` in order of name, `sparse`, `path` itself."""
    sparse = path / "sparse"
    inner = sorted(folder for folder in sparse.iterdir() if folder.is_dir()) if sparse.is_dir() else []
    return [folder for folder in (*inner, sparse, path) if _suffix(folder)]


def count_images(folder: Path) -> int:
    """The number of images of a model, from the head of images.bin or the lines of images.txt."""
    file = model_files(folder)["images"]
    if file.suffix == ".txt":
        return _count_text(file)
    with file.open("rb") as stream:
        head = stream.read(U64.size)
    return int(U64.unpack(head)[0]) if len(head) == U64.size else 0


def _count_text(file: Path) -> int:
    count = 0
    with file.open(encoding="utf-8", errors="replace") as lines:
        for line in lines:
            if line.strip() and not line.startswith("#"):
                count += 1
                next(lines, None)  # the line of keypoints, which may be empty
    return count


def read_model(folder: Path) -> Model:
    """Read a model.

    Raises:
        InputError: a file is missing, truncated or corrupt, a camera model is unknown, or there are no points.
    """
    files = model_files(folder)
    if _suffix(folder) == ".bin":
        check_binary(folder)
    reconstruction = _reconstruction(folder)
    numbers = sorted(reconstruction.points3D)
    points = [reconstruction.point3D(number) for number in numbers]
    positions = _stack([point.xyz for point in points], 3)
    usable = _usable(positions)
    if not usable.any():
        raise InputError(
            f"{files['points3D']} holds no points with finite coordinates, but training starts from points: "
            "triangulate the model (colmap point_triangulator) or reconstruct the photos with scene=photos."
        )
    dropped = int((~usable).sum())
    colours = torch.from_numpy(np.array([point.color for point in points]))
    return Model(
        folder=folder,
        cameras={number: copy.copy(camera) for number, camera in sorted(reconstruction.cameras.items())},
        images=_images(reconstruction, dict(zip(numbers, positions, strict=True)), files["points3D"]),
        points=PointCloud(positions[usable].float(), colours[usable]),
        mean_error=reconstruction.compute_mean_reprojection_error(),
        notes=[f"Dropped {dropped} points with coordinates that are not finite."] if dropped else [],
    )


def _suffix(folder: Path) -> str:
    """`.bin` or `.txt` for a model folder (binary first, as 3D-GS), else an empty string."""
    return next((suffix for suffix in (".bin", ".txt") if (folder / f"cameras{suffix}").is_file()), "")


def model_files(folder: Path) -> dict[str, Path]:
    """Files that every model has, by what they hold.

    Raises:
        InputError: one is missing.
    """
    files = {name: folder / f"{name}{_suffix(folder)}" for name in REQUIRED}
    for file in files.values():
        if not file.is_file():
            raise InputError(f"The COLMAP model {folder} lacks {file.name}: copy the whole model folder again.")
    return files


def _reconstruction(folder: Path) -> Any:
    import pycolmap

    try:
        return pycolmap.Reconstruction(folder)
    except (ValueError, IndexError, KeyError, RuntimeError, MemoryError) as problem:
        raise InputError(
            f"pycolmap cannot read the COLMAP model {folder} "
            f"({', '.join(file.name for file in present_files(folder))}): "
            f"{str(problem).strip()}; copy or make the model again."
        ) from None


def present_files(folder: Path) -> Iterator[Path]:
    """Files of a model that are there; by COLMAP 4 its poses are in `frames` and `rigs`."""
    names = (*REQUIRED, "rigs", "frames")
    return (file for name in names if (file := folder / f"{name}{_suffix(folder)}").is_file())


def _usable(positions: Float[Tensor, "P 3"]) -> Bool[Tensor, "P"]:
    """Which points are finite in float32; false for NaN as well."""
    return (positions.abs() <= torch.finfo(torch.float32).max).all(dim=1)


def _images(reconstruction: Any, positions: Mapping[int, Float[Tensor, "3"]], file: Path) -> list[ModelImage]:
    images = [reconstruction.image(number) for number in reconstruction.reg_image_ids()]
    return [_image(image, positions, file) for image in sorted(images, key=lambda image: _name(image, file))]


def _image(image: Any, positions: Mapping[int, Float[Tensor, "3"]], file: Path) -> ModelImage:
    """An image with its observations; `file` is named if it lacks one of the points in `positions`."""
    indices = image.get_observation_point2D_idxs()
    step = -(-len(indices) // OBSERVATIONS_PER_IMAGE) or 1
    seen = [image.point2D(index) for index in indices[::step]]
    lost = next((point.point3D_id for point in seen if point.point3D_id not in positions), None)
    name = _name(image, file)
    if lost is not None:
        raise InputError(f"{file} is truncated: {name} observes its point {lost}; copy or make the model again.")
    observed = _stack([positions[point.point3D_id] for point in seen], 3)
    usable, pose = _usable(observed), image.cam_from_world()
    length = pose.rotation.norm()
    if not abs(length - 1) <= QUATERNION_TOLERANCE:
        raise InputError(
            f"The model {file.parent} turns {name} by a quaternion of length {length:.3g} instead of 1: correct its "
            "pose, or make the model again."
        )
    return ModelImage(
        name=name,
        camera_id=image.camera_id,
        rotation=torch.from_numpy(pose.rotation.matrix().copy()),
        translation=torch.from_numpy(pose.translation.copy()),
        keypoints=_stack([point.xy for point in seen], 2)[usable],
        observed=observed[usable],
    )


def _name(image: Any, file: Path) -> str:
    """Of the photo of an image.

    Raises:
        InputError: it is no text.
    """
    try:
        return str(image.name)
    except UnicodeDecodeError as error:
        raise InputError(
            f"The model {file.parent} names an image by bytes that are no UTF-8 ({error.object!r}): rename the photo, "
            "and reconstruct again."
        ) from None


def _stack(rows: Sequence[Any], width: int) -> Float[Tensor, "K W"]:
    """Rows of numbers as a float64 matrix, also when there are none."""
    return torch.from_numpy(np.array(rows, dtype=np.float64).reshape(-1, width))
