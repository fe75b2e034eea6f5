"""One process at a time trains in a run folder or evaluates it: a lock in it, which says who holds it."""

import json
import logging
import os
import platform
import stat
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from datetime import datetime
from pathlib import Path
from typing import IO

from filelock import lock_descriptor

from gsx.core.errors import InputError

logger = logging.getLogger(__name__)

LOCK = ".lock"
"""Of a run folder in which somebody works."""
TRIES = 20
"""Times that a lock file is opened which its holder removes meanwhile."""


@contextmanager
def claimed(folder: Path) -> Iterator[None]:
    """This process alone works in a folder as long as the context lasts; the claim of a killed one is void.

    On a file system without locks nobody can know, which is told.

    Raises:
        InputError: another process does, which is named.
    """
    with held(folder / LOCK, folder):
        yield


@contextmanager
def claimed_name(folder: Path) -> Iterator[None]:
    """The same of a folder that others find by its name and that may have to be made or moved away: a lock beside it.

    Raises:
        InputError: another process does, which is named; or nobody can know.
    """
    folder.parent.mkdir(parents=True, exist_ok=True)
    with held(folder.parent / f".{folder.name}{LOCK}", folder, needed=True):
        yield


def left_behind(folder: Path) -> bool:
    """Whether there is a claim on a folder or its name: somebody is at work, or was killed there."""
    return (folder / LOCK).exists() or (folder.parent / f".{folder.name}{LOCK}").exists()


@contextmanager
def held(path: Path, folder: Path, needed: bool = False) -> Iterator[None]:
    """A lock file that says who works in the folder."""
    with taken(path, folder, needed) as stream:
        stream.truncate(0)
        json.dump({"host": platform.node(), "process": os.getpid(), "since": now()}, stream)
        stream.flush()
        try:
            yield
        finally:
            with suppress(OSError):  # Windows keeps what is open
                path.unlink()


def now() -> str:
    """Local time to the second."""
    return datetime.now().isoformat(sep=" ", timespec="seconds")


def taken(path: Path, folder: Path, needed: bool) -> IO[str]:
    """The lock file, open and locked. One that its last holder removed meanwhile is opened again.

    Raises:
        InputError: another process has it, it cannot be opened, or its file system knows no locks and they are needed.
    """
    for _ in range(TRIES):
        stream = opened(path, folder)
        try:
            if not lock_descriptor(stream.fileno(), blocking=False):
                raise InputError(f"{folder} is in use by {holder(stream)}: wait for it, or stop it")
            if same_file(stream, path):
                return stream
            problem = "its lock files do not stay"
        except OSError as error:
            problem = error.strerror or str(error)
        except BaseException:
            stream.close()
            raise
        stream.close()
    if needed:
        raise InputError(
            f"{folder.parent} lies on a file system without locks ({problem}), which keep processes from training the "
            "same run: choose another place, output=FOLDER"
        )
    logger.warning("%s lies on a file system without locks: see that no other process trains in it", folder)
    return opened(path, folder)


def opened(path: Path, folder: Path) -> IO[str]:
    """The lock file, made where there is none; what it holds stays, and a link is not followed.

    Raises:
        InputError: it cannot be opened.
    """
    flags = os.O_RDWR | os.O_CREAT | getattr(os, "O_NOFOLLOW", 0)
    known = f"{path}, by which processes know of each other,"
    try:
        number = os.open(path, flags, 0o666)
    except PermissionError as error:
        if mine(folder) and not (os.access(folder, os.X_OK) and path.exists()):
            raise InputError(f"{folder} cannot be written to ({error.strerror}): chmod u+wx {folder}") from error
        raise InputError(
            f"{known} is {owner(path)}'s: have them take it away, or share {folder} with you (chmod g+w)"
        ) from error
    except OSError as error:
        raise InputError(
            f"{known} cannot be opened ({error.strerror}): it must be writable and no link; see who trains in {folder} "
            "before you remove it"
        ) from error
    found = os.fstat(number)
    if not stat.S_ISREG(found.st_mode) or found.st_nlink > 1:  # its content would be lost
        os.close(number)
        raise InputError(f"{known} is no file of its own, but a link, pipe or device: remove it")
    return os.fdopen(number, "r+", encoding="utf-8")


def mine(path: Path) -> bool:
    """Whether it belongs to who runs this."""
    return os.name == "posix" and path.stat().st_uid == os.geteuid()


def owner(path: Path) -> str:
    """The user whose file it is, in words; of a file in a folder that cannot be written to, the folder's."""
    try:
        return (path if path.exists() else path.parent).owner()
    except (OSError, KeyError, NotImplementedError):
        return "another user"


def same_file(stream: IO[str], path: Path) -> bool:
    """Whether an open file is the one that its path still names."""
    try:
        return os.path.samestat(os.fstat(stream.fileno()), path.stat())
    except FileNotFoundError:
        return False


def holder(stream: IO[str]) -> str:
    """Who has a lock file, in words."""
    try:
        stream.seek(0)
        told = json.load(stream)
        return f"process {told['process']} on {told['host']} since {told['since']}"
    except (OSError, ValueError, TypeError, KeyError):  # Windows does not let others read it
        return "another process"
