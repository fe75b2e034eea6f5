"""Photos by their names in files of poses, and likely replacements of missing ones."""

import os
import re
import unicodedata
from collections.abc import Iterator, Sequence
from itertools import islice
from pathlib import Path, PurePosixPath, PureWindowsPath

from gsx.core.files import is_file

SUFFIXES = (".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff", ".bmp")
"""Suffixes of photos and masks, in the order of the search: NeRF-synthetic means .png where it states none."""
DRIVE = re.compile(r"^[A-Za-z]:/")  # beginning of absolute names of Windows
MOST_FILES = 100_000  # of a folder, that are compared with a name


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
