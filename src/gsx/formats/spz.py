"""SPZ, version 3: a gzip stream of a header and one array an attribute (Niantic, nianticlabs/spz, MIT).

The specification's axes are x right, y up, z back (RUB); training worlds are x right, y down, z front (RDF). Niantic's
own converter, SuperSplat and their like write and read the training world's axes instead; no file says which it holds.
"""

import gzip
import struct
import zlib

import numpy as np

from gsx.core.errors import InputError
from gsx.core.shapes import Float, UInt8
from gsx.formats.arrays import Arrays, from_smallest_three, rounded, smallest_three

MAGIC, VERSION = 0x5053474E, 3
HEADER = struct.Struct("<IIIBBBB")
FRACTION_BITS = 12
FURTHEST = 2048 - 2**-FRACTION_BITS
"""Coordinates that 24 bits hold, scene units."""
ANTIALIASED, EXTENDED = 1, 2
MOST_SPLATS = 10**9
COLOUR_SCALE = 0.15
COEFFICIENTS = {0: 0, 1: 3, 2: 8, 3: 15}
"""By degree, beside the constant one."""
FLIPS = np.array([1.0, -1.0, -1.0])
"""Signs of x, y and z from RDF to RUB, and back."""
ROOT_2 = 2**0.5


def encode_spz(arrays: Arrays, antialiased: bool = False, axes: str = "rub") -> bytes:
    """A file. antialiased: to be drawn with compensated opacities, as models of Mip-Splatting.

    Raises:
        InputError: there are no splats, of too high a degree, or beyond what 24 bits hold.
    """
    if len(arrays.means) == 0:
        raise InputError("SPZ holds no empty scenes: the model has no splats")
    furthest = float(np.abs(arrays.means).max())
    if furthest > FURTHEST:
        raise InputError(
            f"SPZ holds coordinates up to {FURTHEST:,.0f}, the model has {furthest:,.6g}: choose another format"
        )
    arrays = flipped(arrays) if axes == "rub" else arrays
    largest, three = smallest_three(arrays.quats[:, [1, 2, 3, 0]])
    fields = np.floor(511 * np.abs(three) * ROOT_2 + 0.5).clip(0, 511).astype(np.uint32) + 512 * (three < 0)
    packed = (largest << 30 | fields[:, 0] << 20 | fields[:, 1] << 10 | fields[:, 2]).astype("<u4")
    positions = rounded(arrays.means * 2**FRACTION_BITS).astype("<i4")
    header = HEADER.pack(MAGIC, VERSION, len(arrays.means), arrays.degree, FRACTION_BITS, ANTIALIASED * antialiased, 0)
    body = [
        np.ascontiguousarray(positions).view(np.uint8).reshape(-1, 4)[:, :3],
        as_bytes(rounded(255 * arrays.opacities)),
        as_bytes(rounded(arrays.sh_dc * COLOUR_SCALE * 255 + 127.5)),
        as_bytes(rounded((arrays.log_scales + 10) * 16)),
        packed,
        coarse(arrays.sh_rest),
    ]
    return gzip.compress(header + b"".join(part.tobytes() for part in body), mtime=0)


def as_bytes(values: Float[np.ndarray, "..."]) -> UInt8[np.ndarray, "..."]:
    """Whole numbers as bytes, those beyond at the limits."""
    return values.clip(0, 255).astype(np.uint8)


def coarse(sh_rest: Float[np.ndarray, "N B 3"]) -> UInt8[np.ndarray, "N B 3"]:
    """Coefficients within [-1, 1], of degree 1 to 5 bits, of higher ones to 4, so that gzip finds less."""
    steps = np.array([8] * 3 + [16] * 12)[: sh_rest.shape[1], None]
    return as_bytes(np.trunc((rounded(128 * sh_rest) + 128 + steps / 2) / steps) * steps)


