"""Splat files by suffix: the standard 62-property PLY of 3D-GS (3D-GS, save_ply), and compact ones."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from gsx.core.data.camera import offsets_from
from gsx.core.errors import InputError
from gsx.core.gaussians.arrays import Arrays, arrays_of, degree_of, gaussians_from
from gsx.core.gaussians.compressed_ply import decode_compressed_ply, encode_compressed_ply
from gsx.core.gaussians.glb import decode_glb, encode_glb
from gsx.core.gaussians.ply import read_ply, write_ply, write_whole
from gsx.core.gaussians.sh import colours_of
from gsx.core.gaussians.splats import Gaussians, Splats
from gsx.core.gaussians.spz import decode_spz, encode_spz
from gsx.core.shapes import Float

SUFFIXES = (".compressed.ply", ".ply", ".spz", ".glb")
"""Of the files that are written and read; the longer of two that fit first."""
STANDARD = ".ply"
"""Nothing is lost in it, and a backbone's own file is one."""


def suffix_of(path: Path) -> str:
    """Which of SUFFIXES a name has; empty: none."""
    return next((suffix for suffix in SUFFIXES if path.name.lower().endswith(suffix)), "")


def refuse_suffix(path: Path) -> None:
    """Raise InputError if the name promises a format that is not written."""
    if not suffix_of(path):
        better = path.parent / f"{path.stem or 'model'}{STANDARD}"
        raise InputError(f"{path} is not written: gsx writes {', '.join(SUFFIXES)} alone, name it {better}")


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
        return decode_glb(content) if suffix == ".glb" else decode_compressed_ply(content)
    except (OSError, InputError) as problem:
        raise InputError(f"'{path}' cannot be read: {getattr(problem, 'strerror', None) or problem}") from None


def read_standard(path: Path) -> Gaussians:
    """Read a standard PLY; errors as `read_gaussians`."""
    columns = {name: torch.from_numpy(value.astype(np.float32)) for name, value in read_ply(path).items()}

    def column(name: str) -> Tensor:
        if name not in columns:
            raise InputError(f"{path} lacks property '{name}': it is no splat file of 3D-GS")
        return columns[name]

    def stack(prefix: str, count: int) -> Tensor:
        return torch.stack([column(f"{prefix}{i}") for i in range(count)], 1)

    bands = sum(name.startswith("f_rest_") for name in columns) // 3
    rest = stack("f_rest_", 3 * bands) if bands else torch.zeros(len(column("x")), 0)
    return Gaussians(
        means=torch.stack([column(axis) for axis in "xyz"], 1),
        log_scales=stack("scale_", 3),
        quats=stack("rot_", 4),
        opacity_logits=column("opacity"),
        sh_dc=stack("f_dc_", 3),
        sh_rest=rest.view(len(rest), 3, bands).transpose(1, 2),
    )


def splats_of(gaussians: Gaussians, camera_centre: Float[Tensor, "3"]) -> Splats:
    """What a viewer of the file draws: all bands active (3D-GS, sh_utils.py)."""
    degree = degree_of(gaussians.sh_rest.shape[1])
    return Splats(
        means=gaussians.means,
        scales=gaussians.log_scales.exp(),
        quats=gaussians.quats,
        log_opacities=torch.nn.functional.logsigmoid(gaussians.opacity_logits),
        colours=colours_of(
            gaussians.sh_dc[:, None],
            gaussians.sh_rest,
            offsets_from(gaussians.means, camera_centre),
            degree,
        ),
    )
