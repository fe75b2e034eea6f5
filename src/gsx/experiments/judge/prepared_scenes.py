"""Scenes of folders that `gsx prepare` wrote, for other programs and for the comparison of their pictures."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from gsx.core.errors import InputError
from gsx.core.files import read_json
from gsx.core.ranges import ZOOMS
from gsx.experiments.judge.scene_figures import Subject
from gsx.experiments.prepare.prepare import FORMAT
from gsx.experiments.prepare.whole_folder import MANIFEST

LISTS = ("overrides", "zooms", "test")
"""Entries of a manifest that must be lists."""
AGAIN = "prepare the scene again by gsx prepare"


def prepared_subject(folder: Path, overrides: Sequence[str]) -> Subject:
    """Reads the manifest of a prepared folder; `overrides`: further settings.

    Raises:
        InputError: it is unreadable, of another version, or lacks something.
    """
    manifest = read_manifest(folder / MANIFEST)
    return Subject(
        overrides=(*map(str, manifest["overrides"]), *overrides),
        own=len(manifest["overrides"]),
        name=str(manifest.get("scene", "")),
        prepared_zooms=tuple(map(float, manifest["zooms"])),
        aliases={str(view["name"]): str(view["file"]) for view in manifest["test"]},
        prepared=str(folder),
    )


def read_manifest(file: Path) -> Mapping[str, Any]:
    """Reads a manifest; InputError as `prepared_subject`."""
    try:
        manifest = read_json(file)
    except (OSError, ValueError) as error:
        raise InputError(f"'{file}' cannot be read ({error}): {AGAIN}") from None
    if not isinstance(manifest, dict):
        raise InputError(f"'{file}' is no manifest: {AGAIN}")
    if manifest.get("format") != FORMAT:
        raise InputError(f"'{file}' has format {manifest.get('format')}, this gsx reads {FORMAT}: {AGAIN}")
    for name in LISTS:
        if not isinstance(manifest.get(name), list) or not manifest[name]:
            raise InputError(f"'{file}' lacks '{name}': {AGAIN}")
    if not all(isinstance(view, dict) and {"name", "file"} <= view.keys() for view in manifest["test"]):
        raise InputError(f"'{file}' lists test views without name and file: {AGAIN}")
    if odd := [zoom for zoom in manifest["zooms"] if not isinstance(zoom, int | float) or zoom not in ZOOMS]:
        raise InputError(f"'{file}' has the zoom {odd[0]}: give numbers {ZOOMS}, or {AGAIN}")
    return manifest