def decode_spz(content: bytes, axes: str = "rub") -> Arrays:
    """Splats of a file of version 2 or 3. axes: the file's, which it does not tell.

    Raises:
        InputError: it is damaged, or of another version.
    """
    if content[:4] == struct.pack("<I", MAGIC):
        raise InputError("it is SPZ of version 4 or later, gsx reads 2 and 3: export it as version 3")
    data = unzipped(content, HEADER.size)
    if len(data) < HEADER.size:
        raise InputError("it is no SPZ, or ends within its header: export it anew")
    magic, version, count, degree, bits, flags, _ = HEADER.unpack_from(data)
    if magic != MAGIC or version not in (2, 3) or degree not in COEFFICIENTS or bits > 23 or count > MOST_SPLATS:
        raise InputError("it is no SPZ of version 2 or 3 with degrees up to 3: export it anew")
    rotation_bytes = 4 if version == 3 else 3
    sizes = [9, 1, 3, 3, rotation_bytes, 3 * COEFFICIENTS[degree]]
    data = unzipped(content, HEADER.size + count * sum(sizes) + 1)
    beyond = len(data) - HEADER.size - count * sum(sizes)
    if beyond < 0 or (beyond and not flags & EXTENDED):  # extensions follow, which are not read
        raise InputError(f"it has not the bytes of {count:,} splats: copy or export it anew")
    ends = HEADER.size + count * np.cumsum([0, *sizes])
    parts = [
        np.frombuffer(data[begin:end], np.uint8).reshape(count, size)
        for begin, end, size in zip(ends[:-1], ends[1:], sizes, strict=True)
    ]
    positions = np.zeros((count, 3, 4), np.uint8)
    positions[..., 1:] = parts[0].reshape(count, 3, 3)
    arrays = Arrays(
        means=(positions.reshape(count, 12).view("<i4") >> 8) / 2.0**bits,
        opacities=parts[1][:, 0] / 255,
        sh_dc=(parts[2] / 255 - 0.5) / COLOUR_SCALE,
        log_scales=parts[3] / 16 - 10,
        quats=rotations(parts[4]),
        sh_rest=(parts[5].reshape(count, -1, 3).astype(float) - 128) / 128,
    )
    return flipped(arrays) if axes == "rub" else arrays


def is_antialiased(head: bytes) -> bool:
    """Whether the header says that opacities are compensated; False for what is no SPZ."""
    try:
        header = unzipped(head, HEADER.size)
    except InputError:
        return False
    return len(header) == HEADER.size and bool(HEADER.unpack(header)[5] & ANTIALIASED)


def unzipped(content: bytes, most: int) -> bytes:
    """So many bytes of a gzip stream, or all that it has.

    Raises:
        InputError: it is none, or damaged.
    """
    try:
        return zlib.decompressobj(wbits=31).decompress(content, most)
    except zlib.error as error:
        raise InputError(f"it is no whole gzip stream ({error}): copy or export it anew") from None


def rotations(packed: UInt8[np.ndarray, "N b"]) -> Float[np.ndarray, "N 4"]:
    """Quaternions (w, x, y, z) of 4 bytes (version 3: the three smallest) or 3 (version 2: x, y, z with w >= 0)."""
    if packed.shape[1] == 3:
        three = packed / 127.5 - 1
        w = np.sqrt(np.maximum(0, 1 - (three**2).sum(1)))
        quats = np.column_stack([w, three])
        return quats / np.linalg.norm(quats, axis=1, keepdims=True)
    words = np.ascontiguousarray(packed).view("<u4")[:, 0]
    fields = np.stack([words >> 20 & 1023, words >> 10 & 1023, words & 1023], 1).astype(float)
    three = np.where(fields < 512, fields, 512 - fields) / 511 / ROOT_2
    return from_smallest_three((words >> 30).astype(np.int64), three)[:, [3, 0, 1, 2]]


def flipped(arrays: Arrays) -> Arrays:
    """The same splats with y and z turned round: from RDF to RUB, and from RUB to RDF."""
    x, y, z = FLIPS
    turn = np.array([1, y * z, x * z, x * y])
    signs = np.array([y, z, x, x * y, y * z, 1, x * z, 1, y, x * y * z, y, z, x, z, x])
    return Arrays(
        means=arrays.means * FLIPS,
        log_scales=arrays.log_scales,
        quats=arrays.quats * turn,
        opacities=arrays.opacities,
        sh_dc=arrays.sh_dc,
        sh_rest=arrays.sh_rest * signs[: arrays.sh_rest.shape[1], None],
    )
