"""One page to send: a model inside a viewer that opens from disk, without network.

The viewer is npm's @playcanvas/supersplat-viewer (MIT), with its notice; `scripts/viewer_template.py` made the page.
"""

import base64
import html
import json
import lzma
import math
from collections.abc import Sequence
from importlib.resources import files

import torch
from torch import Tensor

from gsx.core.data.camera import Camera
from gsx.core.data.scene import View
from gsx.core.gaussians.splats import Gaussians
from gsx.core.shapes import Float
from gsx.formats.arrays import arrays_of
from gsx.formats.compressed_ply import encode_compressed_ply
from gsx.formats.turned import rotation_between, turned

TEMPLATE = "viewer_page.html.xz"
PLACE = '"GSX_BOOTSTRAP"'
"""Place of settings and splats (scripts/viewer_template.py)."""
NAME = "model.compressed.ply"
"""File name whose suffix selects the viewer's decoder."""
VIEWER_FROM_FILE = torch.tensor([-1.0, -1.0, 1.0], dtype=torch.float64)
"""The viewer turns files by half a turn about z, and has y up."""
LEAST_LEVEL = 0.97
"""Cosine of the largest roll (14 degrees) of a camera that counts as level."""
FIELD_OF_VIEW = (10.0, 120.0)
"""Range of the viewer's cameras, degrees."""


def viewer_page(
    gaussians: Gaussians,
    views: Sequence[View],
    up: Float[Tensor, "3"],
    background: Sequence[float],
    title: str,
    comments: Sequence[str] = (),
) -> str:
    """Makes the page, which starts at the first view and offers the others as places.

    `up`: unit vector of the scene; `background`: display RGB in [0, 1].
    """
    right = views[0].camera.rotation[0].double()  # the viewer's cameras have no roll: turn the scene by a small one
    across = torch.nn.functional.normalize(up.double() - (up.double() @ right) * right, dim=0)
    level = across if float(across @ up.double()) > LEAST_LEVEL else up
    rotation = rotation_between(level, torch.tensor([0.0, -1.0, 0.0]))  # files have y down
    splats = encode_compressed_ply(arrays_of(turned(gaussians, rotation)), comments)
    poses = [pose(view.camera, rotation, gaussians.means) for view in views]
    content = {
        "contentUrl": f"data:application/octet-stream;base64,{base64.b64encode(splats).decode()}",
        "contentFilename": NAME,
        "settings": settings(poses, [view.name for view in views], background),
    }
    page = lzma.decompress(files(__package__).joinpath(TEMPLATE).read_bytes()).decode()
    page = page.replace("<title>SuperSplat Viewer</title>", f"<title>{html.escape(title)}</title>", 1)
    before, _, after = page.partition(PLACE)
    return before + json.dumps(content).replace("<", "\\u003c") + after


def pose(camera: Camera, rotation: Float[Tensor, "3 3"], means: Float[Tensor, "N 3"]) -> dict[str, object]:
    """Converts a camera: the viewer's looks at the median depth before it, and stands upright."""
    depths = camera.to_camera(means)[:, 2]
    ahead = float(depths[depths > camera.near].median()) if bool((depths > camera.near).any()) else 1.0
    centre = camera.centre.double()
    places = torch.stack([centre, centre + ahead * camera.rotation[2].double()])
    position, target = ((places @ rotation.T) * VIEWER_FROM_FILE).tolist()
    half = max(camera.width / camera.fx, camera.height / camera.fy) / 2  # the viewer's angle is that of the longer side
    degrees = math.degrees(2 * math.atan(half))
    return {"position": position, "target": target, "fov": min(max(degrees, FIELD_OF_VIEW[0]), FIELD_OF_VIEW[1])}


def settings(
    poses: Sequence[dict[str, object]], names: Sequence[str], background: Sequence[float]
) -> dict[str, object]:
    """Makes settings of the viewer, version 2 (its docs/api.md), without effects."""
    off = {"enabled": False}
    return {
        "version": 2,
        "tonemapping": "none",
        "highPrecisionRendering": False,
        "background": {"color": [float(value) for value in background]},
        "postEffectSettings": {
            "sharpness": off | {"amount": 0},
            "bloom": off | {"intensity": 0.1, "blurLevel": 2},
            "grading": off | {"brightness": 1, "contrast": 1, "saturation": 1, "tint": [1, 1, 1]},
            "vignette": off | {"intensity": 0.5, "inner": 0.3, "outer": 0.75, "curvature": 1},
            "fringing": off | {"intensity": 0.5},
        },
        "animTracks": [],
        "cameras": [{"initial": poses[0]}],
        "annotations": [
            {"position": one["target"], "title": name, "text": "", "extras": {}, "camera": {"initial": one}}
            for one, name in zip(poses[1:], names[1:], strict=True)
        ],
        "startMode": "default",
    }
