"""Splat files of all formats: the standard 62-property PLY of 3D-GS (3D-GS, save_ply), and compact ones."""

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from gsx.core.errors import InputError
from gsx.core.files import refuse_lfs_pointer
from gsx.core.gaussians.splats import Gaussians
from gsx.core.shapes import Float
from gsx.formats.arrays import Arrays, arrays_of, finite_rows, gaussians_from
from gsx.formats.axis_names import AUTO, CHOICES, EXAMPLES, FIXED, SPECIFIED, TRAINED
from gsx.formats.compressed_ply import decode_compressed_ply, encode_compressed_ply
from gsx.formats.detect import MOST_HEADER, format_of
from gsx.formats.glb import decode_glb, encode_glb, names_linear
from gsx.formats.ksplat import decode_ksplat
from gsx.formats.origin import NO_ORIGIN, Origin, around, away, origin_of_positions, stated_in
from gsx.formats.ply import HEADER_END, write_ply, write_whole
from gsx.formats.sog import encode_sog
from gsx.formats.sog_reading import decode_sog, sog_is_antialiased
from gsx.formats.splat import decode_splat
from gsx.formats.spz import decode_spz, encode_spz, is_antialiased
from gsx.formats.standard_ply import decode_standard_ply
from gsx.formats.suffixes import SPZ_VERSIONS, STANDARD, WRITTEN, splat_file_at, suffix_of
from gsx.formats.turned import to_training_axes

logger = logging.getLogger(__name__)

DECODERS = {".compressed.ply": decode_compressed_ply, ".splat": decode_splat, ".ksplat": decode_ksplat}
"""Decoders that need only a file's content."""

MODE_WORDS = ("splatrendermode:", "antialiased")
"""First words of comments on compensated opacities."""

REASONS = {"given": "the settings say", "stated": "the file states"}
"""Reasons for certain axes, for the log."""


def columns_of(gaussians: Gaussians) -> dict[str, Float[Tensor, "N"]]:
    """Returns properties in file order; f_rest is channel-major: all red, then green, then blue."""
    rest = gaussians.sh_rest.transpose(1, 2).flatten(1)
    zeros = torch.zeros_like(gaussians.opacity_logits)
    columns = dict(zip("xyz", gaussians.means.unbind(1), strict=True))
    columns |= dict.fromkeys(("nx", "ny", "nz"), zeros)
    columns |= {f"f_dc_{i}": value for i, value in enumerate(gaussians.sh_dc.unbind(1))}
    columns |= {f"f_rest_{i}": value for i, value in enumerate(rest.unbind(1))}
    columns["opacity"] = gaussians.opacity_logits
    columns |= {f"scale_{i}": value for i, value in enumerate(gaussians.log_scales.unbind(1))}
    columns |= {f"rot_{i}": value for i, value in enumerate(gaussians.quats.unbind(1))}
    return columns


@dataclass(frozen=True, kw_only=True)
class SpzForm:
    """Version and axes of a .spz to write."""

    version: int = 3
    """4: streams of Zstandard and stated axes; 3: more programs read it."""
    axes: str = SPECIFIED
    """rub, of the specification, or rdf, of training worlds."""

    def __post_init__(self) -> None:
        if self.version not in SPZ_VERSIONS:
            raise InputError(f"the version of SPZ is {self.version!r}: choose {' or '.join(map(str, SPZ_VERSIONS))}")
        if self.axes not in (SPECIFIED, TRAINED):
            raise InputError(f"the axes of SPZ are {self.axes!r}: choose {SPECIFIED} or {TRAINED}")


