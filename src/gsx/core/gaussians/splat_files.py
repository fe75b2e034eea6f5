"""Splat files: the standard 62-property PLY of 3D-GS (3D-GS, save_ply), written and read back."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from gsx.core.data.camera import offsets_from
from gsx.core.errors import InputError
from gsx.core.gaussians.ply import read_ply, write_ply
from gsx.core.gaussians.sh import colours_of
from gsx.core.gaussians.splats import Gaussians, Splats
from gsx.core.shapes import Float

SUFFIXES = (".ply",)
"""Of the files that are written."""


def refuse_suffix(path: Path) -> None:
    """Raise InputError if the name promises a format that is not written."""
    if path.suffix.lower() not in SUFFIXES:
        better = path.parent / f"{path.stem or 'model'}{SUFFIXES[0]}"
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


def write_gaussians(path: Path, gaussians: Gaussians, comments: Sequence[str] = ()) -> None:
    """Write a splat file.

    Raises:
        InputError: a value is not finite; the property and the number of rows are named.
    """
    write_columns(path, columns_of(gaussians), comments)


def write_columns(path: Path, values: dict[str, Float[Tensor, "N"]], comments: Sequence[str] = ()) -> None:
    """Write a splat file of any properties; errors as `write_gaussians`."""
    columns = {name: value.detach().float().cpu().numpy() for name, value in values.items()}
    for name, value in columns.items():
        bad = int((~np.isfinite(value)).sum())
        if bad:
            raise InputError(f"{path} is not written: {bad} of {len(value)} values of '{name}' are not finite")
    write_ply(path, columns, comments)


def read_gaussians(path: Path) -> Gaussians:
    """Read a splat file of any SH degree.

    Raises:
        InputError: a property is missing.
    """
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
    degree = round((gaussians.sh_rest.shape[1] + 1) ** 0.5) - 1
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
