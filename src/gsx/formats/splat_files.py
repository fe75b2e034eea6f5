"""Splat files by suffix: the standard 62-property PLY of 3D-GS (3D-GS, save_ply), and compact ones."""

import logging
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from gsx.core.errors import InputError
from gsx.core.gaussians.sh import constant_from_colour
from gsx.core.gaussians.smoothing import smoothed_raw
from gsx.core.gaussians.splats import Gaussians
from gsx.core.shapes import Float
from gsx.formats.arrays import Arrays, arrays_of, gaussians_from
from gsx.formats.compressed_ply import decode_compressed_ply, encode_compressed_ply
from gsx.formats.glb import decode_glb, encode_glb
from gsx.formats.ply import HEADER_END, read_ply, write_ply, write_whole
from gsx.formats.sog import decode_sog, encode_sog, sog_is_antialiased
from gsx.formats.spz import decode_spz, encode_spz, is_antialiased
from gsx.formats.suffixes import STANDARD, suffix_of

logger = logging.getLogger(__name__)

MOST_LOGIT = 30.0
"""What infinite logits, of opacities 0 and 1, are read as."""
MOST_COEFFICIENTS = 15
"""Beside the constant one, of degree 3."""
MODE_WORDS = ("splatrendermode:", "antialiased")
"""First words of the comments that say how a file is to be drawn."""


def columns_of(gaussians: Gaussians) -> dict[str, Float[Tensor, "N"]]:
    """Properties by name in file order; f_rest is channel-major: all red coefficients, then green, then blue."""
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


def write_gaussians(
    path: Path, gaussians: Gaussians, comments: Sequence[str] = (), compensated: bool = False, axes: str = "rub"
) -> None:
    """Write a splat file of the kind that its suffix says. compensated: opacities are, when it is drawn; axes: of SPZ.

    Raises:
        InputError: a value is not finite; the property and the number of rows are named. Or the format cannot hold
            the splats.
    """
    suffix = suffix_of(path)
    if suffix in (STANDARD, ""):
        write_columns(path, columns_of(gaussians), comments)
    else:
        write_compact(path, suffix, arrays_of(gaussians), comments, compensated, axes)


def write_compact(
    path: Path, suffix: str, arrays: Arrays, comments: Sequence[str], compensated: bool, axes: str
) -> None:
    """Write a splat file that is no standard PLY; errors as `write_gaussians`."""
    if suffix == ".spz":
        content = encode_spz(arrays, compensated, axes)
    elif suffix == ".sog":
        content = encode_sog(arrays, compensated)
    else:
        content = (encode_glb if suffix == ".glb" else encode_compressed_ply)(arrays, comments)
    write_whole(path, content)


def write_columns(path: Path, values: dict[str, Float[Tensor, "N"]], comments: Sequence[str] = ()) -> None:
    """Write a splat file of any properties; errors as `write_gaussians`."""
    columns = {name: value.detach().float().cpu().numpy() for name, value in values.items()}
    for name, value in columns.items():
        bad = int((~np.isfinite(value)).sum())
        if bad:
            raise InputError(f"{path} is not written: {bad} of {len(value)} values of '{name}' are not finite")
    write_ply(path, columns, comments)


def read_gaussians(path: Path, axes: str = "rub") -> Gaussians:
    """Read a splat file of any SH degree, of the kind that its suffix says. axes: of SPZ, which does not tell.

    Raises:
        InputError: it is damaged, or lacks a property.
    """
    suffix = suffix_of(path)
    return read_standard(path) if suffix in (STANDARD, "") else gaussians_from(read_compact(path, suffix, axes))


def read_compact(path: Path, suffix: str, axes: str) -> Arrays:
    """Read a splat file that is no standard PLY; errors as `read_gaussians`."""
    try:
        content = path.read_bytes()
        if suffix == ".spz":
            return decode_spz(content, axes)
        return {".sog": decode_sog, ".glb": decode_glb, ".compressed.ply": decode_compressed_ply}[suffix](content)
    except (OSError, InputError) as problem:
        raise InputError(f"'{path}' cannot be read: {getattr(problem, 'strerror', None) or problem}") from None


