"""Documents, buffers, accessors and nodes of glTF 2.0, as GLB or as text with buffers (glTF specification, 3.6 and 4).

Damaged content raises InputError, which calls the file "it".
"""

import base64
import binascii
import json
import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np
import torch

from gsx.core.errors import InputError
from gsx.core.gaussians.quaternions import quaternions_of, rotation_matrices
from gsx.core.shapes import Float
from gsx.formats.arrays import Arrays
from gsx.formats.turned import product, turned_harmonics

MAGIC, JSON_CHUNK, BINARY_CHUNK = 0x46546C67, 0x4E4F534A, 0x004E4942
KINDS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
"""Values per row of the accessor types of splats."""
COMPONENTS = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
LARGEST = 1e30
"""Bound of numbers in a document."""
DATA_URI = "data:"
COMPRESSED_VIEWS = ("EXT_meshopt_compression", "KHR_meshopt_compression")
"""Extensions of buffer views with compressed values."""
Entry = dict[str, Any]
SHEAR = 1e-3
"""Largest cosine between orthogonal axes of a node."""
EQUAL = 1e-6
"""Largest relative difference of equal scales."""
ROUNDING = 1e-12
"""Largest rounding error of a whole number."""
IDENTITY = np.eye(4)


@dataclass(frozen=True, eq=False, kw_only=True)
class Asset:
    """A document with its buffers."""

    document: Entry
    binary: bytes
    """Binary chunk of a GLB; may be empty."""
    folder: Path | None
    """Folder of buffers in separate files; None: these are not read."""
    buffers: dict[int, bytes] = field(default_factory=dict)
    """Buffers read so far, by index."""


# -- the document ------------------------------------------------------------------------------------------------------


def asset_of(content: bytes, folder: Path | None = None) -> Asset:
    """Returns the asset of a GLB, or of a glTF as text; InputError: it is neither, cut short, or of another version."""
    if content.lstrip(b"\xef\xbb\xbf \t\r\n").startswith(b"{"):
        return Asset(document=document_of(content), binary=b"", folder=folder)
    text, binary = chunks_of(content)
    return Asset(document=document_of(text), binary=binary, folder=folder)


def glb_of(document: Entry, binary: bytes) -> bytes:
    """Packs a document and a binary chunk as GLB; chunks have multiples of 4 bytes."""
    text = json.dumps(document, separators=(",", ":")).encode()
    text, binary = (part + padding * (-len(part) % 4) for part, padding in ((text, b" "), (binary, b"\0")))
    chunks = struct.pack("<II", len(text), JSON_CHUNK) + text + struct.pack("<II", len(binary), BINARY_CHUNK) + binary
    return struct.pack("<III", MAGIC, 2, 12 + len(chunks)) + chunks


def chunks_of(content: bytes) -> tuple[bytes, bytes]:
    """Returns the text and the binary chunk of a GLB; chunks of other kinds are skipped."""
    if len(content) < 12 or struct.unpack_from("<I", content)[0] != MAGIC:
        raise InputError("it is no GLB: export it anew")
    _, version, length = struct.unpack_from("<III", content)
    if version != 2:
        raise InputError(f"it is GLB of version {version}: export it anew as version 2")
    if length > len(content):
        raise InputError(f"it ends after {len(content):,} of {length:,} bytes: copy or export it anew")
    chunks: dict[int, bytes] = {}
    start = 12
    while start + 8 <= length:
        size, kind = struct.unpack_from("<II", content, start)
        if start + 8 + size > length:
            raise InputError("it ends within a chunk: copy or export it anew")
        chunks.setdefault(kind, content[start + 8 : start + 8 + size])
        start += 8 + size
    if JSON_CHUNK not in chunks:
        raise InputError("it is no GLB with a document: export it anew")
    return chunks[JSON_CHUNK], chunks.get(BINARY_CHUNK, b"")


def document_of(text: bytes) -> Entry:
    """Returns the document of a text."""
    try:
        document = json.loads(text.decode("utf-8-sig"))
    except (ValueError, RecursionError):
        raise InputError("its document is no JSON: export it anew") from None
    if not isinstance(document, dict) or not isinstance(document.get("asset"), dict):
        raise InputError("its document is no glTF: export it anew")
    version = document["asset"].get("version")
    if not str(version).startswith("2."):
        raise InputError(f"it is glTF of version {str(version)[:20]}: export it anew as version 2.0")
    return document


def entry_at(document: Entry, collection: str, index: Any) -> Entry:
    """Returns an entry of a collection, such as a node."""
    entries = list_in(document, collection)
    if type(index) is int and 0 <= index < len(entries) and isinstance(entries[index], dict):
        return dict(entries[index])
    raise InputError(f"its {collection}[{str(index)[:20]}] is missing: export it anew")


def part_of(entry: Entry, key: str) -> Entry:
    """Returns an object in an entry, empty by default."""
    part = entry.get(key, {})
    if not isinstance(part, dict):
        raise InputError(f"its '{key}' is no object: export it anew")
    return part


def list_in(entry: Entry, key: str) -> list[Any]:
    """Returns a list in an entry, empty by default."""
    values = entry.get(key, [])
    if not isinstance(values, list):
        raise InputError(f"its '{key}' is no list: export it anew")
    return values


def whole_in(entry: Entry, key: str, default: int | None = None) -> int:
    """Returns a whole number >= 0 of an entry."""
    value = entry.get(key, default)
    if type(value) is not int or not 0 <= value < 2**53:
        raise InputError(f"its '{key}' is {str(value)[:20]}, no whole number: export it anew")
    return value


