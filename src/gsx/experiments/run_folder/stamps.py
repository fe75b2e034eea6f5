"""Digests of files and folders, which change with their content."""

import hashlib
import os
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

from gsx.engine.cache import KEY_LETTERS, content_key

READ = 1 << 20
"""Bytes up to which files count by content (poses, cameras, smaller photos); larger ones count by their time."""


def tree_stamp(place: Path, skip: Path) -> str:
    """Return a digest of a file, or of all files in a folder by `stamp_of`; follow links.

    Hidden names, unreadable files, run folders (they have a config.yaml) and the folder `skip` do not count.
    """
    if not place.is_dir():
        return content_key(stamp_of(place.name, place))
    return content_key(list(stamps_below(str(place), "", {os.path.realpath(skip)})))


def stamp_of(name: str, path: Path) -> tuple[str, int, str | int]:
    """Return name, size in bytes, and the digest of the content, or above READ the modification time in ns."""
    status = path.stat()
    if status.st_size > READ:
        return name, status.st_size, status.st_mtime_ns
    return name, status.st_size, hashlib.sha256(path.read_bytes()).hexdigest()[:KEY_LETTERS]


def stamps_below(folder: str, prefix: str, visited: set[str]) -> Iterator[tuple[str, int, str | int]]:
    """Yield `stamp_of` each file in a folder in order, names with `prefix`."""
    visited.add(os.path.realpath(folder))
    entries = visible_entries(folder)
    for entry in [] if prefix and any(entry.name == "config.yaml" for entry in entries) else entries:
        name = prefix + entry.name
        if entry.is_dir() and os.path.realpath(entry.path) not in visited:
            yield from stamps_below(entry.path, f"{name}/", visited)
        elif entry.is_file():
            with suppress(OSError):
                yield stamp_of(name, Path(entry.path))


def visible_entries(folder: str) -> list[os.DirEntry[str]]:
    """List a folder in order without hidden names; nothing if it cannot be read."""
    try:
        with os.scandir(folder) as entries:
            return sorted((entry for entry in entries if not entry.name.startswith(".")), key=lambda entry: entry.name)
    except OSError:
        return []
