"""`.ksplat`, version 0.1 (mkkellogg/GaussianSplats3D, MIT): a header, headers of sections, and the sections.

A section has the sizes of its partly filled buckets, the centres of all buckets, and its splats. Compression level 0
has floats; levels 1 and 2 have positions of 16 bits around the centre of a bucket, halves for scales and quaternions
(w first), and for higher bands halves (1) or bytes (2). Axes are those of training worlds. Damaged content raises
InputError, which calls the file "it".
"""

import struct
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from gsx.core.errors import InputError
from gsx.core.shapes import Float, Int
from gsx.formats.arrays import Arrays, joined, unit_quaternions
from gsx.formats.splat import constants_of, log_scales_of

HEADER_BYTES, SECTION_BYTES = 4096, 1024
HEADER = struct.Struct("<BB2xIIIIHxx3fff")
"""Version, most sections, sections, most splats, splats, level, centre of the scene, range of coefficients in bytes."""
SECTION = struct.Struct("<IIIIfHxxIIIIH")
"""Fields of `Section`."""
MAJOR, LEAST_MINOR = 0, 1
CENTRE_BYTES = 12
"""Bytes of a bucket's centre."""
HALF_RANGE = 32767
"""Default of the steps from a bucket's centre to its side."""
COEFFICIENT_RANGE = 1.5
"""Default of the largest coefficient in bytes."""
BANDS = {0: (), 1: (3,), 2: (3, 5), 3: (3, 5, 7)}
"""Coefficients of each band, by degree."""


LEVELS = (("<f4", "<f4", "<f4"), ("<u2", "<f2", "<f2"), ("<u2", "<f2", "u1"))
"""Types of positions, of scales and quaternions, and of coefficients, by level of compression."""


@dataclass(frozen=True, kw_only=True)
class Header:
    """Header of a file."""

    sections: int
    splats: int
    level: int
    least: float
    most: float
    """Coefficients that bytes 0 and 255 stand for."""


class Section(NamedTuple):
    """Header of a section, in the order of SECTION."""

    loaded: int
    most: int
    bucket_size: int
    buckets: int
    block: float
    """Side of a bucket's block, scene units."""
    bucket_bytes: int
    half_range: int
    size: int
    full: int
    """Full buckets, which come first."""
    partial: int
    degree: int

    @property
    def splats(self) -> int:
        """Return the number of splats; some writers leave `most` at 0."""
        return self.most or self.loaded

    @property
    def coefficients(self) -> int:
        """Return the number of coefficients without the constant ones, of all colours."""
        return 3 * sum(BANDS[self.degree])

    def row(self, level: int) -> np.dtype:
        """Returns the type of a splat's row at a level of compression."""
        mean, value, coefficient = LEVELS[level]
        parts = [("mean", mean, 3), ("scale", value, 3), ("quat", value, 4), ("colour", "u1", 4)]
        return np.dtype([*parts, ("rest", coefficient, self.coefficients)])


def decode_ksplat(content: bytes) -> Arrays:
    """Decodes a file, rows with NaN or inf included; InputError: it is damaged, or of another version."""
    header = header_of(content)
    start = HEADER_BYTES + header.sections * SECTION_BYTES
    if len(content) < start:
        raise InputError(f"it ends within the headers of its {header.sections:,} sections: copy or export it anew")
    parts = []
    for number in range(header.sections):
        section = section_of(content, number, header.level)
        arrays, start = splats_of(content, start, section, header)
        parts.append(arrays)
    count = sum(len(part.means) for part in parts)
    if count != header.splats:
        raise InputError(f"its header says {header.splats:,} splats, its sections {count:,}: save it anew")
    if not count:
        raise InputError("it holds no splats: choose another file")
    return joined(parts)


