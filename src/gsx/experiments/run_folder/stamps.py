"""What a folder holds, as one short text that changes with it."""

import hashlib
import os
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

from gsx.engine.cache import KEY_LETTERS, content_key

READ = 1 << 20
"""Bytes up to which files are known by content: poses, cameras, smaller photographs; larger ones are by their time."""


def tree_stamp(place: Path, but: Path) -> str:
    """A digest of a file, or of all in a folder: names relative to it, sizes, contents or times of change.

    Links are followed. Passed over are hidden names, what cannot be read, folders of runs (they have a config.yaml) and
    the folder `but`.
    """
    if not place.is_dir():
        return content_key(stamp_of(place.name, place))
    return content_key(list(stamps_below(str(place), "", {os.path.realpath(but)})))


def stamp_of(name: str, path: Path) -> tuple[str, int, str | int]:
    """Name, size in bytes, and the digest of the content, of files larger than READ the modification time in ns.

    Raises:
        OSError: the file cannot be looked at.
    """
    status = path.stat()
    if status.st_size > READ:
        return name, status.st_size, status.st_mtime_ns
    return name, status.st_size, hashlib.sha256(path.read_bytes()).hexdigest()[:KEY_LETTERS]


def stamps_below(folder: str, prefix: str, known: set[str]) -> Iterator[tuple[str, int, str | int]]:
    """`stamp_of` each file in a folder, names with `prefix`, in their order; `known`: folders already seen."""
    known.add(os.path.realpath(folder))
    entries = sorted(entries_of(folder), key=lambda entry: entry.name)
    for entry in [] if prefix and any(entry.name == "config.yaml" for entry in entries) else entries:
        name = prefix + entry.name
        if entry.is_dir() and os.path.realpath(entry.path) not in known:
            yield from stamps_below(entry.path, f"{name}/", known)
        elif entry.is_file():
            with suppress(OSError):
                yield stamp_of(name, Path(entry.path))


def entries_of(folder: str) -> list[os.DirEntry[str]]:
    """What lies in a folder, but for hidden names; nothing if it cannot be read."""
    try:
        with os.scandir(folder) as entries:
            return [entry for entry in entries if not entry.name.startswith(".")]
    except OSError:
        return []
