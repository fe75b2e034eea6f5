"""Locks of open files on any system. They end with their process, so a killed one leaves none behind."""

import logging
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

from gsx.core.errors import InputError

logger = logging.getLogger(__name__)

RETRY_SECONDS = 0.05
"""Between attempts where the system cannot wait by itself."""


def lock(stream: IO[str], wait: bool = False) -> bool:
    """Whether this process has now got the lock of an open file; `wait`: it does not return before.

    Raises:
        OSError: the file system knows no locks.
        InputError: this Python knows none.
    """
    while not locked(stream):
        if not wait:
            return False
        time.sleep(RETRY_SECONDS)
    return True


@contextmanager
def made_by_one(file: Path, wait: bool = False) -> Iterator[bool]:
    """Whether nobody else makes this file; `wait`: until nobody does. Where nothing can be locked everybody may."""
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        stream = file.with_suffix(".lock").open("w")
    except OSError:
        yield True
        return
    with stream:
        try:
            alone = lock(stream)
            if wait and not alone:
                logger.info("waiting for another process, which is making %s ...", file.name.partition("-")[0])
                alone = lock(stream, wait)
        except (OSError, InputError):
            alone = True
        yield alone


def locked(stream: IO[str]) -> bool:
    """One attempt, by the first way that this Python has."""
    for attempt in (by_fcntl, by_msvcrt):
        try:
            attempt(stream)
        except ImportError:
            continue
        except (BlockingIOError, PermissionError):
            return False
        return True
    raise InputError(
        f"{stream.name} cannot be locked, since this Python has neither fcntl nor msvcrt, by which processes keep out "
        "of each other's way: use the one of python.org or of your system"
    )


def by_fcntl(stream: IO[str]) -> None:
    """Unix."""
    import fcntl

    fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)


def by_msvcrt(stream: IO[str]) -> None:
    """Windows: its first byte, which need not exist."""
    import msvcrt

    stream.seek(0)
    msvcrt.locking(stream.fileno(), msvcrt.LK_NBLCK, 1)  # type: ignore[attr-defined,unused-ignore]
