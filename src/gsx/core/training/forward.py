"""Differentiable renders of a training step, and observations for density control."""

from dataclasses import replace

from torch import Tensor

from gsx.core.data.camera import Camera
from gsx.core.rasterizer import Rendering, rasterize
from gsx.core.shapes import Float
from gsx.core.training.backbone import Drawn, Observation
from gsx.core.training.run import Run


def render_for_training(run: Run, camera: Camera, step: int, colour: Float[Tensor, "3"]) -> tuple[Drawn, Rendering]:
    """Renders what the backbone draws at a step over a background colour; returns both.

    Screen statistics are those of the raster that was drawn; the picture is reduced from it.
    """
    raster, absolute = run.views.raster_for(step)(camera), run.backbone.absolute_gradient
    drawn = run.backbone.draw(raster.drawn_for, step)
    rendering = rasterize(drawn.splats, raster.camera, run.raster, background=colour, absolute_gradient=absolute)
    image, alpha = (raster.reduced(part) for part in (rendering.image, rendering.alpha[None]))
    return drawn, replace(rendering, image=image, alpha=alpha[0])


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
