"""The training loop. Density control, learning rates and the like live in backbones; everything else listens."""

import logging
import time
from collections.abc import Callable, Sequence
from dataclasses import replace

import torch
from torch import Tensor

from gsx.core.data.masks import blacked
from gsx.core.data.scene import View
from gsx.core.data.window import Window
from gsx.core.device import uploaded
from gsx.core.errors import Stopped
from gsx.core.plugins import Plugins
from gsx.core.quality.losses import photometric
from gsx.core.shapes import Bool, Float
from gsx.core.training.augmenter import accounts_of
from gsx.core.training.backbone import Observation, Validating, remove_nonfinite
from gsx.core.training.forward import observe, render_for_training
from gsx.core.training.minibatch import gradients_added, merge_gradients, rollback_on_error
from gsx.core.training.parameter_table import zero_grad
from gsx.core.training.pseudo_terms import backward_terms, request_terms, reusable_parts, reused_losses, without_windows
from gsx.core.training.pseudo_views import Term
from gsx.core.training.run import Run, StepResult

logger = logging.getLogger(__name__)


def train(run: Run, plugins: Plugins, clock: Callable[[], float] = time.perf_counter) -> None:
    """Takes steps until the run is complete or one of its ranks asked to stop; listeners hear of each.

    `clock`: seconds that count as training time.
    """
    plugins.emit.gsx_run_started(run=run)
    while not (run.complete or any(run.ranks.all_gather(run.progress.stopping))):
        start = clock()
        try:
            step = train_step(run, plugins)
        except Stopped:
            break
        run.progress.seconds += clock() - start
        plugins.emit.gsx_step_finished(run=run, step=step)
    run.photos.see(())
    plugins.emit.gsx_training_finished(run=run)


def train_step(run: Run, plugins: Plugins) -> StepResult:
    """One step in the order of the published loop (3D-GS, train.py): render, backward, statistics, density, Adam."""
    metrics = before_step(run)
    with rollback_on_error(run):
        step = backward(run)
        step.changes.update(metrics)
        reason = veto(run, step, plugins)
    run.progress.changing = True
    if reason:
        zero_grad(run.backbone.table)
    else:
        for seen in step.seen:
            run.backbone.accumulate(seen)
        step.changes.update(run.backbone.densify_and_prune(step.number))
        run.backbone.table.pace = run.training.pace(step.number, run.iterations)
        run.backbone.update(step.number)
        for module in run.modules.values():
            module.optimizer_step(step.number)
    run.step, run.progress.changing = step.number, False
    return step if not reason else replace(step, skipped=reason)


def before_step(run: Run) -> dict[str, float]:
    """Let the modules estimate, correct or skip steps; returns their metrics."""
    metrics: dict[str, float] = {}
    for module in run.modules.values():
        metrics |= module.before_step(run)
    return metrics


def veto(run: Run, step: StepResult, plugins: Plugins) -> str:
    """A reason to skip the step, the same on all ranks: the first that has one gives it; empty: none."""
    removed = remove_lost(run, step) if step.dropped else ""
    reason = removed or plugins.emit.gsx_gradients_ready(run=run, step=step) or ""
    reason = next(filter(None, run.ranks.all_gather(reason)), "")
    return reason if removed or not reason else "; ".join(filter(None, [reason, remove_lost(run, step)]))


def remove_lost(run: Run, step: StepResult) -> str:
    """Removes primitives that make no picture, the same on all ranks; a reason to skip the step if there were any."""
    views = run.views.at(step.number)
    cameras = [views[number].camera for number in run.sampler.taken]
    removed = remove_nonfinite(run.backbone, cameras, step.number)
    if removed:
        run.progress.changing = True
        logger.warning(
            "step %d: removed %d primitives with values that are not finite or cannot be drawn", step.number, removed
        )
    return f"removed {removed} primitives" if removed else ""


