"""Errors as one sentence with an exit code, and output whose reader has gone."""

import errno
import os
import select
import sys

from gsx.core.errors import GsxError
from gsx.engine.processes import say
from gsx.engine.signals import INTERRUPTED

CLOSED_PIPE = 128 + 13
"""Exit code when the reader of standard output has gone: shells report SIGPIPE like this."""


def report_error(error: BaseException) -> int:
    """Print an error that the user can correct and return its exit code; raise others again."""
    if isinstance(error, KeyboardInterrupt):
        say("\ngsx: interrupted; no half-written files are left\n", as_error=True)
        return INTERRUPTED
    if not isinstance(error, GsxError | OSError):
        raise error
    text = os_sentence(error) if isinstance(error, OSError) else str(error)
    say(f"{text}\n" if text.startswith("gsx ") else f"gsx: {text}\n", as_error=True)
    return 2


def os_sentence(error: OSError) -> str:
    """Return a failure of the file system with its remedy."""
    where = f" ({error.filename})" if error.filename else ""
    remedy = "free some space" if error.errno in (errno.ENOSPC, errno.EDQUOT) else "check that path and its permissions"
    place = "a writable place: output=FOLDER for training, --to FOLDER for commands that have it"
    return f"{error.strerror or error}{where}: {remedy}, or choose {place}"


def report_closed_output(error: BrokenPipeError) -> int:
    """Discard further output if standard output has no reader (`gsx plugins | head -3`); report other broken pipes."""
    if not has_no_reader():
        return report_error(error)
    discard_output()
    return CLOSED_PIPE


def has_no_reader() -> bool:
    """Return True if standard output is a pipe without a reader."""
    try:
        watched = select.poll()
        watched.register(sys.stdout.fileno(), 0)
    except (AttributeError, OSError, ValueError):  # Windows has no poll, notebooks no file descriptor
        return False
    return any(event & select.POLLERR for _, event in watched.poll(0))


def discard_unwritten() -> None:
    """Discard output that cannot be written (a full disk)."""
    try:
        sys.stdout.flush()
    except OSError:
        discard_output()


def discard_output() -> None:
    """Discard standard output: Python would write again at exit and print its own error."""
    with open(os.devnull, "w") as nowhere:
        os.dup2(nowhere.fileno(), sys.stdout.fileno())
