"""Files of poses as JSON: their frames, matrices and numbers; their photos on disk, and likely ones for missing."""

import math
import os
import re
import unicodedata
from collections import Counter
from collections.abc import Container, Iterator, Mapping, Sequence
from itertools import islice
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Any

import torch
from torch import Tensor

from gsx.core.errors import InputError
from gsx.core.files import is_file, refuse_lfs_pointer
from gsx.core.files import read_json as parsed
from gsx.core.shapes import Float
from gsx.scenes.splits import refuse_file_twice

SUFFIXES = (".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff", ".bmp")
"""Suffixes of photos and masks, in the order of the search: NeRF-synthetic means .png where it states none."""
DRIVE = re.compile(r"^[A-Za-z]:/")  # beginning of absolute names of Windows
MOST_FILES = 100_000  # of a folder, that are compared with a name
NAMED_AT_MOST = 5  # file names in a note
ROTATION_TOLERANCE = 0.01  # of the axes' lengths: text formats round, but a scaled camera is another camera
LAST_ROW = torch.tensor([0.0, 0.0, 0.0, 1.0], dtype=torch.float64)


def plain_name(file_path: str) -> str:
    """Return a file name of a poses file with forward slashes and without a leading `./`."""
    return str(PurePosixPath(file_path.replace("\\", "/")))


def find_photo(folder: Path, file_path: str) -> Path | None:
    """Return the photo of a frame, whose name may lack its suffix; None if it is not there."""
    photo = folder / plain_name(file_path)
    if not photo.name:
        return None
    endings = ("", *(form for suffix in SUFFIXES for form in (suffix, suffix.upper())))
    return next((one for ending in endings if is_file(one := photo.with_name(f"{photo.name}{ending}"))), None)


# -- frames of transforms files ----------------------------------------------------------------------------------------


def likely_photo(folder: Path, file_path: str) -> str:
    """Return the photo that a missing frame may mean, relative to the folder; empty: none.

    It is at the end of a longer path, or has another suffix or case.
    """
    parts = PurePosixPath(DRIVE.sub("/", plain_name(file_path))).parts
    tails = (PurePosixPath(*parts[first:]) for first in range(len(parts)))
    return next((photo for tail in tails for photo in _same_stem(folder, tail)), "")


def _same_stem(folder: Path, name: PurePosixPath) -> Iterator[str]:
    """Yield the photos of a folder with the stem of `name` in any case, those with its suffix first."""
    place, suffix = folder / name.parent, name.suffix.lower()
    if name.is_absolute() or ".." in name.parts or not os.access(place, os.R_OK | os.X_OK) or not os.path.isdir(place):
        return
    names = (PurePosixPath(one) for one in os.listdir(place))
    alike = [one for one in names if one.stem.lower() == name.stem.lower()]
    photos = [one for one in alike if one.suffix.lower() in (*SUFFIXES, suffix)]
    for one in sorted(photos, key=lambda one: (one.suffix.lower() != suffix, one.name)):
        yield (name.parent / one.name).as_posix()


# -- images of COLMAP models -------------------------------------------------------------------------------------------


def similar_photo(folder: Path, names: Sequence[str]) -> str:
    """Return a sentence on a file in `folder` with almost the name of one of `names`; empty: none.

    Similar names differ by case, suffix, Unicode form, folders or the path before them.
    """
    files = {_folded(file): file for file in islice(_files(folder), MOST_FILES)}
    stems = {_stem(file): file for file in files.values()}
    for name in names:
        file = files.get(_folded(name)) or stems.get(_stem(name))
        if file is not None and file != name:
            return f"{file} is there instead of {name} ({_difference(name, file)})"
    return ""


def _difference(name: str, file: str) -> str:
    """Describe the difference of two names, with a remedy."""
    stated, present = PurePosixPath(name), PurePosixPath(file)
    if name.startswith("/") or PureWindowsPath(name).drive:
        return "an absolute path: cut the names in images.txt to what follows the folder of the photos"
    if stated.parent != present.parent and stated.name == present.name:
        return "another folder: set scene.images to the folder to which names are relative"
    if stated.stem == present.stem and stated.suffix.lower() != present.suffix.lower():
        return f"another suffix: {f'convert the photos to {stated.suffix}' if stated.suffix else 'rename the photos'}"
    return f"another {'case' if name.casefold() == file.casefold() else 'name'}: rename the photos"


