"""Commands of gsx in forked processes, so that each need not import torch."""

import importlib
import os
import signal
import sys
import traceback
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Ended:
    """How a command ended."""

    code: int
    """Exit code; of a killed process the signal's number below 0."""
    said: str
    """Standard error."""

    @property
    def sentences(self) -> list[str]:
        """What it said to whoever gave the command."""
        return [line for line in self.said.splitlines() if line.startswith(("gsx: ", "gsx "))]


def preload(words: list[str], place: Path) -> None:
    """Import here what a command imports on its way, so that children need not."""
    names = place.parent / "modules.txt"

    def listed() -> int:
        code = command(words)
        names.write_text("\n".join(sys.modules))
        return code

    assert in_child(listed, place).code == 0
    for name in names.read_text().splitlines():
        with suppress(Exception):  # some are parts of others, and come with them
            importlib.import_module(name)


def run_in_child(words: list[str], place: Path, told_in: Path | None = None) -> Ended:
    """`gsx WORDS` in `place`, which is also where its cache lies. What it says goes to a file that begins with
    `told_in`.
    """
    return in_child(lambda: command(words), place, told_in)


def command(words: list[str]) -> int:
    """The command line, inside the child."""
    from gsx.cli.dispatch import main

    return main(words)


def in_child(job: Callable[[], int], place: Path, told_in: Path | None = None) -> Ended:
    """A job in a forked process; see `run_in_child`."""
    said = Path(f"{told_in or place}.stderr")
    child = os.fork()
    if child == 0:
        os._exit(carried_out(job, place, said))
    return ended_as(child, said)


def ended_as(child: int, said: Path) -> Ended:
    """Wait for a child, and read what it said."""
    _, status = os.waitpid(child, 0)
    return Ended(code=os.waitstatus_to_exitcode(status), said=said.read_text(errors="replace"))


def carried_out(job: Callable[[], int], place: Path, said: Path) -> int:
    """The child's whole life; returns its exit code."""
    code = 70
    try:
        place.mkdir(exist_ok=True)
        os.chdir(place)
        os.environ["GSX_CACHE"] = str(place / "cache")
        stream = os.open(said, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
        os.dup2(stream, 1)
        os.dup2(stream, 2)
        sys.stdout, sys.stderr = os.fdopen(1, "w", closefd=False), os.fdopen(2, "w", closefd=False)
        signal.signal(signal.SIGINT, signal.default_int_handler)
        code = job()
    except SystemExit as ended:
        code = ended.code if isinstance(ended.code, int) else 1
    except BaseException:
        traceback.print_exc()
    with suppress(OSError):
        sys.stdout.flush()
        sys.stderr.flush()
    return code
