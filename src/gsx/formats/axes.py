"""Axes of splat files: which way x, y and z of the numbers in a file point.

Training worlds, and what trainers write, are RDF (COLMAP, OpenCV); SPZ specifies RUB (OpenGL, three.js).
"""

from dataclasses import replace

import torch
from torch import Tensor

from gsx.core.gaussians.splats import Gaussians
from gsx.core.shapes import Float
from gsx.formats.axis_names import SYSTEMS, TRAINED
from gsx.formats.turned import turned

QUARTER = torch.tensor([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]], dtype=torch.float64)
"""Rotation from (x, y, z) to (x, z, -y)."""


def to_training_axes(gaussians: Gaussians, axes: str) -> Gaussians:
    """Returns the same Gaussians in RDF; `axes`: one of SYSTEMS, which they are in now.

    Left-handed systems are mirrored, which ellipsoids and spherical harmonics follow exactly. Systems whose y is front
    or back are those that stand 8 places before them, turned: of LFD, RFD, LBU and RBU that is what the library does,
    and not what the letters say.
    """
    if axes == TRAINED:
        return gaussians
    place = SYSTEMS.index(axes)
    upright = flipped(gaussians, signs_between(SYSTEMS[place % 8], TRAINED))
    return upright if place < 8 else turned(upright, QUARTER)


def signs_between(axes: str, others: str) -> Float[Tensor, "3"]:
    """Returns the signs of x, y and z that take one system to another."""
    return torch.tensor([1.0 if a == b else -1.0 for a, b in zip(axes, others, strict=True)])


def flipped(gaussians: Gaussians, signs: Float[Tensor, "3"]) -> Gaussians:
    """Returns the same Gaussians where x, y and z are multiplied by signs of 1 or -1."""
    x, y, z = signs.tolist()
    turn = [1, y * z, x * z, x * y]
    bands = [y, z, x, x * y, y * z, 1, x * z, 1, y, x * y * z, y, z, x, z, x]
    rest = gaussians.sh_rest
    return replace(
        gaussians,
        means=gaussians.means * signs.to(gaussians.means),
        quats=gaussians.quats * gaussians.quats.new_tensor(turn),
        sh_rest=rest * rest.new_tensor(bands)[: rest.shape[1], None],
    )
