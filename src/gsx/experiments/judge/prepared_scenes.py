"""Scenes of folders that `gsx prepare` wrote, for other programs and for the comparison of their pictures."""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from gsx.core.errors import ConfigError, InputError
from gsx.core.files import read_json
from gsx.core.ranges import ZOOMS
from gsx.experiments.judge.scene_figures import Subject
from gsx.experiments.prepare.prepare import FORMAT
from gsx.experiments.prepare.whole_folder import MANIFEST

LISTS = ("overrides", "zooms", "test")
"""Entries of a manifest that must be lists."""
OF_SCENE, PLACE, MEMORY = "scene.", "scene.path", "scene.cache_gb"
"""Beginning of the settings of a scene; its folder and memory, which may be others where pictures are compared."""
AGAIN = "prepare the scene again by gsx prepare"


def prepared_subject(folder: Path, overrides: Sequence[str]) -> Subject:
    """Reads the manifest of a prepared folder; `overrides`: further settings.

    Raises:
        InputError: it is unreadable, of another version, or lacks something.
    """
    manifest = read_manifest(folder / MANIFEST)
    own, chosen = values_by_key(map(str, manifest["overrides"])), values_by_key(overrides)
    refuse_other_scene(folder, own, chosen)
    refuse_vanished(folder, own | chosen)
    return Subject(
        overrides=(*map(str, manifest["overrides"]), *overrides),
        own=len(manifest["overrides"]),
        name=str(manifest.get("scene", "")),
        prepared_zooms=tuple(map(float, manifest["zooms"])),
        aliases={str(view["name"]): str(view["file"]) for view in manifest["test"]},
        prepared=str(folder),
    )


def values_by_key(words: Iterable[str]) -> dict[str, str]:
    """Returns the text of each setting by its key."""
    return {key.lstrip("+"): value for key, _, value in (word.partition("=") for word in words)}


def refuse_other_scene(folder: Path, prepared: Mapping[str, str], chosen: Mapping[str, str]) -> None:
    """Raises ConfigError for settings that make another scene of a prepared one."""
    for key, value in chosen.items():
        if key.startswith(OF_SCENE) and key not in (PLACE, MEMORY) and prepared.get(key) != value:
            before = f"with {key}={prepared[key]}" if key in prepared else f"without {key}"
            raise ConfigError(
                f"'{folder}' was prepared {before}: leave out {key}={value}, or prepare another folder with it"
            )


def refuse_vanished(folder: Path, settings: Mapping[str, str]) -> None:
    """Raises InputError if the photos that a scene was prepared from are no longer there."""
    place = settings.get(PLACE, "").strip("'\"")
    if place and not Path(place).exists():
        raise InputError(
            f"'{folder}' was prepared from '{place}', which is not there: say where its photos are by {PLACE}=FOLDER"
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
