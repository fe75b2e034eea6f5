"""Compressed PLY of PlayCanvas (SuperSplat): 16 bytes a splat in chunks of 256, a byte a coefficient of higher bands.

A chunk holds bounds of its positions, scales and colours; Morton order keeps chunks small (playcanvas/splat-transform,
MIT). Axes are those of training worlds.
"""

from collections.abc import Sequence

import numpy as np

from gsx.core.errors import InputError
from gsx.core.gaussians.sh import BAND_0
from gsx.core.shapes import Float, Int
from gsx.formats.arrays import Arrays, from_smallest_three, smallest_three
from gsx.formats.ply import elements_of, header_of

CHUNK = 256
"""Splats of a chunk."""
FAR = 20.0
"""Distance of far splats from the middle, over the median distance."""
BOUNDS = [f"{end}_{name}" for names in (("x", "y", "z"), ("scale_x", "scale_y", "scale_z"), ("r", "g", "b"))
          for end in ("min", "max") for name in names]  # fmt: skip
"""Properties of a chunk."""
PACKED = ("packed_position", "packed_rotation", "packed_scale", "packed_color")
LARGEST_LOG_SCALE = 20
LEAST_RANGE = 1e-5
"""Least range of a chunk; smaller ones count as 0."""
MOST_REST = 45
"""Coefficients of three bands, three colours."""


def encode_compressed_ply(arrays: Arrays, comments: Sequence[str] = ()) -> bytes:
    """Encodes a file of at least one splat."""
    count = len(arrays.means)
    order = chunk_order(arrays.means, arrays.opacities)
    values = [
        arrays.means[order],
        arrays.log_scales[order].clip(-LARGEST_LOG_SCALE, LARGEST_LOG_SCALE),
        0.5 + BAND_0 * arrays.sh_dc[order],
    ]
    starts, chunk_of = np.arange(0, count, CHUNK), np.arange(count) // CHUNK
    bounds = [[end.reduceat(part, starts, 0).astype(np.float32) for end in (np.minimum, np.maximum)] for part in values]
    position, scale, colour = (
        share(part, least[chunk_of], most[chunk_of]) for part, (least, most) in zip(values, bounds, strict=True)
    )
    largest, three = smallest_three(arrays.quats[order])
    rotation = bits(three * 0.5**0.5 + 0.5, 10)
    colour, opacity = bits(colour, 8), bits(arrays.opacities[order], 8)
    packed = [
        packed_11_10_11(position),
        largest << 30 | rotation[:, 0] << 20 | rotation[:, 1] << 10 | rotation[:, 2],
        packed_11_10_11(scale),
        colour[:, 0] << 24 | colour[:, 1] << 16 | colour[:, 2] << 8 | opacity,
    ]
    rest = arrays.sh_rest[order].transpose(0, 2, 1).reshape(count, -1)  # all of red first
    coefficients = np.trunc((rest / 8 + 0.5) * 256).clip(0, 255).astype(np.uint8)
    elements = {
        "chunk": (len(starts), dict.fromkeys(BOUNDS, "float")),
        "vertex": (count, dict.fromkeys(PACKED, "uint")),
    }
    if rest.shape[1]:
        elements["sh"] = count, {f"f_rest_{i}": "uchar" for i in range(rest.shape[1])}
    ranges = np.concatenate([end for pair in bounds for end in pair], 1)
    body = [ranges.astype("<f4"), np.stack(packed, 1).astype("<u4"), coefficients]
    return header_of(elements, comments) + b"".join(part.tobytes() for part in body)


def chunk_order(means: Float[np.ndarray, "N 3"], opacities: Float[np.ndarray, "N"]) -> Int[np.ndarray, "N"]:
    """Orders rows along a Morton curve; FAR ones, such as a sky, come last along their own curve.

    On one curve a few far splats would put all others into one cell. The faintest near splats, whose positions become
    coarse, fill the chunk that both share.
    """
    distance = np.abs(means - np.median(means, 0)).max(1)
    far = distance > FAR * np.median(distance)
    near_rows, far_rows = np.flatnonzero(~far), np.flatnonzero(far)
    if not len(far_rows):
        return morton_order(means)
    faintest = near_rows[np.argsort(opacities[near_rows], kind="stable")[: len(near_rows) % CHUNK]]
    near_rows = np.setdiff1d(near_rows, faintest)
    parts = [rows[morton_order(means[rows])] for rows in (near_rows, far_rows) if len(rows)]
    return np.concatenate([*parts[:-1], faintest, parts[-1]])


def morton_order(means: Float[np.ndarray, "N 3"]) -> Int[np.ndarray, "N"]:
    """Orders rows along a Morton curve of 10 bits an axis, stable."""
    least, most = means.min(0), means.max(0)
    cells = bits(share(means, least, most), 10)
    spread = np.sum([(cells >> bit & 1) << 3 * bit for bit in range(10)], 0)
    codes = spread[:, 0] | spread[:, 1] << 1 | spread[:, 2] << 2
    return np.argsort(codes, kind="stable")


