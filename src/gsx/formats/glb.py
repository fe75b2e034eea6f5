"""GLB with KHR_gaussian_splatting: linear scales and opacities, harmonics of sRGB or linear light.

Follows the ratified extension, in the text of KhronosGroup/glTF 63770cc (2026-04-15). Splats are written in training
axes below a node that turns them by 180 degrees about z into glTF's world (y up); viewers turn harmonics with it.
"""

import logging
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from gsx.core.data.resize import display_from_linear
from gsx.core.errors import InputError
from gsx.core.gaussians.bands import BAND_0
from gsx.core.gaussians.sh import degree_of, harmonics
from gsx.core.shapes import Float
from gsx.formats.arrays import Arrays, finite_rows, joined, unit_quaternions
from gsx.formats.gltf_asset import (
    KINDS,
    Asset,
    Entry,
    asset_of,
    entry_at,
    glb_of,
    list_in,
    moved,
    part_of,
    placed_meshes,
    values_of,
    view_of,
)
from gsx.formats.spz import decode_spz
from gsx.formats.turned import DIRECTIONS, spread_directions

logger = logging.getLogger(__name__)

EXTENSION = "KHR_gaussian_splatting"
REVISION = "KHR_gaussian_splatting, ratified; text of KhronosGroup/glTF 63770cc (2026-04-15)"
TURN = [0.0, 0.0, 1.0, 0.0]
"""Quaternion (x, y, z, w) of the node."""
TRAINING_FROM_GLTF = np.diag([-1.0, -1.0, 1.0, 1.0])
"""180 degrees about z: y up becomes y down."""
ARRAY_BUFFER, FLOAT, POINTS = 34962, 5126, 0

POSITION = "POSITION"
ROTATION, SCALE, OPACITY = (f"{EXTENSION}:{name}" for name in ("ROTATION", "SCALE", "OPACITY"))
CONSTANT = f"{EXTENSION}:SH_DEGREE_0_COEF_0"
REQUIRED = (POSITION, ROTATION, SCALE, OPACITY, CONSTANT)
SRGB, LINEAR = "srgb_rec709_display", "lin_rec709_display"
RULES = {"kernel": "ellipse", "projection": "perspective"}
"""Rules for drawing splats; gsx blends by depth, not by distance."""
SPZ_EXTENSIONS = (
    "KHR_gaussian_splatting_compression_spz_2",
    "KHR_gaussian_splatting_compression_spz",
    "KHR_spz_gaussian_splats_compression",
)
"""Proposed extensions with splats as SPZ in a buffer view (Cesium)."""
SMALLEST_SCALE = 1e-10
"""Scale in place of 0, whose logarithm is infinite."""
OVERSHOOT = 1e-3
"""Rounding of opacities beyond [0, 1]."""
CHUNK = 4096
"""Splats whose colours are converted at a time."""


def encode_glb(arrays: Arrays, comments: Sequence[str] = (), origin: Sequence[float] = (0.0, 0.0, 0.0)) -> bytes:
    """Encodes a file of at least one splat. origin: added to positions, by the node."""
    count, (x, y, z) = len(arrays.means), origin
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
        "extensions": {EXTENSION: {"kernel": "ellipse", "colorSpace": SRGB}},
    }
    content = {
        "asset": {"version": "2.0", "generator": "gsx", "extras": {"extension": REVISION, "comments": list(comments)}},
        "extensionsUsed": [EXTENSION],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "rotation": TURN} | ({"translation": [-x, -y, z]} if any(origin) else {})],
        "meshes": [{"primitives": [primitive]}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": len(body)}],
    }
    return glb_of(content, body)


def attributes_of(arrays: Arrays) -> dict[str, Float[np.ndarray, "..."]]:
    """Returns the attributes in the units of the extension, by name."""
    found = {
        POSITION: arrays.means,
        ROTATION: arrays.quats[:, [1, 2, 3, 0]],
        SCALE: np.exp(arrays.log_scales.clip(-60, 60)),
        OPACITY: arrays.opacities,
        CONSTANT: arrays.sh_dc,
    }
    return found | {name: arrays.sh_rest[:, i] for i, name in enumerate(higher_bands(arrays.degree))}