def _files(folder: Path) -> Iterator[str]:
    """Yield the files below a folder, relative to it, with `/`."""
    for place, inner, names in os.walk(folder):
        inner.sort()
        yield from ((Path(place) / name).relative_to(folder).as_posix() for name in sorted(names))


def _folded(name: str) -> str:
    """Return a name without differences of case and Unicode form."""
    return unicodedata.normalize("NFC", name).casefold()


def _stem(name: str) -> str:
    """Return a folded name without folders and suffix."""
    return _folded(PurePosixPath(name.replace("\\", "/")).stem)


def read_json(path: Path) -> dict[str, Any]:
    """Return the object in a JSON file; InputError: the file is missing or holds none."""
    if not path.is_file():
        raise InputError(f"'{path}' does not exist: scene.path must be the folder that holds it.")
    refuse_lfs_pointer(path)
    try:
        content = parsed(path)
    except (OSError, ValueError) as problem:
        raise InputError(f"'{path}' is no valid JSON ({problem}), copy or export it anew.") from None
    if not isinstance(content, dict):
        raise InputError(f"'{path}' holds no JSON object, copy or export it anew.")
    return content


def read_frames(path: Path) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """Return the content of a transforms file, and its frames; InputError as `frames_in`."""
    content = read_json(path)
    return content, frames_in(content, path)


def frames_in(content: Mapping[str, Any], path: Path, key: str = "frames") -> list[dict[str, Any]]:
    """Return the frames that a transforms file lists under a key; InputError: none, or names are unusable."""
    frames = content.get(key)
    if not isinstance(frames, list) or not frames:
        raise InputError(f"'{path}' lists no {key}, export it anew.")
    if not all(isinstance(frame, dict) and isinstance(frame.get("file_path"), str) for frame in frames):
        if any(isinstance(frame, dict) and "rgb_path" in frame for frame in frames):
            raise InputError(f"'{path}' is of SDFStudio (rgb_path), which gsx does not read: export transforms.json.")
        raise InputError(f"'{path}' has a frame without 'file_path', export it anew.")
    names = [frame["file_path"] for frame in frames]
    for name in (*names, *(frame["mask_path"] for frame in frames if isinstance(frame.get("mask_path"), str))):
        if any(letter == "\0" or "\ud800" <= letter <= "\udfff" for letter in name):  # NUL, or half of a character
            raise InputError(f"'{path}' names a photo {name!a}, which is no text: rename it there and on disk.")
    refuse_twice(names, path)
    return frames


def refuse_twice(names: Sequence[str], path: Path) -> None:
    """Raise InputError if a poses file has a name twice."""
    for name, count in Counter(map(plain_name, names)).items():
        if count > 1:
            raise InputError(f"'{path}' has '{name}' twice, perhaps to train on and to test on: remove one.")


def finite_number(value: Any) -> float | None:
    """Return a number of a file; None if it is no number, not finite, or beyond double precision."""
    try:
        number = float(value) if isinstance(value, float | int) else math.nan
    except OverflowError:  # an integer of hundreds of digits
        return None
    return number if math.isfinite(number) else None


def refuse_partial(
    missing: Sequence[str],
    count: int,
    place: Path,
    allowed: float,
    fault: str = "are not on disk",
    remedy: str = "complete them",
) -> None:
    """Raise InputError if more than the share `allowed` of the `count` images of `place` cannot be used."""
    share = len(missing) / count
    if share > allowed:
        raise InputError(
            f"{len(missing)} of the {count} images of '{place}' {fault} ({some_names(missing)}): {remedy}, or train on "
            f"the others with scene.missing={math.ceil(100 * share) / 100:g} or more."
        )


