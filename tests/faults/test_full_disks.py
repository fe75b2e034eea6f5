"""Disks of every size on which a run has no room."""

import ctypes
import os
import shutil
import traceback
from collections.abc import Callable
from pathlib import Path

import pytest

from faults.children import preload, run_in_child
from faults.record import record, some
from faults.verbs import VERBS, orphans

pytestmark = pytest.mark.faults

PARTS = 2
RUN = VERBS["reuse"].words
PAGE = 4096
"""Bytes by which a file grows on a tmpfs."""
CASES = 200
LARGE = 1 << 30
NEWUSER, NEWNS, REMOUNT = 0x10000000, 0x20000, 32
"""Of Linux: sched.h, mount.h."""


class NoDisk(Exception):
    """Processes may have no disks of their own here."""


class Disk:
    """A file system in memory (tmpfs) that only this process and its children see."""

    def __init__(self, folder: Path, size: int) -> None:
        self.folder, self.libc = folder, ctypes.CDLL(None, use_errno=True)
        user, group = os.getuid(), os.getgid()
        self.checked(self.libc.unshare(NEWUSER | NEWNS))
        Path("/proc/self/setgroups").write_text("deny")
        Path("/proc/self/uid_map").write_text(f"{user} {user} 1")
        Path("/proc/self/gid_map").write_text(f"{group} {group} 1")
        folder.mkdir()
        self.mount(size, 0)

    def mount(self, size: int, flags: int) -> None:
        options = f"size={size}".encode()
        self.checked(self.libc.mount(b"tmpfs", os.fsencode(self.folder), b"tmpfs", flags, options))

    def resize(self, size: int) -> None:
        """Room for so many bytes."""
        self.mount(size, REMOUNT)

    def used(self) -> int:
        """Bytes in use."""
        told = os.statvfs(self.folder)
        return (told.f_blocks - told.f_bfree) * told.f_frsize

    @staticmethod
    def checked(result: int) -> None:
        if result != 0:
            number = ctypes.get_errno()
            raise NoDisk(os.strerror(number))


def on_a_disk(job: Callable[[Disk], None], folder: Path) -> None:
    """A job in a process of its own, with a disk of its own; what it fails with fails the test.

    A test is skipped where processes may have no disks of their own.
    """
    told = folder / "failure.txt"
    child = os.fork()
    if child == 0:
        code = 1
        try:
            job(Disk(folder / "disk", LARGE))
            code = 0
        except BaseException as error:
            told.write_text(f"no disk: {error}" if isinstance(error, NoDisk) else traceback.format_exc())
        finally:
            os._exit(code)
    _, status = os.waitpid(child, 0)
    failure = told.read_text() if told.exists() else ""
    if failure.startswith("no disk"):
        pytest.skip(failure)
    assert status == 0, failure


@pytest.mark.parametrize("part", range(PARTS))
def test_disks_that_are_too_small(tmp_path: Path, part: int) -> None:
    preload(RUN, tmp_path / "first")

    def sizes(disk: Disk) -> range:
        place = disk.folder / "place"
        assert run_in_child(RUN, place, tmp_path / "whole").code == 0
        pages = disk.used() // PAGE
        assert pages > 100
        expected.append(VERBS["reuse"].result(place))
        shutil.rmtree(place)
        return range(1, pages, max(1, pages // CASES))

    def job(disk: Disk) -> None:
        with record("a disk with too little room for a run, then the same with more", part) as counts:
            for pages in some(sizes(disk)[part::PARTS]):
                case(disk, pages)
                counts.cases += 1

    def case(disk: Disk, pages: int) -> None:
        place = disk.folder / "place"
        disk.resize(pages * PAGE)
        ended = run_in_child(RUN, place, tmp_path / "small")
        assert (ended.code, len(ended.sentences)) == (2, 1), (pages, ended)
        assert "Traceback" not in ended.said, (pages, ended.said)
        disk.resize(LARGE)
        again = run_in_child(RUN, place, tmp_path / "large")
        assert again.code == 0, (pages, again.said)
        assert VERBS["reuse"].result(place) == expected[0], pages
        assert orphans(place) == [], pages
        shutil.rmtree(place)

    expected: list[str] = []
    on_a_disk(job, tmp_path)
