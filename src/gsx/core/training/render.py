"""Renders of a run's model: differentiable in a training step, and in bounded memory for pictures."""

from collections.abc import Mapping
from dataclasses import replace
from typing import TypeAlias

import torch
from torch import Tensor
from torch.nn.functional import pad

from gsx.core.data.camera import Camera
from gsx.core.data.scene import View
from gsx.core.gaussians.splats import Gaussians, Splats, splats_of
from gsx.core.rasterizer import TILE_PIXELS, RasterSettings, Rendering, TiledRendering, rasterize, rasterize_tiled
from gsx.core.shapes import Bool, Float
from gsx.core.training.backbone import Drawn, Observation, behind_scene
from gsx.core.training.finer_raster import finer_raster, render_scale
from gsx.core.training.run import Run

CameraImage: TypeAlias = tuple[Camera, Tensor]
"""A camera and its picture [3, h, w]."""


def render_for_training(
    run: Run, camera: Camera, step: int, colour: Float[Tensor, "3"], channels: bool = False
) -> tuple[Drawn, Rendering, CameraImage, Mapping[str, Tensor]]:
    """Renders what the backbone draws at a step over a background colour.

    Returns:
        What was drawn, its render, the picture before reduction with its camera, and, with `channels`, those of the
        modules by name, blended on the same raster. Screen statistics are those of the raster that was drawn; the
        render's picture is reduced from it.
    """
    raster, absolute = run.views.raster_for(step)(camera), run.backbone.absolute_gradient
    drawn = run.backbone.draw(raster.drawn_for, step)
    added = module_channels(run, drawn.splats, raster.camera, step) if channels else {}
    splats, colours = (drawn.splats, colour) if not added else with_channels(drawn.splats, colour, added)
    rendering = rasterize(splats, raster.camera, run.raster, background=colours, absolute_gradient=absolute)
    whole, *blended = rendering.image.split([3, *(v.shape[1] for v in added.values())]) if added else [rendering.image]
    image, alpha = (raster.reduced(part) for part in (whole, rendering.alpha[None]))
    named = dict(zip(added, blended, strict=True))
    return drawn, replace(rendering, image=image, alpha=alpha[0]), (raster.camera, whole), named


def module_channels(run: Run, splats: Splats, camera: Camera, step: int) -> dict[str, Float[Tensor, "M _"]]:
    """Returns the channels of the run's modules by name, without those that have none."""
    values = {name: module.channels(run, splats, camera, step) for name, module in run.modules.items()}
    return {name: value for name, value in values.items() if value is not None}


def with_channels(
    splats: Splats, colour: Float[Tensor, "3"], added: Mapping[str, Float[Tensor, "M _"]]
) -> tuple[Splats, Float[Tensor, "C"]]:
    """Returns splats with more channels after their colours, and the background, which is 0 there."""
    colours = torch.cat([splats.colours, *added.values()], 1)
    return replace(splats, colours=colours), pad(colour, (0, colours.shape[1] - len(colour)))


def module_losses(
    run: Run, view: View, step: int, camera: Camera, blended: Mapping[str, Tensor], counted: Bool[Tensor, "H W"] | None
) -> dict[str, Float[Tensor, ""]]:
    """Returns the terms of the modules in a training view's loss, by name."""
    nothing = torch.empty(0, camera.height, camera.width, device=run.device)
    terms = {
        name: module.loss(run, view, step, camera, blended.get(name, nothing), counted)
        for name, module in run.modules.items()
    }
    return {name: term for name, term in terms.items() if term is not None}


def observe(run: Run, drawn: Drawn, rendering: Rendering, step: int, weight: float) -> Observation:
    """Returns the observation of a render with a weight in its view's loss; empty for weight 0.

    Weight and screen gradients are divided by the number of views, since the step's loss is the mean over the batch.
    """
    if not weight > 0:
        return {}
    views = run.training.batch
    for offset in (rendering.screen.means2d_offset, rendering.screen.absgrad):
        if views > 1 and offset is not None and offset.grad is not None:
            offset.grad /= views
    return run.backbone.observe(drawn, rendering, step, weight / views)


@torch.no_grad()
def splats_for(run: Run, camera: Camera) -> Splats:
    """Returns the current splats for a camera."""
    return run.backbone.draw(camera, run.model_step).splats


@torch.no_grad()
def render_gaussians(
    gaussians: Gaussians, camera: Camera, raster: RasterSettings, background: Float[Tensor, "3"]
) -> Float[Tensor, "3 H W"]:
    """Renders the Gaussians of a splat file over a colour; values clamped to [0, 1]."""
    splats = splats_of(gaussians, camera.centre)
    return rasterize_tiled(splats, camera, raster, background=background).image.clamp_(0, 1)


@torch.no_grad()
def render(
    run: Run,
    camera: Camera,
    pixels: int = TILE_PIXELS,
    supersample: int = 0,
    splats: Splats | None = None,
    depth: bool = False,
) -> TiledRendering:
    """Renders the current model over the scene's background; the result is on the CPU, clamped to [0, 1].

    Args:
        run: Run with the model.
        camera: Camera of the picture.
        pixels: Largest window rendered at once, px; bounds memory.
        supersample: Factor of the render's resolution before reduction; 0: as in training.
        splats: Splats instead of the model's own.
        depth: True: with depth, at the render's resolution. With a `Backdrop`, depth and alpha are those of the splats
            before it, so that a backdrop that shines through a wall does not move the wall.
    """
    scale = supersample or render_scale(camera, run.scene.train, run.views.raster_scale(run.model_step))
    raster = finer_raster(camera, run.scene.reduction, scale)
    drawn = splats_for(run, raster.drawn_for) if splats is None else splats
    far = behind_scene(run.backbone, drawn.means) if depth else None
    if far is not None and bool(far.any()):
        tiled = with_depth_of_scene(drawn, far, raster.camera, run, pixels)
    else:
        tiled = rasterize_tiled(drawn, raster.camera, run.raster, background=run.background, depth=depth, pixels=pixels)
    image, alpha = (raster.reduced(part) for part in (tiled.image, tiled.alpha[None]))
    return replace(tiled, image=image.clamp_(0, 1), alpha=alpha[0])


def with_depth_of_scene(
    splats: Splats, far: Bool[Tensor, "M"], camera: Camera, run: Run, pixels: int
) -> TiledRendering:
    """Renders with depth and alpha of the near splats alone, blended as two more colours."""
    channels = replace(splats, colours=torch.cat([splats.colours, coverage_and_depth(splats, far, camera)], 1))
    background = torch.cat([run.background, run.background.new_zeros(2)])
    tiled = rasterize_tiled(channels, camera, run.raster, background=background, pixels=pixels)
    return replace(tiled, image=tiled.image[:3], alpha=tiled.image[3], depth=tiled.image[4])


def coverage_and_depth(splats: Splats, far: Bool[Tensor, "M"], camera: Camera) -> Float[Tensor, "M 2"]:
    """Returns (1, camera z in scene units) of each near splat and 0 of far ones, to be blended as colours."""
    near = (~far).to(splats.colours)[:, None]
    return torch.cat([near, near * camera.to_camera(splats.means)[:, 2:].to(near)], 1)
