"""The up direction of a scene, from its cameras."""

import torch
from torch import Tensor

from gsx.core.shapes import Float

UPRIGHT = 0.05
"""Weight of the mean image-up against level horizons; small: horizons win wherever they say anything."""


def upright(rotations: Float[Tensor, "K 3 3"]) -> Float[Tensor, "3"]:
    """Return the up direction: near the mean image-up, and across the images' horizontal axes where those differ.

    Photographers hold cameras level but tilt them: the mean image-up alone leans away from what a half ring surrounds.
    """
    right, up = rotations[:, 0], -rotations[:, 1]
    level = right.T @ right / len(right) + UPRIGHT * torch.eye(3, dtype=right.dtype)
    solved = torch.linalg.solve(level, up.mean(0))
    if solved.norm() < 1e-6:  # cameras rolled every way
        return up[0]
    return solved / solved.norm()
