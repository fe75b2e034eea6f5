"""COLMAP models of pinhole pictures, as COLMAP, 3D-GS, gsplat and OpenSplat read them."""

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from gsx.core.data.camera import Camera
from gsx.core.data.scene import PointCloud

NamedCamera = tuple[str, Camera]
"""File name of a picture below the folder of images, and its camera."""


def write_model(folder: Path, cameras: Iterable[NamedCamera], points: PointCloud, origin: Sequence[float]) -> None:
    """Write cameras.bin, images.bin and points3D.bin, in the coordinates of the scene's files.

    Pictures of equal intrinsics share a camera. The points have no observations.
    """
    import pycolmap

    model = pycolmap.Reconstruction()
    numbers: dict[tuple[float, ...], int] = {}
    for number, (file, camera) in enumerate(cameras, start=1):
        lens = (*camera.size, camera.fx, camera.fy, camera.cx, camera.cy)
        if lens not in numbers:
            numbers[lens] = len(numbers) + 1
            model.add_camera_with_trivial_rig(colmap_camera(camera, numbers[lens]))
        image = pycolmap.Image(name=file, camera_id=numbers[lens], image_id=number)
        model.add_image_with_trivial_frame(image, pose_of(camera, origin))
    add_points(model, points, origin)
    folder.mkdir(parents=True, exist_ok=True)
    model.write_binary(folder)


def colmap_camera(camera: Camera, number: int) -> Any:
    """Return a pinhole camera of COLMAP."""
    import pycolmap

    params = [camera.fx, camera.fy, camera.cx, camera.cy]
    return pycolmap.Camera(model="PINHOLE", width=camera.width, height=camera.height, params=params, camera_id=number)


def pose_of(camera: Camera, origin: Sequence[float]) -> Any:
    """Return the pose, camera from world, in the coordinates of the scene's files."""
    import pycolmap

    rotation, translation = motion_of(camera, origin)
    return pycolmap.Rigid3d(pycolmap.Rotation3d(rotation), translation)


def motion_of(camera: Camera, origin: Sequence[float]) -> tuple[np.ndarray, np.ndarray]:
    """Return rotation [3, 3] and translation [3], camera from world, float64, in the coordinates of the files."""
    rotation = camera.rotation.double().numpy()
    return rotation, camera.translation.double().numpy() - rotation @ np.asarray(origin)


def add_points(model: Any, points: PointCloud, origin: Sequence[float]) -> None:
    """Add the initial points, without observations."""
    import pycolmap

    for place, colour in zip(positions_of(points, origin), points.colours.numpy(), strict=True):
        model.add_point3D(place, pycolmap.Track(), colour)


def positions_of(points: PointCloud, origin: Sequence[float]) -> np.ndarray:
    """Return positions [P, 3], float64, in the coordinates of the scene's files."""
    return np.asarray(points.positions.double().numpy() + np.asarray(origin))
