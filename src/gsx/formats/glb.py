"""GLB with KHR_gaussian_splatting: glTF's binary container, float attributes (KhronosGroup/glTF at 77b44be7, of
2026-07-17, where the extension is a release candidate: scales and opacities are linear).

The splats lie as training has them (x right, y down, z front) below a node that turns them by 180 degrees about z, into
glTF's world (y up): a viewer that heeds the node turns their spherical harmonics with them.
"""

import json
import struct
from collections.abc import Sequence
from typing import Any

import numpy as np

from gsx.core.errors import InputError
from gsx.core.gaussians.sh import degree_of
from gsx.core.shapes import Float
from gsx.formats.arrays import Arrays

MAGIC, JSON_CHUNK, BINARY_CHUNK = 0x46546C67, 0x4E4F534A, 0x004E4942
EXTENSION = "KHR_gaussian_splatting"
REVISION = "KHR_gaussian_splatting release candidate, KhronosGroup/glTF 77b44be7 (2026-07-17)"
TURN = [0.0, 0.0, 1.0, 0.0]
"""Quaternion (x, y, z, w) of the node."""
FLOAT, ARRAY_BUFFER, POINTS = 5126, 34962, 0
KINDS = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}


def encode_glb(arrays: Arrays, comments: Sequence[str] = ()) -> bytes:
    """A file.

    Raises:
        InputError: there are no splats.
    """
    count = len(arrays.means)
    if count == 0:
        raise InputError("GLB holds no empty scenes: the model has no splats")
    columns = {name: values.astype("<f4") for name, values in attributes_of(arrays).items()}
    body, views, accessors = b"", [], []
    for values in columns.values():
        kind = next(kind for kind, width in KINDS.items() if values.size == count * width)
        views.append({"buffer": 0, "byteOffset": len(body), "byteLength": values.nbytes, "target": ARRAY_BUFFER})
        accessors.append({"bufferView": len(views) - 1, "componentType": FLOAT, "count": count, "type": kind})
        body += values.tobytes()
    accessors[0] |= {"min": columns["POSITION"].min(0).tolist(), "max": columns["POSITION"].max(0).tolist()}
    primitive = {
        "mode": POINTS,
        "attributes": {name: i for i, name in enumerate(columns)},
        "extensions": {EXTENSION: {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}},
    }
    content = {
        "asset": {"version": "2.0", "generator": "gsx", "extras": {"extension": REVISION, "comments": list(comments)}},
        "extensionsUsed": [EXTENSION],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "rotation": TURN}],
        "meshes": [{"primitives": [primitive]}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": len(body)}],
    }
    text = json.dumps(content, separators=(",", ":")).encode()
    chunks = chunk(JSON_CHUNK, text, b" ") + chunk(BINARY_CHUNK, body, b"\0")
    return struct.pack("<III", MAGIC, 2, 12 + len(chunks)) + chunks


def attributes_of(arrays: Arrays) -> dict[str, Float[np.ndarray, "..."]]:
    """Attributes by name, in the units of the extension."""
    found = {
        "POSITION": arrays.means,
        f"{EXTENSION}:ROTATION": arrays.quats[:, [1, 2, 3, 0]],
        f"{EXTENSION}:SCALE": np.exp(arrays.log_scales.clip(-60, 60)),
        f"{EXTENSION}:OPACITY": arrays.opacities,
        f"{EXTENSION}:SH_DEGREE_0_COEF_0": arrays.sh_dc,
    }
    return found | {name: arrays.sh_rest[:, i] for i, name in enumerate(higher_bands(arrays.degree))}


def higher_bands(degree: int) -> list[str]:
    """Attributes of all bands but the constant one."""
    return [f"{EXTENSION}:SH_DEGREE_{band}_COEF_{n}" for band in range(1, degree + 1) for n in range(2 * band + 1)]


def chunk(kind: int, content: bytes, padding: bytes) -> bytes:
    """A chunk of the container, of a multiple of 4 bytes."""
    content += padding * (-len(content) % 4)
    return struct.pack("<II", len(content), kind) + content


