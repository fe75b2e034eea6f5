"""A scene without photographs and gs3d on it: for tests of rules rather than pictures."""

from dataclasses import fields, replace
from importlib.resources import as_file, files
from typing import Any

import torch
from omegaconf import OmegaConf
from torch import Tensor

from gsx.backbones.gs3d import GS3D, gs3d
from gsx.backbones.gs3d_options import GS3DOptions
from gsx.core.data.camera import Camera, look_at
from gsx.core.data.scene import PointCloud, Scene, View
from gsx.core.rasterizer import RasterSettings
from gsx.core.training.backbone import BackboneContext
from gsx.core.training.training_views import TrainingViews
from gsx.experiments.runs.typed import typed


class Grey:
    """Every view shows mid grey."""

    def image(self, camera: Camera) -> Tensor:
        return torch.full((3, camera.height, camera.width), 128, dtype=torch.uint8)

    def max_zoom(self, camera: Camera) -> float:
        return 1.0


def small_scene(
    positions: Tensor, colours: Tensor | None = None, *, extent: float = 1.0, background: float = 0.0, views: int = 4
) -> Scene:
    """`views` cameras 4 units from the origin; grey photographs; the points given."""
    if colours is None:
        colours = torch.full((len(positions), 3), 128, dtype=torch.uint8)
    cameras = [look_at([0.1 * i, -4, 1], [0, 0, 0], fov_x=0.9, width=24, height=16) for i in range(views)]
    return Scene(
        name="small",
        train=[View(f"view{i}", camera, Grey()) for i, camera in enumerate(cameras)],
        test=[],
        points=PointCloud(positions, colours),
        background=torch.full((3,), background),
        extent=extent,
    )


def published_options(**density: float) -> GS3DOptions:
    """conf/backbone/gs3d.yaml, with changes to its density section."""
    with as_file(files("gsx.conf") / "backbone" / "gs3d.yaml") as path:
        values = OmegaConf.masked_copy(OmegaConf.load(path), [f.name for f in fields(GS3DOptions)])
        options = typed(GS3DOptions, values, "backbone")
    return replace(options, density=replace(options.density, **density))


def small_context(scene: Scene, *, iterations: int = 30000, seed: int = 0, **more: Any) -> BackboneContext:
    """What a backbone on the CPU is built from; `more`: of its training views."""
    return BackboneContext(
        scene=scene,
        iterations=iterations,
        device=torch.device("cpu"),
        raster=RasterSettings(),
        generator=torch.Generator().manual_seed(seed),
        views=TrainingViews(scene=scene, **more),
    )


def small_gs3d(
    scene: Scene, *, iterations: int = 30000, seed: int = 0, options: GS3DOptions | None = None, **more: Any
) -> GS3D:
    """The backbone at step 0; `more`: of its training views."""
    return gs3d(options or published_options(), small_context(scene, iterations=iterations, seed=seed, **more))


def spread(count: int, seed: int = 0) -> Tensor:
    """Points in a unit cube around the origin."""
    return torch.rand(count, 3, generator=torch.Generator().manual_seed(seed)) - 0.5
