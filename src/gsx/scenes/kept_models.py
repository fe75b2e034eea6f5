"""COLMAP models that take minutes to make, kept in the cache."""

import os
import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

from gsx.core.files import process_tag
from gsx.engine.cache import add_to_manifest, is_intact, make_folder, read_manifest


def kept_model(final: Path, make: Callable[[Path], Any]) -> Path:
    """Return the folder of a model in the cache; where it is not there whole, it is made.

    make: returns the pycolmap.Reconstruction, and has an empty folder for its files.
    """
    if intact(final):
        return final
    make_folder(final.parent)
    with tempfile.TemporaryDirectory(".partial", f".{final.name}.{process_tag()}-", final.parent) as work:
        made = make(Path(work))
        model = make_folder(Path(work) / "model")
        made.write_binary(model)
        add_to_manifest(*model.iterdir())
        _publish(model, final)
    return final


def intact(final: Path) -> bool:
    """Return whether there is a model in the cache, and all its files are as they were written."""
    names = read_manifest(final)
    return bool(names) and all(is_intact(final / name) for name in names)


def _publish(model: Path, final: Path) -> None:
    """Move the finished model to its place, unless another process has finished the same in the meantime."""
    if final.is_dir() and not intact(final):
        shutil.rmtree(final, ignore_errors=True)
    try:
        os.rename(model, final)
    except OSError:
        if not intact(final):
            raise
