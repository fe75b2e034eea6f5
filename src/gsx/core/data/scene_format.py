"""How a loader tells which folders are for it."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True, kw_only=True)
class SceneFormat:
    """What a loader knows of a folder before it loads it; `gsx scenes PATH` asks all loaders."""

    meaning: str
    """What a folder of this format is, in a few words."""
    sign: str
    """What it is known by, without an article: 'transforms.json'."""
    recognise: Callable[[Path], bool]
    """Whether a folder can be read as this format."""
    facts: Callable[[Path], Iterable[str]] = lambda path: ()
    """Lines on what lies there, `label`, blanks up to column 10, text; an error they raise is told as a problem."""
    overrides: Callable[[Path], Mapping[str, str]] = lambda path: {}
    """Options of the scene that this folder needs, beside its path."""
    quick: bool = True
    """Whether loading takes seconds, so that it can be described by what the loader makes of it."""
