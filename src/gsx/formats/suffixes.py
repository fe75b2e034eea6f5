"""Suffixes of splat files."""

import difflib
import json
from contextlib import suppress
from pathlib import Path

from gsx.core.errors import CLOSE, InputError

WRITTEN = (".compressed.ply", ".ply", ".spz", ".sog", ".glb")
"""Suffixes that gsx writes, the longer of two matches first."""
SUFFIXES = (*WRITTEN, ".gltf", ".splat", ".ksplat")
"""Suffixes that gsx reads."""
META = "meta.json"
"""Description of an unbundled SOG, whose pictures lie in the same folder."""
READABLE = f"{', '.join(SUFFIXES)}, an unbundled SOG's {META} or its folder"
"""All kinds of splat files that gsx reads, for messages and help."""
STANDARD = ".ply"
"""Suffix of the lossless format."""
MOST_META = 1 << 24
"""Most bytes of a meta.json."""
SPZ_VERSIONS = (3, 4)
"""Versions of SPZ that gsx writes."""


def suffix_of(path: Path) -> str:
    """Returns which of SUFFIXES a name has, '' if none; `.sog` for META."""
    name = path.name.lower()
    if name == META:
        return ".sog"
    return next((suffix for suffix in SUFFIXES if name.endswith(suffix)), "")


def splat_file_at(path: Path) -> Path:
    """Returns the META in a folder of an unbundled SOG, any other path unchanged."""
    return path / META if is_sog_folder(path) else path


def is_sog_folder(path: Path) -> bool:
    """Returns whether a folder contains an unbundled SOG and is no run folder."""
    meta = path / META
    if not path.is_dir() or not meta.is_file() or (path / "config.yaml").exists():
        return False
    with suppress(OSError, ValueError, RecursionError):
        content = json.loads(meta.read_bytes()) if meta.stat().st_size <= MOST_META else None
        return isinstance(content, dict) and {"means", "scales", "quats"} <= content.keys()
    return False


def refuse_suffix(path: Path, others: tuple[str, ...] = ()) -> None:
    """Raises InputError for a suffix that gsx does not write; `others`: suffixes apart from splat files."""
    if path.name.lower() == META or suffix_of(path) not in WRITTEN:
        known = (*WRITTEN, *others)
        near = difflib.get_close_matches(path.suffix.lower(), known, n=1, cutoff=CLOSE)
        better = path.with_name(f"{path.stem or 'model'}{near[0] if near else STANDARD}")
        remedy = f". Did you mean {better}?" if near else f", name it {better}"
        raise InputError(f"{path} is not written: gsx writes {', '.join(known)} alone{remedy}")
