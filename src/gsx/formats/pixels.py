"""Size and losslessness of a WebP or PNG picture, from its first bytes: no pixel is unpacked."""

import struct
from dataclasses import dataclass

from gsx.core.errors import InputError

MOST_SIDE = 16383
"""Longest side of a WebP, px."""
PNG = b"\x89PNG\r\n\x1a\n"
MOST_CHUNKS = 64
"""Chunks of a WebP before its pixels."""


@dataclass(frozen=True, kw_only=True)
class PictureHeader:
    """Facts that the first bytes of a picture state."""

    width: int
    height: int
    lossless: bool


def header_of(content: bytes, name: str) -> PictureHeader:
    """Returns the header of a still picture."""
    try:
        if content.startswith(PNG):
            return png_header(content, name)
        if content[:4] == b"RIFF" and content[8:12] == b"WEBP":
            return webp_header(content, name)
    except struct.error:
        raise InputError(f"'{name}' ends within its header: copy or export it anew") from None
    raise InputError(f"'{name}' is neither WebP nor PNG: export it anew")


def png_header(content: bytes, name: str) -> PictureHeader:
    """Returns the header of a PNG; errors as `header_of`."""
    width, height, depth = struct.unpack_from(">IIB", content, 16)
    if content[12:16] != b"IHDR" or depth != 8:
        raise InputError(f"'{name}' is no PNG of 8 bits: export it anew")
    return PictureHeader(width=width, height=height, lossless=True)


def webp_header(content: bytes, name: str) -> PictureHeader:
    """Returns the header of a WebP, whose pixels follow chunks of other kinds; errors as `header_of`."""
    at, canvas = 12, None
    for _ in range(MOST_CHUNKS):
        kind, size = struct.unpack_from("<4sI", content, at)
        if kind == b"VP8X":
            canvas = tuple(1 + int.from_bytes(content[at + first : at + first + 3], "little") for first in (12, 15))
        elif kind == b"VP8L":
            _, packed = struct.unpack_from("<BI", content, at + 8)
            size_of = 1 + (packed & 16383), 1 + (packed >> 14 & 16383)
            return still(size_of, canvas, name, lossless=True)
        elif kind == b"VP8 ":
            width, height = struct.unpack_from("<HH", content, at + 14)
            return still((width & 16383, height & 16383), canvas, name, lossless=False)
        elif kind in (b"ANIM", b"ANMF"):
            raise InputError(f"'{name}' is an animation: export it anew")
        at += 8 + size + size % 2
    raise InputError(f"'{name}' has no pixels: copy or export it anew")


def still(size: tuple[int, int], canvas: tuple[int, ...] | None, name: str, lossless: bool) -> PictureHeader:
    """Returns the header of a picture that fills its canvas."""
    if canvas is not None and canvas != size:
        raise InputError(f"'{name}' has a canvas of other size than its pixels: export it anew")
    return PictureHeader(width=size[0], height=size[1], lossless=lossless)
