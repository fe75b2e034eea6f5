"""Quaternions (w, x, y, z)."""

import torch
from torch import Tensor

from gsx.core.shapes import Float


@torch.no_grad()
def make_identity_where_zero(quats: Float[Tensor, "N 4"]) -> None:
    """Replaces zero quaternions, which have no gradient, by the identity, in place."""
    quats[:, 0] = torch.where(quats.any(1), quats[:, 0], 1.0)


def rotation_matrices(quats: Float[Tensor, "N 4"]) -> Float[Tensor, "N 3 3"]:
    """Returns the rotation matrices of quaternions of any length; the zero quaternion is the identity (3D-GS)."""
    w, x, y, z = (quats / quats.norm(dim=1, keepdim=True).clamp_min(1e-12)).unbind(1)
    rows = [
        torch.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], 1),
        torch.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], 1),
        torch.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], 1),
    ]
    return torch.stack(rows, 1)


def quaternions_of(rotations: Float[Tensor, "N 3 3"]) -> Float[Tensor, "N 4"]:
    """Returns unit quaternions of rotation matrices, by the formula without cancellation (Shepperd 1978)."""
    r = rotations.permute(1, 2, 0)
    trace = r[0, 0] + r[1, 1] + r[2, 2]
    squares = torch.stack([1 + trace, *(1 - trace + 2 * r[i, i] for i in range(3))])
    x, y, z = r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]
    xy, xz, yz = r[1, 0] + r[0, 1], r[0, 2] + r[2, 0], r[2, 1] + r[1, 2]
    rows = [[squares[0], x, y, z], [x, squares[1], xy, xz], [y, xy, squares[2], yz], [z, xz, yz, squares[3]]]
    products = torch.stack([torch.stack(row, 1) for row in rows])
    chosen = products[squares.argmax(0), torch.arange(len(rotations), device=rotations.device)]
    return chosen / chosen.norm(dim=1, keepdim=True)
