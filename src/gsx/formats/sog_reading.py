"""Reading of SOG 1 and 2 from a ZIP or a folder: meta.json and lossless pictures, a pixel a splat.

Version 1 (playcanvas/sogs) has scales, colours and opacity logits as bytes between two bounds, version 2
(playcanvas/splat-transform) as indices of code books. Pillow reads the pictures (`gsx[sog]`). Damaged content raises
InputError, which calls the file "it".
"""

import io
import json
import logging
import struct
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any, NamedTuple

import numpy as np

from gsx.core.errors import InputError
from gsx.core.packages import require
from gsx.core.shapes import Float, UInt8
from gsx.formats.arrays import Arrays, from_smallest_three
from gsx.formats.sog import BOOK, COEFFICIENTS, FIRST_LARGEST, PALETTE, VERSION
from gsx.formats.suffixes import META, MOST_META

MOST_SIDE = 16383
"""Longest side of a WebP, px."""
PNG = b"\x89PNG\r\n\x1a\n"
MOST_CHUNKS = 64
"""Most chunks of a WebP before its pixels."""
logger = logging.getLogger(__name__)
MOST_SPLATS = 1 << 26
SPARE_PIXELS = 1 << 22
"""Most pixels of a picture beyond four times the splats."""
COMPENSATED, FLAT = "antialiased", "2dgs"
MODELS = (COMPENSATED, FLAT, "default")
"""Values of `model`."""
BYTES_PER_PIXEL = 8
"""Bound of the bytes per pixel of any encoder."""


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


@dataclass(frozen=True, eq=False, kw_only=True)
class Archive:
    """Files of a SOG by name."""

    read: Callable[[str, int], bytes]
    """Returns the content of a file of at most this many bytes."""
    meta: dict[str, Any]
    """Content of meta.json."""

    @property
    def version(self) -> int:
        """Return the version, 1 if meta.json states none."""
        version = self.meta.get("version", 1)
        if version not in (1, VERSION) or isinstance(version, bool):
            raise InputError(f"its meta.json has version {version!r}; gsx reads SOG 1 and 2: export it anew")
        return int(version)

    @property
    def count(self) -> int:
        """Return the number of splats."""
        parts = (self.meta.get(part) for part in ("means", "scales", "quats", "sh0"))
        shapes = [part["shape"] for part in parts if isinstance(part, dict) and "shape" in part]
        stated = [self.meta["count"]] if "count" in self.meta else []
        stated += [shape[0] if isinstance(shape, list) and shape else shape for shape in shapes]
        if not stated or any(type(count) is not int or count != stated[0] for count in stated):
            raise InputError(f"its meta.json states no one number of splats ({stated}): export it anew")
        if not 0 < stated[0] <= MOST_SPLATS:
            raise InputError(f"its meta.json states {stated[0]:,} splats; SOG has 1 to {MOST_SPLATS:,}: export it anew")
        return int(stated[0])


def decode_sog(content: bytes, path: Path) -> Arrays:
    """Decodes a ZIP, or a meta.json with its folder. path: of the file.

    Raises:
        InputError: it is damaged, of another version, or has flat splats.
        ConfigError: Pillow is not installed.
    """
    require("SOG", ("PIL",), "gsx[sog]")
    archive = archive_of(content, path)
    model = archive.meta.get("model", "default")
    if model == FLAT:
        raise InputError(f"its meta.json has model '{FLAT}': it holds flat splats, which gsx does not draw")
    if model not in MODELS:
        logger.warning("meta.json has the unknown model %r: its splats are drawn as usual ones", model)
    try:
        with np.errstate(all="ignore"):  # the check below refuses what overflows
            arrays = splats_in(archive)
    except InputError:
        raise
    except Exception as error:  # any error of its content means damage
        raise InputError(f"it is no whole SOG ({type(error).__name__}): export it anew") from None
    for name, values in vars(arrays).items():
        if not np.isfinite(values).all():
            raise InputError(f"its ranges or code books give '{name}' that are not finite: export it anew")
    return arrays


def sog_is_antialiased(path: Path) -> bool:
    """Returns whether meta.json states compensated opacities, by `model` or the older `antialias`; False for no SOG."""
    try:
        meta = archive_of(path.read_bytes(), path).meta
    except (InputError, OSError):  # the decoder reports it
        return False
    if "model" in meta:
        return bool(meta["model"] == COMPENSATED)
    return meta.get("antialias") is True


