"""Nodes of glTF: the transform of each mesh of a scene, and its application to splats."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import torch

from gsx.core.errors import InputError
from gsx.core.gaussians.quaternions import quaternions_of, rotation_matrices
from gsx.core.shapes import Float
from gsx.formats.arrays import Arrays
from gsx.formats.gltf_asset import LARGEST, Entry, entry_at, list_in, numbers_in
from gsx.formats.turned import product, turned_harmonics

SHEAR = 1e-3
"""Largest cosine between orthogonal axes of a node."""
EQUAL = 1e-6
"""Largest relative difference of equal scales."""
ROUNDING = 1e-12
"""Largest rounding error of a whole number."""
IDENTITY = np.eye(4)


def placed_meshes(document: Entry) -> Iterator[tuple[int, Float[np.ndarray, "4 4"]]]:
    """Yields (index of a mesh, its matrix to the world) for each node with a mesh; the identity without nodes.

    Raises:
        InputError: nodes are no trees, or one is damaged.
    """
    if not list_in(document, "nodes"):
        yield from ((mesh, IDENTITY) for mesh in range(len(list_in(document, "meshes"))))
    pending = [(index, IDENTITY) for index in reversed(roots(document))]
    visited: set[int] = set()
    while pending:
        index, world_from_parent = pending.pop()
        node = entry_at(document, "nodes", index)
        if index in visited:
            raise InputError(f"its node {index} has two parents: export it anew")
        visited.add(index)
        with np.errstate(over="ignore", invalid="ignore"):  # `moved` refuses it
            matrix = world_from_parent @ node_matrix(node)
        if "mesh" in node:
            yield node["mesh"], matrix
        pending += [(child, matrix) for child in reversed(list_in(node, "children"))]


def roots(document: Entry) -> list[int]:
    """Returns the root nodes of the displayed scene; without scenes, nodes that are no children."""
    if list_in(document, "scenes"):
        return list_in(entry_at(document, "scenes", document.get("scene", 0)), "nodes")
    nodes = range(len(list_in(document, "nodes")))
    children = [child for index in nodes for child in list_in(entry_at(document, "nodes", index), "children")]
    below = {child for child in children if type(child) is int}
    return [index for index in nodes if index not in below]


def node_matrix(node: Entry) -> Float[np.ndarray, "4 4"]:
    """Returns the matrix from a node to its parent: as stored by columns, or by translation, rotation and scale."""
    if "matrix" in node:
        return numbers_in(node, "matrix", IDENTITY.flatten().tolist()).reshape(4, 4).T
    x, y, z, w = numbers_in(node, "rotation", (0.0, 0.0, 0.0, 1.0))
    matrix = np.eye(4)
    turn = rotation_matrices(torch.tensor([[w, x, y, z]], dtype=torch.float64))[0].numpy()
    matrix[:3, :3] = turn * numbers_in(node, "scale", (1.0, 1.0, 1.0))
    matrix[:3, 3] = numbers_in(node, "translation", (0.0, 0.0, 0.0))
    return matrix


def moved(arrays: Arrays, matrix: Float[np.ndarray, "4 4"]) -> Arrays:
    """Maps every point p of splats to `matrix` (p, 1); colours turn (KHR_gaussian_splatting, "Splat Lighting").

    Raises:
        InputError: the matrix is no rotation after positive scales, and translation.
    """
    if not np.abs(matrix).max() < LARGEST:
        raise InputError("a node lies beyond all numbers: export it with its transform applied")
    if np.abs(matrix - IDENTITY).max() < ROUNDING:
        return arrays
    linear, scale = matrix[:3, :3], np.linalg.norm(matrix[:3, :3], axis=0)
    turn = torch.from_numpy(unscaled(linear, scale))
    if float(scale.max() - scale.min()) <= EQUAL * float(scale.max()):
        log_scales = arrays.log_scales + np.log(scale.mean())
        quats = product(quaternions_of(turn[None])[0], torch.from_numpy(arrays.quats)).numpy()
    else:
        log_scales, quats = stretched(arrays, linear)
    rest = arrays.sh_rest
    if arrays.degree:
        rest = sharpened(turned_harmonics(turn, arrays.degree).numpy()) @ rest
    means = arrays.means @ linear.T + matrix[:3, 3]
    return replace(arrays, means=means, log_scales=log_scales, quats=quats, sh_rest=rest)


def unscaled(linear: Float[np.ndarray, "3 3"], scale: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    """Returns the rotation of a node from its columns of lengths `scale`."""
    if scale.min() < 1 / LARGEST:
        raise InputError("a node has a scale of 0: export it with its transform applied")
    axes = linear / scale
    if np.abs(axes.T @ axes - np.eye(3)).max() > SHEAR:
        raise InputError("a node shears its splats, which is not read: export it with its transform applied")
    if np.linalg.det(axes) < 0:
        raise InputError("a node mirrors its splats, which is not read: export it with its transform applied")
    left, _, right = np.linalg.svd(axes)
    return sharpened(left @ right)


def sharpened(matrix: Float[np.ndarray, "n n"]) -> Float[np.ndarray, "n n"]:
    """Rounds entries within ROUNDING of whole numbers."""
    return np.where(np.abs(matrix - matrix.round()) < ROUNDING, matrix.round(), matrix)


def stretched(
    arrays: Arrays, linear: Float[np.ndarray, "3 3"]
) -> tuple[Float[np.ndarray, "N 3"], Float[np.ndarray, "N 4"]]:
    """Returns (log-scales, quaternions) of splats with covariance C C^T after a linear map M, by the SVD of M C."""
    own = rotation_matrices(torch.from_numpy(arrays.quats)).numpy() * np.exp(arrays.log_scales)[:, None]
    left, scales, _ = np.linalg.svd(linear @ own)
    left[:, :, 2] *= np.sign(np.linalg.det(left))[:, None]
    quats = quaternions_of(torch.from_numpy(left)).numpy()
    return np.log(np.maximum(scales, np.finfo(float).tiny)), quats
