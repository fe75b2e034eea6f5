"""SPZ, versions 2 to 4: one array an attribute, each number in few bits (Niantic, nianticlabs/spz, MIT).

The specification's axes are x right, y up, z back (RUB); many programs write those of training worlds instead, x right,
y down, z front (RDF). Only an extension of version 4 states the axes.
"""

import numpy as np

from gsx.core.errors import InputError
from gsx.core.shapes import Float, Int, UInt8
from gsx.formats.arrays import Arrays, from_smallest_three, rounded, smallest_three
from gsx.formats.axis_names import SPECIFIED
from gsx.formats.spz_streams import (
    ANTIALIASED,
    EXTENDED,
    HEADER,
    MAGIC,
    STREAMED,
    Header,
    gzipped,
    read_content,
    streamed,
    unzipped,
)

FRACTION_BITS = 12
FURTHEST = 2048 - 2**-FRACTION_BITS
"""Largest coordinate in 24 bits, scene units."""
COLOUR_SCALE = 0.15
MOST_COEFFICIENTS = 15
"""Coefficients of degree 3, without the constant one."""
ROOT_2 = 2**0.5


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
    file = read_content(content)
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