def share(
    values: Float[np.ndarray, "N 3"], least: Float[np.ndarray, "..."], most: Float[np.ndarray, "..."]
) -> Float[np.ndarray, "N 3"]:
    """Returns the relative place of values between bounds, in [0, 1]; 0 if the bounds are equal."""
    span = most.astype(float) - least
    return np.where(span < LEAST_RANGE, 0, (values - least) / np.maximum(span, LEAST_RANGE)).clip(0, 1)


def bits(shares: Float[np.ndarray, "..."], count: int) -> Int[np.ndarray, "..."]:
    """Quantises shares in [0, 1] to `count` bits."""
    most = 2**count - 1
    return np.floor(shares * most + 0.5).clip(0, most).astype(np.int64)


def packed_11_10_11(shares: Float[np.ndarray, "N 3"]) -> Int[np.ndarray, "N"]:
    """Packs three shares into 32 bits."""
    x, y, z = (bits(shares[:, axis], count) for axis, count in enumerate((11, 10, 11)))
    return x << 21 | y << 11 | z


def decode_compressed_ply(content: bytes) -> Arrays:
    """Decodes a file; InputError: it is damaged, or no compressed PLY."""
    elements = elements_of(content)
    chunks, vertices = elements.get("chunk"), elements.get("vertex")
    if chunks is None or vertices is None or not set(PACKED) <= set(vertices.dtype.names or ()):
        raise InputError("it has no packed splats: export it anew as compressed PLY")
    if not set(BOUNDS[:12]) <= set(chunks.dtype.names or ()) or len(chunks) != -(-len(vertices) // CHUNK):
        raise InputError("its chunks do not match its splats: export it anew as compressed PLY")
    if not all(np.isfinite(chunks[name]).all() for name in chunks.dtype.names or ()):
        raise InputError("a chunk's range is not finite: export it anew")
    chunk_of = np.arange(len(vertices)) // CHUNK
    position, rotation, scale, colour = (vertices[name].astype(np.int64) for name in PACKED)
    means = unpacked_11_10_11(position, *ends(chunks, 0), chunk_of)
    log_scales = unpacked_11_10_11(scale, *ends(chunks, 6), chunk_of)
    colours = np.stack([colour >> shift & 255 for shift in (24, 16, 8)], 1) / 255
    if set(BOUNDS) <= set(chunks.dtype.names or ()):
        least, most = ends(chunks, 12)
        colours = least[chunk_of] + (most - least)[chunk_of] * colours
    three = np.stack([rotation >> shift & 1023 for shift in (20, 10, 0)], 1)
    return Arrays(
        means=means,
        log_scales=log_scales,
        quats=from_smallest_three(rotation >> 30, (three / 1023 - 0.5) * 2**0.5),
        opacities=(colour & 255) / 255,
        sh_dc=(colours - 0.5) / BAND_0,
        sh_rest=higher_bands(elements.get("sh"), len(vertices)),
    )


def ends(chunks: np.ndarray, first: int) -> tuple[Float[np.ndarray, "C 3"], Float[np.ndarray, "C 3"]]:
    """Returns (least, most) values of chunks, from the six properties of BOUNDS that begin at `first`."""
    columns = np.stack([chunks[name].astype(float) for name in BOUNDS[first : first + 6]], 1)
    return columns[:, :3], columns[:, 3:]


def unpacked_11_10_11(
    packed: Int[np.ndarray, "N"],
    least: Float[np.ndarray, "C 3"],
    most: Float[np.ndarray, "C 3"],
    chunk_of: Int[np.ndarray, "N"],
) -> Float[np.ndarray, "N 3"]:
    """Unpacks `packed_11_10_11` into the bounds of each chunk."""
    shares = np.stack([packed >> 21, packed >> 11 & 1023, packed & 2047], 1) / (2047, 1023, 2047)
    return least[chunk_of] + (most - least)[chunk_of] * shares


def higher_bands(table: np.ndarray | None, count: int) -> Float[np.ndarray, "N B 3"]:
    """Returns coefficients of higher bands; none without a table."""
    if table is None:
        return np.zeros((count, 0, 3))
    names = [f"f_rest_{i}" for i in range(len(table.dtype.names or ()))]
    if len(names) not in (9, 24, MOST_REST) or len(table) != count or set(names) != set(table.dtype.names or ()):
        raise InputError("its spherical harmonics do not match its splats: export it anew")
    stored = np.stack([table[name] for name in names], 1)
    values = np.select([stored == 0, stored == 255], [-4.0, 4.0], ((stored + 0.5) / 256 - 0.5) * 8)
    return values.reshape(count, 3, -1).transpose(0, 2, 1)
