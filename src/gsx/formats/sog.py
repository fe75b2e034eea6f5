"""Writing of SOG 2 by PlayCanvas: a ZIP of meta.json and lossless WebP pictures (playcanvas/splat-transform, MIT).

A pixel is a splat in every picture. Axes are those of training worlds, as in splat-transform. Pillow writes WebP
(`gsx[sog]`). `sog_reading` reads both versions.
"""

import io
import json
import math
import zipfile
from typing import Any

import numpy as np
import torch

from gsx.core.packages import require
from gsx.core.shapes import Float, Int, UInt8
from gsx.formats.arrays import Arrays, rounded, smallest_three
from gsx.formats.compressed_ply import morton_order

NUMBER_ROUNDS, VECTOR_ROUNDS = 20, 8
"""Rounds of Lloyd's algorithm."""
CHUNK_VALUES = 1 << 24
"""Distances held at once."""
VERSION = 2
BOOK = 256
"""Entries of a code book of numbers."""
PALETTE = 64
"""Vectors of higher bands in a row of their picture; at most 1024 rows."""
FIRST_LARGEST = 252
"""Alpha of a quaternion whose first component is the largest."""
HIGHER = ("shN_centroids.webp", "shN_labels.webp")
COEFFICIENTS = {1: 3, 2: 8, 3: 15}


def number_book(values: Float[np.ndarray, "V"], size: int) -> Float[np.ndarray, "size"]:
    """Returns an ascending code book by k-means, from quantiles (dense values) and even steps (sparse ones)."""
    ordered, half = np.sort(values), size // 2
    even = np.linspace(ordered[0], ordered[-1], size - half)
    book = np.sort(np.concatenate([np.quantile(ordered, (np.arange(half) + 0.5) / half), even]))
    sums = np.concatenate([[0.0], np.cumsum(ordered)])
    for _ in range(NUMBER_ROUNDS):
        ends = np.concatenate([[0], np.searchsorted(ordered, (book[1:] + book[:-1]) / 2), [len(ordered)]])
        counts = np.diff(ends)
        book = np.where(counts > 0, (sums[ends[1:]] - sums[ends[:-1]]) / np.maximum(counts, 1), book)
    return book


def nearest_number(values: Float[np.ndarray, "..."], book: Float[np.ndarray, "size"]) -> Int[np.ndarray, "..."]:
    """Returns the index of the nearest number in an ascending book."""
    return np.searchsorted((book[1:] + book[:-1]) / 2, values)


