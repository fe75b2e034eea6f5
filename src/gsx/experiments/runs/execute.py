"""Trains from the current step on, evaluates, exports, reports; evaluates again."""

import logging
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from gsx.core.errors import CompilerError, LostModel, first_line
from gsx.core.files import read_json, remove_partial, write_json
from gsx.core.plugins import Plugins, hookimpl
from gsx.core.training.run import Run, StepResult
from gsx.core.training.trainer import train
from gsx.engine.allocator import return_freed_memory
from gsx.engine.cache import cache_root, trim
from gsx.engine.compile_cache import training_clock
from gsx.experiments.evaluation.remarks import CapNotice
from gsx.experiments.reports.report import write_report
from gsx.experiments.run_folder import checkpoint
from gsx.experiments.run_folder.files import SPLATS
from gsx.experiments.runs import warm_start
from gsx.experiments.runs.environment import announce
from gsx.experiments.runs.evaluate import evaluate
from gsx.experiments.runs.export import export
from gsx.experiments.runs.guard import Agreement, Guard
from gsx.experiments.runs.open import refuse_code, reopened
from gsx.experiments.runs.progress import MetricsLog, Progress
from gsx.experiments.runs.rasterizer_path import warm, warm_or_eager
from gsx.experiments.runs.settings import Settings
from gsx.experiments.runs.tracking import announce_failure, build_trackers, reason_of

logger = logging.getLogger(__name__)


class Checkpointer:
    """Listener that saves every `training.checkpoint_every` steps, and when training ends, complete or not."""

    @hookimpl
    def gsx_step_finished(self, run: Run, step: StepResult) -> None:
        """Save when due."""
        if run.step % run.training.checkpoint_every == 0 and not run.complete:
            checkpoint.save(run)

    @hookimpl
    def gsx_training_finished(self, run: Run) -> None:
        """Save the last state."""
        checkpoint.save(run)


class MemoryTrimmer:
    """Listener that returns freed memory where the sizes of tensors change: before, between and after steps."""

    @hookimpl
    def gsx_run_started(self) -> None:
        """Return what building the run has freed."""
        return_freed_memory()

    @hookimpl
    def gsx_step_finished(self, run: Run) -> None:
        """Return it if the next step renders other cameras."""
        if not run.complete and run.views.changes_after(run.step):
            return_freed_memory()

    @hookimpl
    def gsx_training_finished(self) -> None:
        """Return what steps have used."""
        return_freed_memory()


def status(run: Run, state: str, reason: str = "") -> None:
    """Write the state of a run to status.json."""
    write_json(run.folder / "status.json", {"state": state, "reason": reason, "step": run.step})


def execute(run: Run, settings: Settings, plugins: Plugins, keep_states: bool = False) -> None:
    """Train from the current step on; when complete, evaluate and report. Interrupted runs keep a checkpoint.

    Ranks above 0 only train. keep_states: keep states for other runs to branch from (`init=warm_start`); not for a run
    whose first steps may have followed other settings.
    """
    if not run.ranks.first:
        warm(run, helped=False)
        with plugins.listening([Guard(), Agreement()]):
            train(run, plugins, training_clock)
        return
    trackers = build_trackers(settings.trackers)
    remove_partial(cache_root())
    announce(run, plugins)
    status(run, "running")
    general, log = settings.general, MetricsLog(settings.evaluation)
    first = [Guard(), Agreement(), CapNotice(), log]  # trackers read the log
    listeners: list[object] = [*first, *trackers, Checkpointer(), Progress(), MemoryTrimmer()]
    if keep_states and general.init == "warm_start":
        states = warm_start.warm_start_folder(run, settings.idle, plugins.versions)
        listeners.append(warm_start.WarmStartKeeper(states, general.disk_cache_gb, general.warm_start_at))
    try:
        if warm_or_eager(run, settings.raster.path):
            facts = read_json(run.folder / "environment.json")
            write_json(run.folder / "environment.json", facts | {"rasterizer": "eager"})
        with (
            viewed(run, settings) as viewers,
            plugins.listening([*listeners, *viewers]),
            announce_failure(run, plugins),
        ):
            train(run, plugins, training_clock)
            if run.complete:
                finish(run, settings, plugins)
    except BaseException as error:
        save_on_failure(run, error)
        raise
    finally:
        log.close()
        trim(general.disk_cache_gb)
    if not run.complete:
        status(run, "interrupted")
        write_report(run.folder)


@contextmanager
def viewed(run: Run, settings: Settings) -> Iterator[list[object]]:
    """Yield the listener of `viewer=true` that shows the model in a browser, and log its address.

    Raises:
        ConfigError, InputError: viser is not installed, or the port is not free.
    """
    general = settings.general
    if not general.viewer:
        yield []
        return
    from gsx.experiments.viewer.training import TrainingViewer

    viewer = TrainingViewer(run, general.viewer_host, general.viewer_port, general.viewer_share)
    logger.info("look around: %s", viewer.viewer.address)
    try:
        yield [viewer]
    finally:
        viewer.stop()


def save_on_failure(run: Run, error: BaseException) -> None:
    """Write the reason of a failure, and a checkpoint of the last step if the model is still that of a step."""
    kept = run.step in map(checkpoint.step_of, checkpoint.sidecars(run.folder / "checkpoints"))
    nothing = run.step == 0 and not isinstance(error, KeyboardInterrupt | CompilerError)  # their remedy is to resume
    with problems_logged(f"the checkpoint of step {run.step}"):
        if not (kept or nothing or run.progress.changing or isinstance(error, LostModel)):
            checkpoint.save(run)
    with problems_logged("its status"):
        status(run, "failed", reason_of(error))


@contextmanager
def problems_logged(what: str) -> Iterator[None]:
    """Log what cannot be written after an error (no space, no memory), so that it does not hide that error."""
    try:
        yield
    except Exception as problem:
        logger.warning("after this error %s could not be saved (%s)", what, first_line(problem))


def finish(run: Run, settings: Settings, plugins: Plugins) -> dict[str, Any]:
    """Evaluate, export and report a trained run."""
    evaluation = evaluate(run, settings)
    plugins.emit.gsx_evaluated(run=run, evaluation=evaluation)
    export(run, run.folder / SPLATS)
    status(run, "ok")
    write_report(run.folder)
    plugins.emit.gsx_run_finished(run=run)
    return evaluation


def evaluate_again(folder: Path, plugins: Plugins, overrides: Sequence[str] = ()) -> dict[str, Any]:
    """Write evaluation.json, pictures, splat file and report of a run anew; errors as `reopened`."""
    with reopened(folder, plugins, overrides) as (run, settings):
        refuse_code(folder, settings, overrides, evaluating=True)
        if run.complete:
            return finish(run, settings, plugins)
        evaluation = evaluate(run, settings)
        plugins.emit.gsx_evaluated(run=run, evaluation=evaluation)
        write_report(folder)
        return evaluation