def numbers_in(entry: Entry, key: str, default: Sequence[float]) -> Float[np.ndarray, "k"]:
    """Returns finite numbers of an entry, as many as in the default."""
    values = entry.get(key, default)
    counted = isinstance(values, Sequence) and len(values) == len(default)
    if counted and all(type(value) in (int, float) and abs(value) < LARGEST for value in values):
        return np.array(values, dtype=float)
    raise InputError(f"its '{key}' is {str(values)[:40]}, no {len(default)} finite numbers: export it anew")


# -- buffers and accessors ---------------------------------------------------------------------------------------------


def buffer_of(asset: Asset, index: int) -> bytes:
    """Returns the bytes of a buffer: the binary chunk, a data URI, or a file in the same folder."""
    if index not in asset.buffers:
        entry = entry_at(asset.document, "buffers", index)
        content = asset.binary if "uri" not in entry else linked(asset, entry["uri"])
        size = whole_in(entry, "byteLength")
        if len(content) < size:
            raise InputError(f"its buffer {index} has {len(content):,} of {size:,} bytes: copy or export it anew")
        asset.buffers[index] = content
    return asset.buffers[index]


def linked(asset: Asset, uri: Any) -> bytes:
    """Returns the bytes of a buffer's URI."""
    if isinstance(uri, str) and uri.startswith(DATA_URI):
        head, _, data = uri.partition(",")
        try:
            return (
                base64.b64decode(data, validate=True) if head.endswith(";base64") else unquote(data).encode("latin-1")
            )
        except (binascii.Error, ValueError):
            raise InputError("a buffer's data URI is damaged: export it anew") from None
    name = unquote(uri) if isinstance(uri, str) else ""
    outside = "\0" in name or "://" in name or Path(name).is_absolute() or ".." in Path(name).parts
    if asset.folder is None or not name or outside:
        raise InputError(f"its buffer '{str(uri)[:60]}' is no file next to it: export it as GLB")
    try:
        return (asset.folder / name).read_bytes()
    except OSError as problem:
        raise InputError(f"its buffer '{name}' cannot be read ({problem.strerror}): copy it next to the file") from None


def view_of(asset: Asset, index: Any) -> tuple[bytes, Entry]:
    """Returns (bytes of a buffer view, its entry)."""
    entry = entry_at(asset.document, "bufferViews", index)
    compressed = [name for name in COMPRESSED_VIEWS if name in part_of(entry, "extensions")]
    if compressed:
        raise InputError(f"its values are compressed ({compressed[0]}), which is not read: export it uncompressed")
    content = buffer_of(asset, whole_in(entry, "buffer"))
    start, size = whole_in(entry, "byteOffset", 0), whole_in(entry, "byteLength")
    if start + size > len(content):
        raise InputError(f"its bufferViews[{index}] ends beyond its buffer: copy or export it anew")
    return content[start : start + size], entry


def values_of(asset: Asset, index: Any) -> Float[np.ndarray, "N k"]:
    """Returns the values of an accessor, normalised and with sparse ones; InputError: damaged, or no type of splats."""
    accessor = entry_at(asset.document, "accessors", index)
    width, count = KINDS.get(str(accessor.get("type")), 0), whole_in(accessor, "count")
    if not width or whole_in(accessor, "componentType") not in COMPONENTS or not count:
        raise InputError(f"its accessors[{index}] is of no type that splats have: export it anew")
    values = stored(asset, accessor, count, width)
    if "sparse" in accessor:
        fill_sparse(asset, accessor, values)
    return normalised(values, accessor)


def stored(asset: Asset, accessor: Entry, count: int, width: int) -> np.ndarray:
    """Returns the stored values of an accessor without sparse ones; zeros without a buffer view."""
    kind = np.dtype(COMPONENTS[accessor["componentType"]])
    if "bufferView" not in accessor:
        buffers = range(len(list_in(asset.document, "buffers")))
        if count > sum(len(buffer_of(asset, index)) for index in buffers):  # a stated length may be false
            raise InputError(f"an accessor has {count:,} values, more than the file has bytes: export it anew")
        return np.zeros((count, width), kind)
    content, view = view_of(asset, accessor["bufferView"])
    stride = whole_in(view, "byteStride", kind.itemsize * width)
    start = whole_in(accessor, "byteOffset", 0)
    if stride < 1 or start + stride * (count - 1) + kind.itemsize * width > len(content):
        raise InputError(f"an accessor has {count:,} values, its buffer view fewer: copy or export it anew")
    return np.ndarray((count, width), kind, content, start, (stride, kind.itemsize)).copy()


def fill_sparse(asset: Asset, accessor: Entry, values: np.ndarray) -> None:
    """Writes the sparse values of an accessor to their rows."""
    sparse = part_of(accessor, "sparse")
    count, indices = whole_in(sparse, "count"), part_of(sparse, "indices")
    if whole_in(indices, "componentType") not in (5121, 5123, 5125) or not count:
        raise InputError("a sparse accessor has no indices: export it anew")
    rows = stored(asset, indices, count, 1)[:, 0]
    if (rows >= len(values)).any():
        raise InputError("a sparse accessor has an index beyond its values: export it anew")
    replacing = part_of(sparse, "values") | {"componentType": accessor["componentType"]}
    values[rows] = stored(asset, replacing, count, values.shape[1])


def normalised(values: np.ndarray, accessor: Entry) -> Float[np.ndarray, "N k"]:
    """Converts values to floats; integers of a normalised accessor become shares of their maximum."""
    with np.errstate(invalid="ignore"):  # nan of any kind
        floats = values.astype(float)
    if values.dtype.kind == "f" or accessor.get("normalized") is not True:
        return floats
    return np.maximum(floats / np.iinfo(values.dtype).max, -1)


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