def vector_book(
    vectors: Float[np.ndarray, "N D"], size: int
) -> tuple[Float[np.ndarray, "size D"], Int[np.ndarray, "N"]]:
    """Returns (code book, row of the nearest entry of each vector) by k-means from evenly spaced rows."""
    points = torch.from_numpy(vectors.astype(np.float32))
    book = points[torch.arange(size) * len(points) // size].clone()
    labels = nearest_vector(points, book)
    for _ in range(VECTOR_ROUNDS if size < len(points) else 0):
        counts = torch.bincount(labels, minlength=size)
        sums = torch.zeros_like(book).index_add_(0, labels, points)
        book = torch.where(counts[:, None] > 0, sums / counts.clamp_min(1)[:, None], book)
        labels = nearest_vector(points, book)
    return book.numpy().astype(float), labels.numpy()


def nearest_vector(points: Float[torch.Tensor, "N D"], book: Float[torch.Tensor, "K D"]) -> Int[torch.Tensor, "N"]:
    """Returns the row of the nearest vector in a book."""
    squares = book.square().sum(1)
    rows = max(1, CHUNK_VALUES // len(book))
    return torch.cat([(squares - 2 * part @ book.T).argmin(1) for part in points.split(rows)])


def encode_sog(arrays: Arrays, antialiased: bool = False) -> bytes:
    """Encodes a file of at least one splat; ConfigError: Pillow is not installed.

    antialiased: opacities are compensated in renders, as in models of Mip-Splatting.
    """
    order = morton_order(arrays.means)
    logs = signed_log(arrays.means[order])
    least, most = logs.min(0), logs.max(0)
    words = mean_words(logs, least, most)
    scales, constants = (number_book(part.ravel(), BOOK) for part in (arrays.log_scales, arrays.sh_dc))
    meta: dict[str, Any] = {
        "version": VERSION,
        "asset": {"generator": "gsx"},
        "count": len(arrays.means),
        "means": {"mins": least.tolist(), "maxs": most.tolist(), "files": ["means_l.webp", "means_u.webp"]},
        "scales": {"codebook": scales.tolist(), "files": ["scales.webp"]},
        "quats": {"files": ["quats.webp"]},
        "sh0": {"codebook": constants.tolist(), "files": ["sh0.webp"]},
    } | ({"model": "antialiased"} if antialiased else {})
    pictures = {
        "means_l.webp": raster(with_alpha(words & 255)),
        "means_u.webp": raster(with_alpha(words >> 8)),
        "scales.webp": raster(with_alpha(nearest_number(arrays.log_scales[order], scales))),
        "quats.webp": raster(quaternion_bytes(arrays.quats[order])),
        "sh0.webp": raster(
            with_alpha(nearest_number(arrays.sh_dc[order], constants), rounded(255 * arrays.opacities[order]))
        ),
    }
    if arrays.sh_rest.shape[1]:
        more, meta["shN"] = higher_bands(arrays.sh_rest[order])
        pictures |= more
    return zipped(meta, pictures)


def signed_log(values: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
    """Computes sign(x) ln(1 + |x|)."""
    return np.sign(values) * np.log1p(np.abs(values))


def mean_words(
    logs: Float[np.ndarray, "N 3"], least: Float[np.ndarray, "3"], most: Float[np.ndarray, "3"]
) -> Int[np.ndarray, "N 3"]:
    """Quantises logarithms of positions to 16 bits."""
    span = np.where(most > least, most - least, 1.0)
    return rounded(65535 * ((logs - least) / span)).clip(0, 65535).astype(np.int64)


def quaternion_bytes(quats: Float[np.ndarray, "N 4"]) -> UInt8[np.ndarray, "N 4"]:
    """Packs the three smallest of (w, x, y, z), and in alpha the index of the largest."""
    largest, three = smallest_three(quats)
    return with_alpha(rounded(255 * (three * 0.5**0.5 + 0.5)).clip(0, 255), FIRST_LARGEST + largest)


def with_alpha(
    colours: Float[np.ndarray, "N 3"] | Int[np.ndarray, "N 3"], alpha: Any = 255
) -> UInt8[np.ndarray, "N 4"]:
    """Puts colours and alpha together as RGBA."""
    pixels = np.empty((len(colours), 4), np.uint8)
    pixels[:, :3], pixels[:, 3] = colours, alpha
    return pixels


def raster(pixels: UInt8[np.ndarray, "N 4"]) -> UInt8[np.ndarray, "H W 4"]:
    """Lays out a picture with splat i at pixel i, about square, with spare pixels at the end."""
    width = 4 * math.ceil(math.sqrt(len(pixels)) / 4)
    height = 4 * math.ceil(len(pixels) / width / 4)
    whole = np.zeros((width * height, 4), np.uint8)
    whole[: len(pixels)] = pixels
    return whole.reshape(height, width, 4)


def higher_bands(rest: Float[np.ndarray, "N B 3"]) -> tuple[dict[str, UInt8[np.ndarray, "H W 4"]], dict[str, Any]]:
    """Returns (pictures, entry of meta.json): a palette of vectors, and which of them each splat has."""
    count, coefficients, _ = rest.shape
    size = min(count, int(min(PALETTE, 2.0 ** math.floor(math.log2(count / 1024))) * 1024)) or 1
    vectors, labels = vector_book(rest.reshape(count, -1), size)
    book = number_book(vectors.ravel(), BOOK)
    rows = math.ceil(size / PALETTE)
    palette = np.zeros((rows * PALETTE, coefficients, 3), np.int64)
    palette[:size] = nearest_number(vectors, book).reshape(size, coefficients, 3)
    centroids = with_alpha(palette.reshape(-1, 3)).reshape(rows, PALETTE * coefficients, 4)
    numbers = np.stack([labels & 255, labels >> 8, np.zeros_like(labels)], 1)
    bands = {value: band for band, value in COEFFICIENTS.items()}[coefficients]
    entry = {"count": size, "bands": bands, "codebook": book.tolist(), "files": list(HIGHER)}
    return {HIGHER[0]: centroids, HIGHER[1]: raster(with_alpha(numbers))}, entry


def zipped(meta: dict[str, Any], pictures: dict[str, UInt8[np.ndarray, "H W 4"]]) -> bytes:
    """Packs the archive; nothing in it depends on the time."""
    require("a .sog file", ("PIL",), "gsx[sog]")
    from PIL import Image

    whole = io.BytesIO()
    with zipfile.ZipFile(whole, "w") as archive:  # WebP is packed already
        archive.writestr(zipfile.ZipInfo("meta.json"), json.dumps(meta))
        for name, pixels in pictures.items():
            packed = io.BytesIO()
            Image.fromarray(pixels).save(packed, "WEBP", lossless=True, exact=True)
            archive.writestr(zipfile.ZipInfo(name), packed.getvalue())
    return whole.getvalue()
