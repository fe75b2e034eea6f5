"""glTF documents as other programs write them, accessor by accessor."""

import json
import struct
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch

from gsx.core.gaussians.splats import Gaussians

PREFIX = "KHR_gaussian_splatting"
CODES = {5120: "i1", 5121: "u1", 5122: "i2", 5123: "u2", 5125: "u4", 5126: "f4"}
TYPES = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}


class Builder:
    """A document that grows by accessors."""

    def __init__(self) -> None:
        self.body = b""
        self.views: list[dict[str, Any]] = []
        self.accessors: list[dict[str, Any]] = []

    def view(self, content: bytes, **more: Any) -> int:
        self.body += bytes(-len(self.body) % 4)
        self.views.append({"buffer": 0, "byteOffset": len(self.body), "byteLength": len(content)} | more)
        self.body += content
        return len(self.views) - 1

    def accessor(self, values: np.ndarray, component: int = 5126, **more: Any) -> int:
        values = np.asarray(values)
        values = values[:, None] if values.ndim == 1 else values
        view = self.view(values.astype(f"<{CODES[component]}").tobytes())
        self.accessors.append({"bufferView": view, "componentType": component, "count": len(values),
                               "type": TYPES[values.shape[1]]} | more)  # fmt: skip
        return len(self.accessors) - 1

    def splats(self, gaussians: Gaussians, **options: Any) -> dict[str, Any]:
        """A primitive of splats, stored as they are."""
        names = {
            "POSITION": gaussians.means,
            f"{PREFIX}:ROTATION": torch.nn.functional.normalize(gaussians.quats, dim=1)[:, [1, 2, 3, 0]],
            f"{PREFIX}:SCALE": gaussians.log_scales.exp(),
            f"{PREFIX}:OPACITY": gaussians.opacity_logits.sigmoid(),
            f"{PREFIX}:SH_DEGREE_0_COEF_0": gaussians.sh_dc,
        }
        degree = round((gaussians.sh_rest.shape[1] + 1) ** 0.5) - 1
        bands = [(band, n) for band in range(1, degree + 1) for n in range(2 * band + 1)]
        for number, (band, n) in enumerate(bands):
            names[f"{PREFIX}:SH_DEGREE_{band}_COEF_{n}"] = gaussians.sh_rest[:, number]
        attributes = {name: self.accessor(value.numpy()) for name, value in names.items()}
        rules = {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"} | options
        return {"mode": 0, "attributes": attributes, "extensions": {PREFIX: rules}}

    def document(
        self, primitives: Sequence[Sequence[dict[str, Any]]], nodes: Sequence[dict[str, Any]]
    ) -> dict[str, Any]:
        return {
            "asset": {"version": "2.0"},
            "extensionsUsed": [PREFIX],
            "scene": 0,
            "scenes": [{"nodes": [0]}],
            "nodes": list(nodes),
            "meshes": [{"primitives": list(of_mesh)} for of_mesh in primitives],
            "accessors": self.accessors,
            "bufferViews": self.views,
            "buffers": [{"byteLength": len(self.body)}],
        }


def glb(document: dict[str, Any], body: bytes) -> bytes:
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    body += bytes(-len(body) % 4)
    chunks = struct.pack("<II", len(text), 0x4E4F534A) + text + struct.pack("<II", len(body), 0x004E4942) + body
    return struct.pack("<III", 0x46546C67, 2, 12 + len(chunks)) + chunks
