"""COLMAP scenes on disk for tests: cameras on a sphere around points, made by pycolmap, with photos of noise."""

from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import torch

from gsx.core.data.images import write_image
from gsx.core.plugins import load_plugins
from gsx.experiments.runs.compose import compose_raw, hydra_session
from gsx.experiments.runs.typed import typed
from gsx.scenes.colmap import ColmapOptions

WIDTH, HEIGHT = 64, 48
PINHOLE = (80.0, 82.0, 30.0, 25.0)  # fx, fy, cx, cy; the principal point is off the centre


def synthesize(
    model: str = "PINHOLE",
    params: Sequence[float] = PINHOLE,
    *,
    cameras: int = 1,
    frames: int = 5,
    size: tuple[int, int] = (WIDTH, HEIGHT),
) -> Any:
    """A pycolmap.Reconstruction of 50 points on the unit sphere, seen without error by every image."""
    pycolmap.set_random_seed(1)
    settings = pycolmap.SyntheticDatasetOptions()
    settings.num_rigs, settings.num_cameras_per_rig, settings.num_frames_per_rig = 1, cameras, frames
    settings.num_points3D = 50
    settings.camera_width, settings.camera_height = size
    settings.camera_model_id = pycolmap.CameraModelId.__members__[model]
    settings.camera_params = list(params)
    return pycolmap.synthesize_dataset(settings)


def write_photos(reconstruction: Any, folder: Path, size: tuple[int, int] | None = None) -> None:
    """A photo of noise for every image, of its camera's size or another."""
    generator = torch.Generator().manual_seed(0)
    for image in reconstruction.images.values():
        file = folder / image.name
        file.parent.mkdir(parents=True, exist_ok=True)
        width, height = size or (image.camera.width, image.camera.height)
        write_image(file, torch.rand(3, height, width, generator=generator))


def write_scene(reconstruction: Any, folder: Path, *, sparse: str = "sparse/0", text: bool = False) -> Path:
    """Model and photos; returns the folder of the model."""
    model = folder / sparse
    model.mkdir(parents=True, exist_ok=True)
    (reconstruction.write_text if text else reconstruction.write_binary)(model)
    write_photos(reconstruction, folder / "images")
    return model


@cache
def shipped(kind: str) -> dict[str, Any]:
    """The values that `gsx scene=<kind>` starts from."""
    with hydra_session(load_plugins([], [])):
        return dict(compose_raw([f"scene={kind}"]).scene)


def colmap_options(folder: Path, **changes: Any) -> ColmapOptions:
    """The shipped configuration with changes."""
    made = typed(ColmapOptions, shipped("colmap") | {"path": str(folder)} | changes, "scene")
    assert isinstance(made, ColmapOptions)
    return made


def captured(
    truth: Sequence[float],
    stated: Sequence[float] | float,
    *,
    noise: float = 0.5,
    points: int = 45,
    sides: Sequence[tuple[int, int]] = ((640, 480),),
) -> Any:
    """A model of photos with true focal lengths `truth`, px: keypoints off by `noise` px, cameras as `stated`.

    One number: all share a camera. Photos take the sizes `sides` in turn; their principal point is the middle.
    """
    generator = np.random.default_rng(0)
    out, world = pycolmap.Reconstruction(), generator.uniform(-1, 1, (points, 3))
    pixels = np.empty((len(truth), points, 2))
    for at, focal in enumerate(truth):
        width, height = sides[at % len(sides)]
        own = stated if isinstance(stated, float) else stated[at]
        number = 1 if isinstance(stated, float) else at + 1
        if not out.exists_camera(number):
            params = [own, own, width / 2, height / 2]
            camera = pycolmap.Camera(model="PINHOLE", width=width, height=height, params=params, camera_id=number)
            out.add_camera_with_trivial_rig(camera)
        pose = looking_in(generator)
        x, y, z = (pose * world).T
        exact = np.stack([focal * x / z + width / 2, focal * y / z + height / 2], 1)
        pixels[at] = exact + generator.normal(size=exact.shape) * noise
        image = pycolmap.Image(name=f"{at:03}.png", keypoints=pixels[at], camera_id=number, image_id=at + 1)
        out.add_image_with_trivial_frame(image, pose)
    for index, position in enumerate(world):
        track = pycolmap.Track()
        for at in range(len(truth)):
            track.add_element(at + 1, index)
        out.add_point3D(position, track)
    return out


def looking_in(generator: np.random.Generator) -> Any:
    """A camera at 3 to 6 from the middle of the world, which looks there."""
    towards = generator.normal(size=3)
    forward = -towards / np.linalg.norm(towards)
    right = np.cross(forward, generator.normal(size=3))
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    return pycolmap.Rigid3d(pycolmap.Rotation3d(rotation), np.array([0, 0, generator.uniform(3, 6)]))
