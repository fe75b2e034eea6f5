"""Runs in processes of a launcher, and the signals that end them.

joblib kills all of its processes as soon as one of their tasks raises anything, or the process that waits for them. So
neither does: the first signal ends every run with a checkpoint, and counts once all of them have ended.
"""

import os
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from multiprocessing import parent_process
from pathlib import Path
from shutil import rmtree
from typing import Any

from gsx.engine.signals import handled_signals

LAUNCHER = "GSX_LAUNCHER"
"""Environment variable: the process that waits for those of a launcher, which inherit it."""
STOPPED = "stopped"
"""File in the folder of a multirun or of a table's phase: no job of it begins any more."""
WORKING = "working"
"""Folder there with a file for each process in a job, named by its number."""


@contextmanager
def waiting_for_all(folder: Path) -> Iterator[None]:
    """Ends the jobs in processes of a launcher at the first Ctrl-C or signal of a job's end; none begins after it.

    Without such processes, and at a second Ctrl-C, nothing changes. Threads but the main one hear no signals.

    Raises:
        KeyboardInterrupt, SystemExit: there was one, and all have ended.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    received: list[int] = []

    def stop(number: int, frame: Any) -> None:
        working = list((folder / WORKING).glob("*"))
        if not working:
            give_back(before)
            signal.raise_signal(number)
            return
        received.append(number)
        (folder / STOPPED).touch()
        give_back({signal.SIGINT: before[signal.SIGINT]})
        for one in working if os.name == "posix" else ():  # elsewhere it would be killed; a console tells all anyway
            with suppress(ProcessLookupError):
                os.kill(int(one.name), signal.SIGTERM)

    before = {number: signal.getsignal(number) for number in (signal.SIGINT, *handled_signals())}
    forget(folder)
    os.environ[LAUNCHER] = str(os.getpid())
    try:
        for number in before:
            signal.signal(number, stop)
        yield
    except Exception:
        if not received:
            raise
    finally:
        give_back(before)
        del os.environ[LAUNCHER]
        forget(folder)
    if received:
        raise KeyboardInterrupt if received[0] == signal.SIGINT else SystemExit(128 + received[0])


def give_back(handlers: dict[signal.Signals, Any]) -> None:
    """Restores handlers of signals."""
    for number, handler in handlers.items():
        signal.signal(number, signal.SIG_DFL if handler is None else handler)


def forget(folder: Path) -> None:
    """Removes the messages between processes in a folder."""
    (folder / STOPPED).unlink(missing_ok=True)
    rmtree(folder / WORKING, ignore_errors=True)


def is_launched() -> bool:
    """Returns whether this is a process of a launcher, for which another one waits."""
    parent = parent_process()
    return parent is not None and os.environ.get(LAUNCHER) == str(parent.pid)


@contextmanager
def ended_from_without(folder: Path) -> Iterator[None]:
    """Turns the first signal to a job in a process of a launcher into KeyboardInterrupt, unless training handles it.

    No signal ends the process, now or between its jobs. Anywhere else nothing changes.

    Raises:
        KeyboardInterrupt: it was ended, or jobs of `folder` do not begin any more.
    """
    if not is_launched():
        yield
        return

    def once(number: int, frame: Any) -> None:
        let_pass()
        raise KeyboardInterrupt

    def let_pass() -> None:
        for number in heard:
            signal.signal(number, lambda number, frame: None)

    heard, own = (signal.SIGINT, *handled_signals()), folder / WORKING / str(os.getpid())
    for number in heard:
        signal.signal(number, once)
    try:
        own.parent.mkdir(parents=True, exist_ok=True)
        own.touch()
        if (folder / STOPPED).exists():
            raise KeyboardInterrupt
        yield
    finally:
        let_pass()
        own.unlink(missing_ok=True)
