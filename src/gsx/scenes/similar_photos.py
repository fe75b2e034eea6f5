"""Photos that a model names otherwise than the disk does: the probable file of each."""

import os
import unicodedata
from collections.abc import Iterator, Sequence
from pathlib import Path, PurePosixPath, PureWindowsPath

MOST_FILES = 100_000
"""Files of a folder that are compared with a name."""


def similar_photo(folder: Path, names: Sequence[str]) -> str:
    """Return a sentence on a file in `folder` that is called almost like one of `names`; empty: there is none.

    Alike are names that differ by case, suffix, Unicode form, folders or the path before them.
    """
    files = {_plain(file): file for file in _files(folder)}
    stems = {_stem(file): file for file in files.values()}
    for name in names:
        file = files.get(_plain(name)) or stems.get(_stem(name))
        if file is not None and file != name:
            return f"{file} is there instead of {name} ({_difference(name, file)})"
    return ""


def _difference(name: str, file: str) -> str:
    """Return the difference of two names in words, with a remedy."""
    wanted, present = PurePosixPath(name), PurePosixPath(file)
    if name.startswith("/") or PureWindowsPath(name).drive:
        return "an absolute path: cut the names in images.txt to what follows the folder of the photos"
    if wanted.parent != present.parent and wanted.name == present.name:
        return "another folder: set scene.images to the folder to which names are relative"
    if wanted.stem == present.stem and wanted.suffix.lower() != present.suffix.lower():
        return f"another suffix: {f'convert the photos to {wanted.suffix}' if wanted.suffix else 'rename the photos'}"
    if name.casefold() == file.casefold():
        return "another case: rename the photos"
    return "another name: rename the photos"


def _files(folder: Path) -> Iterator[str]:
    """Yield the files below a folder, relative to it, with `/`."""
    count = 0
    for place, inner, names in os.walk(folder):
        inner.sort()
        for name in sorted(names):
            count += 1
            if count > MOST_FILES:
                return
            yield (Path(place) / name).relative_to(folder).as_posix()


def _plain(name: str) -> str:
    """Return a name without differences of case and Unicode form."""
    return unicodedata.normalize("NFC", name).casefold()


def _stem(name: str) -> str:
    """Return a plain name without folders and suffix."""
    return _plain(PurePosixPath(name.replace("\\", "/")).stem)