def higher_bands(degree: int) -> list[str]:
    """Returns the names of the attributes of the bands after the constant one."""
    return [f"{EXTENSION}:SH_DEGREE_{band}_COEF_{n}" for band in range(1, degree + 1) for n in range(2 * band + 1)]


# -- reading -----------------------------------------------------------------------------------------------------------


def decode_glb(content: bytes, name: str = "", folder: Path | None = None) -> Arrays:
    """Returns all splats of the scene of a GLB or glTF, moved by their nodes, in training axes.

    Other primitives, and rows with NaN or inf, are dropped. name: of the file, for the log; folder: of its buffers.

    Raises:
        InputError: it is damaged, has no splats, or some with other drawing rules.
    """
    asset = asset_of(content, folder)
    parts, others, dropped = [], 0, False
    for mesh, world in placed_meshes(asset.document):
        for primitive in list_in(entry_at(asset.document, "meshes", mesh), "primitives"):
            if not holds_splats(primitive):
                others += 1
                dropped |= any(key.startswith(EXTENSION) for key in part_of(primitive, "attributes"))
                continue
            parts.append(moved(splats_of_primitive(asset, primitive, name), TRAINING_FROM_GLTF @ world))
    if not parts:
        why = ", though their attributes are there: a program has dropped the extension" if dropped else ""
        raise InputError(f"its scene holds no splats ({EXTENSION}), but {others} other primitives{why}. "
                         "Choose another file, or export it anew")  # fmt: skip
    if others:
        logger.info("%s: %d primitives of its scene are no splats, skipping them", name, others)
    arrays = joined(parts)
    if len(arrays.means) and not np.abs(arrays.means).max() <= np.finfo(np.float32).max:
        raise InputError("its splats lie beyond what 32 bits hold: export them with their transform applied")
    return arrays


def names_linear(content: bytes) -> bool:
    """Returns whether a GLB or glTF has colours of linear light."""
    return f'"{LINEAR}"'.encode() in content


def holds_splats(primitive: Any) -> bool:
    """Returns whether a primitive consists of splats."""
    if not isinstance(primitive, dict):
        raise InputError("one of its primitives is no object: export it anew")
    return EXTENSION in part_of(primitive, "extensions") or bool(compression_of(primitive))


def splats_of_primitive(asset: Asset, primitive: Entry, name: str) -> Arrays:
    """Returns the splats of a primitive in its own axes, with sRGB colours."""
    options = part_of(part_of(primitive, "extensions"), EXTENSION)
    refuse_other_rules(options)
    compressed = compression_of(primitive)
    if compressed:
        content, _ = view_of(asset, compressed.get("bufferView"))
        arrays, _ = decode_spz(content)  # the node turns them
    else:
        attributes = part_of(primitive, "attributes")
        found = {key: values_of(asset, attributes[key]) for key in splat_attributes(attributes)}
        refuse_shapes(found)
        arrays = arrays_of_attributes(finite_rows(found, name))
    for key, usual in {"kernel": RULES["kernel"], "colorSpace": SRGB}.items():
        if key not in options:
            logger.warning("%s: splats have no %s, using '%s'", name, key, usual)
    space = options.get("colorSpace", SRGB)
    if space not in (SRGB, LINEAR):
        raise InputError(f"its colours are of '{str(space)[:40]}', gsx reads {SRGB} and {LINEAR}: export one of them")
    return srgb_of_linear(arrays, name) if space == LINEAR else arrays


def compression_of(primitive: Entry) -> Entry:
    """Returns the extension of a primitive with splats as SPZ; empty: none."""
    extensions = part_of(primitive, "extensions")
    inner = part_of(part_of(extensions, EXTENSION), "extensions")
    names = [key for key in extensions | inner if key in SPZ_EXTENSIONS]
    return part_of(extensions | inner, names[0]) if names else {}


def refuse_other_rules(options: Entry) -> None:
    """Raises InputError for drawing rules other than ellipses in perspective."""
    for key, known in RULES.items():
        value = options.get(key, known)
        if value != known:
            raise InputError(f"its {key} is '{str(value)[:40]}', gsx draws '{known}' alone: export it with that")
    others = [key for key in part_of(options, "extensions") if key not in SPZ_EXTENSIONS]
    if others:
        raise InputError(f"its splats need '{others[0][:60]}', which is not read: export them without")