def read_standard(path: Path) -> Gaussians:
    """Read a standard PLY, with what programs are known to write otherwise; errors as `read_gaussians`.

    Properties are found by name. Colours may be bytes (nerfstudio) and bands beyond degree 3 are left out; a 3D filter
    beside the scales is fused (Mip-Splatting, training); rows that are not finite go, as viewers have it.
    """
    columns = {name: torch.from_numpy(value.astype(np.float32)) for name, value in read_ply(path).items()}

    def column(name: str) -> Tensor:
        if name not in columns:
            flat = ", it holds flat splats (2DGS)" if name == "scale_2" and "scale_1" in columns else ""
            raise InputError(f"{path} lacks property '{name}': it is no splat file of 3D-GS{flat}")
        return columns[name]

    def stack(*names: str) -> Tensor:
        return torch.stack([column(name) for name in names], 1)

    raw = {
        "means": stack(*"xyz"),
        "log_scales": stack(*(f"scale_{i}" for i in range(3))),
        "quats": stack(*(f"rot_{i}" for i in range(4))),
        "opacity_logits": column("opacity").nan_to_num(torch.nan, MOST_LOGIT, -MOST_LOGIT),
        "sh_dc": constant_colours(columns, path)
        if "f_dc_0" not in columns
        else stack(*(f"f_dc_{i}" for i in range(3))),
        "sh_rest": higher_bands(columns, path),
    }
    if "filter_3D" in columns:
        drawn = smoothed_raw(raw["log_scales"], raw["opacity_logits"], columns["filter_3D"])
        raw |= dict(zip(("log_scales", "opacity_logits"), drawn, strict=True))
    return Gaussians(**finite_rows(raw, path))


def constant_colours(columns: dict[str, Float[Tensor, "N"]], path: Path) -> Float[Tensor, "N 3"]:
    """Coefficients of the constant band from colours in bytes.

    Raises:
        InputError: there are none.
    """
    names = ("red", "green", "blue")
    if not set(names) <= columns.keys():
        raise InputError(f"{path} lacks property 'f_dc_0', or red, green and blue: it is no splat file of 3D-GS")
    return constant_from_colour(torch.stack([columns[name] for name in names], 1) / 255)


def higher_bands(columns: dict[str, Float[Tensor, "N"]], path: Path) -> Float[Tensor, "N B 3"]:
    """Coefficients beside the constant one, up to degree 3; f_rest is channel-major.

    Raises:
        InputError: there are not as many as any degree has.
    """
    count = sum(name.startswith("f_rest_") for name in columns)
    if count not in (3 * ((degree + 1) ** 2 - 1) for degree in range(5)):
        raise InputError(f"{path} has {count} f_rest properties: degrees 0 to 4 have 0, 9, 24, 45 or 72")
    rows, names = len(columns["x"]), [f"f_rest_{i}" for i in range(count)]
    if not set(names) <= columns.keys():
        raise InputError(f"{path} does not number its f_rest properties from 0 to {count - 1}: export it anew")
    values = torch.stack([columns[name] for name in names], 1) if names else torch.zeros(rows, 0)
    return values.view(rows, 3, count // 3).transpose(1, 2)[:, :MOST_COEFFICIENTS]


def finite_rows(raw: dict[str, Tensor], path: Path) -> dict[str, Tensor]:
    """The rows that are finite in everything; how many others there were goes to the log."""
    finite = torch.stack([torch.isfinite(value).flatten(1).all(1) if value.ndim > 1 else torch.isfinite(value)
                          for value in raw.values()]).all(0)  # fmt: skip
    if bool(finite.all()):
        return raw
    logger.warning("%s: %d of %d splats have values that are not finite, and are left out", path,
                   int((~finite).sum()), len(finite))  # fmt: skip
    return {name: value[finite] for name, value in raw.items()}


def compensated(path: Path) -> bool:
    """Whether a file says that opacities are compensated when it is drawn, as Mip-Splatting has it.

    SPZ has a flag for it, SOG an entry; PLY a comment, `SplatRenderMode: mip` (Brush, SuperSplat) or `antialiased 1`
    (Postshot), of which the last counts.

    Raises:
        InputError: it cannot be read.
    """
    try:
        with path.open("rb") as file:
            head = file.read(1 << 16)
    except OSError as problem:
        raise InputError(f"'{path}' cannot be read: {problem.strerror}") from None
    if suffix_of(path) == ".spz":
        return is_antialiased(head)
    if suffix_of(path) == ".sog":
        return sog_is_antialiased(path)
    if suffix_of(path) == ".glb":
        return b"SplatRenderMode: mip" in head  # a comment of ours
    lines = head.partition(HEADER_END)[0].decode("latin-1").lower().splitlines()
    words = [line.split()[1:] for line in lines if line.startswith("comment ")]
    told = [mode[1] in ("mip", "1") for mode in words if len(mode) == 2 and mode[0] in MODE_WORDS]
    return bool(told) and told[-1]
