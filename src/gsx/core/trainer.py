"""The training loop. Density control, learning rates and the like live in backbones; everything else listens."""

import logging
import time

import torch
from torch import Tensor

from gsx.core.losses import photometric
from gsx.core.plugins import Plugins
from gsx.core.rasterizer import rasterize
from gsx.core.run import Run, Step
from gsx.core.shapes import Float

logger = logging.getLogger(__name__)


def train(run: Run, plugins: Plugins) -> None:
    """Take steps until the run is complete or asked to stop; listeners hear of each."""
    plugins.emit.gsx_run_started(run=run)
    while not (run.complete or run.stopping):
        begun = time.perf_counter()
        step = take_step(run, plugins)
        run.seconds += time.perf_counter() - begun
        plugins.emit.gsx_step_finished(run=run, step=step)
    plugins.emit.gsx_training_finished(run=run)


def take_step(run: Run, plugins: Plugins) -> Step:
    """One step in the order of the published loop (spec 7): render, backward, statistics, density, Adam."""
    step = backward(run)
    reason = healed(run, step) or plugins.emit.gsx_gradients_ready(run=run, step=step) or ""
    if reason:
        run.backbone.discard()
    else:
        run.backbone.observe(step.rendering, step.number)
        step.changes.update(run.backbone.adapt(step.number))
        run.backbone.update()
    run.step = step.number
    synchronise(run.device)
    return step if not reason else Step(**(vars(step) | {"skipped": reason}))


def healed(run: Run, step: Step) -> str:
    """Removes primitives that the render had to leave out; a reason to skip the step if there were any."""
    removed = run.backbone.heal() if step.rendering.dropped else 0
    if removed:
        logger.warning("step %d: removed %d primitives with values that are not finite", step.number, removed)
    return f"removed {removed} primitives" if removed else ""


def backward(run: Run) -> Step:
    """Render the next view and send the loss back."""
    number = run.step + 1
    view = run.scene.train[run.sampler.next()]
    target = view.image().to(run.device)
    run.backbone.begin(number)
    splats = run.backbone.splats(view.camera)
    rendering = rasterize(
        splats,
        view.camera,
        run.raster,
        background=background(run),
        absolute_gradient=run.backbone.absolute_gradient,
    )
    loss = photometric(rendering.image, target, run.training.ssim_weight)
    extra = run.backbone.regulariser()
    if extra is not None:
        loss = loss + extra
    loss.backward()
    return Step(number=number, view=view, target=target, rendering=rendering, loss=loss.detach())


def background(run: Run) -> Float[Tensor, "3"]:
    """The scene's background, or a new random colour."""
    if run.training.random_background:
        return torch.rand(3, generator=run.generator).to(run.device)
    return run.background


def synchronise(device: torch.device) -> None:
    """Wait for a GPU, so that times mean something."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)
