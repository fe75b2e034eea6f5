"""Atomic writes, temporary files, JSON and CSV."""

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
    """Yields a temporary path with the same folder and suffix; renames it to `path`, or deletes it on an error.

    Its name holds machine and process, and random digits, since containers share both.
    """
    temporary = path.with_name(f".{path.stem}.{process_tag()}-{secrets.token_hex(4)}.partial{path.suffix}")
    try:
        yield temporary
        os.replace(temporary, path)
    except OSError as error:
        if error.filename == str(temporary):  # report the name that the user knows
            error.filename = str(path)
        raise
    finally:
        temporary.unlink(missing_ok=True)


def replace_file(path: Path, content: bytes) -> None:
    """Writes a file atomically; content and name are on the disk at the end."""
    with replacing(path) as temporary, temporary.open("wb") as stream:
        stream.write(content)
        stream.flush()
        os.fsync(stream.fileno())
    sync_folder(path.parent)


def replace_text(path: Path, text: str) -> None:
    """Writes UTF-8 text by `replace_file`; surrogates of undecodable file names become escapes."""
    replace_file(path, text.encode("utf-8", "backslashreplace"))


def sync_folder(folder: Path) -> None:
    """Flushes the names in a folder to the disk, where the system can."""
    if not hasattr(os, "O_DIRECTORY"):
        return
    with suppress(OSError):  # file systems without this call
        number = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
        try:
            os.fsync(number)
        finally:
            os.close(number)


ABANDONED = 3600.0
"""Age in seconds at which temporary files of other machines are deleted."""
MARKED = re.compile(r"^\..+\.(?P<machine>[A-Za-z0-9]*)-(?P<process>\d+)-[0-9a-z_]{8}\.partial")
"""Names of temporary files."""


def process_tag() -> str:
    """Returns an identifier of machine, container and process, for file names."""
    try:
        counted_by = os.readlink("/proc/self/ns/pid")  # differs between containers
    except OSError:
        counted_by = ""
    return f"{re.sub(r'[^A-Za-z0-9]', '', platform.node() + counted_by)}-{os.getpid()}"


def expand_home(path: str | Path) -> Path:
    """Expands `~` and `~user` in a path, unless there is no such user."""
    try:
        return Path(path).expanduser()
    except RuntimeError:
        return Path(path)


def remove_partial(folder: Path, below: bool = True) -> None:
    """Deletes temporary files of ended processes in a folder and, if `below`, in its subfolders."""
    for place, inner, names in os.walk(folder):
        for name in (*names, *inner):
            if found := MARKED.match(name):
                with suppress(OSError):
                    path = Path(place, name)
                    if has_ended(found["machine"], int(found["process"]), path):
                        shutil.rmtree(path) if path.is_dir() else path.unlink()
        if not below:
            inner.clear()


def has_ended(machine: str, process: int, path: Path) -> bool:
    """Returns whether the writer of a temporary file has ended; on other machines, whether the file is old."""
    if machine != process_tag().rpartition("-")[0] or os.name != "posix":
        return time.time() - path.stat().st_mtime > ABANDONED
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return True
    except OSError:  # another user's
        pass
    return False


def file_count(folder: Path) -> int:
    """Returns the number of visible files in a folder; 0 if it cannot be read."""
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
    """Replaces inf and NaN by None, for JSON."""
    if isinstance(content, dict):
        return {key: finite(value) for key, value in content.items()}
    if isinstance(content, list | tuple):
        return [finite(value) for value in content]
    return None if isinstance(content, float) and not math.isfinite(content) else content


LFS_POINTER = b"version https://git-lfs"
"""First bytes of the pointer that Git LFS leaves in place of a file."""
LFS_REMEDY = "a Git LFS pointer, not the file itself: run 'git lfs pull' in its repository"


def is_lfs_pointer(path: Path) -> bool:
    """Returns whether a file is a pointer that Git LFS has not resolved."""
    with suppress(OSError), path.open("rb") as stream:
        return stream.read(len(LFS_POINTER)) == LFS_POINTER
    return False


def refuse_lfs_pointer(path: Path) -> None:
    """Raises InputError for a pointer that Git LFS has not resolved."""
    if is_lfs_pointer(path):
        raise InputError(f"'{path}' is {LFS_REMEDY}.")


def is_file(path: Path) -> bool:
    """Returns whether a file exists; False for impossible names, where `Path.is_file` may raise."""
    return os.path.isfile(path)


def write_json(path: Path, content: Any) -> None:
    """Writes JSON; inf and NaN become null, unknown objects text."""
    replace_file(path, json.dumps(finite(content), indent=2, default=str).encode())


def read_json(path: Path) -> Any:
    """Reads JSON in UTF-8, -16 or -32, with or without a byte order mark; OSError, ValueError: it is unreadable."""
    try:
        return json.loads(path.read_bytes())
    except RecursionError as error:
        raise ValueError("its brackets are nested too deeply") from error
    except ValueError as error:
        raise (ValueError(f"it is {LFS_REMEDY}") if is_lfs_pointer(path) else error) from None


def sidecars(folder: Path) -> list[Path]:
    """Returns the JSON files of a checkpoint folder, oldest first."""
    return sorted(path for path in folder.glob("step_*.json") if path.stem.removeprefix("step_").isdecimal())


def step_of(sidecar: Path) -> int:
    """Returns the step of a checkpoint."""
    return int(sidecar.stem.removeprefix("step_"))
