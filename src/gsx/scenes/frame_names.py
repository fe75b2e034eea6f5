"""Photos by the names that poses files have for them: other slashes, a suffix left out; what lies there instead."""

import os
import re
from collections.abc import Iterator
from pathlib import Path, PurePosixPath

from gsx.core.files import is_file

SUFFIXES = (".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff", ".bmp")
"""Suffixes of photos and masks, in the order of the search: NeRF-synthetic means .png where it states none."""
DRIVE = re.compile(r"^[A-Za-z]:/")
"""Beginning of absolute names of Windows."""


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


def lies_there(folder: Path, file_path: str) -> str:
    """Return the photo that a missing name may mean, relative to the folder; empty if there is none.

    It lies where the end of a longer path leads, or has another suffix or case.
    """
    parts = PurePosixPath(DRIVE.sub("/", plain_name(file_path))).parts
    tails = (PurePosixPath(*parts[first:]) for first in range(len(parts)))
    return next((found for tail in tails for found in _alike(folder, tail)), "")


def _alike(folder: Path, name: PurePosixPath) -> Iterator[str]:
    """Yield the photos of a folder with the stem of `name` in any case, those with its own suffix first."""
    place = folder / name.parent
    if name.is_absolute() or ".." in name.parts or not os.access(place, os.R_OK | os.X_OK) or not os.path.isdir(place):
        return
    known = (*SUFFIXES, name.suffix.lower())
    stem = name.stem.lower()
    names = (PurePosixPath(one) for one in os.listdir(place))
    files = [one for one in names if one.stem.lower() == stem and one.suffix.lower() in known]
    for one in sorted(files, key=lambda one: (one.suffix.lower() != name.suffix.lower(), one.name)):
        yield (name.parent / one.name).as_posix()
