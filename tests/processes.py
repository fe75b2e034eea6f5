"""Processes of tests: they hear signals, whatever the shell of the tests ignores, and none outlives its test."""

import os
import signal
import subprocess
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Any

Begin = Callable[..., subprocess.Popen]
DEFAULTS = {
    getattr(signal, name): signal.default_int_handler if name == "SIGINT" else signal.SIG_DFL
    for name in ("SIGINT", "SIGTERM", "SIGHUP", "SIGQUIT", "SIGUSR2")
    if hasattr(signal, name)
}
"""Python's own handlers. `nohup` ignores SIGHUP, and a shell's `&` ignores SIGINT and SIGQUIT."""


@contextmanager
def default_signals() -> Iterator[None]:
    """Give ignored signals their default handlers, and ignore them again at the end."""
    ignored = [number for number in DEFAULTS if signal.getsignal(number) == signal.SIG_IGN]
    for number in ignored:
        signal.signal(number, DEFAULTS[number])
    try:
        yield
    finally:
        for number in ignored:
            signal.signal(number, signal.SIG_IGN)


@contextmanager
def killed_at_the_end() -> Iterator[Begin]:
    """Yield a `Popen` whose processes, and all that these start in their group, are killed at the end."""
    begun: list[subprocess.Popen] = []

    def begin(command: list[str], **options: Any) -> subprocess.Popen:
        begun.append(subprocess.Popen(command, **{"start_new_session": True} | options))
        return begun[-1]

    try:
        yield begin
    finally:
        for process in begun:
            kill_group(process)


def kill_group(process: subprocess.Popen) -> None:
    """Kill a process and what it has started; close its pipes."""
    with suppress(ProcessLookupError):
        leads = os.name == "posix" and os.getpgid(process.pid) == process.pid
        os.killpg(process.pid, signal.SIGKILL) if leads else process.kill()
    process.wait()
    for pipe in (process.stdin, process.stdout, process.stderr):
        if pipe is not None:
            pipe.close()
