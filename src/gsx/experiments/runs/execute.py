"""Train from the current step on, evaluate, export, report."""

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

from gsx.core.errors import CompilerError, LostModel, TrainingError, first_line
from gsx.core.files import read_json, remove_partial, write_json
from gsx.core.plugins import Plugins, hookimpl
from gsx.core.training import checkpoint
from gsx.core.training.guard import Agreement, Guard
from gsx.core.training.run import Run, StepResult
from gsx.core.training.trainer import train
from gsx.engine.cache import cache_root, trim
from gsx.experiments.evaluation.remarks import CapNotice
from gsx.experiments.reports.report import write_report
from gsx.experiments.run_folder.files import SPLATS
from gsx.experiments.runs import warm_start
from gsx.experiments.runs.environment import announce
from gsx.experiments.runs.evaluate import evaluate
from gsx.experiments.runs.export import export
from gsx.experiments.runs.progress import MetricsLog, Progress
from gsx.experiments.runs.rasterizer_path import warm
from gsx.experiments.runs.settings import Settings
from gsx.experiments.runs.tracking import build_trackers, telling_of_failure

logger = logging.getLogger(__name__)


class Checkpointer:
    """Listener: saves every `training.checkpoint_every` steps and when training ends, complete or not."""

    @hookimpl
    def gsx_step_finished(self, run: Run, step: StepResult) -> None:
        """Save when due."""
        if run.step % run.training.checkpoint_every == 0 and not run.complete:
            checkpoint.save(run)

    @hookimpl
    def gsx_training_finished(self, run: Run) -> None:
        """Save the last state."""
        checkpoint.save(run)


def status(run: Run, state: str, reason: str = "") -> None:
    """Record how the run stands, for reports over many runs."""
    write_json(run.folder / "status.json", {"state": state, "reason": reason, "step": run.step})


def execute(run: Run, settings: Settings, plugins: Plugins, keep_states: bool = False) -> None:
    """Trains from the current step on; when complete, evaluates and reports. Interrupted runs keep a checkpoint.

    All ranks but the first only train. keep_states: for other runs to branch from, with `init=warm_start`; not of a run
    whose first steps may have followed other settings.
    """
    if not run.ranks.first:
        follow(run, settings, plugins)
        return
    trackers = build_trackers(settings.trackers)
    remove_partial(cache_root())
    announce(run, plugins)
    status(run, "running")
    log = MetricsLog(settings.evaluation)
    listeners: list[object] = [
        Guard(),
        Agreement(),
        CapNotice(),
        log,
        *trackers,
        Checkpointer(),
        Progress(),
    ]  # trackers read the log
    general = settings.general
    if keep_states and general.init == "warm_start":
        states = warm_start.warm_start_folder(run, settings.idle, plugins.versions)
        listeners.append(warm_start.WarmStartKeeper(states, general.disk_cache_gb, general.warm_start_at))
    try:
        warm_or_eager(run, settings)
        with (
            viewed(run, settings) as viewers,
            plugins.listening([*listeners, *viewers]),
            telling_of_failure(run, plugins),
        ):
            train(run, plugins)
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


def warm_or_eager(run: Run, settings: Settings) -> None:
    """Have compiled what steps need; where that fails at the beginning of a run that left the path to gsx, it goes
    eagerly.

    Raises:
        CompilerError: elsewhere.
    """
    try:
        warm(run, settings)
    except CompilerError as error:
        left_to_gsx = settings.raster.path == "auto" and run.raster.path == "compiled"
        if not left_to_gsx or run.step > 0 or run.ranks.size > 1:
            raise
        logger.warning("%s; going on with the eager path, which is several times slower", error)
        run.raster = run.backbone.raster = replace(run.raster, path="eager")
        facts = read_json(run.folder / "environment.json")
        write_json(run.folder / "environment.json", facts | {"rasterizer": "eager"})


@contextmanager
def viewed(run: Run, settings: Settings) -> Iterator[list[object]]:
    """The listener that shows the model in a browser, where that is asked for; its address is told.

    Raises:
        ConfigError, InputError: viser is not installed, or nothing can listen there.
    """
    general = settings.general
    if not general.viewer:
        yield []
        return
    from gsx.experiments.viewer.training import TrainingViewer

    shown = TrainingViewer(run, general.viewer_host, general.viewer_port, general.viewer_share)
    logger.info("look around: %s", shown.viewer.address)
    try:
        yield [shown]
    finally:
        shown.stop()


def save_on_failure(run: Run, error: BaseException) -> None:
    """After an error: a checkpoint of the last step, where the model is that of a step, and a word on what happened.

    What cannot be written now is told in the log; the error itself is what matters.
    """
    kept = run.step in map(checkpoint.step_of, checkpoint.sidecars(run.folder / "checkpoints"))
    nothing = run.step == 0 and not isinstance(error, KeyboardInterrupt | CompilerError)  # who says how to go on
    reason = str(error) if isinstance(error, TrainingError) else f"{type(error).__name__}: {error}"
    with told_of(f"the checkpoint of step {run.step}"):
        if not (kept or nothing or run.changing or isinstance(error, LostModel)):
            checkpoint.save(run)
    with told_of("its status"):
        status(run, "failed", reason)


@contextmanager
def told_of(what: str) -> Iterator[None]:
    """What cannot be written after an error, for want of space or memory, must not hide it."""
    try:
        yield
    except Exception as problem:
        logger.warning("after this error %s could not be kept (%s)", what, first_line(problem))


def follow(run: Run, settings: Settings, plugins: Plugins) -> None:
    """Train as another process does, and write nothing."""
    warm(run, settings, helped=False)
    with plugins.listening([Guard(), Agreement()]):
        train(run, plugins)


def finish(run: Run, settings: Settings, plugins: Plugins) -> dict[str, Any]:
    """Evaluate, export, draw and report a trained run."""
    evaluation = evaluate(run, settings)
    plugins.emit.gsx_evaluated(run=run, evaluation=evaluation)
    export(run, run.folder / SPLATS)
    status(run, "ok")
    write_report(run.folder)
    plugins.emit.gsx_run_finished(run=run)
    return evaluation
