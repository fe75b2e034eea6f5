"""Commands of gsx under strace: their system calls that change files are listed, and one of them kills or fails."""

import os
import re
import shutil
import signal
import subprocess
import time
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import pytest

from faults.children import Ended, carried_out, command, ended_as

STRACE = shutil.which("strace")
CHANGING = ("openat", "creat", "write", "pwrite64", "writev", "pwritev", "sendfile", "copy_file_range", "truncate",
            "ftruncate", "fallocate", "fsync", "fdatasync", "rename", "renameat", "renameat2", "unlink", "unlinkat",
            "mkdir", "mkdirat", "rmdir", "link", "linkat", "symlink", "symlinkat", "chmod", "fchmod", "fchmodat",
            "utimensat")  # fmt: skip
"""System calls that can change what is on a disk."""
CALL = re.compile(r"^(?P<thread>\d+) +(?P<name>\w+)\((?P<given>.*)$")
WRITING = re.compile(r"O_WRONLY|O_RDWR|O_CREAT|O_TRUNC")
NAMED = re.compile(r'(?:\w+<(?P<folder>[^>]*)>, )?"(?P<name>[^"]*)"')
"""A name, and the folder that it is below where the call tells one."""
OPENED = re.compile(r"^\d+<([^>]*)>")
"""What a number stands for, as strace -y tells."""


@dataclass(frozen=True)
class Call:
    """A call of the main thread."""

    name: str
    number: int
    """Among the calls of that name, from 1."""
    failed: bool
    """Whether the system refused it, as to remove what is not there."""
    path: Path
    """What it changes."""


def changes(lines: list[str], place: Path) -> list[Call]:
    """Calls that change something below the folder in which the command was given, in their order.

    Raises:
        AssertionError: a thread beside the main one changes files; its calls would be counted apart.
    """
    made, counted, main = list[Call](), Counter[str](), ""
    for line in lines:
        if not (found := CALL.match(line)):
            continue
        main = main or found["thread"]
        name, given = found["name"], found["given"]
        counted[name] += found["thread"] == main
        paths = [path for path in changed(name, given, place) if path.is_relative_to(place)]
        if paths:
            assert found["thread"] == main, line
            made.append(Call(name, counted[name], failed=" = -1 " in given, path=paths[-1]))
    return made


def changed(name: str, given: str, place: Path) -> list[Path]:
    """What a call changes: what its names or its number of an open file stand for."""
    if name == "openat" and not WRITING.search(given):
        return []
    named = [] if "write" in name else list(NAMED.finditer(given))  # writing, what is quoted is the content
    return [Path(found["folder"] or place, found["name"]) for found in named] or [
        Path(opened) for opened in OPENED.findall(given)
    ]


def traced(words: list[str], place: Path, given: list[str], log: Path | None = None) -> Ended:
    """`gsx WORDS` in `place` under strace with more options; what strace sees goes to `log`."""
    said = Path(f"{place}.stderr")

    def job() -> int:
        os.kill(os.getpid(), signal.SIGSTOP)  # until strace is there
        return command(words)

    child = os.fork()
    if child == 0:
        os._exit(carried_out(job, place, said))
    os.waitpid(child, os.WUNTRACED)
    options = ["-qq", "-s0", "-y", "-o", str(log or os.devnull), "-p", str(child)]
    tracer = subprocess.Popen([str(STRACE), *options, *given], stderr=subprocess.PIPE, text=True)
    status = Path(f"/proc/{child}/status")
    while "TracerPid:\t0" in status.read_text():
        if tracer.poll() is not None:
            os.kill(child, signal.SIGKILL)
            os.waitpid(child, 0)
            pytest.skip(f"strace cannot attach to processes here: {tracer.stderr and tracer.stderr.read()}")
        time.sleep(0.002)
    os.kill(child, signal.SIGCONT)
    ended = ended_as(child, said)
    tracer.communicate()
    return ended


def listed(words: list[str], place: Path) -> tuple[Ended, list[Call]]:
    """A command to which nothing happens, and what it changes below `place`."""
    log = Path(f"{place}.strace")
    ended = traced(words, place, ["-f", "-e", f"trace={','.join(CHANGING)}"], log)
    return ended, changes(log.read_text(errors="replace").splitlines(), place)


def killed(words: list[str], place: Path, call: Call) -> Ended:
    """The command, killed when it makes a call."""
    return traced(words, place, injected(call, "signal=KILL"))


def failed(words: list[str], place: Path, call: Call, error: str) -> Ended | None:
    """The command, one of whose calls fails; None: messages on their way, as many as time allowed, had come between,
    so that another call had its number: one to a file in memory, say, which no disk lets fail.
    """
    log = Path(f"{place}.strace")
    ended = traced(words, place, injected(call, f"error={error}"), log)
    lines = [line for line in log.read_text(errors="replace").splitlines() if "(INJECTED)" in line]
    assert lines, call
    return ended if changes([f"1 {lines[0]}"], place) else None


def injected(call: Call, what: str) -> list[str]:
    """Options of strace that let something happen at a call."""
    return ["-e", f"trace={call.name}", "-e", f"inject={call.name}:{what}:when={call.number}"]
