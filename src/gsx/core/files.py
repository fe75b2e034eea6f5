"""Files that are either wholly there or not at all, JSON and CSV."""

import csv
import io
import json
import math
import os
import platform
import re
import secrets
import shutil
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from gsx.core.errors import InputError


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A temporary path beside `path`, same suffix; it becomes `path` when the block ends, or vanishes on an error.

    Its name says who writes it, and is drawn besides: containers share names of machines and numbers of processes.
    """
    temporary = path.with_name(f".{path.stem}.{own_mark()}-{secrets.token_hex(4)}.partial{path.suffix}")
    try:
        yield temporary
        os.replace(temporary, path)
    except OSError as error:
        if error.filename == str(temporary):  # nobody knows that name
            error.filename = str(path)
        raise
    finally:
        temporary.unlink(missing_ok=True)


def replace_file(path: Path, content: bytes) -> None:
    """Write a file at once, and onto the disk before it takes the place of an older one; then its name, too."""
    with replacing(path) as temporary, temporary.open("wb") as stream:
        stream.write(content)
        stream.flush()
        os.fsync(stream.fileno())
    keep_names(path.parent)


def replace_text(path: Path, text: str) -> None:
    """`replace_file` as UTF-8; bytes of file names that are no text, which Python has as surrogates, become escapes."""
    replace_file(path, text.encode("utf-8", "backslashreplace"))


def keep_names(folder: Path) -> None:
    """Have the disk keep what a folder's files are called now, where a system lets folders be written through."""
    if not hasattr(os, "O_DIRECTORY"):
        return
    with suppress(OSError):  # file systems that know no such thing
        number = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
        try:
            os.fsync(number)
        finally:
            os.close(number)


ABANDONED = 3600.0
"""Seconds after which a temporary file of another machine is taken for left behind."""
MARKED = re.compile(r"^\..+\.(?P<machine>[A-Za-z0-9]*)-(?P<process>\d+)-[0-9a-z_]{8}\.partial")
"""Names of temporary files."""


def own_mark() -> str:
    """This machine and process, in letters of file names; containers that number processes anew are told apart."""
    try:
        counted_by = os.readlink("/proc/self/ns/pid")  # of containers each has its own
    except OSError:
        counted_by = ""
    return f"{re.sub(r'[^A-Za-z0-9]', '', platform.node() + counted_by)}-{os.getpid()}"


def at_home(path: str | Path) -> Path:
    """A path with `~` and `~user` as what they stand for; as it is where there is no such user."""
    try:
        return Path(path).expanduser()
    except RuntimeError:
        return Path(path)


def remove_partial(folder: Path, below: bool = True) -> None:
    """Remove what killed processes left half-written in a folder, and below it."""
    for place, inner, names in os.walk(folder):
        for name in (*names, *inner):
            if found := MARKED.match(name):
                with suppress(OSError):
                    path = Path(place, name)
                    if gone(found["machine"], int(found["process"]), path):
                        shutil.rmtree(path) if path.is_dir() else path.unlink()
        if not below:
            inner.clear()


def gone(machine: str, process: int, path: Path) -> bool:
    """Whether the process that wrote a temporary file is no more; of other machines its age tells."""
    if machine != own_mark().rpartition("-")[0] or os.name != "posix":
        return time.time() - path.stat().st_mtime > ABANDONED
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return True
    except OSError:  # another user's
        pass
    return False


def file_count(folder: Path) -> int:
    """Files of a folder that are not hidden; none where it cannot be looked at."""
    try:
        return sum(path.is_file() and not path.name.startswith(".") for path in folder.iterdir())
    except OSError:
        return 0


def csv_text(fields: Sequence[str], rows: Iterable[Mapping[str, Any]]) -> str:
    """Formats a table as CSV with a header; missing values are empty."""
    stream = io.StringIO()
    writer = csv.DictWriter(stream, fields, extrasaction="ignore", lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return stream.getvalue()


def finite(content: Any) -> Any:
    """The same with infinite and undefined numbers as None, for which JSON has a word."""
    if isinstance(content, dict):
        return {key: finite(value) for key, value in content.items()}
    if isinstance(content, list | tuple):
        return [finite(value) for value in content]
    return None if isinstance(content, float) and not math.isfinite(content) else content


LFS_POINTER = b"version https://git-lfs"
"""First bytes of the small text that stands in for a file until Git LFS downloads it."""
LFS_REMEDY = "a Git LFS pointer, not the file itself: run 'git lfs pull' in its repository"


def is_lfs_pointer(path: Path) -> bool:
    """Recognise a file that Git LFS has not downloaded yet."""
    with suppress(OSError), path.open("rb") as stream:
        return stream.read(len(LFS_POINTER)) == LFS_POINTER
    return False


def refuse_lfs_pointer(path: Path) -> None:
    """Raise InputError for a file that Git LFS has not downloaded yet."""
    if is_lfs_pointer(path):
        raise InputError(f"'{path}' is {LFS_REMEDY}.")


def is_file(path: Path) -> bool:
    """Whether there is such a file; a name that none can have, as too long a one, is that of none."""
    return os.path.isfile(path)


def write_json(path: Path, content: Any) -> None:
    """Write JSON; numbers that are not finite become null, unknown objects text."""
    replace_file(path, json.dumps(finite(content), indent=2, default=str).encode())


def read_json(path: Path) -> Any:
    """Return what a JSON file holds, in UTF-8, UTF-16 or UTF-32, with or without a byte order mark.

    Raises:
        OSError, ValueError: it cannot be read or parsed.
    """
    try:
        return json.loads(path.read_bytes())
    except RecursionError as error:
        raise ValueError("its brackets are nested too deeply") from error
    except ValueError as error:
        raise (ValueError(f"it is {LFS_REMEDY}") if is_lfs_pointer(path) else error) from None