def header_of(content: bytes) -> Header:
    """Returns the header."""
    if len(content) < HEADER_BYTES:
        raise InputError("it is no .ksplat, or ends within its header: copy or export it anew")
    major, minor, sections, _, most, splats, level, *_, least, greatest = HEADER.unpack_from(content)
    if major != MAJOR or minor < LEAST_MINOR:
        raise InputError(f"it is no .ksplat, or of version {major}.{minor}; gsx reads 0.1: save it anew as that")
    if level >= len(LEVELS):
        raise InputError(f"it has compression level {level}; gsx reads 0, 1 and 2: save it anew with one of them")
    if splats and most and splats != most:
        raise InputError(f"it holds {splats:,} of {most:,} splats: it was saved half loaded, save it anew")
    return Header(
        sections=sections,
        splats=most or splats,  # some writers leave one of them at 0
        level=level,
        least=least or -COEFFICIENT_RANGE,
        most=greatest or COEFFICIENT_RANGE,
    )


def section_of(content: bytes, number: int, level: int) -> Section:
    """Returns the header of a section."""
    section = Section(*SECTION.unpack_from(content, HEADER_BYTES + number * SECTION_BYTES))
    degree, full = section.degree, section.full
    if degree not in BANDS:
        raise InputError(f"section {number} has degree {degree}; gsx reads 0 to 3: save it anew")
    misfit = full + section.partial != section.buckets or full * section.bucket_size > section.splats
    if level and (section.bucket_bytes != CENTRE_BYTES or misfit):
        raise InputError(f"the buckets of section {number} are not those of its splats: save it anew")
    return section._replace(half_range=section.half_range or HALF_RANGE)


def splats_of(content: bytes, start: int, section: Section, header: Header) -> tuple[Arrays, int]:
    """Returns (splats of a section that begins at byte `start`, byte of its end)."""
    kind = section.row(header.level)
    centres = start + 4 * section.partial
    first = centres + section.bucket_bytes * section.buckets
    end = first + section.splats * kind.itemsize
    if end > len(content):
        raise InputError(f"it ends after {len(content):,} of {end:,} bytes or more: copy or export it anew")
    rows = np.frombuffer(content, kind, section.splats, first)
    means = rows["mean"].astype(float)
    if header.level:
        sizes = np.frombuffer(content, "<u4", section.partial, start).astype(np.int64)
        bucket = buckets_of(sizes, section)
        middle = np.frombuffer(content, "<f4", 3 * section.buckets, centres).reshape(-1, 3).astype(float)
        means = middle[bucket] + (means - section.half_range) * (section.block / 2 / section.half_range)
    arrays = Arrays(
        means=means,
        log_scales=log_scales_of(rows["scale"].astype(float)),
        quats=unit_quaternions(rows["quat"].astype(float)),
        opacities=rows["colour"][:, 3] / 255,
        sh_dc=constants_of(rows["colour"][:, :3]),
        sh_rest=higher_bands(coefficients_of(rows["rest"], header), section.degree),
    )
    return arrays, end


def buckets_of(partial: Int[np.ndarray, "P"], section: Section) -> Int[np.ndarray, "N"]:
    """Returns the bucket of each splat; partial: sizes of the buckets that are not full."""
    held = section.full * section.bucket_size + int(partial.sum())
    if held != section.splats:
        raise InputError(f"its buckets hold {held:,} splats, their section {section.splats:,}: save it anew")
    sizes = np.concatenate([np.full(section.full, section.bucket_size), partial])
    return np.repeat(np.arange(section.buckets), sizes)


def coefficients_of(stored: np.ndarray, header: Header) -> Float[np.ndarray, "N C"]:
    """Returns coefficients of higher bands as numbers."""
    if stored.dtype != np.uint8:
        return stored.astype(float)
    return header.least + stored / 255 * (header.most - header.least)


def higher_bands(values: Float[np.ndarray, "N C"], degree: int) -> Float[np.ndarray, "N B 3"]:
    """Returns coefficients as (coefficient, colour); each band of a file has all of red, then green, then blue."""
    bands, begin = [np.zeros((len(values), 0, 3))], 0
    for size in BANDS[degree]:
        bands.append(values[:, begin : begin + 3 * size].reshape(-1, 3, size).transpose(0, 2, 1))
        begin += 3 * size
    return np.concatenate(bands, 1)
