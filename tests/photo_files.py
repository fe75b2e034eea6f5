"""Photo files as phones, cameras and converters write them, made of pixels."""

import struct
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio


def write_pixels(path: Path, pixels: np.ndarray, attributes: dict[str, Any]) -> None:
    """Write [H, W, C] with attributes by OpenImageIO's names, alpha straight."""
    buffer = oiio.ImageBuf(np.ascontiguousarray(pixels))
    for name, value in ({"oiio:UnassociatedAlpha": 1} | attributes).items():
        buffer.specmod().attribute(name, value)
    assert buffer.write(str(path)), buffer.geterror()


def lossless_webp(pixels: np.ndarray, scratch: Path) -> bytes:
    """The bytes of a WebP file; `scratch` is a place for files."""
    file = scratch / "scratch.webp"
    write_pixels(file, pixels, {"Compression": "lossless"})
    content = file.read_bytes()
    file.unlink()
    return content


def exif_of(attributes: dict[str, Any], scratch: Path) -> bytes:
    """EXIF with these attributes, as a JPEG has it behind its mark."""
    file = scratch / "scratch.jpg"
    write_pixels(file, np.zeros((8, 8, 3), np.uint8), attributes)
    jpeg = file.read_bytes()
    file.unlink()
    start = jpeg.index(b"Exif\0\0")
    (length,) = struct.unpack(">H", jpeg[start - 2 : start])
    return jpeg[start + 6 : start + length - 2]


def write_webp_with_exif(path: Path, pixels: np.ndarray, attributes: dict[str, Any]) -> None:
    """Write a lossless WebP in its extended form, which OpenImageIO reads and does not write."""
    height, width = pixels.shape[:2]
    head = struct.pack("<I", 8) + (width - 1).to_bytes(3, "little") + (height - 1).to_bytes(3, "little")
    exif = exif_of(attributes, path.parent)
    body = b"WEBPVP8X" + struct.pack("<I", 10) + head + lossless_webp(pixels, path.parent)[12:]
    body += b"EXIF" + struct.pack("<I", len(exif)) + exif + b"\0" * (len(exif) % 2)
    path.write_bytes(b"RIFF" + struct.pack("<I", len(body)) + body)
