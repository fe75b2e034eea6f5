"""Runs in processes of a launcher, and the signals that end them.

joblib kills all its processes as soon as one of their tasks, or the process that waits for them, raises anything. So
neither raises: the first signal ends every run with a checkpoint, and takes effect after all of them have ended.
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
"""File in the folder of a multirun or of a table's phase: no further job of it starts."""
WORKING = "working"
"""Folder there with a file for each process that runs a job, named by its number."""


@contextmanager
def waiting_for_all(folder: Path) -> Iterator[None]:
    """End the jobs in a launcher's processes at the first Ctrl-C or signal of a job's end; start no further ones.

    Without such processes, and at a second Ctrl-C, nothing changes. Only the main thread receives signals.

    Raises:
        KeyboardInterrupt, SystemExit: there was a signal, and all jobs have ended.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    received: list[int] = []

    def stop(number: int, frame: Any) -> None:
        working = list((folder / WORKING).glob("*"))
        if not working:
            restore(before)
            signal.raise_signal(number)
            return
        received.append(number)
        (folder / STOPPED).touch()
        restore({signal.SIGINT: before[signal.SIGINT]})
        for one in working if os.name == "posix" else ():  # on Windows that kills; its console signals all anyway
            with suppress(ProcessLookupError):
                os.kill(int(one.name), signal.SIGTERM)

    before = {number: signal.getsignal(number) for number in (signal.SIGINT, *handled_signals())}
    remove_messages(folder)
    os.environ[LAUNCHER] = str(os.getpid())
    try:
        for number in before:
            signal.signal(number, stop)
        yield
    except Exception:
        if not received:
            raise
    finally:
        restore(before)
        del os.environ[LAUNCHER]
        remove_messages(folder)
    if received:
        raise KeyboardInterrupt if received[0] == signal.SIGINT else SystemExit(128 + received[0])


def restore(handlers: dict[signal.Signals, Any]) -> None:
    """Restore handlers of signals."""
    for number, handler in handlers.items():
        signal.signal(number, signal.SIG_DFL if handler is None else handler)


def remove_messages(folder: Path) -> None:
    """Remove the messages between processes in a folder."""
    (folder / STOPPED).unlink(missing_ok=True)
    rmtree(folder / WORKING, ignore_errors=True)


def is_launched() -> bool:
    """Return True in a launcher's process that another one waits for."""
    parent = parent_process()
    return parent is not None and os.environ.get(LAUNCHER) == str(parent.pid)


@contextmanager
def ended_from_without(folder: Path) -> Iterator[None]:
    """Turn the first signal to a job in a launcher's process into KeyboardInterrupt, unless training handles it.

    No signal ends the process, now or between its jobs. Outside of a launcher nothing changes.

    Raises:
        KeyboardInterrupt: there was a signal, or no further jobs of `folder` start.
    """
    if not is_launched():
        yield
        return

    def once(number: int, frame: Any) -> None:
        ignore()
        raise KeyboardInterrupt

    def ignore() -> None:
        for number in handled:
            signal.signal(number, lambda number, frame: None)

    handled, message = (signal.SIGINT, *handled_signals()), folder / WORKING / str(os.getpid())
    for number in handled:
        signal.signal(number, once)
    try:
        message.parent.mkdir(parents=True, exist_ok=True)
        message.touch()
        if (folder / STOPPED).exists():
            raise KeyboardInterrupt
        yield
    finally:
        ignore()
        message.unlink(missing_ok=True)
