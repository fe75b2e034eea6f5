"""Description of a scene format, by which a loader recognises its folders."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True, kw_only=True)
class SceneFormat:
    """What a loader knows of a folder before it loads it, for `gsx scenes PATH`."""

    meaning: str
    """What a folder of this format is, in a few words."""
    sign: str
    """What it is known by, without an article: 'transforms.json'."""
    recognise: Callable[[Path], bool]
    """Whether a folder can be read as this format."""
    facts: Callable[[Path], Iterable[str]] = lambda path: ()
    """Lines on its content: label, blanks up to column 10, text; an error that it raises is reported as a problem."""
    overrides: Callable[[Path], Mapping[str, str]] = lambda path: {}
    """Options of the scene that this folder needs, beside its path."""
    quick: bool = True
    """Whether loading takes seconds, so that `gsx scenes` may load it."""
