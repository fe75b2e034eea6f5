"""A run whose model paints pictures of one grey each, for figures worked by hand."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import fmean
from typing import Any

import pytest
import torch
from small_scene import small_gs3d, small_scene, spread
from torch import Tensor

from gsx.backbones.gs3d import GS3D
from gsx.core.data.camera import Camera
from gsx.core.data.scene import View
from gsx.core.gaussians.splats import Splats
from gsx.core.rasterizer import RasterSettings
from gsx.core.training.backbone import DrawnSplats
from gsx.core.training.photo_cache import PhotoCache
from gsx.core.training.run import Progress, Run, TrainingOptions
from gsx.core.training.sampler import Sampler
from gsx.core.training.training_views import TrainingViews

SIZE = (24, 16)
LEVELS = {"a": {1: 100.4, 2: 110.0}, "b": {1: 60.0, 2: 70.0}, "c": {1: 200.0, 2: 90.0}}
"""8-bit levels that the model shows of each view, by zoom."""
TRUTH = {"a": {1: 90, 2: 104}, "b": {1: 80, 2: 71}, "c": {1: 150, 2: 0}}
FINEST = {"a": 4.0, "b": 2.0, "c": 1.0}
GROUPS = {"a": "near", "b": "near", "c": "far"}


@dataclass(frozen=True)
class Grey:
    """A photograph of one grey at each zoom."""

    name: str

    def image(self, camera: Camera) -> Tensor:
        level = TRUTH[self.name][camera.width // SIZE[0]]
        return torch.full((3, camera.height, camera.width), level, dtype=torch.uint8)

    def max_zoom(self, camera: Camera) -> float:
        return FINEST[self.name]


class Brighter(Grey):
    """The right half is 5 levels brighter."""

    def image(self, camera: Camera) -> Tensor:
        picture = super().image(camera)
        picture[..., camera.width // 2 :] += 5
        return picture


class Painted(GS3D):
    """Shows each camera the grey of its view: half of what one splat as wide as the world has, on black.

    A second splat lies behind the camera.
    """

    names: Sequence[str] = tuple(LEVELS)

    def draw(self, camera: Camera, step: int) -> DrawnSplats:
        name = self.names[round(float(camera.centre[0]) / 0.1)]
        ahead = camera.rotation[2] * torch.tensor([[2.0], [-2.0]])
        splats = Splats(
            means=(camera.centre + ahead).float(),
            scales=torch.full((2, 3), 1e5),
            quats=torch.tensor([[1.0, 0, 0, 0]]).repeat(2, 1),
            log_opacities=torch.full((2,), math.log(0.5)),
            colours=torch.full((2, 3), 2 * LEVELS[name][camera.width // SIZE[0]] / 255),
        )
        return DrawnSplats(splats=splats, rows=None)


def run_of(folder: Path, photograph: type[Grey] = Grey) -> Run:
    """Trained for 7 steps in 3 seconds, tested on the three views."""
    scene = small_scene(spread(50), views=3)
    views = zip(LEVELS, scene.train, strict=True)
    scene = replace(scene, test=[View(name, view.camera, photograph(name), GROUPS[name]) for name, view in views])
    backbone = small_gs3d(scene)
    backbone.__class__ = Painted
    training = TrainingOptions(
        ssim_weight=0.2, random_background=False, log_every=1, checkpoint_every=9, checkpoints_kept=1, test_points=0
    )
    return Run(
        config={},
        folder=folder,
        backbone=backbone,
        raster=RasterSettings(cull="tight"),
        training=training,
        iterations=7,
        photos=PhotoCache(torch.device("cpu")),
        generator=torch.Generator(),
        views=TrainingViews(scene=scene),
        sampler=Sampler(3, 0),
        progress=Progress(step=7, seconds=3.0),
    )


def decibels(*levels: float) -> float:
    """Mean PSNR of pictures that are so many levels off."""
    return fmean(20 * math.log10(255 / level) for level in levels)


def close(value: float) -> Any:
    """To float32's rounding of flat pictures."""
    return pytest.approx(value, abs=1e-3)
