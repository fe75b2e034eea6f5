"""transforms.json and points.ply as nerfstudio and OpenSplat read them (nerfstudio_dataparser.py, nerfstudio.cpp)."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from gsx.core.data.camera import Camera
from gsx.core.data.scene import PointCloud
from gsx.core.files import write_json
from gsx.experiments.prepare.colmap_files import motion_of, positions_of
from gsx.experiments.prepare.picture_names import Picture
from gsx.formats.ply import write_ply

FILE, POINTS = "transforms.json", "points.ply"
OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
"""Turn of axes x right, y up, z back to x right, y down, z forward."""
UNCHANGED = np.eye(4)[:3].tolist()


def write_transforms(
    folder: Path,
    pictures: Sequence[Picture],
    test: Sequence[Picture],
    points: PointCloud,
    origin: Sequence[float],
    masked: bool,
) -> None:
    """Write both files for pictures in `images/`, in the coordinates of the scene's files.

    pictures: all in the folder; test: those of them that are held out, with lists of names by split.
    masked: each has a mask in `masks/`.
    """
    each = [intrinsics(picture.camera) for picture in pictures]
    shared = each[0] if all(one == each[0] for one in each) else {}
    frames = []
    for picture, own in zip(pictures, each, strict=True):
        matrix = np.linalg.inv(camera_from_world(picture.camera, origin)) @ OPENGL  # world from camera
        frame: dict[str, Any] = {"file_path": f"images/{picture.file}"}
        frame |= {"mask_path": f"masks/{picture.file}"} if masked else {}
        frames.append(frame | {"transform_matrix": matrix.tolist()} | ({} if shared else own))
    content = {
        "camera_model": "PINHOLE",
        **shared,
        "applied_transform": UNCHANGED,
        "ply_file_path": POINTS,
        **(split_lists(pictures, test) if test else {}),
        "frames": frames,
    }
    write_json(folder / FILE, content)
    write_points(folder / POINTS, points, origin)


def camera_from_world(camera: Camera, origin: Sequence[float]) -> np.ndarray:
    """Return a camera's motion as a matrix [4, 4], float64."""
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = motion_of(camera, origin)
    return matrix


def intrinsics(camera: Camera) -> dict[str, Any]:
    """Return the intrinsics by nerfstudio's keys, px."""
    lens = {"fl_x": camera.fx, "fl_y": camera.fy, "cx": camera.cx, "cy": camera.cy}
    return lens | {"w": camera.width, "h": camera.height}


def split_lists(pictures: Sequence[Picture], test: Sequence[Picture]) -> dict[str, list[str]]:
    """Return nerfstudio's lists: each split needs its own, and validation views are the test views."""
    held_out = {picture.file for picture in test}
    files = [f"images/{picture.file}" for picture in pictures if picture.file not in held_out]
    tested = [f"images/{picture.file}" for picture in test]
    return {"train_filenames": files, "val_filenames": tested, "test_filenames": tested}


def write_points(path: Path, points: PointCloud, origin: Sequence[float]) -> None:
    """Write points with colours; doubles only where float32 is too coarse, as OpenSplat reads nothing else."""
    kind = np.float64 if any(origin) else np.float32
    columns = dict(zip("xyz", positions_of(points, origin).astype(kind).T, strict=True))
    colours = dict(zip(("red", "green", "blue"), points.colours.numpy().T, strict=True))
    write_ply(path, columns | colours)
