"""Scene formats, by which loaders recognise their folders."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True, kw_only=True)
class SceneFormat:
    """Description of a scene format, for `gsx scenes PATH`."""

    meaning: str
    """Name of the format in a few words."""
    sign: str
    """Characteristic file, without an article: 'transforms.json'."""
    recognise: Callable[[Path], bool]
    """Returns whether a folder has this format."""
    facts: Callable[[Path], Iterable[str]] = lambda path: ()
    """Returns lines on the content: label, blanks up to column 10, text; errors are reported as problems."""
    overrides: Callable[[Path], Mapping[str, str]] = lambda path: {}
    """Returns scene options that a folder needs in addition to its path."""
    quick: bool = True
    """True: loading takes only seconds, so `gsx scenes` may load it."""
