"""A run's model drawn for one camera, as it is now."""

import torch

from gsx.core.data.camera import Camera
from gsx.core.gaussians.splats import Splats
from gsx.core.rasterizer import TILE_PIXELS, TiledRendering, rasterize_tiled
from gsx.core.training.run import Run


@torch.no_grad()
def splats_for(run: Run, camera: Camera) -> Splats:
    """The splats of a camera after the run's steps."""
    return run.backbone.draw(camera, run.model_step).splats


@torch.no_grad()
def render(run: Run, camera: Camera, pixels: int = TILE_PIXELS) -> TiledRendering:
    """The model after the run's steps, over the scene's background; colours clamped to [0, 1].

    Rendered in windows of at most `pixels` px, so that memory does not grow with the picture; on the CPU.
    """
    tiled = rasterize_tiled(splats_for(run, camera), camera, run.raster, background=run.background, pixels=pixels)
    tiled.image.clamp_(0, 1)
    return tiled
