"""SPZ, versions 2 to 4: one array an attribute, each number in few bits (Niantic, nianticlabs/spz, MIT).

The specification's axes are x right, y up, z back (RUB); many programs write those of training worlds instead, x right,
y down, z front (RDF). Only an extension states the axes. The file is one gzip stream (versions 2 and 3), or has streams
of Zstandard (4). Source: load-spz.cc and extensions/README.md, revision 21715c3. Damaged content raises InputError,
which calls the file "it".
"""

import gzip
import struct
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from importlib import import_module
from io import BytesIO
from typing import Any, NamedTuple

import numpy as np

from gsx.core.errors import InputError
from gsx.core.shapes import Float, Int, UInt8
from gsx.formats.arrays import Arrays, from_smallest_three, rounded, smallest_three
from gsx.formats.axis_names import SPECIFIED, SYSTEMS

LEVEL = 12
"""Level of compression, as in Niantic's library."""
PIECE = 1 << 20
"""Bytes decompressed at a time: a stream's header may state any size."""
MAGIC = b"NGSP"
HEADER = struct.Struct("<4sIIBBBB")
"""Magic, version, count, degree, fraction bits, flags, number of streams (version 4)."""
STREAMED_HEADER = 32
TABLE, ENTRY, RECORD = struct.Struct("<I"), struct.Struct("<QQ"), struct.Struct("<II")
ANTIALIASED, EXTENDED = 1, 2
COEFFICIENTS = (0, 3, 8, 15, 24)
"""Number of coefficients by degree, without the constant one."""
COORDINATE_SYSTEM = 0xADBE0003
"""Extension that states the axes: SPZ_ADOBE_coordinate_system."""
SMALLEST_THREE, STREAMED = 3, 4
"""First versions with quaternions of 4 bytes, and with streams of Zstandard."""
POSITION_BYTES, MOST_RATIO = 9, 1024
"""Bytes of a position, and largest ratio of all positions to the file (the library's bound)."""
MOST_EXTENSION_BYTES = 1 << 16
"""Most bytes of extensions after the arrays in versions 2 and 3."""
MOST_FRACTION_BITS = 23
FRACTION_BITS = 12
FURTHEST = 2048 - 2**-FRACTION_BITS
"""Largest coordinate in 24 bits, scene units."""
COLOUR_SCALE = 0.15
MOST_COEFFICIENTS = 15
"""Coefficients of degree 3, without the constant one."""
ROOT_2 = 2**0.5


def zstd_module() -> Any:
    """Returns the installed module; InputError: there is none."""
    for name in ("compression.zstd", "zstandard"):
        try:
            return import_module(name)
        except ImportError:
            continue
    raise InputError("version 4 holds Zstandard streams, for which a package is missing: pip install 'gsx[spz]'")


def compress(data: bytes) -> bytes:
    """Compresses data to one frame."""
    module = zstd_module()
    if hasattr(module, "ZstdFile"):
        return bytes(module.compress(data, level=LEVEL))
    return bytes(module.ZstdCompressor(level=LEVEL).compress(data))


def decompress(data: bytes, size: int) -> bytes:
    """Decompresses a stream of `size` bytes; InputError: it is damaged, or has another size."""
    module = zstd_module()
    try:
        plain = hasattr(module, "ZstdFile")
        opened = module.ZstdFile(BytesIO(data)) if plain else module.ZstdDecompressor().stream_reader(data)
        with opened as stream:
            pieces, left = [], size
            while left and (piece := stream.read(min(left, PIECE))):
                pieces.append(piece)
                left -= len(piece)
            if left or stream.read(1):
                raise InputError(f"a Zstandard stream does not have {size:,} bytes: copy or export it anew")
    except (module.ZstdError, EOFError) as error:
        raise InputError(f"a Zstandard stream is damaged ({error}): copy or export it anew") from None
    return b"".join(pieces)


class Header(NamedTuple):
    """Fields of HEADER after the magic."""

    version: int
    splats: int
    degree: int
    fraction_bits: int
    """Bits of positions after the point."""
    flags: int
    streams: int = 0

    def sizes(self) -> list[int]:
        """Returns the bytes per splat of positions, opacities, colours, scales, rotations and coefficients."""
        return [POSITION_BYTES, 1, 3, 3, 4 if self.version >= SMALLEST_THREE else 3, 3 * COEFFICIENTS[self.degree]]

    def packed(self) -> bytes:
        """Returns the bytes, with the magic."""
        return HEADER.pack(MAGIC, *self)


