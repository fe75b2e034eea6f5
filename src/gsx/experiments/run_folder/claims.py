"""Claims of run folders: one process at a time trains or evaluates there; a lock file names it."""

import json
import logging
import os
import platform
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from datetime import datetime
from pathlib import Path
from typing import IO

from filelock import lock_descriptor

from gsx.core.errors import InputError

logger = logging.getLogger(__name__)

LOCK = ".lock"
"""Lock file in a run folder."""
TRIES = 20
"""Attempts to open a lock file that its holder removes meanwhile."""


def claimed(folder: Path) -> AbstractContextManager[None]:
    """Claim a folder for this process; the claim of a killed process is void. Without locks of the file system: warn.

    Raises:
        InputError: another process has claimed it.
    """
    return held(folder / LOCK, folder)


def claimed_name(folder: Path) -> AbstractContextManager[None]:
    """Claim a folder that may have to be made or moved away, by a lock next to it.

    Raises:
        InputError: another process has claimed it, or the file system has no locks.
    """
    folder.parent.mkdir(parents=True, exist_ok=True)
    return held(name_lock(folder), folder, needed=True)


def name_lock(folder: Path) -> Path:
    """Return the lock file next to a folder."""
    return folder.parent / f".{folder.name}{LOCK}"


def left_behind(folder: Path) -> bool:
    """Return True if there is a lock file of a folder: a process works in it, or was killed there."""
    return (folder / LOCK).exists() or name_lock(folder).exists()


@contextmanager
def held(path: Path, folder: Path, needed: bool = False) -> Iterator[None]:
    """Hold a lock file that names this process, and remove it at the end."""
    with locked(path, folder, needed) as stream:
        stream.truncate(0)
        since = datetime.now().isoformat(sep=" ", timespec="seconds")
        json.dump({"host": platform.node(), "process": os.getpid(), "since": since}, stream)
        stream.flush()
        try:
            yield
        finally:
            with suppress(OSError):  # Windows does not remove open files
                path.unlink()


def locked(path: Path, folder: Path, needed: bool) -> IO[str]:
    """Open and lock the lock file; open it again if its last holder removed it meanwhile.

    Raises:
        InputError: another process has it, it cannot be opened, or locks are `needed` and the file system has none.
    """
    problem = "lock files vanish"
    for _ in range(TRIES):
        stream = opened(path, folder)
        try:
            if not lock_descriptor(stream.fileno(), blocking=False):
                raise InputError(f"{folder} is in use by {holder(stream)}: wait for it, or stop it")
            if is_at(path, stream):
                return stream
        except OSError as error:
            problem = error.strerror or str(error)
        except BaseException:
            stream.close()
            raise
        stream.close()
    if needed:
        raise InputError(
            f"{folder.parent} is on a file system without locks ({problem}), so two processes could train the same "
            "run: choose another place, output=FOLDER"
        )
    logger.warning("%s is on a file system without locks: check that no other process trains in it", folder)
    return opened(path, folder)


def opened(path: Path, folder: Path) -> IO[str]:
    """Open the lock file with its content, or make it; follow no link; raise InputError if that fails."""
    flags = os.O_RDWR | os.O_CREAT | getattr(os, "O_NOFOLLOW", 0)
    try:
        return os.fdopen(os.open(path, flags, 0o666), "r+", encoding="utf-8")
    except OSError as error:
        raise InputError(
            f"lock file {path} of {owner(path)} cannot be opened ({error.strerror}): make it and {folder} writable "
            f"(chmod u+rwx {folder}, or g+rw by its owner), or remove it if it is a link"
        ) from error


def owner(path: Path) -> str:
    """Return the user that owns a file or its folder."""
    try:
        return (path if path.exists() else path.parent).owner()
    except (OSError, KeyError, NotImplementedError):
        return "another user"


def is_at(path: Path, stream: IO[str]) -> bool:
    """Return True if an open file is still the one at a path."""
    try:
        return os.path.samestat(os.fstat(stream.fileno()), path.stat())
    except FileNotFoundError:
        return False


def holder(stream: IO[str]) -> str:
    """Describe the holder of a lock file."""
    try:
        stream.seek(0)
        content = json.load(stream)
        return f"process {content['process']} on {content['host']} since {content['since']}"
    except (OSError, ValueError, TypeError, KeyError):  # on Windows others cannot read it
        return "another process"
