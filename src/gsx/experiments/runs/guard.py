"""Stops a broken run: skips steps with a non-finite loss or gradient, names its cause, and compares ranks."""

import hashlib
import logging
import math

import torch

from gsx.core.errors import Disagreement, LostModel, TrainingError, command
from gsx.core.plugins import hookimpl
from gsx.core.training.parameter_table import gradients, table_tensors
from gsx.core.training.run import Run, StepResult

logger = logging.getLogger(__name__)

PATIENCE = 3
"""Bad steps in a row that end the run."""


class Guard:
    """Listener that skips bad steps, and ends the run with a checkpoint after PATIENCE in a row."""

    def __init__(self) -> None:
        self.in_a_row = 0

    @hookimpl
    def gsx_gradients_ready(self, run: Run, step: StepResult) -> str | None:
        """Return the reason to skip the step, if any; raise TrainingError at the third in a row."""
        reason = culprit(run, step)
        if reason is None:
            self.in_a_row = 0
            return None
        self.in_a_row += 1
        logger.warning("step %d on view %s skipped: %s", step.number, step.view.name, reason)
        if self.in_a_row >= PATIENCE:
            raise TrainingError(
                f"{PATIENCE} steps in a row were not finite, last at step {step.number}, view {step.view.name}: "
                f"{reason}; check that view, or lower the learning rates"
            )
        return reason

    @hookimpl
    def gsx_step_finished(self, run: Run, step: StepResult) -> None:
        """Raise LostModel if no primitive is left."""
        if len(run.backbone.table) == 0:
            raise LostModel(
                f"no primitive is left after step {step.number}: lower the learning rates (backbone.rates), or the "
                "thresholds below which density control removes"
            )


def culprit(run: Run, step: StepResult) -> str | None:
    """Name what is not finite: the loss, or a parameter's gradient with its number of rows."""
    by_name = gradients(run.backbone.table)
    # one read of the device: the loss, then the sum of every gradient
    loss, *sums = torch.stack([step.loss, *(gradient.sum() for gradient in by_name.values())]).tolist()
    if not math.isfinite(loss):
        return f"the loss is {loss}"
    for (name, gradient), total in zip(by_name.items(), sums, strict=True):
        if not math.isfinite(total):
            rows = int((~torch.isfinite(gradient)).reshape(len(gradient), -1).any(1).sum())
            if rows:  # else every value is finite, only their sum overflowed
                return f"the gradient of {name} is not finite in {rows} of {len(gradient)} rows"
    return None


class Agreement:
    """Listener that compares the state of all ranks at the steps of checkpoints."""

    @hookimpl
    def gsx_step_finished(self, run: Run, step: StepResult) -> None:
        """Raise Disagreement if digests differ."""
        due = run.step % run.training.checkpoint_every == 0 or run.complete
        if due and run.ranks.size > 1 and len(set(run.ranks.all_gather(digest(run)))) > 1:
            raise Disagreement(
                f"ranks disagree at step {run.step}: their models have drifted apart and none is kept; continue from "
                f"the checkpoint before, if there is one, with {command('resume', run.folder)}"
            )


def digest(run: Run) -> str:
    """Return a digest of all that the next steps depend on."""
    content = hashlib.sha256(repr((run.sampler.order, run.sampler.orders)).encode())
    for name, value in sorted({"generator": run.generator.get_state(), **table_tensors(run.backbone.table)}.items()):
        content.update(name.encode() + value.detach().cpu().contiguous().numpy().tobytes())
    return content.hexdigest()