@dataclass(frozen=True, eq=False, kw_only=True)
class Content:
    """An uncompressed file."""

    header: Header
    arrays: Sequence[bytes]
    """Arrays in the order of `Header.sizes`."""
    axes: str | None
    """Axes that the file states, if any."""


def header_of(data: bytes, size: int) -> Header:
    """Reads a header; `size`: bytes of the compressed file."""
    if len(data) < HEADER.size or data[:4] != MAGIC:
        raise InputError("it is no SPZ, or ends within its header: export it anew")
    header = Header(*HEADER.unpack_from(data)[1:])
    if header.version == 1:
        raise InputError("it is SPZ version 1, which was never published, gsx reads 2, 3 and 4: export it anew")
    if header.version not in (2, 3, STREAMED):
        raise InputError(f"it is SPZ version {header.version}, gsx reads 2, 3 and 4: export it as version 4")
    if header.degree >= len(COEFFICIENTS) or header.fraction_bits > MOST_FRACTION_BITS:
        raise InputError(
            f"it is damaged: its header says degree {header.degree} and {header.fraction_bits} fraction bits of "
            f"positions, SPZ has up to {len(COEFFICIENTS) - 1} and {MOST_FRACTION_BITS}: copy or export it anew"
        )
    if header.splats * POSITION_BYTES > size * MOST_RATIO:
        raise InputError(f"its {size:,} bytes cannot hold {header.splats:,} splats, as it says: copy or export it anew")
    return header


# -- versions 2 and 3 --------------------------------------------------------------------------------------------------


def gzipped_content(content: bytes) -> Content:
    """Reads a file of version 2 or 3; errors as `decode_spz`."""
    header = header_of(unzipped(content, HEADER.size), len(content))
    if header.version >= STREAMED:
        raise InputError(f"it is SPZ version {header.version} within a gzip stream: unzip it (gzip -d)")
    most = HEADER.size + header.splats * sum(header.sizes())
    data = unzipped(content, most + (MOST_EXTENSION_BYTES if header.flags & EXTENDED else 1))
    if len(data) < most or (len(data) > most and not header.flags & EXTENDED):
        raise InputError(f"it has not the bytes of {header.splats:,} splats: copy or export it anew")
    arrays, rest = split(data[HEADER.size :], [header.splats * size for size in header.sizes()])
    return Content(header=header, arrays=arrays, axes=stated_axes(rest))


def unzipped(content: bytes, most: int) -> bytes:
    """Decompresses at most `most` bytes of a gzip stream."""
    try:
        return zlib.decompressobj(wbits=31).decompress(content, most)
    except zlib.error as error:
        raise InputError(f"it is no whole gzip stream ({error}): copy or export it anew") from None


def split(data: bytes, sizes: Sequence[int]) -> tuple[list[bytes], bytes]:
    """Returns (parts of these sizes, the rest)."""
    parts, begin = [], 0
    for size in sizes:
        parts.append(data[begin : begin + size])
        begin += size
    return parts, data[begin:]


def gzipped(header: Header, arrays: Sequence[bytes]) -> bytes:
    """Packs a file of version 2 or 3."""
    return gzip.compress(header.packed() + b"".join(arrays), mtime=0)


# -- version 4 ---------------------------------------------------------------------------------------------------------


def streamed_content(content: bytes) -> Content:
    """Reads a file of version 4; errors as `decode_spz`."""
    header = header_of(content, len(content))
    if header.version < STREAMED:
        raise InputError(f"it is the content of SPZ version {header.version} without its gzip stream: gzip it")
    if len(content) < STREAMED_HEADER:
        raise InputError("it ends within its header: copy or export it anew")
    (table,) = TABLE.unpack_from(content, HEADER.size)
    sizes = [header.splats * size for size in header.sizes()]
    streams = iter(table_entries(content, table, header, [size for size in sizes if size]))
    arrays = [decompress(*next(streams)) if size else b"" for size in sizes]
    records = content[STREAMED_HEADER:table] if header.flags & EXTENDED else b""
    return Content(header=header, arrays=arrays, axes=stated_axes(records))


