"""Splat files as other programs write them: SOG pixel by pixel, rows of `.splat`, sections of `.ksplat`."""

import io
import json
import struct
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

Pictures = dict[str, list[tuple[int, ...]]]
Sog = tuple[dict[str, Any], Pictures]
EMPTY: list[tuple[int, ...]] = [(0, 0, 0, 0)] * 174
"""Rest of a palette of 64 vectors of one band, of which six are there."""


def version_2() -> Sog:
    """Two splats of degree 1, in pictures of 2 x 1 pixels; the second has vector 5 of the palette."""
    code = [-4.0, -2.0, 1.0, -1.0]
    meta = {
        "version": 2, "count": 2,
        "means": {"mins": [-2, -2, -2], "maxs": [2, 2, 2], "files": ["means_l.webp", "means_u.webp"]},
        "scales": {"codebook": code, "files": ["scales.webp"]},
        "quats": {"files": ["quats.webp"]},
        "sh0": {"codebook": code, "files": ["sh0.webp"]},
        "shN": {"count": 6, "bands": 1, "codebook": code, "files": ["shN_centroids.webp", "shN_labels.webp"]},
    }  # fmt: skip
    pictures: Pictures = {
        "means_l.webp": [(0x5C, 0xB0, 0xF3, 255), (0, 0xFF, 0, 255)],
        "means_u.webp": [(0xAC, 0x39, 0x99, 255), (0, 0xFF, 0, 255)],
        "scales.webp": [(0, 1, 1, 255), (1, 1, 1, 255)],
        "quats.webp": [(128, 236, 128, 252), (10, 20, 30, 7)],
        "sh0.webp": [(2, 3, 1, 51), (3, 3, 3, 255)],
        "shN_centroids.webp": [(2, 2, 2, 255)] * 15 + [(0, 1, 2, 255), (1, 2, 3, 255), (2, 3, 0, 255)] + EMPTY,
        "shN_labels.webp": [(0, 0, 0, 255), (5, 0, 0, 255)],
    }
    return meta, pictures


def version_1() -> Sog:
    """The same positions, quaternions and labels; other values are bytes between a least and a most value."""
    _, pictures = version_2()
    meta: dict[str, Any] = {
        "means": {"shape": [2, 3], "dtype": "float32", "mins": [-2, -2, -2], "maxs": [2, 2, 2],
                  "files": ["means_l.webp", "means_u.webp"]},
        "scales": {"shape": [2, 3], "dtype": "float32", "mins": [-5.1, -5.1, -5.1], "maxs": [0, 0, 0],
                   "files": ["scales.webp"]},
        "quats": {"shape": [2, 4], "dtype": "uint8", "encoding": "quaternion_packed", "files": ["quats.webp"]},
        "sh0": {"shape": [2, 1, 4], "dtype": "float32", "mins": [-1, -1, -1, -4], "maxs": [1, 1, 1, 4],
                "files": ["sh0.webp"]},
        "shN": {"shape": [2, 9], "dtype": "float32", "mins": -1.0, "maxs": 1.0, "quantization": 8,
                "files": ["shN_centroids.webp", "shN_labels.webp"]},
    }  # fmt: skip
    pictures["scales.webp"] = [(51, 255, 0, 255), (51, 51, 51, 255)]
    pictures["sh0.webp"] = [(255, 0, 51, 255), (51, 51, 51, 0)]
    pictures["shN_centroids.webp"] = [(0,) * 4] * 15 + [(255, 0, 51, 255)] * 3 + EMPTY
    return meta, pictures


def packed(pixels: list[tuple[int, ...]], kind: str = "WEBP", size: tuple[int, int] | None = None, **how: Any) -> bytes:
    """A picture of one row, or of another size."""
    width, height = size or (len(pixels), 1)
    image, out = Image.fromarray(np.array(pixels, np.uint8).reshape(height, width, 4)), io.BytesIO()
    image.save(out, kind, **({"lossless": True, "exact": True} if kind == "WEBP" else {}) | how)
    return out.getvalue()


def files_of(sog: Sog) -> dict[str, bytes]:
    meta, pictures = sog
    return {"meta.json": json.dumps(meta).encode()} | {name: packed(pixels) for name, pixels in pictures.items()}


def zipped(path: Path, files: dict[str, bytes], folder: str = "", how: int = zipfile.ZIP_STORED) -> Path:
    with zipfile.ZipFile(path, "w", how) as archive:
        for name, content in files.items():
            archive.writestr(folder + name, content)
    return path


def unpacked(folder: Path, files: dict[str, bytes]) -> Path:
    folder.mkdir()
    for name, content in files.items():
        (folder / name).write_bytes(content)
    return folder


def splat(mean: float = 0.0, scale: float = 0.1, quat: Sequence[int] = (255, 128, 128, 128)) -> bytes:
    return struct.pack("<6f8B", mean, 0, 0, scale, 0.1, 0.1, 10, 20, 30, 40, *quat)


LEVELS = {0: "<f4", 1: "<f2", 2: "<f2"}
"""Types of scales and quaternions by level."""


def header(sections: int, splats: int, level: int, most: int | None = None, version: tuple[int, int] = (0, 1)) -> bytes:
    most = splats if most is None else most
    return struct.pack("<BBxxIIIIHxx3f2f", *version, sections, sections, most, splats, level, 0, 0, 0, -2, 3).ljust(
        4096, b"\0"
    )


def section(splats: int, degree: int = 0, size: int = 0, full: int = 0, partial: int = 0, block: float = 0.0) -> bytes:
    buckets, bucket_bytes, reach = full + partial, 12 * bool(full + partial), 32767 * bool(full + partial)
    values = splats, splats, size, buckets, block, bucket_bytes, reach, 0, full, partial, degree
    return struct.pack("<IIIIfHxxIIIIH", *values).ljust(1024, b"\0")


def row(level: int, mean: Sequence[float], rest: Sequence[float] = ()) -> bytes:
    """A splat; mean: in level 0 numbers, else steps; rest: in level 2 bytes."""
    means = np.array(mean, "<f4" if level == 0 else "<u2").tobytes()
    shape = np.array([0.25, 0.5, 1, 0.6, 0, -0.8, 0], LEVELS[level]).tobytes()
    return means + shape + bytes([255, 0, 51, 204]) + np.array(rest, ("<f4", "<f2", "u1")[level]).tobytes()


def whole(level: int = 1) -> bytearray:
    content = header(1, 2, level) + section(2, size=2, full=1, block=5) + struct.pack("<3f", 0, 0, 0)
    return bytearray(content + 2 * row(level, (32767,) * 3))