def splat_attributes(attributes: Entry) -> list[str]:
    """Returns the names of splat attributes; others, such as COLOR_0, are redundant."""
    missing = [name for name in REQUIRED if name not in attributes]
    if missing:
        draft = ", as drafts of the extension did" if "_ROTATION" in attributes or "_SCALE" in attributes else ""
        raise InputError(f"its splats lack attribute {missing[0]}{draft}: export them anew")
    bands = [name for name in higher_bands(3) if name in attributes]
    degree = degree_of(len(bands))
    if bands != higher_bands(degree):
        raise InputError(f"its harmonics lack coefficients, it has {len(bands)} but not 0, 3, 8 or 15: export it anew")
    return [*REQUIRED, *bands]


def refuse_shapes(found: dict[str, Float[np.ndarray, "N k"]]) -> None:
    """Raises InputError for attributes of a wrong shape."""
    for key, values in found.items():
        width = {ROTATION: 4, OPACITY: 1}.get(key, 3)
        if values.shape != (len(found[POSITION]), width):
            raise InputError(f"its attribute {key} has {values.shape[0]:,} x {values.shape[1]} values, "
                             f"not {len(found[POSITION]):,} x {width}: export it anew")  # fmt: skip


def arrays_of_attributes(found: dict[str, Float[np.ndarray, "N k"]]) -> Arrays:
    """Returns the splats of finite attributes."""
    scales, opacities, quats = found[SCALE], found[OPACITY][:, 0], found[ROTATION]
    if (scales < 0).any():
        raise InputError("a scale is below 0, but scales are no logarithms in glTF: export it anew")
    if (opacities < -OVERSHOOT).any() or (opacities > 1 + OVERSHOOT).any():
        raise InputError("an opacity is beyond [0, 1], but opacities are no logits in glTF: export it anew")
    rest = [found[name] for name in found if name not in REQUIRED]
    return Arrays(
        means=found[POSITION],
        log_scales=np.log(np.maximum(scales, SMALLEST_SCALE)),
        quats=unit_quaternions(quats[:, [3, 0, 1, 2]]),
        opacities=opacities.clip(0, 1),
        sh_dc=found[CONSTANT],
        sh_rest=np.stack(rest, 1) if rest else np.empty((len(scales), 0, 3)),
    )


# -- linear light ------------------------------------------------------------------------------------------------------


def srgb_of_linear(arrays: Arrays, name: str) -> Arrays:
    """Converts colours of splats from linear light to sRGB, and logs the error with the file's name.

    Exact for degree 0; higher degrees are least-squares fits over evenly spread directions. Blends of splats differ.
    """
    basis = basis_of(arrays.degree)
    linear = np.concatenate([arrays.sh_dc[:, None], arrays.sh_rest], 1)
    fit, squares, most = np.linalg.pinv(basis), 0.0, 0.0
    coefficients = np.empty_like(linear)
    for start in range(0, len(linear), CHUNK):
        rows = slice(start, start + CHUNK)
        light = torch.from_numpy(np.maximum(0.5 + basis @ linear[rows], 0))
        colours = display_from_linear(light, limited=False).numpy()  # beyond 1 by the same formula
        coefficients[rows] = fit @ (colours - 0.5)
        errors = np.maximum(0.5 + basis @ coefficients[rows], 0) - colours
        squares, most = squares + float((errors**2).sum()), max(most, float(np.abs(errors).max()))
    rms = (squares / max(len(linear) * len(basis) * 3, 1)) ** 0.5
    logger.warning("%s: colours are of linear light and become sRGB, each to within %.4f RMS (at most %.4f); blends of "
                   "splats differ from those in linear light", name, rms, most)  # fmt: skip
    return replace(arrays, sh_dc=coefficients[:, 0], sh_rest=coefficients[:, 1:])


def basis_of(degree: int) -> Float[np.ndarray, "D B"]:
    """Returns all harmonics up to a degree in evenly spread directions, the constant one first."""
    if not degree:
        return np.full((1, 1), BAND_0)
    rest = harmonics(spread_directions(DIRECTIONS), degree).numpy()
    return np.concatenate([np.full((len(rest), 1), BAND_0), rest], 1)
