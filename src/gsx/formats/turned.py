"""Rotations and axes of Gaussians: positions, orientations and view-dependent colours.

Training worlds and trainers' files are RDF (COLMAP, OpenCV); SPZ specifies RUB (OpenGL, three.js).
"""

from dataclasses import replace

import torch
from torch import Tensor

from gsx.core.gaussians.quaternions import quaternions_of
from gsx.core.gaussians.sh import degree_of, harmonics
from gsx.core.gaussians.splats import Gaussians
from gsx.core.shapes import Float
from gsx.formats.axis_names import SYSTEMS, TRAINED

DIRECTIONS = 200
"""Samples on the sphere, many more than coefficients."""
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


def turned(gaussians: Gaussians, rotation: Float[Tensor, "3 3"]) -> Gaussians:
    """Maps every point p of Gaussians to `rotation` p."""
    rotation = rotation.double()
    quats = product(quaternions_of(rotation[None])[0], torch.nn.functional.normalize(gaussians.quats.double(), dim=1))
    rest = gaussians.sh_rest
    if rest.shape[1]:
        rest = (turned_harmonics(rotation, degree_of(rest.shape[1])) @ rest.double()).to(rest)
    means = (gaussians.means.double() @ rotation.T).to(gaussians.means)
    return replace(gaussians, means=means, quats=quats.to(gaussians.quats), sh_rest=rest)


def turned_harmonics(rotation: Float[Tensor, "3 3"], degree: int) -> Float[Tensor, "B B"]:
    """Returns M with Y(d) M c = Y(rotation^T d) c for all directions d and coefficients c.

    A least-squares fit over many directions is exact, as bands do not mix (Wigner).
    """
    directions = spread_directions(DIRECTIONS)
    rotated = harmonics(directions @ rotation, degree)
    return torch.linalg.lstsq(harmonics(directions, degree), rotated).solution


def spread_directions(count: int) -> Float[Tensor, "count 3"]:
    """Returns unit vectors evenly over the sphere, float64 (a Fibonacci lattice)."""
    step = torch.arange(count, dtype=torch.float64) + 0.5
    z, angle = 1 - 2 * step / count, torch.pi * (1 + 5**0.5) * step
    return torch.stack([(1 - z * z).sqrt() * angle.cos(), (1 - z * z).sqrt() * angle.sin(), z], 1)


def product(a: Float[Tensor, "4"], b: Float[Tensor, "N 4"]) -> Float[Tensor, "N 4"]:
    """Returns the rotation b followed by a, as quaternions (w, x, y, z)."""
    w, x, y, z = a.unbind()
    left = torch.stack([torch.stack([w, -x, -y, -z]), torch.stack([x, w, -z, y]), torch.stack([y, z, w, -x]),
                        torch.stack([z, -y, x, w])])  # fmt: skip
    return b @ left.T


def cross_matrix(a: Float[Tensor, "3"]) -> Float[Tensor, "3 3"]:
    """Returns the matrix that maps b to a x b."""
    zero, (x, y, z) = a.new_zeros(()), a.unbind()
    return torch.stack([zero, -z, y, z, zero, -x, -y, x, zero]).view(3, 3)


def rotation_between(a: Float[Tensor, "3"], b: Float[Tensor, "3"]) -> Float[Tensor, "3 3"]:
    """Returns the smallest rotation from unit vector a to unit vector b, float64."""
    a, b = a.double(), b.double()
    axis, cosine = torch.linalg.cross(a, b), float(a @ b)
    if cosine < -1 + 1e-9:  # a half turn about any axis across a
        axis = torch.linalg.cross(a, torch.eye(3, dtype=torch.float64)[int(a.abs().argmin())])
        axis = axis / axis.norm()
        return 2 * torch.outer(axis, axis) - torch.eye(3, dtype=torch.float64)
    skew = cross_matrix(axis)
    return torch.eye(3, dtype=torch.float64) + skew + skew @ skew / (1 + cosine)
