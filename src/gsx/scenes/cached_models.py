"""COLMAP models in the cache, which take minutes to make."""

import os
import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

from gsx.core.files import process_tag
from gsx.engine.cache import add_to_manifest, is_intact, make_folder, read_manifest


def cached_model(final: Path, make: Callable[[Path], Any]) -> Path:
    """Return the folder of a model in the cache; make the model if it is not there whole.

    `make` returns the pycolmap.Reconstruction; its argument is an empty folder for intermediate files.
    """
    if holds_whole_model(final):
        return final
    make_folder(final.parent)
    with tempfile.TemporaryDirectory(".partial", f".{final.name}.{process_tag()}-", final.parent) as work:
        made = make(Path(work))
        model = make_folder(Path(work) / "model")
        made.write_binary(model)
        add_to_manifest(*model.iterdir())
        if final.is_dir() and not holds_whole_model(final):
            shutil.rmtree(final, ignore_errors=True)
        try:
            os.rename(model, final)
        except OSError:  # another process has finished the same in the meantime
            if not holds_whole_model(final):
                raise
    return final


def holds_whole_model(final: Path) -> bool:
    """Return whether the cache holds a model whose files are all as they were written."""
    names = read_manifest(final)
    return bool(names) and all(is_intact(final / name) for name in names)