def write_gaussians(
    path: Path,
    gaussians: Gaussians,
    comments: Sequence[str] = (),
    compensated: bool = False,
    spz: SpzForm = SpzForm(),
    origin: Origin = NO_ORIGIN,
) -> None:
    """Writes a splat file of the format of its suffix.

    compensated: opacities are compensated in renders; origin: added to positions in float64.

    Raises:
        InputError: a value is not finite, or the format cannot hold the splats.
    """
    suffix = suffix_of(path)
    if suffix in (STANDARD, ""):
        write_columns(path, columns_of(gaussians), comments, origin)
    elif suffix == ".glb":
        write_whole(path, encode_glb(arrays_of(gaussians), comments, origin))
    elif suffix == ".spz":
        turned = to_training_axes(away(gaussians, origin), spz.axes)  # a turn by 180 degrees is its own inverse
        write_whole(path, encode_spz(arrays_of(turned), compensated, spz.version, spz.axes))
    elif suffix == ".sog":
        write_whole(path, encode_sog(arrays_of(away(gaussians, origin)), compensated))
    elif suffix == ".compressed.ply":
        write_whole(path, encode_compressed_ply(arrays_of(away(gaussians, origin)), comments))
    else:
        raise InputError(f"{path}: gsx does not write {suffix}: give a name that ends in {', '.join(WRITTEN)}")


def write_columns(
    path: Path, values: dict[str, Float[Tensor, "N"]], comments: Sequence[str] = (), origin: Origin = NO_ORIGIN
) -> None:
    """Writes a PLY of any properties; origin: added to x, y and z as doubles; errors as `write_gaussians`."""
    columns = {name: value.detach().float().cpu().numpy() for name, value in values.items()}
    for name, value in columns.items():
        bad = int((~np.isfinite(value)).sum())
        if bad:
            raise InputError(f"{path} is not written: {bad} of {len(value)} values of '{name}' are not finite")
    if any(origin):
        columns |= {axis: columns[axis].astype(float) + by for axis, by in zip("xyz", origin, strict=True)}
    write_ply(path, columns, comments)


@dataclass(frozen=True, eq=False, kw_only=True)
class SplatContent:
    """Content of a splat file."""

    path: Path
    gaussians: Gaussians
    """Splats converted from `axes` to training axes; means in float64, with the stated origin."""
    axes: str
    """Axes of the file's numbers: one of `axis_names.SYSTEMS`."""
    by: str
    """Source of the axes: a setting, stated in the file, specified (SPZ, not always followed), fixed (glTF), or
    conventional."""


def read_gaussians(path: Path, axes: str = AUTO, origin: Origin = NO_ORIGIN) -> Gaussians:
    """Reads a splat file of any format and SH degree, and logs its axes.

    axes: one of `axis_names.CHOICES`; origin: subtracted from positions in float64.

    Raises:
        InputError: it is damaged, lacks a property, or axes are set for a format that fixes them.
    """
    return around(read_in_double(path, axes), origin)


def read_around(path: Path, axes: str = AUTO, base: Origin = NO_ORIGIN) -> tuple[Gaussians, Origin]:
    """Reads a splat file as (Gaussians around their own origin, that origin); coordinates relative to `base`."""
    x, y, z = base
    gaussians = away(read_in_double(path, axes), (-x, -y, -z))
    origin = origin_of_positions(gaussians.means)
    return around(gaussians, origin), origin


def read_in_double(path: Path, axes: str = AUTO) -> Gaussians:
    """Reads a splat file as `read_gaussians`, with means in float64 and the file's stated origin added."""
    content = read_splats(path, axes)
    log_axes(content)
    return content.gaussians


def read_splats(path: Path, axes: str = AUTO) -> SplatContent:
    """Reads a splat file without logging its axes; errors as `read_gaussians`."""
    if axes not in CHOICES:
        raise InputError(f"axes is {axes!r}: choose {EXAMPLES}")
    path = splat_file_at(path)
    if not path.exists():
        raise InputError(f"'{path}' does not exist: check the path")
    refuse_lfs_pointer(path)
    try:
        content = path.read_bytes()
        kind = kind_of(content, path)
        if axes != AUTO and kind == ".glb":
            raise InputError(f"axes is {axes}, and glTF fixes the axes of its files: leave it out")
        gaussians, stated = decode(content, kind, str(path))
        gaussians = away(gaussians, stated_in(content[:MOST_HEADER]))
    except (OSError, InputError) as problem:
        raise InputError(f"'{path}' cannot be read: {getattr(problem, 'strerror', None) or problem}") from None
    if axes != AUTO and stated not in (None, axes):
        logger.warning("%s states axes %s, using %s from the settings", path, stated, axes)
    if axes != AUTO:
        by = "given"
    elif stated:
        axes, by = stated, "stated"
    elif kind == ".spz":
        axes, by = SPECIFIED, "specified"
    else:
        axes, by = TRAINED, FIXED if kind == ".glb" else "conventional"
    return SplatContent(path=path, gaussians=to_training_axes(gaussians, axes), axes=axes, by=by)