def backward(run: Run) -> StepResult:
    """Render this rank's share of the next views and send their losses back; gradients are those of the mean loss."""
    number = run.step + 1
    batch = run.sampler.take()
    picked = run.ranks.share(batch)
    terms = request_terms(run, number, picked)
    colours = run.ranks.share([background(run) for _ in batch])  # drawn for all: generators stay alike
    views, steps = run.views.at(number), []
    for module in run.modules.values():
        module.zero_grad()
    run.photos.see(views)
    for view, of_view, colour in zip(picked, terms, colours, strict=True):
        run.refuse_if_stopping()
        with gradients_added(run.backbone.table):
            steps.append(view_loss(run, number, views[view], of_view, colour))
    steps[0] = replace(steps[0], pseudo=accounts_of(run, number))
    return steps[0] if len(batch) == 1 else merge_gradients(run, steps)


def view_loss(run: Run, number: int, view: View, terms: Sequence[Term], colour: Float[Tensor, "3"]) -> StepResult:
    """Render a view, and the pseudo views that go with it, and send the loss back.

    Pseudo views come first, and among them those that leave shared parameters alone: what these parameters have
    gathered from them is forgotten before anything else adds to it. Those that see what the training view sees are
    compared with its own render.
    """
    windows, seen = withheld_windows(run, view, number), list[Observation]()
    counted = counted_in_loss(view, windows)
    target = blacked(run.photos.of(view), counted)
    allowed = [without_windows(term, view.camera, windows) for term in terms]
    divided = [reusable_parts(term, view.camera, run.training.random_background) for term in allowed]
    parts = backward_terms(run, [term for term, _ in divided], number, seen)
    own = 1 - sum(term.replaces for term in terms)
    drawn, rendering = render_for_training(run, view.camera, number, colour)
    backend = run.raster.backend.on(run.device.type, learning=True)
    shown = run.views.match_photo(rendering.image, target, view, learning=True)
    moments = run.photos.moments_of(view, target, backend) if counted is None else None
    loss = photometric(blacked(shown, counted), target, run.training.ssim_weight, backend, moments)
    extra = run.backbone.regulariser(drawn)
    if extra is not None:
        loss = loss + extra
    loss = loss if own == 1 else own * loss
    named = {"own": float(loss.detach())} | parts if parts else {}
    for name, value in reused_losses(rendering.image, divided):
        named[name] += float(value.detach())
        loss = loss + value
    loss.backward()
    served = sum(weight for _, reused in divided for _, weight in reused)
    seen.append(observe(run, drawn, rendering, number, own + served))
    return StepResult(
        number=number,
        view=view,
        target=target,
        # the picture alone: steps of a batch do not hold on to what made theirs
        rendering=replace(rendering, image=shown.detach(), alpha=rendering.alpha.detach()),
        counted=counted,
        loss=loss.detach() + sum(parts.values()),
        terms=named,
        seen=seen,
        dropped=rendering.dropped,
    )


def withheld_windows(run: Run, view: View, number: int) -> list[Window]:
    """Windows of a view that are kept to judge by at a step: the backbone's own, and those that judge the steps."""
    withheld = [run.backbone.validation_window(view, number)] if isinstance(run.backbone, Validating) else []
    ignored = [window for module in run.modules.values() for window in module.ignored_windows(run, view, number)]
    return [window for window in withheld if window is not None] + ignored


def counted_in_loss(view: View, windows: Sequence[Window]) -> Bool[Tensor, "H W"] | None:
    """Pixels that count: all but those masked, and those of windows that are kept to judge by."""
    counted = view.counted()
    if not windows:
        return counted
    left = torch.ones(view.camera.height, view.camera.width, dtype=torch.bool) if counted is None else counted.clone()
    for window in windows:
        left[window.pixels] = False
    return left


def background(run: Run) -> Float[Tensor, "3"]:
    """The scene's background, or a new random colour."""
    if run.training.random_background:
        return uploaded(torch.rand(3, generator=run.generator), run.device)
    return run.background
