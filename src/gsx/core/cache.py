"""Where results that are dear to compute live between runs: undistorted photos, reconstructions."""

import hashlib
import os
from pathlib import Path

from gsx.core.errors import InputError

KEY_LETTERS = 16  # 64 bits of the digest: collisions are out of reach for any number of scenes on one machine


def cache_root() -> Path:
    """$GSX_CACHE, else $XDG_CACHE_HOME/gsx, else ~/.cache/gsx (XDG base directories)."""
    if own := os.environ.get("GSX_CACHE"):
        return Path(own).expanduser()
    if shared := os.environ.get("XDG_CACHE_HOME"):
        return Path(shared).expanduser() / "gsx"
    return Path.home() / ".cache" / "gsx"


def cache_folder(kind: str, key: str) -> Path:
    """The folder of the results of one `kind` and `key`; it is not created."""
    return cache_root() / kind / key


def content_key(*parts: object) -> str:
    """A short hexadecimal digest of `parts`; parts whose `repr` differs, or is split otherwise, differ in key."""
    return hashlib.sha256(repr(parts).encode()).hexdigest()[:KEY_LETTERS]


def file_stamp(path: Path) -> tuple[str, int, int]:
    """Name, size in bytes and modification time in ns: enough to notice that a file was replaced.

    Raises:
        OSError: the file cannot be looked at.
    """
    status = path.stat()
    return path.name, status.st_size, status.st_mtime_ns


def make_folder(folder: Path) -> Path:
    """Create a folder of the cache, with its parents.

    Raises:
        InputError: it cannot be created.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as problem:
        raise InputError(
            f"Cannot create the cache folder {folder} ({problem.strerror}): let GSX_CACHE name a folder that can be "
            "written to."
        ) from None
    return folder
