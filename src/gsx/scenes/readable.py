"""Check that photos can be decoded to their end, without decoding most of them."""

import os
from contextlib import suppress
from pathlib import Path
from typing import Any

from gsx.core.data.images import damaged, open_image, read_image, refuse_unusable
from gsx.core.data.resize import Size
from gsx.core.errors import InputError

PNG_END = b"IEND\xaeB`\x82"  # name and checksum of the last chunk
JPEG_END = b"\xff\xd9"
AVIF_BRANDS = (b"avif", b"avis")  # first brands of ISO base media files that are no HEIC


def readable_size(photo: Path) -> Size:
    """Return (width, height) of a photo as stored; InputError: it is no image, cut off, or of an unreadable kind."""
    refuse_heif(photo)
    reader = open_image(photo)
    spec, kind = reader.spec(), reader.format_name()
    refuse_unusable(photo, spec)
    if kind not in ("jpeg", "png") and not all(decodes(reader, spec, last) for last in (False, True)):
        raise damaged(photo, reader.geterror())
    reader.close()
    if kind in ("jpeg", "png") and may_be_cut(photo, kind):
        read_image(photo)
    return spec.width, spec.height


def refuse_heif(photo: Path) -> None:
    """Raise InputError for a HEIC or AVIF file of any name: phones and converters rename them to .jpg."""
    head = b""
    with suppress(OSError), photo.open("rb") as file:  # `open_image` reports files that cannot be opened
        head = file.read(12)
    if head[4:8] == b"ftyp":
        kind = "AVIF" if head[8:] in AVIF_BRANDS else "HEIC"
        raise InputError(f"Image '{photo}' is {kind} under another name, convert it to JPEG.")


def decodes(reader: Any, spec: Any, last: bool) -> bool:
    """Return whether the first or the last row or tile of a picture can be decoded."""
    if not spec.tile_width:
        return reader.read_scanline(spec.y + last * (spec.height - 1), spec.z, spec.format) is not None
    sides = (spec.width, spec.tile_width), (spec.height, spec.tile_height)
    x, y = (last * (side - 1) // tile * tile for side, tile in sides)
    return reader.read_tile(spec.x + x, spec.y + y, spec.z, spec.format) is not None


def may_be_cut(photo: Path, kind: str) -> bool:
    """Return whether a PNG lacks its last chunk at the end, or a JPEG the end mark of its last picture.

    A whole file with other bytes behind it may look cut as well.
    """
    end = PNG_END if kind == "png" else JPEG_END
    with photo.open("rb") as file:
        file.seek(-len(end), os.SEEK_END)
        if file.read() == end:  # as in nearly all: the rest need not be read
            return False
    if kind == "png":
        return True
    content = photo.read_bytes()
    return content.startswith(b"\xff\xd8") and content.rfind(JPEG_END) < content.rfind(b"\xff\xda")
