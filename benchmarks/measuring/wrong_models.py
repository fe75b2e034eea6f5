"""COLMAP models whose cameras are made to say something wrong, while what they observed stays."""

from pathlib import Path

import numpy as np
import pycolmap


def wrong_model(scene: Path, target: Path, *, focal: float = 0, turn: float = 0, bend: float = 0) -> Path:
    """A scene like a COLMAP scene of one PINHOLE camera, in a folder, with the same photographs.

    focal: share by which cameras say too long a focal length. turn: px of the model's cameras by which they are turned
    about each axis (standard deviation), the same in every run. bend: share by which they say that corners of the
    photographs are bent outwards.
    """
    model = target / "sparse" / "0"
    if model.is_dir():
        return target
    found = pycolmap.Reconstruction(scene / "sparse" / "0")
    [camera] = found.cameras.values()
    if turn:
        turn_frames(found, turn / camera.mean_focal_length())
    camera.params = [*(1 + focal) * np.array(camera.params[:2]), *camera.params[2:]]
    if bend:
        squared = (camera.width / camera.focal_length_x) ** 2 + (camera.height / camera.focal_length_y) ** 2
        camera.model, camera.params = pycolmap.CameraModelId.OPENCV, [*camera.params, 4 * bend / squared, 0, 0, 0]
    model.mkdir(parents=True)
    (target / "images").symlink_to((scene / "images").resolve())
    found.write_binary(model)
    return target


def turn_frames(reconstruction: pycolmap.Reconstruction, angle: float) -> None:
    """Turn every camera about each of its axes by an angle, rad (standard deviation)."""
    generator = np.random.default_rng(0)
    for number in sorted(reconstruction.frames):
        frame = reconstruction.frames[number]
        pose, quaternion = frame.rig_from_world, np.array([*generator.normal(size=3) * angle / 2, 1.0])
        assert pose is not None
        by = pycolmap.Rotation3d(quaternion / np.linalg.norm(quaternion))
        frame.rig_from_world = pycolmap.Rigid3d(by * pose.rotation, by.matrix() @ pose.translation)
