"""Quaternions (w, x, y, z)."""

import torch
from torch import Tensor

from gsx.core.shapes import Float


@torch.no_grad()
def make_identity_where_zero(quats: Float[Tensor, "N 4"]) -> None:
    """Turn zero quaternions into the identity that they stand for, in place: at zero they have no gradient."""
    quats[:, 0] = torch.where(quats.any(1), quats[:, 0], 1.0)


def rotation_matrices(quats: Float[Tensor, "N 4"]) -> Float[Tensor, "N 3 3"]:
    """Rotation matrices of quaternions (w, x, y, z) of any length; a zero quaternion is the identity (3D-GS)."""
    w, x, y, z = (quats / quats.norm(dim=1, keepdim=True).clamp_min(1e-12)).unbind(1)
    rows = [
        torch.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], 1),
        torch.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], 1),
        torch.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], 1),
    ]
    return torch.stack(rows, 1)
