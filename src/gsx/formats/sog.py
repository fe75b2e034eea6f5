"""SOG, version 2: a ZIP of lossless WebP pictures and meta.json, of PlayCanvas (playcanvas/splat-transform, MIT).

A pixel is a splat in every picture. Axes are those of training worlds, as splat-transform writes them. WebP is written
and read by Pillow (`gsx[sog]`).
"""

import io
import json
import math
import zipfile
from pathlib import Path
from typing import Any

import numpy as np

from gsx.core.errors import InputError
from gsx.core.packages import require
from gsx.core.shapes import Float, Int, UInt8
from gsx.formats.arrays import Arrays, from_smallest_three, smallest_three
from gsx.formats.clusters import nearest_number, number_book, vector_book
from gsx.formats.compressed_ply import morton_order

VERSION = 2
BOOK = 256
"""Entries of a code book of numbers."""
PALETTE = 64
"""Vectors of higher bands in a row of their picture; and at most so many times 1024 in all."""
FIRST_LARGEST = 252
"""Alpha of quaternions whose first component is the largest."""
MOST_SPLATS = 1 << 26
HIGHER = ("shN_centroids.webp", "shN_labels.webp")
COEFFICIENTS = {1: 3, 2: 8, 3: 15}


def encode_sog(arrays: Arrays, antialiased: bool = False) -> bytes:
    """A file. antialiased: to be drawn with compensated opacities, as models of Mip-Splatting.

    Raises:
        InputError: there are no splats.
        ConfigError: Pillow is not installed.
    """
    count = len(arrays.means)
    if count == 0:
        raise InputError("SOG holds no empty scenes: the model has no splats")
    order = morton_order(arrays.means)
    logs = signed_log(arrays.means[order])
    least, most = logs.min(0), logs.max(0)
    words = mean_words(logs, least, most)
    scales, constants = (number_book(part.ravel(), BOOK) for part in (arrays.log_scales, arrays.sh_dc))
    meta: dict[str, Any] = {
        "version": VERSION,
        "asset": {"generator": "gsx"},
        "count": count,
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
            with_alpha(nearest_number(arrays.sh_dc[order], constants), np.trunc(255 * arrays.opacities[order]))
        ),
    }
    if arrays.sh_rest.shape[1]:
        more, meta["shN"] = higher_bands(arrays.sh_rest[order])
        pictures |= more
    return zipped(meta, pictures)