def present_frames(
    folder: Path, frames: list[dict[str, Any]], file: Path, allowed: float
) -> tuple[list[tuple[dict[str, Any], Path]], list[str]]:
    """Return the frames with a photo on disk, its path, and a note on the others; InputError: too few, or one twice."""
    pairs = [(frame, find_photo(folder, frame["file_path"])) for frame in frames]
    present = [(frame, photo) for frame, photo in pairs if photo is not None]
    missing = [plain_name(frame["file_path"]) for frame, photo in pairs if photo is None]
    remedy = renaming(folder, missing, {photo for _, photo in present}) if len(missing) > allowed * len(frames) else ""
    if not present:
        raise InputError(
            f"None of the {len(frames)} images of '{file}' is in '{folder}' (looked for {some_names(missing)}): "
            f"{remedy or 'put them there or correct the names in the file'}."
        )
    refuse_partial(missing, len(frames), file, allowed, remedy=remedy or "complete them")
    refuse_file_twice([plain_name(frame["file_path"]) for frame, _ in present], [photo for _, photo in present], file)
    note = f"Skipped {len(missing)} of the {len(frames)} images of {file.name}, not on disk: {some_names(missing)}."
    return present, [note] if missing else []


def renaming(folder: Path, missing: Sequence[str], used: Container[Path]) -> str:
    """Return the remedy for missing photos if one is there under another name that no other frame uses."""
    pairs = ((name, likely_photo(folder, name)) for name in missing[:NAMED_AT_MOST])
    right = (pair for pair in pairs if pair[1] and folder / pair[1] not in used)
    return next((f"'{there}' is there, correct '{name}' in the file" for name, there in right), "")


def pose_from_opengl(matrix: Any, place: str) -> tuple[Float[Tensor, "3 3"], Float[Tensor, "3"]]:
    """Return rotation and translation camera_from_world, float64, of an OpenGL camera-to-world matrix (3D-GS).

    `matrix` holds 3 or 4 rows of 4 numbers; OpenGL cameras have x right, y up, z back. Rotations that text has
    rounded are replaced by the nearest exact ones.

    Raises:
        InputError: it is no such matrix, not finite, or no rigid motion; `place` names its frame.
    """
    try:
        world_from_camera = torch.tensor(matrix, dtype=torch.float64)
    except (TypeError, ValueError, RuntimeError, OverflowError):
        raise InputError(f"{place} has a pose that is no matrix of numbers, export it anew.") from None
    if world_from_camera.shape not in ((3, 4), (4, 4)) or not world_from_camera.isfinite().all():
        raise InputError(f"{place} has a pose that is not 3 x 4 or 4 x 4 finite numbers, remove or repair it.")
    if len(world_from_camera) == 4 and (world_from_camera[3] - LAST_ROW).abs().max() > ROTATION_TOLERANCE:
        raise InputError(f"{place} has a pose whose fourth row is not 0 0 0 1: is the matrix transposed?")
    u, stretch, vh = torch.linalg.svd(world_from_camera[:3, :3])
    if (stretch - 1).abs().max() > ROTATION_TOLERANCE or torch.linalg.det(u @ vh) < 0:
        raise InputError(f"{place} has a pose that scales or mirrors, export cameras without scale.")
    rotation = (u @ vh @ torch.diag(torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64))).T
    return rotation, -rotation @ world_from_camera[:3, 3]


def frames_line(file: Path) -> str:
    """Return the number of images of a transforms file on disk, for `gsx scenes`."""
    names = [frame["file_path"] for frame in read_frames(file)[1]]
    absent = [name for name in names if find_photo(file.parent, name) is None]
    missing = f", absent: {some_names(absent)}" if absent else ""
    return f"images    {len(names) - len(absent)} of {len(names)} of {file.name}{missing}"


def some_names(names: Sequence[str]) -> str:
    """List the first few names, and the number of others."""
    more = len(names) - NAMED_AT_MOST
    return ", ".join(names[:NAMED_AT_MOST]) + (f" and {more} more" if more > 0 else "")