def kind_of(content: bytes, path: Path) -> str:
    """Returns the format of a file, one of SUFFIXES; logs if its name differs."""
    kind = format_of(content[:MOST_HEADER], path)
    if kind != format_of(b"", path):
        logger.info("%s is read as %s, by its first bytes", path, kind)
    return kind


def log_axes(content: SplatContent) -> None:
    """Logs the axes of a file and a remedy if they are wrong, unless its format fixes them."""
    if content.by == "specified":
        logger.info(
            "%s: axes %s, as SPZ specifies; the file states none. If it lies upside down or out of view, set axes %s "
            "(--axes %s, or axes=%s)",
            *(content.path, content.axes, TRAINED, TRAINED, TRAINED),
        )
    elif content.by in REASONS:
        logger.info("%s: axes %s, as %s", content.path, content.axes, REASONS[content.by])


def decode(content: bytes, kind: str, name: str) -> tuple[Gaussians, str | None]:
    """Returns (splats of a file's content with float64 means, axes that it states or None).

    kind: one of SUFFIXES; name: of the file, for the log.
    """
    if kind == ".spz":
        arrays, stated = decode_spz(content)
        return in_double(arrays), stated
    if kind == STANDARD:
        return decode_standard_ply(content, name), None
    if kind == ".glb":
        return in_double(decode_glb(content, name, Path(name).parent)), None
    if kind == ".sog":
        return in_double(decode_sog(content, Path(name))), None
    with np.errstate(over="ignore", invalid="ignore"):  # `finite_rows` drops the rows
        gaussians = in_double(DECODERS[kind](content))
    return Gaussians(**finite_rows(vars(gaussians), name)), None


def in_double(arrays: Arrays) -> Gaussians:
    """Returns Gaussians of arrays with float64 means; NaN for those beyond float32."""
    gaussians, means = gaussians_from(arrays), torch.from_numpy(arrays.means)
    return replace(gaussians, means=torch.where(gaussians.means.isfinite(), means, torch.nan))


def compensated(path: Path) -> bool:
    """Returns whether a file states compensated opacities, as of Mip-Splatting; InputError: it cannot be read.

    SPZ has a flag, SOG an entry (`sog_is_antialiased`), PLY a comment, of which the last counts: `SplatRenderMode: mip`
    (Brush, SuperSplat) or `antialiased 1` (Postshot). `.splat` and `.ksplat` have none.
    """
    path = splat_file_at(path)
    refuse_lfs_pointer(path)
    try:
        with path.open("rb") as file:
            head = file.read(MOST_HEADER)
    except OSError as problem:
        raise InputError(f"'{path}' cannot be read: {problem.strerror}") from None
    kind = format_of(head, path)
    if kind == ".spz":
        return is_antialiased(head)
    if kind == ".sog":
        return sog_is_antialiased(path)
    if kind == ".glb":
        return b"SplatRenderMode: mip" in head  # a comment of ours
    if kind in (".splat", ".ksplat"):
        return False
    lines = head.partition(HEADER_END)[0].decode("latin-1").lower().splitlines()
    words = [line.split()[1:] for line in lines if line.startswith("comment ")]
    stated = [mode[1] in ("mip", "1") for mode in words if len(mode) == 2 and mode[0] in MODE_WORDS]
    return bool(stated) and stated[-1]


def is_linear(path: Path) -> bool:
    """Returns whether a splat file has colours of linear light, which reading converts to sRGB."""
    with splat_file_at(path).open("rb") as file:
        head = file.read(MOST_HEADER)
        return format_of(head, path) == ".glb" and names_linear(head + file.read())
