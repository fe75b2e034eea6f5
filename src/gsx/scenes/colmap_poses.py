"""Poses that a COLMAP model states twice, where they contradict each other.

COLMAP 4 takes the pose of an image from `frames` and `rigs` and writes it to `images`, too, for older programs.
Programs that know only `images` change, add or remove poses there alone. A folder may also hold the model as text and
as binary files, of which text is not used.
"""

import math
import struct
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from gsx.scenes.colmap_records import FRAME, IMAGE_HEAD, SKIPS, U64
from gsx.scenes.colmap_text import text_poses
from gsx.scenes.pose_files import some_names

IMAGE_POSE = struct.Struct("<I7d")  # id; quaternion w, x, y, z; translation
FRAME_IMAGE = struct.Struct("<iIQ")  # type of sensor, its id, id of the image
CAMERA = 0
"""Type of a sensor that takes images."""
TOLERANCE = 1e-5
"""Radians, and share of the spread of the cameras, by which the same pose may differ where text has rounded it."""
ROUNDING = 1e-9
"""The same, as a share of the largest coordinate: far from the origin, numbers of text are coarse."""


@dataclass(frozen=True)
class Difference:
    """Difference of two statements of poses."""

    names: list[str]
    """Images whose poses differ."""
    degrees: float
    """Largest angle between two rotations."""
    units: float
    """Largest distance between two camera centres."""
    broken: int
    """Number of images stated without a rotation, as by zeros."""

    def __str__(self) -> str:
        """Return how many images differ, by how much, and some names."""
        kinds = [f"by up to {self.degrees:.3g} degrees and {self.units:.3g} units"] if self.degrees + self.units else []
        kinds += [f"{self.broken} without a rotation"] if self.broken else []
        return f"{len(self.names)} images ({', '.join(kinds)}: {some_names(self.names)})"


def pose_conflict(folder: Path, files: Mapping[str, Path], reconstruction: Any) -> str:
    """Return a note where files of a model state other poses than those in use; empty: they agree.

    folder: of the binary files that were read; files: the model's own, by what they hold.
    """
    used = [image for image in reconstruction.images.values() if image.has_pose]
    if (folder / "frames.bin").is_file():
        stated = {number: pose for number, pose, _ in binary_poses(folder / "images.bin")}
        if other := difference((image, stated[image.image_id]) for image in used if image.image_id in stated):
            images, frames, rigs = (files[name].name for name in ("images", "frames", "rigs"))
            return (
                f"{images} and {frames} state different poses of {other}: those of {frames} are used, as by COLMAP 4. "
                f"If {images} is right, remove {frames} and {rigs}."
            )
    text = files["images"].with_name("images.txt")
    if files["images"].suffix.lower() == ".bin" and text.is_file():
        by_name, texts = {_name(image): image for image in used}, dict(text_poses(text))
        if other := difference((by_name[name], texts[name]) for name in sorted(by_name.keys() & texts)):
            return (
                f"{text.name} states other poses than the binary model for {other}: the binary model is used. If the "
                "text is right, remove the binary files."
            )
    return ""


def _name(image: Any) -> str:
    """Return the name of a pycolmap image; an empty string if it is no text."""
    try:
        return str(image.name)
    except UnicodeDecodeError:
        return ""


def binary_poses(file: Path) -> Iterator[tuple[int, np.ndarray, str]]:
    """Yield (id, quaternion w, x, y, z and translation, name) of each image of an images.bin that is whole."""
    data, at = file.read_bytes(), U64.size
    for _ in range(U64.unpack_from(data, 0)[0]):
        number, *pose = IMAGE_POSE.unpack_from(data, at)
        name = data[at + IMAGE_HEAD : data.find(b"\0", at + IMAGE_HEAD)].decode(errors="replace")
        yield number, np.array(pose), name
        at = SKIPS["images"](data, at)


@np.errstate(all="ignore")  # what is not finite is no equal pose
def difference(pairs: Iterable[tuple[Any, np.ndarray]]) -> Difference | None:
    """Return how poses that are stated differ from those of pycolmap images; None: they do not."""
    compared = list(pairs)
    if not compared:
        return None
    used = np.array([image.cam_from_world().matrix() for image, _ in compared])
    stated = np.array([matrix_of(pose) for _, pose in compared])
    turns, steps = angles(used, stated), np.linalg.norm(centres(used) - centres(stated), axis=1)
    near = tolerance(centres(used))
    same = (turns <= TOLERANCE) & (steps <= near)  # false for NaN
    names = sorted(_name(compared[index][0]) for index in np.flatnonzero(~same))
    broken = int((~np.isfinite(turns + steps)).sum())
    return Difference(names, math.degrees(_above(turns, TOLERANCE)), _above(steps, near), broken) if names else None


def matrix_of(pose: np.ndarray) -> np.ndarray:
    """Return the matrix (3 x 4) of a quaternion w, x, y, z of any length and a translation; NaN for length 0."""
    w, x, y, z = pose[:4] / np.linalg.norm(pose[:4])
    rotation = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.concatenate([np.array(rotation), pose[4:, None]], axis=1)


def centres(matrices: np.ndarray) -> np.ndarray:
    """Return camera centres (N x 3) of matrices camera_from_world (N x 3 x 4)."""
    return -np.einsum("nij,ni->nj", matrices[:, :, :3], matrices[:, :, 3])


def angles(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Return radians between the rotations of matrices (N x 3 x 4)."""
    apart = np.linalg.norm(one[:, :, :3] - other[:, :, :3], axis=(1, 2))
    return 2 * np.arcsin(np.clip(apart / np.sqrt(8), 0, 1))


def tolerance(places: np.ndarray) -> float:
    """Return the distance below which two centres are one, for cameras at these places."""
    spread = np.linalg.norm(places - places.mean(0), axis=1).max()
    return float(TOLERANCE * spread + ROUNDING * max(1.0, np.abs(places).max()))


def _above(values: np.ndarray, least: float) -> float:
    """Return the largest finite value above a bound; 0: there is none."""
    return float(values[np.isfinite(values) & (values > least)].max(initial=0.0))


def unmatched(folder: Path) -> str:
    """Return which images `frames.bin` and `images.bin` do not share, in words; empty: they list the same, or one."""
    if not (folder / "frames.bin").is_file():
        return ""
    names = {number: name for number, _, name in binary_poses(folder / "images.bin")}
    framed = set(framed_images(folder / "frames.bin"))
    if lacking := sorted(framed - names.keys()):
        return f"frames lists image {lacking[0]}, which images lacks"
    if lacking := sorted(names.keys() - framed):
        return f"images lists {names[lacking[0]]} (image {lacking[0]}), which frames lacks"
    return ""


def framed_images(file: Path) -> Iterator[int]:
    """Yield the ids of the images that a frames.bin that is whole lists."""
    data, at = file.read_bytes(), U64.size
    for _ in range(U64.unpack_from(data, 0)[0]):
        end = SKIPS["frames"](data, at)
        for place in range(at + FRAME.size, end, FRAME_IMAGE.size):
            kind, _, image = FRAME_IMAGE.unpack_from(data, place)
            if kind == CAMERA:
                yield image
        at = end
