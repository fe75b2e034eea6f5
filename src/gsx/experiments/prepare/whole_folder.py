"""Folders that appear whole or not at all."""

import os
import secrets
import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from gsx.core.errors import InputError
from gsx.core.files import expand_home, process_tag, read_json, remove_partial, sync_folder

MANIFEST = "prepared.json"


@contextmanager
def whole_folder(path: Path) -> Iterator[Path]:
    """Yield a temporary neighbour; rename it to `path`, which may be an empty folder, or delete it on an error."""
    path.parent.mkdir(parents=True, exist_ok=True)
    remove_partial(path.parent, below=False)
    temporary = path.with_name(f".{path.name}.{process_tag()}-{secrets.token_hex(4)}.partial")
    try:
        temporary.mkdir()
        yield temporary
        if path.is_dir():
            path.rmdir()
        os.replace(temporary, path)
        sync_folder(path.parent)
    except OSError as error:
        if error.filename == str(temporary):  # report the name that the user knows
            error.filename = str(path)
        raise
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def refuse_occupied(path: Path, prepared: bool = False) -> None:
    """Raise InputError for a path that is neither free nor an empty folder; `prepared`: nor a prepared one."""
    if path.is_dir():
        if any(path.iterdir()) and not (prepared and (path / MANIFEST).is_file()):
            raise InputError(f"--to {path} holds other files: choose a new folder")
    elif path.exists() or path.is_symlink():
        raise InputError(f"--to {path} is a file: choose a new folder")


def refuse_inside(path: Path, scene: str) -> None:
    """Raise InputError for a path inside of a scene's folder, where its photos would be searched."""
    if scene and expand_home(scene).resolve() in path.resolve().parents:
        raise InputError(f"--to {path} is inside of the scene's folder {scene}: choose a folder elsewhere")


def is_prepared(path: Path, manifest: Mapping[str, Any]) -> bool:
    """Return whether a folder was prepared with this manifest; InputError: with another, or it is unreadable."""
    file = path / MANIFEST
    if not file.is_file():
        return False
    try:
        earlier = read_json(file)
    except (OSError, ValueError) as error:
        raise InputError(f"'{file}' cannot be read ({error}): remove {path}, or choose another --to") from None
    if earlier == manifest:
        return True
    keys = sorted(manifest.keys() | earlier.keys()) if isinstance(earlier, dict) else []
    other = ", ".join(key for key in keys if earlier.get(key) != manifest.get(key)) or "its content"
    raise InputError(f"{path} was prepared with other settings ({other} differ): remove it, or choose another --to")
