"""Sharpness of photos, relative to their neighbours.

Blur reduces fine contrast but not coarse contrast; motion blur along one axis. The ratio of both, on the axis where it
is lower, is similar in all photos of a capture; motion by 3 px halves it (docs/explanation/photo-corrections.md).
"""

import math
import os
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d

from gsx.core.data.images import read_image
from gsx.core.shapes import Float, UInt8

COARSE = 4
"""Edge of the pixel blocks averaged for coarse contrast."""
NEIGHBOURS = 3
"""Neighbours on each side, in the order of names."""
BLURRED = 0.6
"""Largest ratio of a blurred photo. 181 photos of three captures have 0.67 or more; blurred by 3 px, 0.58 or less."""
LEAST_SIDE = 64
"""Least side of a photo for the measurement, px."""


def fineness(photo: UInt8[Tensor, "C H W"]) -> Float[Tensor, "2"]:
    """Returns fine by coarse contrast, vertical and horizontal; nan without contrast or for small photos."""
    grey = photo[:3].float().mean(0)
    if min(grey.shape) < LEAST_SIDE:
        return torch.full((2,), torch.nan)
    coarse = avg_pool2d(grey[None], COARSE)[0]
    return torch.stack([curvature(grey, axis) / curvature(coarse, axis) for axis in (0, 1)])


def curvature(grey: Float[Tensor, "H W"], axis: int) -> Float[Tensor, ""]:
    """Returns the variance of second differences along an axis."""
    inner = grey.shape[axis] - 2
    return (grey.narrow(axis, 2, inner) + grey.narrow(axis, 0, inner) - 2 * grey.narrow(axis, 1, inner)).var()


def against_neighbours(values: Float[Tensor, "N 2"]) -> Float[Tensor, "N"]:
    """Returns `fineness` by the neighbours' median, the lower of both axes; nan: unknown."""
    out = torch.full((len(values),), torch.nan)
    for number in range(len(values)):
        before, after = values[max(0, number - NEIGHBOURS) : number], values[number + 1 : number + 1 + NEIGHBOURS]
        others = torch.cat([before, after])
        if len(others):
            out[number] = (values[number] / others.nanmedian(0).values).min()
    return out


def sharpness(photos: Sequence[Path]) -> dict[Path, float]:
    """Returns `against_neighbours` of each photo in order, without unknown ones; InputError: one cannot be read."""
    if not photos:
        return {}
    with ThreadPoolExecutor(max_workers=min(8, os.cpu_count() or 1)) as pool:
        values = list(pool.map(lambda path: fineness(read_image(path)), photos))
    found = against_neighbours(torch.stack(values)).tolist()
    return {path: ratio for path, ratio in zip(photos, found, strict=True) if math.isfinite(ratio)}


def blurred(ratios: Mapping[Path, float]) -> list[tuple[Path, float]]:
    """Returns the blurred photos and their `sharpness`, worst first."""
    return sorted(((path, ratio) for path, ratio in ratios.items() if ratio < BLURRED), key=lambda pair: pair[1])


def sharpness_line(photos: Sequence[Path]) -> str:
    """Returns the line on blurred photos for `gsx scenes`; InputError: one cannot be read."""
    known = sharpness(sorted(photos))
    found, rest = blurred(known), len(photos) - len(known)
    unknown = f"; {rest} have too few pixels or too little contrast to compare" if rest else ""
    if not known:
        return f"sharpness not known{unknown}"
    if not found:
        return f"sharpness none of {len(known)} photos is blurred against its neighbours{unknown}"
    worst = ", ".join(f"{path.name} ({ratio:.2f})" for path, ratio in found[:5]) + (", ..." if found[5:] else "")
    return (
        f"sharpness {len(found)} of {len(known)} photos are blurred against their neighbours, 1 being as sharp: "
        f"{worst}; take them again, or leave them out{unknown}"
    )
