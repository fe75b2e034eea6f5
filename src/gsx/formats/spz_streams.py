"""Containers of SPZ: one gzip stream (versions 2 and 3), or streams of Zstandard (version 4).

Source: nianticlabs/spz, load-spz.cc and extensions/README.md (MIT), revision 21715c3. Damaged content raises
InputError, which calls the file "it".
"""

import gzip
import struct
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from gsx.core.errors import InputError
from gsx.formats.axis_names import SYSTEMS
from gsx.formats.zstd import compress, decompress

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


def read_content(content: bytes) -> Content:
    """Reads a file; InputError: it is damaged, or no SPZ of version 2, 3 or 4."""
    return streamed_content(content) if content[:4] == MAGIC else gzipped_content(content)


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
    """Reads a file of version 2 or 3; errors as `read_content`."""
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
    """Reads a file of version 4; errors as `read_content`."""
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
