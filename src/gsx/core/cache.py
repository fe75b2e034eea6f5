"""Where results that are dear to compute live between runs: undistorted photos, reconstructions, networks, states.

An entry is a folder <kind>/<key> with a manifest of its files. Whatever is not as the manifest says is made again.
"""

import hashlib
import json
import logging
import math
import os
import secrets
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, Any

import gsx
from gsx.core.errors import InputError
from gsx.core.files import at_home, own_mark
from gsx.core.locks import lock

logger = logging.getLogger(__name__)

MANIFEST = ".gsx_manifest.jsonl"
"""File of an entry with a line for each of its files; of several for one file the last counts."""
IN_USE = "in_use"
"""Folder of the cache with a locked file of each process that uses it."""

KEY_LETTERS = 16  # 64 bits of the digest: collisions are out of reach for any number of scenes on one machine


def cache_root() -> Path:
    """$GSX_CACHE, else $XDG_CACHE_HOME/gsx, else ~/.cache/gsx (XDG base directories).

    Raises:
        InputError: there is no home folder to find it in.
    """
    below = os.environ.get("XDG_CACHE_HOME") or "~/.cache"
    given = os.environ.get("GSX_CACHE") or f"{below}/gsx"
    found = at_home(given)
    if str(found).startswith("~"):
        raise InputError(
            f"the cache would be {given}, and there is no such home folder: let GSX_CACHE name a folder that can be "
            "written"
        )
    return found


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


# -- manifests ---------------------------------------------------------------------------------------------------------


def enlist(*files: Path) -> None:
    """Note in the manifest of an entry, the folder in which they lie, that these files are whole: size and digest.

    Raises:
        OSError: the manifest cannot be written.
    """
    notes = [{"file": file.name, **fingerprint(file.read_bytes())} for file in files]
    with (files[0].parent / MANIFEST).open("a", encoding="utf-8") as stream:
        stream.write("".join(f"{json.dumps(note)}\n" for note in notes))


def fingerprint(content: bytes) -> dict[str, Any]:
    """By which a file is known."""
    return {"bytes": len(content), "sha256": hashlib.sha256(content).hexdigest()}


def listed(entry: Path, name: str = "") -> dict[str, dict[str, Any]]:
    """Fingerprints in the manifest of an entry, at least that of the file named; damaged lines are no notes."""
    found, named = {}, json.dumps(name).strip('"')
    with suppress(OSError):
        for line in (entry / MANIFEST).read_text(encoding="utf-8", errors="replace").splitlines():
            with suppress(ValueError, TypeError, KeyError, AttributeError):
                if named in line:  # a manifest may have thousands of lines
                    note = json.loads(line)
                    found[str(note.pop("file"))] = note
    return found


def whole(file: Path) -> bool:
    """Whether a file of an entry is as it was written; the entry then counts as used now.

    A damaged one is told, and its user makes it again.
    """
    try:
        content = file.read_bytes()
    except (FileNotFoundError, NotADirectoryError):
        return False
    except OSError as error:
        logger.warning("%s cannot be read (%s): it is made again", file, error.strerror)
        return False
    if listed(file.parent, file.name).get(file.name) != fingerprint(content):
        logger.warning("%s is not as it was written: it is made again", file)
        return False
    touch(file.parent)
    return True


def touch(entry: Path) -> None:
    """An entry is used now."""
    with suppress(OSError):
        os.utime(entry / MANIFEST)


# -- room --------------------------------------------------------------------------------------------------------------


@contextmanager
def in_use() -> Iterator[None]:
    """As long as the context lasts, nobody who needs room removes what this process uses of the cache from now on.

    A killed process holds nothing. Where nothing can be written or locked, nothing is kept from removal.
    """
    stream = use_lock()
    try:
        yield
    finally:
        if stream is not None:
            stream.close()
            with suppress(OSError):
                Path(stream.name).with_suffix(".lock").unlink()


def use_lock() -> IO[str] | None:
    """A locked file in IN_USE, which gets the name that others look for once it is locked."""
    stream = None
    try:
        folder = make_folder(cache_root() / IN_USE)
        stream = (folder / f".use.{own_mark()}-{secrets.token_hex(4)}.partial").open("w")
        lock(stream)
        os.replace(stream.name, Path(stream.name).with_suffix(".lock"))
    except (OSError, InputError) as error:
        logger.info("nobody is told that the cache is used: %s", error)
        if stream is not None:
            stream.close()
            with suppress(OSError):
                Path(stream.name).unlink()
        return None
    return stream


def used_since() -> float:
    """When the longest at work of all processes that use the cache began, seconds since 1970; infinite if none does."""
    begun = []
    for path in (cache_root() / IN_USE).glob(".use.*.lock"):
        with suppress(OSError):
            if released(path):
                path.unlink()
            else:
                begun.append(path.stat().st_mtime)
    return min(begun, default=math.inf)


def released(path: Path) -> bool:
    """Whether the process that locked a file has ended; where that cannot be told it counts as at work."""
    try:
        with path.open("r+") as stream:  # some network file systems lock nothing that is open for reading alone
            return lock(stream)
    except (OSError, InputError):
        return False


def trim(gigabytes: float) -> list[Path]:
    """Remove entries that were used longest ago until all hold so many 10^9 bytes; never what a process at work uses.

    Returns what was removed. What has no manifest is nothing of gsx's, and stays; so does what cannot be removed.
    """
    since, removed = used_since(), []
    used, sizes = entries()
    excess = sum(sizes.values()) - gigabytes * 1e9
    for entry in sorted(used, key=lambda one: used[one]):
        if excess > 0 and used[entry] < since and remove_entry(entry, used[entry]):
            excess -= sizes[entry]
            removed.append(entry)
    if removed:
        freed = sum(sizes[entry] for entry in removed) / 1e9
        logger.info("%d entries made room in the cache (%.1f GB)", len(removed), freed)
    return removed


def entries() -> tuple[dict[Path, float], dict[Path, int]]:
    """When each entry of the cache was last used, seconds since 1970, and its bytes."""
    used, sizes, manifests = {}, {}, list[Path]()
    with suppress(OSError):  # somebody removes the cache meanwhile
        manifests += cache_root().glob(f"*/*/{MANIFEST}")
    for manifest in manifests:
        with suppress(OSError):  # or this entry
            size = sum(path.stat().st_size for path in manifest.parent.rglob("*"))
            used[manifest.parent], sizes[manifest.parent] = manifest.stat().st_mtime, size
    return used, sizes


def remove_entry(entry: Path, used: float) -> bool:
    """Remove an entry that was not used since; its manifest last, so that what is left of it is still one."""
    try:
        if (entry / MANIFEST).stat().st_mtime != used:
            return False
        for path in [path for path in entry.iterdir() if path.name != MANIFEST]:
            shutil.rmtree(path) if path.is_dir() else path.unlink()
        (entry / MANIFEST).unlink()
        entry.rmdir()
    except OSError as error:
        logger.info("%s cannot be removed from the cache (%s)", entry, error.strerror)
        return False
    return True
