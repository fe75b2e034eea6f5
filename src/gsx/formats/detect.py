"""Format of a splat file by its first bytes, because file names are unreliable."""

from pathlib import Path

from gsx.formats.ply import header_length
from gsx.formats.suffixes import STANDARD, suffix_of

MOST_HEADER = 1 << 16
"""Most bytes of a splat file's header."""
FIRST_BYTES = {b"glTF": ".glb", b"PK\x03\x04": ".sog", b"\x1f\x8b\x08": ".spz", b"NGSP": ".spz"}
"""First bytes of formats other than PLY; three of gzip, because a `.splat` may begin with two of them."""
PACKED_PROPERTY = b" packed_position"
"""A property that only compressed PLY has."""


def format_of(head: bytes, path: Path) -> str:
    """Returns the format, one of SUFFIXES, by the first bytes, else by the name."""
    if head.startswith(b"ply"):
        return ".compressed.ply" if PACKED_PROPERTY in head[: header_length(head)] else STANDARD
    named = suffix_of(path) or STANDARD
    named = ".glb" if named == ".gltf" else named  # one reader for both forms of glTF
    return next((kind for first, kind in FIRST_BYTES.items() if head.startswith(first)), named)
