"""Contradictory poses in the files of a COLMAP model.

COLMAP 4 takes the pose of an image from `frames` and `rigs` and writes it to `images` as well, for older programs.
Programs that know only `images` change, add or remove poses there alone. A folder may also hold the model both as text
and as binary files, of which text is not used.
"""

import math
import struct
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from gsx.scenes.colmap_records import FRAME, IMAGE_HEAD, records
from gsx.scenes.colmap_text import text_poses
from gsx.scenes.pose_files import some_names

IMAGE_POSE = struct.Struct("<I7d")  # id; quaternion w, x, y, z; translation
FRAME_IMAGE = struct.Struct("<iIQ")  # type of sensor, its id, id of the image
CAMERA = 0  # type of a sensor that takes images
TOLERANCE = 1e-5
"""Radians, and share of the spread of the cameras, by which the same pose may differ where text has rounded it."""
ROUNDING = 1e-9  # the same, as a share of the largest coordinate: far from the origin, numbers of text are coarse


def pose_conflict(folder: Path, files: Mapping[str, Path], reconstruction: Any) -> str:
    """Return a note if files of a model state other poses than those in use; empty: they agree.

    `folder` holds the binary files that were read; `files` are the model's own, by content.
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
    """Yield (id, quaternion w, x, y, z and translation, name) of each image of a whole images.bin."""
    data = file.read_bytes()
    for at in records("images", data):
        number, *pose = IMAGE_POSE.unpack_from(data, at)
        name = data[at + IMAGE_HEAD : data.find(b"\0", at + IMAGE_HEAD)].decode(errors="replace")
        yield number, np.array(pose), name


@np.errstate(all="ignore")  # what is not finite is no equal pose
def difference(pairs: Iterable[tuple[Any, np.ndarray]]) -> str:
    """Describe how poses of pycolmap images differ from stated ones; empty: they are the same."""
    compared = list(pairs)
    if not compared:
        return ""
    images, poses = zip(*compared, strict=True)
    used, stated = np.array([image.cam_from_world().matrix() for image in images]), np.array([*map(matrix_of, poses)])
    turns, steps = angles(used, stated), np.linalg.norm(centres(used) - centres(stated), axis=1)
    places = centres(used)
    spread = np.linalg.norm(places - places.mean(0), axis=1).max()
    near = float(TOLERANCE * spread + ROUNDING * max(1.0, np.abs(places).max()))
    same = (turns <= TOLERANCE) & (steps <= near)  # false for NaN
    names = sorted(_name(images[index]) for index in np.flatnonzero(~same))
    degrees, units = math.degrees(_above(turns, TOLERANCE)), _above(steps, near)
    kinds = [f"by up to {degrees:.3g} degrees and {units:.3g} units"] if degrees + units else []
    broken = int((~np.isfinite(turns + steps)).sum())
    kinds += [f"{broken} without a rotation"] if broken else []
    return f"{len(names)} images ({', '.join(kinds)}: {some_names(names)})" if names else ""


def matrix_of(pose: np.ndarray) -> np.ndarray:
    """Return the matrix (3 x 4) of a quaternion w, x, y, z of any length and a translation; NaN for length 0."""
    import pycolmap

    w, *xyz = pose[:4] / np.linalg.norm(pose[:4])
    return np.concatenate([pycolmap.Rotation3d([*xyz, w]).matrix(), pose[4:, None]], axis=1)


def centres(matrices: np.ndarray) -> np.ndarray:
    """Return camera centres (N x 3) of matrices camera_from_world (N x 3 x 4)."""
    return -np.einsum("nij,ni->nj", matrices[:, :, :3], matrices[:, :, 3])


def angles(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Return radians between the rotations of matrices (N x 3 x 4)."""
    apart = np.linalg.norm(one[:, :, :3] - other[:, :, :3], axis=(1, 2))
    return 2 * np.arcsin(np.clip(apart / np.sqrt(8), 0, 1))


def _above(values: np.ndarray, least: float) -> float:
    """Return the largest finite value above a bound; 0: there is none."""
    return float(values[np.isfinite(values) & (values > least)].max(initial=0.0))


def unmatched(folder: Path) -> str:
    """Describe which images `frames.bin` and `images.bin` do not share; empty: they agree, or one is missing."""
    if not (folder / "frames.bin").is_file():
        return ""
    names = {number: name for number, _, name in binary_poses(folder / "images.bin")}
    data = (folder / "frames.bin").read_bytes()
    framed = set[int]()
    for at in records("frames", data):
        first = at + FRAME.size
        for place in range(first, first + FRAME.unpack_from(data, at)[-1] * FRAME_IMAGE.size, FRAME_IMAGE.size):
            kind, _, image = FRAME_IMAGE.unpack_from(data, place)
            framed |= {image} if kind == CAMERA else set()
    if lacking := sorted(framed - names.keys()):
        return f"frames lists image {lacking[0]}, which images lacks"
    if lacking := sorted(names.keys() - framed):
        return f"images lists {names[lacking[0]]} (image {lacking[0]}), which frames lacks"
    return ""
