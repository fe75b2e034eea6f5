"""The training loop. Backbones hold density control and learning rates; plugins listen through hooks."""

import logging
import time
from collections.abc import Callable, Sequence
from dataclasses import replace

import torch
from torch import Tensor

from gsx.core.data.masks import black_out
from gsx.core.data.scene import View
from gsx.core.data.window import Window
from gsx.core.device import upload
from gsx.core.errors import Stopped
from gsx.core.plugins import Plugins
from gsx.core.quality.losses import photometric
from gsx.core.shapes import Bool, Float
from gsx.core.training.augmenter import accounts_of
from gsx.core.training.backbone import Observation, Validating, remove_nonfinite
from gsx.core.training.minibatch import accumulate_gradients, merge_gradients, rollback_on_error
from gsx.core.training.parameter_table import zero_grad
from gsx.core.training.pseudo_terms import backward_terms, request_terms, reusable_parts, reused_losses, without_windows
from gsx.core.training.pseudo_views import Term
from gsx.core.training.render import module_losses, observe, render_for_training
from gsx.core.training.run import Run, StepResult

logger = logging.getLogger(__name__)


def train(run: Run, plugins: Plugins, clock: Callable[[], float] = time.perf_counter) -> None:
    """Takes steps until the run is complete or one of its ranks is stopping; listeners are called after each step.

    Args:
        run: Run to train, in place.
        plugins: Plugins whose event hooks are called.
        clock: Seconds that count as training time.
    """
    plugins.emit.gsx_run_started(run=run)
    while not (run.complete or any(run.ranks.all_gather(run.progress.stopping))):
        start = clock()
        try:
            result = train_step(run, plugins)
        except Stopped:
            break
        run.progress.seconds += clock() - start
        plugins.emit.gsx_step_finished(run=run, step=result)
    run.photos.set_views(())
    plugins.emit.gsx_training_finished(run=run)


def train_step(run: Run, plugins: Plugins) -> StepResult:
    """Takes one step in the published order (3D-GS, train.py): render, backward, statistics, density control, Adam."""
    metrics = before_step(run)
    with rollback_on_error(run):
        result = backward(run)
        result.changes.update(metrics)
        reason = veto(run, result, plugins)
    step, run.progress.changing = result.number, True
    if reason:
        zero_grad(run.backbone.table)
    else:
        for observation in result.observations:
            run.backbone.accumulate(observation)
        run.backbone.table.pace = run.training.pace(step, run.iterations)
        result.changes.update(run.backbone.densify_and_prune(step))
        run.backbone.update(step)
        for module in run.modules.values():
            module.optimizer_step(step)
    run.step, run.progress.changing = step, False
    return replace(result, skipped=reason)


def before_step(run: Run) -> dict[str, float]:
    """Runs the modules' estimates, corrections and skips before a step; returns their metrics."""
    metrics: dict[str, float] = {}
    for module in run.modules.values():
        metrics |= module.before_step(run)
    return metrics


def veto(run: Run, result: StepResult, plugins: Plugins) -> str:
    """Returns the reason to skip the step: the first of any rank, the same on all; empty: none."""
    removed = remove_lost(run, result) if result.dropped else ""
    reason = removed or plugins.emit.gsx_gradients_ready(run=run, step=result) or ""
    reason = next(filter(None, run.ranks.all_gather(reason)), "")
    return reason if removed or not reason else "; ".join(filter(None, [reason, remove_lost(run, result)]))


def remove_lost(run: Run, result: StepResult) -> str:
    """Removes primitives that cannot be drawn, the same on all ranks; returns a reason to skip the step, if any."""
    views = run.views.at(result.number)
    cameras = [views[index].camera for index in run.sampler.current]
    removed = remove_nonfinite(run.backbone, cameras, result.number)
    if not removed:
        return ""
    run.progress.changing = True
    logger.warning(
        "step %d: removed %d primitives with values that are not finite or cannot be drawn", result.number, removed
    )
    return f"removed {removed} primitives"