def decode_glb(content: bytes) -> Arrays:
    """The splats of a file that holds one primitive of them, in floats, below a node as `encode_glb` writes it.

    Raises:
        InputError: it is damaged, or other than that.
    """
    document, body = container(content)
    try:
        (mesh,) = document["meshes"]
        (primitive,) = mesh["primitives"]
        (node,) = document["nodes"]
        turned = {key: node[key] for key in ("rotation", "translation", "scale", "matrix") if key in node}
        if EXTENSION not in primitive["extensions"] or turned != {"rotation": TURN}:
            raise InputError(
                "its splats lie otherwise than gsx writes them: convert it to PLY by the program it is from"
            )
        found = {name: accessed(document, body, index) for name, index in primitive["attributes"].items()}
        return arrays_of_attributes(found)
    except (KeyError, TypeError, ValueError, IndexError, AttributeError) as error:
        raise InputError(f"it is no GLB of splats as gsx reads them ({type(error).__name__}: {error})") from None


def container(content: bytes) -> tuple[Any, bytes]:
    """Document and binary chunk.

    Raises:
        InputError: it is no GLB, or ends early.
    """
    if len(content) < 20 or struct.unpack_from("<II", content) != (MAGIC, 2):
        raise InputError("it is no GLB of version 2: export it anew")
    size, kind = struct.unpack_from("<II", content, 12)
    binary = 20 + size + 8
    if kind != JSON_CHUNK or binary > len(content):
        raise InputError("it is no whole GLB: copy or export it anew")
    length, second = struct.unpack_from("<II", content, binary - 8)
    if second != BINARY_CHUNK or binary + length > len(content):
        raise InputError("it is no whole GLB: copy or export it anew")
    try:
        return json.loads(content[20 : 20 + size].decode()), content[binary : binary + length]
    except (ValueError, RecursionError):
        raise InputError("its document is no JSON: export it anew") from None


def accessed(document: Any, body: bytes, index: int) -> Float[np.ndarray, "N k"]:
    """Values of an accessor, which has to be of floats that lie side by side."""
    accessor = document["accessors"][index]
    view, width = document["bufferViews"][accessor["bufferView"]], KINDS[accessor["type"]]
    count, start = accessor["count"], view.get("byteOffset", 0) + accessor.get("byteOffset", 0)
    if accessor["componentType"] != FLOAT or "sparse" in accessor or view.get("byteStride", 4 * width) != 4 * width:
        raise ValueError("its attributes are no floats side by side")
    if not (isinstance(count, int) and count >= 1 and isinstance(start, int) and start >= 0):
        raise ValueError("an accessor is of nothing")
    with np.errstate(invalid="ignore"):  # nan of any kind, refused later
        return np.frombuffer(body, "<f4", count * width, start).reshape(count, width).astype(float)


def arrays_of_attributes(found: dict[str, Float[np.ndarray, "N k"]]) -> Arrays:
    """Splats of attributes by name.

    Raises:
        KeyError, ValueError: one is missing, or of another form.
    """
    bands = [name for name in higher_bands(3) if name in found]
    degree = degree_of(len(bands))
    if bands != higher_bands(degree) or len({len(values) for values in found.values()}) != 1:
        raise ValueError("its bands are not whole, or not those of all splats")
    scales, quats = found[f"{EXTENSION}:SCALE"], found[f"{EXTENSION}:ROTATION"]
    if not all(np.isfinite(values).all() for values in found.values()) or (scales <= 0).any():
        raise ValueError("a value is not finite, or a scale not above 0")
    norms = np.linalg.norm(quats, axis=1, keepdims=True)
    if not (norms > 0).all():
        raise ValueError("a rotation is none")
    rest = np.stack([found[name] for name in bands], 1) if bands else np.empty((len(scales), 0, 3))
    return Arrays(
        means=found["POSITION"],
        log_scales=np.log(scales),
        quats=(quats / norms)[:, [3, 0, 1, 2]],
        opacities=found[f"{EXTENSION}:OPACITY"][:, 0],
        sh_dc=found[f"{EXTENSION}:SH_DEGREE_0_COEF_0"],
        sh_rest=rest,
    )
