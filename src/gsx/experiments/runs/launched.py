"""Runs in processes of a launcher, and the signals that end them.

joblib kills all of its processes as soon as one of their tasks raises anything, or the process that waits for them.
So neither does: the first signal ends every run with a checkpoint, and counts once all of them have ended.
"""

import os
import signal
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from multiprocessing import active_children, parent_process
from pathlib import Path
from typing import Any

from gsx.core.signals import heeded

STOPPED = "stopped"
"""File in the folder of a multirun or of a table's phase: no job of it begins any more."""


@contextmanager
def waiting_for_all(folder: Path) -> Iterator[None]:
    """The first Ctrl-C, or signal of a job's end, ends runs in processes of a launcher; nothing begins after it. Where
    there are no such processes it is as ever, and so is a second Ctrl-C.

    Raises:
        KeyboardInterrupt, SystemExit: there was one, and all have ended.
    """
    received: list[int] = []
    mark = folder / STOPPED

    def stop(number: int, frame: Any) -> None:
        children = active_children()
        if not children:
            give_back()
            signal.raise_signal(number)
            return
        received.append(number)
        folder.mkdir(parents=True, exist_ok=True)
        mark.touch()
        signal.signal(signal.SIGINT, before[signal.SIGINT])
        for child in children if os.name == "posix" else ():  # elsewhere it would be killed; a console tells all anyway
            with suppress(ProcessLookupError):
                os.kill(child.pid or 0, signal.SIGTERM)

    def give_back() -> None:
        for number, handler in before.items():
            signal.signal(number, handler)

    mark.unlink(missing_ok=True)
    before = {number: signal.signal(number, stop) for number in (signal.SIGINT, *heeded())}
    try:
        yield
    except Exception:
        if not received:
            raise
    finally:
        give_back()
        mark.unlink(missing_ok=True)
    if received:
        raise KeyboardInterrupt if received[0] == signal.SIGINT else SystemExit(128 + received[0])


@contextmanager
def ended_from_without(folder: Path | None) -> Iterator[None]:
    """A job in a process of a launcher: the first signal raises KeyboardInterrupt, unless training heeds it; none ends
    the process, now or between its jobs. Anywhere else nothing changes.

    Raises:
        KeyboardInterrupt: it was ended, or jobs of `folder` do not begin any more.
    """
    if parent_process() is None:
        yield
        return

    def once(number: int, frame: Any) -> None:
        let_pass()
        raise KeyboardInterrupt

    def let_pass() -> None:
        for number in heard:
            signal.signal(number, lambda number, frame: None)

    heard = (signal.SIGINT, *heeded())
    for number in heard:
        signal.signal(number, once)
    try:
        if folder is not None and (folder / STOPPED).exists():
            raise KeyboardInterrupt
        yield
    finally:
        let_pass()
