"""Which splat files are written and read, by the ends of their names."""

from pathlib import Path

from gsx.core.errors import InputError

SUFFIXES = (".compressed.ply", ".ply", ".spz", ".sog", ".glb")
"""The longer of two that fit first."""
STANDARD = ".ply"
"""Nothing is lost in it, and a backbone's own file is one."""


def suffix_of(path: Path) -> str:
    """Which of SUFFIXES a name has; empty: none."""
    return next((suffix for suffix in SUFFIXES if path.name.lower().endswith(suffix)), "")


def refuse_suffix(path: Path, others: tuple[str, ...] = ()) -> None:
    """Raise InputError if the name promises a format that is not written; `others`: what is written beside splats."""
    if not suffix_of(path):
        better = path.parent / f"{path.stem or 'model'}{STANDARD}"
        raise InputError(f"{path} is not written: gsx writes {', '.join((*SUFFIXES, *others))} alone, name it {better}")
