"""Splat files that are read and written, by the ends of their names."""

import json
from contextlib import suppress
from pathlib import Path

from gsx.core.errors import InputError

WRITTEN = (".compressed.ply", ".ply", ".spz", ".sog", ".glb")
"""Ends of the names of files that gsx writes; the longer of two that fit first."""
SUFFIXES = (*WRITTEN, ".gltf", ".splat", ".ksplat")
"""Ends of the names of files that gsx reads."""
META = "meta.json"
"""Describes an unbundled SOG: its pictures lie in the same folder."""
READABLE = f"{', '.join(SUFFIXES)}, an unbundled SOG's {META} or its folder"
"""All kinds of splat files that gsx reads, for messages and help."""
STANDARD = ".ply"
"""Nothing is lost in it, and a backbone's own file is one."""
MOST_META = 1 << 24
"""Bytes of a meta.json; those of SOG have a few thousand."""
SPZ_VERSIONS = (3, 4)
"""Versions of SPZ that are written."""


def suffix_of(path: Path) -> str:
    """Returns which of SUFFIXES a name has; empty if none. The META of an unbundled SOG counts as `.sog`."""
    name = path.name.lower()
    if name == META:
        return ".sog"
    return next((suffix for suffix in SUFFIXES if name.endswith(suffix)), "")


def splat_file_at(path: Path) -> Path:
    """Returns the META of a folder that holds an unbundled SOG; any other path as it is."""
    return path / META if is_sog_folder(path) else path


def is_sog_folder(path: Path) -> bool:
    """Returns whether a folder holds the META of an unbundled SOG; a run folder never does."""
    meta = path / META
    if not path.is_dir() or not meta.is_file() or (path / "config.yaml").exists():
        return False
    with suppress(OSError, ValueError, RecursionError):
        content = json.loads(meta.read_bytes()) if meta.stat().st_size <= MOST_META else None
        return isinstance(content, dict) and {"means", "scales", "quats"} <= content.keys()
    return False


def refuse_suffix(path: Path, others: tuple[str, ...] = ()) -> None:
    """Raises InputError if the name promises a format that gsx does not write; `others`: what it writes apart from
    splat files."""
    if path.name.lower() == META or suffix_of(path) not in WRITTEN:
        better = path.parent / f"{path.stem or 'model'}{STANDARD}"
        raise InputError(f"{path} is not written: gsx writes {', '.join((*WRITTEN, *others))} alone, name it {better}")