def backward(run: Run) -> StepResult:
    """Renders this rank's share of the next views and runs backward; gradients are those of the mean loss."""
    step = run.step + 1
    batch = run.sampler.take()
    indices = run.ranks.share(batch)
    terms = request_terms(run, step, indices)
    colours = run.ranks.share([background(run) for _ in batch])  # drawn for all: generators stay alike
    views, results = run.views.at(step), []
    for module in run.modules.values():
        module.zero_grad()
    run.photos.set_views(views)
    for index, of_view, colour in zip(indices, terms, colours, strict=True):
        run.raise_if_stopping()
        with accumulate_gradients(run.backbone.table):
            results.append(view_loss(run, step, views[index], of_view, colour))
    results[0] = replace(results[0], pseudo=accounts_of(run, step))
    return results[0] if len(batch) == 1 else merge_gradients(run, results)


def view_loss(run: Run, step: int, view: View, terms: Sequence[Term], colour: Float[Tensor, "3"]) -> StepResult:
    """Renders a view and its pseudo views, and runs backward.

    Pseudo views come first, and among them those without shared parameters, whose gradients from them are dropped
    before anything else adds to them. Pseudo views with the training view's camera reuse its render, also the finer
    one that the picture is reduced from.
    """
    windows, observations = excluded_windows(run, view, step), list[Observation]()
    counted = counted_in_loss(view, windows)
    target = black_out(run.photos.of(view), counted)
    allowed = [without_windows(term, view.camera, windows) for term in terms]
    cameras = view.camera, run.views.raster_for(step)(view.camera).camera
    divided = [reusable_parts(term, cameras, run.training.random_background) for term in allowed]
    parts = backward_terms(run, [term for term, _ in divided], step, observations)
    own = 1 - sum(term.replaces for term in terms)
    drawn, rendering, finer, blended = render_for_training(run, view.camera, step, colour, channels=True)
    backend = run.raster.backend.on(run.device.type, learning=True)
    matched = run.views.match_photo(rendering.image, target, view, learning=True)
    moments = run.photos.moments_of(view, target, backend) if counted is None else None
    loss = photometric(black_out(matched, counted), target, run.training.ssim_weight, backend, moments)
    extra = run.backbone.regulariser(drawn)
    if extra is not None:
        loss = loss + extra
    loss = loss if own == 1 else own * loss
    added = module_losses(run, view, step, finer[0], blended, counted)
    named = {"own": float(loss.detach())} | parts | dict.fromkeys(added, 0.0) if parts or added else {}
    reused_terms = reused_losses(run, [(view.camera, rendering.image), finer], divided)
    for name, value in [*added.items(), *reused_terms]:
        named[name] += float(value.detach())
        loss = loss + value
    loss.backward()
    reused = sum(weight for _, reused_parts in divided for _, weight in reused_parts)
    observations.append(observe(run, drawn, rendering, step, own + reused))
    return StepResult(
        number=step,
        view=view,
        target=target,
        # the picture alone: results of a batch do not hold on to their graphs
        rendering=replace(rendering, image=matched.detach(), alpha=rendering.alpha.detach()),
        counted=counted,
        loss=loss.detach() + sum(parts.values()),
        terms=named,
        observations=observations,
        dropped=rendering.dropped,
    )


def excluded_windows(run: Run, view: View, step: int) -> list[Window]:
    """Returns the windows of a view that enter no loss at a step: the backbone's and the modules'."""
    validation = run.backbone.validation_window(view, step) if isinstance(run.backbone, Validating) else None
    ignored = [window for module in run.modules.values() for window in module.ignored_windows(run, view, step)]
    return ([] if validation is None else [validation]) + ignored


def counted_in_loss(view: View, windows: Sequence[Window]) -> Bool[Tensor, "H W"] | None:
    """Marks the pixels that enter the loss, outside masks and windows; None: all."""
    counted = view.counted()
    if not windows:
        return counted
    left = torch.ones(view.camera.height, view.camera.width, dtype=torch.bool) if counted is None else counted.clone()
    for window in windows:
        left[window.pixels] = False
    return left


def background(run: Run) -> Float[Tensor, "3"]:
    """Returns the scene's background, or a new random colour."""
    if run.training.random_background:
        return upload(torch.rand(3, generator=run.generator), run.device)
    return run.background
