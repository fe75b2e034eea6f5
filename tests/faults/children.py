"""Commands of gsx in forked processes whose changes of files are counted, and fail or kill at a chosen one."""

import errno
import importlib
import os
import signal
import sys
import traceback
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gsx.core.cache import IN_USE

WRITING = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND
CHANGING = ("os.rename", "os.remove", "os.rmdir", "os.mkdir", "os.truncate", "os.link", "os.symlink")
"""Events of Python's audit hooks (PEP 578) that change what is on a disk; os.replace tells of os.rename."""


@dataclass(frozen=True)
class Ended:
    """How a command ended."""

    code: int
    """Exit code; of a killed process the signal's number below 0."""
    said: str
    """Standard error."""
    changes: int
    """Changes of files that it began."""
    failed: int
    """Those of them that failed, but for removing a lock."""

    @property
    def sentences(self) -> list[str]:
        """What it said to whoever gave the command."""
        return [line for line in self.said.splitlines() if line.startswith("gsx: ")]


@dataclass
class Disk:
    """Audit hook: counts changes below a folder; those from number `at` on fail, or the first of them kills."""

    below: str
    at: int
    error: int
    """Number of the error; 0: the process is killed."""
    count: int = 0
    failed: int = 0

    def __call__(self, event: str, given: tuple[Any, ...]) -> None:
        if not (event in CHANGING or (event == "open" and self.writes(given))) or not self.concerns(given):
            return
        self.count += 1
        if self.count < self.at or not self.at:
            return
        if event in ("os.remove", "os.rmdir") and self.error in (errno.ENOSPC, errno.EDQUOT):
            return  # what a full disk still allows
        if not self.error:
            os.kill(os.getpid(), signal.SIGKILL)
        self.failed += not self.void(event, str(given[0]))
        raise OSError(self.error, os.strerror(self.error), str(given[0]))

    @staticmethod
    def void(event: str, path: str) -> bool:
        """Whether nothing is lost: a lock, or a sign that the cache is used, that is void without its process."""
        return (event == "os.remove" and path.endswith(".lock")) or Path(path).parent.name == IN_USE

    def writes(self, given: tuple[Any, ...]) -> bool:
        """Whether a file is opened for more than reading."""
        return isinstance(given[2], int) and bool(given[2] & WRITING)

    def concerns(self, given: tuple[Any, ...]) -> bool:
        """Whether the file lies below the folder."""
        named = isinstance(given[0], str | bytes | os.PathLike)
        return named and os.path.abspath(os.fsdecode(given[0])).startswith(f"{self.below}{os.sep}")


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


def run_in_child(words: list[str], place: Path, *, at: int = 0, error: int = 0, told_in: Path | None = None) -> Ended:
    """`gsx WORDS` in `place`, which is also where its cache lies; its `at`-th change of a file kills it, or fails with
    an error as all later ones do. 0: nothing happens to it. What it says goes to files that begin with `told_in`.
    """
    return in_child(lambda: command(words), place, at, error, told_in)


def command(words: list[str]) -> int:
    """The command line, inside the child."""
    from gsx.cli.dispatch import main

    return main(words)


def in_child(job: Callable[[], int], place: Path, at: int = 0, error: int = 0, told_in: Path | None = None) -> Ended:
    """A job in a forked process; see `run_in_child`."""
    said, counted = (Path(f"{told_in or place}.{kind}") for kind in ("stderr", "changes"))
    child = os.fork()
    if child == 0:
        os._exit(carried_out(job, place, Disk(str(place), at, error), said, counted))
    _, status = os.waitpid(child, 0)
    changes, failed = map(int, counted.read_text().split()) if counted.exists() else (0, 0)
    code = os.waitstatus_to_exitcode(status)
    return Ended(code=code, said=said.read_text(errors="replace"), changes=changes, failed=failed)


def carried_out(job: Callable[[], int], place: Path, disk: Disk, said: Path, counted: Path) -> int:
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
        sys.addaudithook(disk)
        code = job()
    except SystemExit as ended:
        code = ended.code if isinstance(ended.code, int) else 1
    except BaseException:
        traceback.print_exc()
    sys.stdout.flush()
    sys.stderr.flush()
    disk.at = 0
    counted.write_text(f"{disk.count} {disk.failed}")
    return code
