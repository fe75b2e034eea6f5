"""The cache of results that are expensive to compute, between runs: photos, reconstructions, networks, states.

An entry is a folder <kind>/<key> with a manifest of its files. Files that differ from it are computed again.
"""

import hashlib
import json
import logging
import math
import os
import secrets
import shutil
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any

from filelock import lock_descriptor

import gsx
from gsx.core.errors import InputError
from gsx.core.files import expand_home, process_tag

logger = logging.getLogger(__name__)

MANIFEST = ".gsx_manifest.jsonl"
"""File of an entry with a line for each of its files; the last line of a file counts."""
IN_USE = "in_use"
"""Folder of the cache with a locked file of each process that uses it."""

KEY_LETTERS = 16  # 64 bits of the digest: collisions are out of reach for any number of scenes on one machine


def cache_root() -> Path:
    """Returns $GSX_CACHE, else $XDG_CACHE_HOME/gsx, else ~/.cache/gsx (XDG base directories).

    Raises:
        InputError: there is no home folder.
    """
    name = os.environ.get("GSX_CACHE") or f"{os.environ.get('XDG_CACHE_HOME') or '~/.cache'}/gsx"
    root = expand_home(name)
    if str(root).startswith("~"):
        raise InputError(f"the cache folder {name} has no home folder: set GSX_CACHE to a writable folder")
    return root


def cache_folder(kind: str, key: str) -> Path:
    """Returns the folder of the results of one `kind` and `key`, without creating it."""
    return cache_root() / kind / key


def content_key(*parts: object) -> str:
    """Digests the `repr` of `parts` into a short hexadecimal key."""
    return hashlib.sha256(repr(parts).encode()).hexdigest()[:KEY_LETTERS]


def source_files(*places: Path) -> list[Path]:
    """Lists the Python files below folders, and files themselves, in order."""
    return sorted(path for place in places for path in (place.rglob("*.py") if place.is_dir() else [place]))


def source_digest(*places: Path) -> str:
    """Digests Python files and those below folders: other code may give other results."""
    digest = hashlib.sha256()
    for path in source_files(*places):
        digest.update(path.read_bytes())
    return digest.hexdigest()


def source_revision() -> str:
    """Digests the source of gsx: another revision may give other results."""
    return source_digest(Path(gsx.__file__).parent)[:KEY_LETTERS]


def file_stamp(path: Path) -> tuple[str, int, int]:
    """Returns name, size in bytes and modification time in ns: enough to notice that a file was replaced.

    Raises:
        OSError: the file cannot be read.
    """
    status = path.stat()
    return path.name, status.st_size, status.st_mtime_ns


def make_folder(folder: Path) -> Path:
    """Creates a folder of the cache, with its parents.

    Raises:
        InputError: it cannot be created.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(
            f"Cannot create the cache folder {folder} ({error.strerror}): set GSX_CACHE to a writable folder."
        ) from None
    return folder


# -- manifests ---------------------------------------------------------------------------------------------------------


def add_to_manifest(*files: Path) -> None:
    """Adds size and digest of files to the manifest of their entry, the folder that holds them.

    Raises:
        OSError: the manifest cannot be written.
    """
    notes = [{"file": file.name, **fingerprint(file.read_bytes())} for file in files]
    with (files[0].parent / MANIFEST).open("a", encoding="utf-8") as stream:
        stream.write("".join(f"{json.dumps(note)}\n" for note in notes))


def fingerprint(content: bytes) -> dict[str, Any]:
    """Returns size and digest of a file's content."""
    return {"bytes": len(content), "sha256": hashlib.sha256(content).hexdigest()}


def read_manifest(entry: Path, name: str = "") -> dict[str, dict[str, Any]]:
    """Reads fingerprints from the manifest of an entry, at least that of the named file; skips damaged lines."""
    notes, quoted = {}, json.dumps(name).strip('"')
    with suppress(OSError):
        for line in (entry / MANIFEST).read_text(encoding="utf-8", errors="replace").splitlines():
            with suppress(ValueError, TypeError, KeyError, AttributeError):
                if quoted in line:  # a manifest may have thousands of lines
                    note = json.loads(line)
                    notes[str(note.pop("file"))] = note
    return notes