def archive_of(content: bytes, path: Path) -> Archive:
    """Returns the files of a ZIP, or of the folder of a meta.json. path: of the file."""
    read = in_folder(path) if path.name.lower() == META else in_zip(content)
    try:
        meta = json.loads(read(META, MOST_META))
    except (ValueError, RecursionError):
        raise InputError("its meta.json is no JSON: export it anew") from None
    if not isinstance(meta, dict) or "means" not in meta:
        raise InputError("its meta.json describes no SOG: give that of a SOG, or another file")
    return Archive(read=read, meta=meta)


def in_folder(path: Path) -> Callable[[str, int], bytes]:
    """Returns a reader of the files in the folder of a meta.json."""

    def read(name: str, most: int) -> bytes:
        file = path if name == META else path.parent / name
        if not file.resolve().is_relative_to(path.parent.resolve()):
            raise InputError(f"its meta.json names '{name}', which is outside of its folder: export it anew")
        if name != META and not file.is_file():
            raise InputError(f"'{name}' is missing next to {META}: copy all pictures of the folder")
        if file.stat().st_size > most:
            raise InputError(f"'{name}' has {file.stat().st_size:,} bytes, more than its splats need: export it anew")
        return file.read_bytes()

    return read


def in_zip(content: bytes) -> Callable[[str, int], bytes]:
    """Returns a reader of a ZIP's files, in its root or one folder; InputError: no ZIP, or not one meta.json."""
    try:
        entries = {info.filename: info for info in zipfile.ZipFile(io.BytesIO(content)).infolist()}
    except Exception as error:  # damage raises errors of many kinds
        raise InputError(f"it is no whole ZIP ({type(error).__name__}): copy or export it anew") from None
    folder = folder_of_meta(list(entries))

    def read(name: str, most: int) -> bytes:
        info = entries.get(str(folder / name))
        if info is None:
            raise InputError(f"it has no '{name}': export it anew")
        if info.file_size > most:
            raise InputError(f"its '{name}' has {info.file_size:,} bytes, more than its splats need: export it anew")
        try:
            with zipfile.ZipFile(io.BytesIO(content)) as archive:
                return archive.read(info)
        except Exception as error:  # damaged, encrypted, or of an unknown compression
            problem = type(error).__name__
            raise InputError(f"its '{name}' cannot be unpacked ({problem}): copy or export it anew") from None

    return read


def folder_of_meta(names: list[str]) -> PurePosixPath:
    """Returns the folder of meta.json in a ZIP; InputError: there is none, or several."""
    paths = [PurePosixPath(name) for name in names if not name.startswith("__MACOSX/")]
    folders = sorted({path.parent for path in paths if path.name == META}, key=lambda folder: len(folder.parts))
    if not folders:
        raise InputError(f"it is a ZIP without {META}: give a SOG, or unpack it")
    if len(folders) > 1 and folders[0].parts:
        raise InputError(f"it has {META} in {len(folders)} folders: unpack it, and give one of them")
    return folders[0]


def splats_in(archive: Archive) -> Arrays:
    """Decodes the files; damage raises errors of many kinds."""
    meta, count = archive.meta, archive.count
    first = archive.version == 1
    least, most = (np.array(meta["means"][end], float) for end in ("mins", "maxs"))
    low, high = (pixels(archive, "means", number)[:, :3].astype(np.int64) for number in (0, 1))
    logs = least + (high << 8 | low) / 65535 * (most - least)
    sh0 = pixels(archive, "sh0")
    value = interpolated if first else looked_up
    colours = value(meta["sh0"], sh0 if first else sh0[:, :3])
    return Arrays(
        means=np.sign(logs) * np.expm1(np.abs(logs)),
        log_scales=value(meta["scales"], pixels(archive, "scales")[:, :3]),
        quats=quaternions(meta["quats"], pixels(archive, "quats")),
        opacities=1 / (1 + np.exp(-colours[:, 3].clip(-700, 700))) if first else sh0[:, 3] / 255,
        sh_dc=colours[:, :3],
        sh_rest=rest_of(archive) if meta.get("shN") else np.zeros((count, 0, 3)),
    )