def table_entries(content: bytes, table: int, header: Header, sizes: Sequence[int]) -> list[tuple[bytes, int]]:
    """Returns (compressed bytes, size) of each stream; `table`: byte at which their table begins."""
    begin = table + len(sizes) * ENTRY.size
    if header.streams != len(sizes) or table < STREAMED_HEADER or begin > len(content):
        raise InputError(
            f"it is damaged: {header.streams} streams from byte {table} on do not fit {header.splats:,} splats of "
            f"degree {header.degree} in {len(content):,} bytes: copy or export it anew"
        )
    entries = [ENTRY.unpack_from(content, table + i * ENTRY.size) for i in range(len(sizes))]
    for (_, claimed), size in zip(entries, sizes, strict=True):
        if claimed != size:
            raise InputError(f"it has not the bytes of {header.splats:,} splats: copy or export it anew")
    if begin + sum(compressed for compressed, _ in entries) != len(content):
        raise InputError("its streams do not end where the file does: copy or export it anew")
    parts, _ = split(content[begin:], [compressed for compressed, _ in entries])
    return list(zip(parts, sizes, strict=True))


def streamed(header: Header, arrays: Sequence[bytes], axes: str) -> bytes:
    """Packs a file of version 4 that states its axes."""
    parts = [part for part in arrays if part]
    streams = [compress(part) for part in parts]
    record = RECORD.pack(COORDINATE_SYSTEM, TABLE.size) + TABLE.pack(SYSTEMS.index(axes) + 1)
    table = [ENTRY.pack(len(stream), len(part)) for stream, part in zip(streams, parts, strict=True)]
    place = TABLE.pack(STREAMED_HEADER + len(record)) + bytes(STREAMED_HEADER - HEADER.size - TABLE.size)
    return b"".join([header.packed(), place, record, *table, *streams])


# -- extensions --------------------------------------------------------------------------------------------------------


def records_of(data: bytes) -> Iterator[tuple[int, bytes]]:
    """Yields (type, payload) of complete extensions."""
    while len(data) >= RECORD.size:
        kind, size = RECORD.unpack_from(data)
        payload, data = data[RECORD.size : RECORD.size + size], data[RECORD.size + size :]
        if len(payload) == size:
            yield kind, payload


def stated_axes(records: bytes) -> str | None:
    """Returns the axes that extensions state, if any; number 0 means none."""
    for kind, payload in records_of(records):
        if kind == COORDINATE_SYSTEM and len(payload) >= TABLE.size:
            (number,) = TABLE.unpack_from(payload)
            if number > len(SYSTEMS):
                raise InputError(f"it states axes number {number}, gsx knows 1 to {len(SYSTEMS)}: export it anew")
            return SYSTEMS[number - 1] if number else None
    return None


def encode_spz(arrays: Arrays, antialiased: bool = False, version: int = 3, axes: str = SPECIFIED) -> bytes:
    """Encodes a file of at least one splat; version 4 states the axes of the arrays.

    antialiased: opacities are compensated in renders, as in models of Mip-Splatting.

    Raises:
        InputError: positions exceed 24 bits, or Zstandard is missing.
    """
    furthest = float(np.abs(arrays.means).max())
    if furthest > FURTHEST:
        raise InputError(
            f"SPZ holds coordinates up to {FURTHEST:,.0f}, the model has {furthest:,.6g}: choose another format"
        )
    parts = packed_arrays(arrays)
    is_streamed = version >= STREAMED
    header = Header(
        version=version,
        splats=len(arrays.means),
        degree=arrays.degree,
        fraction_bits=FRACTION_BITS,
        flags=ANTIALIASED * antialiased | EXTENDED * is_streamed,
        streams=sum(map(bool, parts)) if is_streamed else 0,
    )
    return streamed(header, parts, axes) if is_streamed else gzipped(header, parts)


def packed_arrays(arrays: Arrays) -> list[bytes]:
    """Packs positions, opacities, colours, scales, rotations and coefficients."""
    positions = rounded(arrays.means * 2**FRACTION_BITS).astype("<i4")
    parts = [
        np.ascontiguousarray(positions).view(np.uint8).reshape(-1, 4)[:, :3],
        as_bytes(rounded(255 * arrays.opacities)),
        as_bytes(rounded(arrays.sh_dc * COLOUR_SCALE * 255 + 127.5)),
        as_bytes(rounded((arrays.log_scales + 10) * 16)),
        packed_rotations(arrays.quats),
        coarse(arrays.sh_rest),
    ]
    return [part.tobytes() for part in parts]


