"""Size and losslessness of a WebP or PNG picture, without decoding it."""

import struct
from typing import NamedTuple

from gsx.core.errors import InputError

MOST_SIDE = 16383
"""Longest side of a WebP, px."""
PNG = b"\x89PNG\r\n\x1a\n"
MOST_CHUNKS = 64
"""Most chunks of a WebP before its pixels."""


class PictureHeader(NamedTuple):
    """Header of a picture."""

    width: int
    height: int
    lossless: bool


def header_of(content: bytes, name: str) -> PictureHeader:
    """Returns the header of a still picture."""
    try:
        if content.startswith(PNG):
            width, height, depth = struct.unpack_from(">IIB", content, 16)
            if content[12:16] != b"IHDR" or depth != 8:
                raise InputError(f"'{name}' is no PNG of 8 bits: export it anew")
            return PictureHeader(width, height, lossless=True)
        if content[:4] == b"RIFF" and content[8:12] == b"WEBP":
            return webp_header(content, name)
    except struct.error:
        raise InputError(f"'{name}' ends within its header: copy or export it anew") from None
    raise InputError(f"'{name}' is neither WebP nor PNG: export it anew")


def webp_header(content: bytes, name: str) -> PictureHeader:
    """Returns the header of a WebP from its first chunk of pixels; errors as `header_of`."""
    at, canvas = 12, None
    for _ in range(MOST_CHUNKS):
        kind, size = struct.unpack_from("<4sI", content, at)
        if kind == b"VP8X":
            canvas = tuple(1 + int.from_bytes(content[at + first : at + first + 3], "little") for first in (12, 15))
        elif kind in (b"VP8L", b"VP8 "):
            if kind == b"VP8L":
                _, packed = struct.unpack_from("<BI", content, at + 8)
                sides = 1 + (packed & 16383), 1 + (packed >> 14 & 16383)
            else:
                sides = tuple(side & 16383 for side in struct.unpack_from("<HH", content, at + 14))
            if canvas not in (None, sides):
                raise InputError(f"'{name}' has a canvas of other size than its pixels: export it anew")
            return PictureHeader(*sides, lossless=kind == b"VP8L")
        elif kind in (b"ANIM", b"ANMF"):
            raise InputError(f"'{name}' is an animation: export it anew")
        at += 8 + size + size % 2
    raise InputError(f"'{name}' has no pixels: copy or export it anew")
