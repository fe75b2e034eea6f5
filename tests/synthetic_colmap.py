"""COLMAP scenes on disk for tests: cameras on a sphere around points, made by pycolmap, with photos of noise."""

from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any

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