def is_intact(file: Path) -> bool:
    """Checks that a file of an entry is as written, and marks the entry as used now; warns of a damaged file."""
    try:
        content = file.read_bytes()
    except (FileNotFoundError, NotADirectoryError):
        return False
    except OSError as error:
        logger.warning("%s cannot be read (%s), computing it again", file, error.strerror)
        return False
    if read_manifest(file.parent, file.name).get(file.name) != fingerprint(content):
        logger.warning("%s is damaged, computing it again", file)
        return False
    with suppress(OSError):
        os.utime(file.parent / MANIFEST)
    return True


# -- locks -------------------------------------------------------------------------------------------------------------


@contextmanager
def creation_lock(file: Path, wait: bool = False) -> Iterator[bool]:
    """Locks the making of a file; yields True in the process that has the lock, and in all where locking fails.

    `wait`: until the other process has finished. The lock of a killed process is free.
    """
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        stream = file.with_suffix(".lock").open("w")
    except OSError:
        yield True
        return
    with stream:
        try:
            alone = lock_descriptor(stream.fileno(), blocking=False)
            if wait and not alone:
                logger.info("waiting for another process that makes %s ...", file.name.partition("-")[0])
                alone = lock_descriptor(stream.fileno())
        except OSError:
            alone = True
        yield alone


@contextmanager
def in_use() -> Iterator[None]:
    """Protects cache entries that this process uses from now on against `trim` of other processes.

    The protection ends with the process. There is none where nothing can be written or locked.
    """
    with ExitStack() as stack:
        try:
            folder = make_folder(cache_root() / IN_USE)
            partial = folder / f".use.{process_tag()}-{secrets.token_hex(4)}.partial"
            locked = partial.with_suffix(".lock")  # others look for that name alone, which it gets once it is locked
            stack.callback(remove_files, partial, locked)
            lock_descriptor(stack.enter_context(partial.open("w")).fileno(), blocking=False)
            partial.replace(locked)
        except (OSError, InputError) as error:
            logger.info("cache entries in use are not protected from other processes: %s", error)
        yield


def remove_files(*paths: Path) -> None:
    """Removes files; ignores errors."""
    for path in paths:
        with suppress(OSError):
            path.unlink()


def used_since() -> float:
    """Returns the start of the oldest process that uses the cache, seconds since 1970; infinite if there is none."""
    starts = []
    for path in (cache_root() / IN_USE).glob(".use.*.lock"):
        with suppress(OSError):
            if released(path):
                path.unlink()
            else:
                starts.append(path.stat().st_mtime)
    return min(starts, default=math.inf)


def released(path: Path) -> bool:
    """Checks that the process that locked a file has ended; False where that is unknown."""
    try:
        with path.open("r+") as stream:  # some network file systems lock nothing that is open for reading alone
            return lock_descriptor(stream.fileno(), blocking=False)
    except OSError:
        return False


# -- space -------------------------------------------------------------------------------------------------------------


def trim(gigabytes: float) -> list[Path]:
    """Removes the entries used longest ago until the rest fit into `gigabytes` (10^9 bytes); returns them.

    Entries that a running process uses stay, and so do folders without a manifest, which are not gsx's.
    """
    since, removed, freed, known = used_since(), list[Path](), 0, entries()
    excess = sum(size for _, size, _ in known) - gigabytes * 1e9
    for used, size, entry in known:
        if freed < excess and used < since and remove_entry(entry, used):
            freed += size
            removed.append(entry)
    if removed:
        logger.info("cache: removed %d entries (%.1f GB)", len(removed), freed / 1e9)
    return removed


def entries() -> list[tuple[float, int, Path]]:
    """Lists (last use, seconds since 1970; bytes; folder) of all entries, least recently used first."""
    known, manifests = [], list[Path]()
    with suppress(OSError):  # another process may remove the cache meanwhile
        manifests += cache_root().glob(f"*/*/{MANIFEST}")
    for manifest in manifests:
        with suppress(OSError):  # or this entry
            size = sum(path.stat().st_size for path in manifest.parent.rglob("*"))
            known.append((manifest.stat().st_mtime, size, manifest.parent))
    return sorted(known)


def remove_entry(entry: Path, used: float) -> bool:
    """Removes an entry not used since `used`; its manifest last, so that a partly removed entry is still an entry."""
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
