"""What people read: errors as one sentence, messages of the log."""

import errno
import os
import select
import sys

from gsx.core.errors import GsxError
from gsx.engine.processes import say
from gsx.experiments.runs.job import INTERRUPTED


def explained(error: BaseException) -> int:
    """Shows an error that people can correct and returns its exit code; raises others again."""
    if isinstance(error, KeyboardInterrupt):
        say("\ngsx: interrupted; nothing half-written is left\n", as_error=True)
        return INTERRUPTED
    if not isinstance(error, GsxError | OSError):
        raise error
    say(f"gsx: {os_sentence(error) if isinstance(error, OSError) else error}\n", as_error=True)
    return 2


UNHEARD = 128 + 13
"""Exit code where standard output is a pipe that nobody reads any more, as shells tell SIGPIPE."""


def unheard(error: BrokenPipeError) -> int:
    """Says nothing more on standard output, if it is that which nobody reads any more (`gsx plugins | head -3`)."""
    if not unread():
        return explained(error)
    discard_output()
    return UNHEARD


def discard_output() -> None:
    """Discards standard output: Python would write again at its end, and complain in words of its own."""
    with open(os.devnull, "w") as nowhere:
        os.dup2(nowhere.fileno(), sys.stdout.fileno())


def discard_unwritten() -> None:
    """Discards standard output if it takes nothing (a full disk)."""
    try:
        sys.stdout.flush()
    except OSError:
        discard_output()


def unread() -> bool:
    """Returns whether standard output is a pipe without a reader."""
    try:
        watched = select.poll()
        watched.register(sys.stdout.fileno(), 0)
    except (AttributeError, OSError, ValueError):  # Windows has no poll, notebooks no number of the file
        return False
    return any(event & select.POLLERR for _, event in watched.poll(0))


def os_sentence(error: OSError) -> str:
    """Returns a failure of the file system with its remedy."""
    where = f" ({error.filename})" if error.filename else ""
    remedy = "free some space" if error.errno in (errno.ENOSPC, errno.EDQUOT) else "check that path and its permissions"
    place = "a writable place: output=FOLDER to train, --to FOLDER where a command has that"
    return f"{error.strerror or error}{where}: {remedy}, or choose {place}"