def interpolated(entry: dict[str, Any], stored: UInt8[np.ndarray, "N k"]) -> Float[np.ndarray, "N k"]:
    """Returns values of version 1: bytes between the bounds of each column."""
    least, most = (np.array(entry[end], float) for end in ("mins", "maxs"))
    if least.shape not in ((), (1,), stored.shape[1:]) or most.shape != least.shape:
        raise InputError(f"its ranges are of {least.size} columns, its picture has {stored.shape[1]}: export it anew")
    return least + stored / 255 * (most - least)


def looked_up(entry: dict[str, Any], indices: UInt8[np.ndarray, "N k"]) -> Float[np.ndarray, "N k"]:
    """Returns values of version 2: entries of a code book."""
    book = np.array(entry["codebook"], float)
    if len(book) == BOOK and entry["codebook"][0] is None:  # early writers left it out: extrapolate
        book[0] = book[1] + (book[1] - book[-1]) / (BOOK - 1)
    return book[indices]


def quaternions(entry: dict[str, Any], stored: UInt8[np.ndarray, "N 4"]) -> Float[np.ndarray, "N 4"]:
    """Returns unit quaternions (w, x, y, z); the identity for an invalid alpha."""
    encoding = entry.get("encoding", "quaternion_packed")
    if encoding != "quaternion_packed":
        raise InputError(f"its quaternions are encoded as {encoding!r}; gsx reads quaternion_packed: export it anew")
    largest = stored[:, 3].astype(np.int64) - FIRST_LARGEST
    three = np.where(largest[:, None] < 0, 0.0, (stored[:, :3] / 255 - 0.5) * 2**0.5)
    return from_smallest_three(largest.clip(0), three)


def rest_of(archive: Archive) -> Float[np.ndarray, "N B 3"]:
    """Returns coefficients of higher bands, entries of a palette by the splats' labels."""
    entry = archive.meta["shN"]
    centroids = picture(archive, entry["files"][0], 1)
    bands = {64 * count: count for count in COEFFICIENTS.values()}
    coefficients = bands.get(centroids.shape[1], 0)
    if coefficients != COEFFICIENTS.get(entry.get("bands", 0), coefficients) or not coefficients:
        stated = f" of {entry['bands']} bands" if "bands" in entry else ""
        raise InputError(
            f"its palette{stated} is {centroids.shape[1]} pixels wide; bands 1 to 3 have 192, 512, 960: export it anew"
        )
    palette = centroids[..., :3].reshape(-1, coefficients, 3)[: entry.get("count", PALETTE * len(centroids))]
    numbers = pixels(archive, "shN", 1).astype(np.int64)
    labels = numbers[:, 0] | numbers[:, 1] << 8
    if labels.max() >= len(palette):
        raise InputError(f"a splat has vector {labels.max():,} of a palette of {len(palette):,}: export it anew")
    vectors = palette.reshape(len(palette), -1)
    values = interpolated(entry, vectors) if archive.version == 1 else looked_up(entry, vectors)
    return values[labels].reshape(len(labels), coefficients, 3)


def pixels(archive: Archive, part: str, number: int = 0) -> UInt8[np.ndarray, "N 4"]:
    """Returns the splats' pixels in a picture of a part of meta.json."""
    name = archive.meta[part]["files"][number]
    return picture(archive, name, archive.count).reshape(-1, 4)[: archive.count]


def picture(archive: Archive, name: str, needed: int) -> UInt8[np.ndarray, "H W 4"]:
    """Returns a lossless picture as RGBA; needed: least number of pixels."""
    from PIL import Image

    most = 4 * max(needed, archive.count) + SPARE_PIXELS
    content = archive.read(name, BYTES_PER_PIXEL * most)
    header = header_of(content, name)
    if header.width * header.height < needed:
        raise InputError(f"'{name}' is {header.width}x{header.height}, too small for {needed:,} splats: export it anew")
    if header.width * header.height > most or max(header.width, header.height) > MOST_SIDE:
        raise InputError(f"'{name}' is {header.width}x{header.height}, far more than {archive.count:,} splats need: "
                         "export it anew")  # fmt: skip
    if not header.lossless:
        raise InputError(f"'{name}' is a lossy picture, which has changed its values: export it anew, lossless")
    try:
        with Image.open(io.BytesIO(content), formats=["WEBP", "PNG"]) as image:
            return np.asarray(image.convert("RGBA"))
    except Exception as error:  # of Pillow's decoders
        raise InputError(f"'{name}' is no whole picture ({type(error).__name__}): copy or export it anew") from None
