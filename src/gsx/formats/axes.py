"""Axes of splat files: directions of x, y and z.

Training worlds and trainers' files are RDF (COLMAP, OpenCV); SPZ specifies RUB (OpenGL, three.js).
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
    """Converts Gaussians from `axes`, one of SYSTEMS, to RDF; mirrors left-handed systems exactly.

    Systems whose y is front or back are the ones 8 places earlier, turned, as in Niantic's library; for LFD, RFD, LBU
    and RBU this differs from their letters.
    """
    if axes == TRAINED:
        return gaussians
    place = SYSTEMS.index(axes)
    signs = [1.0 if a == b else -1.0 for a, b in zip(SYSTEMS[place % 8], TRAINED, strict=True)]
    upright = flipped(gaussians, torch.tensor(signs))
    return upright if place < 8 else turned(upright, QUARTER)


def flipped(gaussians: Gaussians, signs: Float[Tensor, "3"]) -> Gaussians:
    """Multiplies x, y and z of Gaussians by signs of 1 or -1."""
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
