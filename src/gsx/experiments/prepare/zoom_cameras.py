"""Cameras of test views at each zoom: as JSON, and as COLMAP models for programs that render a scene's cameras."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from gsx.core.data.scene import Scene, View
from gsx.core.errors import InputError
from gsx.core.files import write_json
from gsx.experiments.prepare.colmap_files import write_model
from gsx.experiments.prepare.picture_names import Picture
from gsx.experiments.prepare.transforms_file import camera_from_world

CONVENTION = (
    "camera axes: x right, y down, z forward (OpenCV); pixel = (fx x/z + cx, fy y/z + cy), pixel centres at +0.5; "
    "matrices are 4 x 4 in rows, world coordinates are those of sparse/0"
)

Zoomed = dict[str, View]
"""Test views at one zoom by file name; those without a photo that fine are left out."""


def zoom_name(factor: float) -> str:
    """Return the name of a zoom: `x2`, `x0.5`."""
    return f"x{factor:g}"


def zoomed_views(test: Sequence[Picture], factors: Sequence[float]) -> dict[float, Zoomed]:
    """Return the test views at each zoom; InputError: none has a photo that fine."""
    zoomed = {
        factor: {picture.file: view for picture in test if (view := picture.view.zoom(factor)) is not None}
        for factor in factors
    }
    for factor, views in zoomed.items():
        if test and not views:
            finest = max(picture.view.source.max_zoom(picture.camera) for picture in test)
            raise InputError(
                f"eval.zoom has {factor:g}, but test photos are at most {finest:.3g} times as fine as training photos: "
                f"leave {factor:g} out, or raise scene.downscale"
            )
    return zoomed


def write_zoom(folder: Path, scene: Scene, factor: float, views: Zoomed) -> None:
    """Write `cameras_xK.json`, and the COLMAP model `test_xK/sparse/0`."""
    name = zoom_name(factor)
    cameras = []
    for file, view in views.items():
        camera, matrix = view.camera, camera_from_world(view.camera, scene.origin)
        values = {key: getattr(camera, key) for key in ("width", "height", "fx", "fy", "cx", "cy")}
        poses = {"camera_from_world": matrix.tolist(), "world_from_camera": np.linalg.inv(matrix).tolist()}
        cameras.append({"file": file, "name": view.name, **values, **poses})
    write_json(folder / f"cameras_{name}.json", {"zoom": factor, "convention": CONVENTION, "cameras": cameras})
    named = [(file, view.camera) for file, view in views.items()]
    write_model(folder / f"test_{name}" / "sparse" / "0", named, scene.points, scene.origin)