def packed_rotations(quats: Float[np.ndarray, "N 4"]) -> UInt8[np.ndarray, "N 4"]:
    """Packs quaternions (w, x, y, z) in 4 bytes: the three smallest of x, y, z, w by sign and magnitude."""
    largest, three = smallest_three(quats[:, [1, 2, 3, 0]])
    fields = np.floor(511 * np.abs(three) * ROOT_2 + 0.5).clip(0, 511).astype(np.uint32) + 512 * (three < 0)
    words = (largest << 30 | fields[:, 0] << 20 | fields[:, 1] << 10 | fields[:, 2]).astype("<u4")
    return words.view(np.uint8).reshape(-1, 4)


def as_bytes(values: Float[np.ndarray, "..."]) -> UInt8[np.ndarray, "..."]:
    """Clamps whole numbers to bytes."""
    return values.clip(0, 255).astype(np.uint8)


def coarse(sh_rest: Float[np.ndarray, "N B 3"]) -> UInt8[np.ndarray, "N B 3"]:
    """Quantises coefficients in [-1, 1] to 5 bits (degree 1) or 4 bits, for smaller files."""
    steps = np.array([8] * 3 + [16] * 12)[: sh_rest.shape[1], None]
    return as_bytes(np.trunc((rounded(128 * sh_rest) + 128 + steps / 2) / steps) * steps)


def decode_spz(content: bytes) -> tuple[Arrays, str | None]:
    """Returns (splats of a file in its own axes up to degree 3, axes that it states or None).

    Raises:
        InputError: it is damaged, or not of version 2, 3 or 4.
    """
    file = streamed_content(content) if content[:4] == MAGIC else gzipped_content(content)
    count, sizes = file.header.splats, file.header.sizes()
    parts = [np.frombuffer(part, np.uint8).reshape(count, size) for part, size in zip(file.arrays, sizes, strict=True)]
    arrays = Arrays(
        means=positions_of(parts[0]) / 2.0**file.header.fraction_bits,
        opacities=parts[1][:, 0] / 255,
        sh_dc=(parts[2] / 255 - 0.5) / COLOUR_SCALE,
        log_scales=parts[3] / 16 - 10,
        quats=rotations(parts[4]),
        sh_rest=(parts[5].reshape(count, sizes[5] // 3, 3)[:, :MOST_COEFFICIENTS].astype(float) - 128) / 128,
    )
    return arrays, file.axes


def positions_of(packed: UInt8[np.ndarray, "N 9"]) -> Int[np.ndarray, "N 3"]:
    """Unpacks signed integers of 24 bits."""
    words = np.zeros((len(packed), 3, 4), np.uint8)
    words[..., 1:] = packed.reshape(-1, 3, 3)
    return words.reshape(-1, 12).view("<i4") >> 8


def is_antialiased(head: bytes) -> bool:
    """Returns whether the header states compensated opacities; False for other files."""
    try:
        header = head if head[:4] == MAGIC else unzipped(head, HEADER.size)
    except InputError:
        return False
    return len(header) >= HEADER.size and bool(HEADER.unpack_from(header)[5] & ANTIALIASED)


def rotations(packed: UInt8[np.ndarray, "N b"]) -> Float[np.ndarray, "N 4"]:
    """Unpacks quaternions (w, x, y, z) of 4 bytes (the three smallest) or, in version 2, 3 (x, y, z; w >= 0)."""
    if packed.shape[1] == 3:
        three = packed / 127.5 - 1
        w = np.sqrt(np.maximum(0, 1 - (three**2).sum(1)))
        quats = np.column_stack([w, three])
        return quats / np.linalg.norm(quats, axis=1, keepdims=True)
    words = np.ascontiguousarray(packed).view("<u4")[:, 0]
    fields = np.stack([words >> 20 & 1023, words >> 10 & 1023, words & 1023], 1).astype(float)
    three = np.where(fields < 512, fields, 512 - fields) / 511 / ROOT_2
    return from_smallest_three((words >> 30).astype(np.int64), three)[:, [3, 0, 1, 2]]
