"""Where results that are dear to compute live between runs: undistorted photos, reconstructions."""

import hashlib
import logging
import os
import shutil
from pathlib import Path

import gsx
from gsx.core.errors import InputError

logger = logging.getLogger(__name__)

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


def source_digest(folder: Path) -> str:
    """A digest of the Python files below a folder: other code may give other results."""
    digest = hashlib.sha256()
    for path in sorted(folder.rglob("*.py")):
        digest.update(path.read_bytes())
    return digest.hexdigest()


def source_revision() -> str:
    """A short digest of gsx's own source: of another revision results may be others."""
    return source_digest(Path(gsx.__file__).parent)[:KEY_LETTERS]


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


def trim(kind: str, budget: float, kept: Path) -> list[Path]:
    """Remove those folders of a kind that were touched longest ago, until all hold `budget` bytes; `kept` stays.

    Returns what was removed. Folders that cannot be removed stay as they are.

    Raises:
        OSError: the cache cannot be looked at.
    """
    folders = [path for path in cache_folder(kind, "").glob("*") if path.is_dir()]
    sizes = {folder: sum(path.stat().st_size for path in folder.rglob("*")) for folder in folders}
    excess = sum(sizes.values()) - budget
    removed: list[Path] = []
    for folder in sorted(folders, key=lambda path: path.stat().st_mtime_ns):
        if excess > 0 and folder != kept:
            shutil.rmtree(folder, ignore_errors=True)
            excess -= sizes[folder]
            removed.append(folder)
    if removed:
        freed = sum(sizes[folder] for folder in removed) / 1e9
        logger.info("%d of %s made room in the cache (%.1f GB)", len(removed), kind, freed)
    return removed


def make_room(kind: str, gigabytes: float) -> None:
    """`trim` to so many 10^9 bytes; a cache that cannot be looked at, or changes meanwhile, is no error."""
    try:
        trim(kind, gigabytes * 1e9, kept=cache_folder(kind, ""))
    except OSError as error:
        logger.warning("the cache of %s could not be trimmed (%s)", kind, error)