def signed_log(values: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
    """sign(x) ln(1 + |x|)."""
    return np.sign(values) * np.log1p(np.abs(values))


def mean_words(
    logs: Float[np.ndarray, "N 3"], least: Float[np.ndarray, "3"], most: Float[np.ndarray, "3"]
) -> Int[np.ndarray, "N 3"]:
    """Logarithms of positions in 16 bits."""
    span = np.where(most > least, most - least, 1.0)
    return np.trunc(65535 * ((logs - least) / span)).clip(0, 65535).astype(np.int64)


def quaternion_bytes(quats: Float[np.ndarray, "N 4"]) -> UInt8[np.ndarray, "N 4"]:
    """The three smallest of (w, x, y, z), and in alpha which is the largest."""
    largest, three = smallest_three(quats)
    return with_alpha(np.trunc(255 * (three * 0.5**0.5 + 0.5)).clip(0, 255), FIRST_LARGEST + largest)


def with_alpha(
    colours: Float[np.ndarray, "N 3"] | Int[np.ndarray, "N 3"], alpha: Any = 255
) -> UInt8[np.ndarray, "N 4"]:
    """RGBA of bytes."""
    pixels = np.empty((len(colours), 4), np.uint8)
    pixels[:, :3], pixels[:, 3] = colours, alpha
    return pixels


def raster(pixels: UInt8[np.ndarray, "N 4"]) -> UInt8[np.ndarray, "H W 4"]:
    """A picture with splat i at pixel i, about square, with spare pixels at the end."""
    width = 4 * math.ceil(math.sqrt(len(pixels)) / 4)
    height = 4 * math.ceil(len(pixels) / width / 4)
    whole = np.zeros((width * height, 4), np.uint8)
    whole[: len(pixels)] = pixels
    return whole.reshape(height, width, 4)


def higher_bands(rest: Float[np.ndarray, "N B 3"]) -> tuple[dict[str, UInt8[np.ndarray, "H W 4"]], dict[str, Any]]:
    """(pictures, entry of meta.json): a palette of vectors, and which of them each splat has."""
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
    """The archive; nothing in it depends on the time."""
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


def decode_sog(content: bytes) -> Arrays:
    """Splats of a file.

    Raises:
        InputError: it is damaged, or of another version.
        ConfigError: Pillow is not installed.
    """
    require("a .sog file", ("PIL",), "gsx[sog]")
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            return arrays_in(archive)
    except InputError:
        raise
    except Exception as error:  # of zip, JSON, WebP and numbers: all say that it is damaged
        raise InputError(f"it is no whole SOG ({type(error).__name__}): export it anew") from None


def sog_is_antialiased(path: Path) -> bool:
    """Whether meta.json says that opacities are compensated; False for what is no SOG."""
    try:
        with zipfile.ZipFile(path) as archive:
            return bool(json.loads(archive.read("meta.json"))["model"] == "antialiased")
    except Exception:  # what is wrong with it is told by who reads it
        return False


def arrays_in(archive: zipfile.ZipFile) -> Arrays:
    """Splats of an archive; whatever is wrong with it raises."""
    meta = json.loads(archive.read("meta.json"))
    count = meta.get("count")
    if meta.get("version") != VERSION or not isinstance(count, int) or not 0 < count <= MOST_SPLATS:
        raise InputError(f"it is no SOG of version {VERSION} with splats: export it anew")

    def pixels(part: str, number: int = 0) -> UInt8[np.ndarray, "N 4"]:
        return picture(archive, meta[part]["files"][number]).reshape(-1, 4)[:count]

    def looked_up(part: str, indices: UInt8[np.ndarray, "N 3"]) -> Float[np.ndarray, "N 3"]:
        return np.array(meta[part]["codebook"], float)[indices]

    low, high = (pixels("means", number)[:, :3].astype(np.int64) for number in (0, 1))
    least, most = (np.array(meta["means"][end], float) for end in ("mins", "maxs"))
    logs = least + (high << 8 | low) / 65535 * (most - least)
    quats, sh0 = pixels("quats"), pixels("sh0")
    largest = quats[:, 3].astype(np.int64) - FIRST_LARGEST
    three = np.where(largest[:, None] < 0, 0.0, (quats[:, :3] / 255 - 0.5) * 2**0.5)
    return checked(
        Arrays(
            means=np.sign(logs) * np.expm1(np.abs(logs)),
            log_scales=looked_up("scales", pixels("scales")[:, :3]),
            quats=from_smallest_three(largest.clip(0), three),
            opacities=sh0[:, 3] / 255,
            sh_dc=looked_up("sh0", sh0[:, :3]),
            sh_rest=rest_of(archive, meta.get("shN"), count),
        ),
        count,
    )


def rest_of(archive: zipfile.ZipFile, entry: dict[str, Any] | None, count: int) -> Float[np.ndarray, "N B 3"]:
    """Coefficients beside the constant one; none where there is no entry."""
    if entry is None:
        return np.zeros((count, 0, 3))
    coefficients = COEFFICIENTS[entry["bands"]]
    centroids, labels = (picture(archive, name) for name in entry["files"])
    palette = centroids[:, : PALETTE * coefficients, :3].reshape(-1, coefficients, 3)
    numbers = labels.reshape(-1, 4)[:count].astype(np.int64)
    return np.array(entry["codebook"], float)[palette[numbers[:, 0] | numbers[:, 1] << 8]]


def checked(arrays: Arrays, count: int) -> Arrays:
    """Splats, of which there are as many as told and all finite.

    Raises:
        InputError: they are not.
    """
    values = list(vars(arrays).values())
    if any(len(value) != count or not np.isfinite(value).all() for value in values):
        raise InputError("its pictures or code books are not those of its splats: export it anew")
    return arrays


def picture(archive: zipfile.ZipFile, name: str) -> UInt8[np.ndarray, "H W 4"]:
    """One picture."""
    from PIL import Image

    with Image.open(io.BytesIO(archive.read(name)), formats=["WEBP"]) as shown:
        return np.asarray(shown.convert("RGBA"))
