"""The format of a splat file by its first bytes: names of files are changed by people and by programs."""

from pathlib import Path

from gsx.formats.ply import header_length
from gsx.formats.suffixes import STANDARD, suffix_of

MOST_HEADER = 1 << 16
"""Bytes within which the header of a splat file ends."""
FIRST_BYTES = {b"glTF": ".glb", b"PK\x03\x04": ".sog", b"\x1f\x8b\x08": ".spz", b"NGSP": ".spz"}
"""First bytes of each format that has some of its own, but for PLY; three of gzip, as a `.splat` may begin with two."""
PACKED_PROPERTY = b" packed_position"
"""A property that only compressed PLY has."""


def format_of(head: bytes, path: Path) -> str:
    """Returns which of SUFFIXES a file is, by its first bytes, or by its name where these show none."""
    if head.startswith(b"ply"):
        return ".compressed.ply" if PACKED_PROPERTY in head[: header_length(head)] else STANDARD
    named = suffix_of(path) or STANDARD
    named = ".glb" if named == ".gltf" else named  # one reader for both forms of glTF
    return next((kind for first, kind in FIRST_BYTES.items() if head.startswith(first)), named)
