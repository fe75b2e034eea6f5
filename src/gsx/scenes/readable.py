"""Photos that can be decoded to their end, which is checked without decoding most of them."""

import os
from contextlib import suppress
from pathlib import Path
from typing import Any

from gsx.core.data.images import damaged, open_image, read_image, refuse_unusable
from gsx.core.data.resize import Size
from gsx.core.errors import InputError

PNG_END = b"IEND\xaeB`\x82"
"""The last eight bytes of every PNG: name and checksum of its last chunk."""
HEIF_BRANDS = {b"avif": "AVIF", b"avis": "AVIF"}
"""First brands of ISO base media files that are no HEIC."""


def readable_size(photo: Path) -> Size:
    """Return (width, height) of a photo, as stored, that gsx can decode.

    Raises:
        InputError: the file is no image, is cut off, or holds inks, channels or a compression that gsx does not read.
    """
    refuse_heif(photo)
    reader = open_image(photo)
    spec, kind = reader.spec(), reader.format_name()
    refuse_unusable(photo, spec)
    if kind not in ("jpeg", "png") and not all(decodes(reader, spec, last) for last in (False, True)):
        raise damaged(photo, reader.geterror())
    reader.close()
    if (kind == "jpeg" and may_be_cut(photo)) or (kind == "png" and lacks_end(photo)):
        read_image(photo)
    return spec.width, spec.height


def refuse_heif(photo: Path) -> None:
    """Raise InputError for a HEIC or AVIF file of any name: phones and converters rename them to .jpg."""
    head = b""
    with suppress(OSError), photo.open("rb") as file:  # the reader of pictures reports what cannot be opened
        head = file.read(12)
    if head[4:8] == b"ftyp":
        kind = HEIF_BRANDS.get(head[8:], "HEIC")
        raise InputError(f"Image '{photo}' is {kind} under another name, convert it to JPEG.")


def decodes(reader: Any, spec: Any, last: bool) -> bool:
    """Return whether the first or the last row or tile of a picture can be decoded."""
    if not spec.tile_width:
        return reader.read_scanline(spec.y + last * (spec.height - 1), spec.z, spec.format) is not None
    sides = (spec.width, spec.tile_width), (spec.height, spec.tile_height)
    x, y = (last * (side - 1) // tile * tile for side, tile in sides)
    return reader.read_tile(spec.x + x, spec.y + y, spec.z, spec.format) is not None


def may_be_cut(photo: Path) -> bool:
    """Return whether a JPEG has no mark of its end behind the begin of its last picture.

    Other bytes behind a whole one may look so.
    """
    with photo.open("rb") as file:
        file.seek(-2, os.SEEK_END)
        if file.read() == b"\xff\xd9":  # as nearly all end: the rest need not be read
            return False
    content = photo.read_bytes()
    return content.startswith(b"\xff\xd8") and content.rfind(b"\xff\xd9") < content.rfind(b"\xff\xda")


def lacks_end(photo: Path) -> bool:
    """Return whether a PNG does not end as all do; other bytes may lie behind a whole one."""
    with photo.open("rb") as file:
        file.seek(-len(PNG_END), os.SEEK_END)
        return file.read() != PNG_END
