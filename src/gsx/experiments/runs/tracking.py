"""Trackers: listeners that report a run to other programs. A tracker may fail; the run continues without it.

A factory takes the options and returns an object with `@hookimpl` events. It checks its options before training begins
and raises ConfigError. The first error of its events is logged; then it receives no more.
"""

import logging
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import pluggy

from gsx.core.errors import TrainingError, first_line
from gsx.core.plugins import GROUP, Hooks, Plugins, hookimpl, refuse_unmarked
from gsx.core.training.run import Run, StepResult
from gsx.experiments.runs.settings import Chosen

logger = logging.getLogger(__name__)


def build_trackers(trackers: Mapping[str, Chosen]) -> "list[Tracking]":
    """Return the chosen trackers as listeners; raise ConfigError if one lacks a package."""
    return [Tracking(name, chosen.component.factory(chosen.options)) for name, chosen in trackers.items()]


class Tracking:
    """Listener that passes the events of a run to one tracker, but for vetoes, until the tracker fails.

    Raises:
        TypeError, pluggy.PluginValidationError: the tracker has an unmarked or unknown hook.
    """

    def __init__(self, name: str, tracker: object) -> None:
        refuse_unmarked(tracker)
        self.name, self.started, self.lost = name, False, ""
        self.manager = pluggy.PluginManager(GROUP)  # separate, so that its errors do not reach other listeners
        self.manager.add_hookspecs(Hooks)
        self.manager.register(tracker)
        self.manager.check_pending()

    @hookimpl
    def gsx_run_started(self, run: Run) -> None:
        self.started = True
        self.call("gsx_run_started", run)

    @hookimpl
    def gsx_step_finished(self, run: Run, step: StepResult) -> None:
        self.call("gsx_step_finished", run, step=step)

    @hookimpl
    def gsx_training_finished(self, run: Run) -> None:
        self.call("gsx_training_finished", run, last=not run.complete)

    @hookimpl
    def gsx_evaluated(self, run: Run, evaluation: dict[str, Any]) -> None:
        self.call("gsx_evaluated", run, evaluation=evaluation)

    @hookimpl
    def gsx_run_finished(self, run: Run) -> None:
        self.call("gsx_run_finished", run, last=True)

    @hookimpl
    def gsx_run_failed(self, run: Run, reason: str) -> None:
        self.call("gsx_run_failed", run, last=True, reason=reason)

    def call(self, hook: str, run: Run, last: bool = False, **more: Any) -> None:
        """Call a hook of the tracker if the run has started; log its first error, and at the `last` hook a reminder."""
        if self.started and not self.lost:
            try:
                getattr(self.manager.hook, hook)(run=run, **more)
            except Exception as error:  # a full disk, a server that is down, a defect of a third party
                self.lost = f"step {run.step}"
                logger.warning(
                    "tracker %s failed at %s (%s: %s): the run continues without it",
                    *(self.name, self.lost, type(error).__name__, first_line(error)),
                )
        if last and self.lost:
            logger.warning("tracker %s is incomplete from %s on; the run folder has everything", self.name, self.lost)


@contextmanager
def announce_failure(run: Run, plugins: Plugins) -> Iterator[None]:
    """Announce an error that ends a run to listeners; an error of theirs does not hide it."""
    try:
        yield
    except BaseException as error:
        try:
            plugins.emit.gsx_run_failed(run=run, reason=reason_of(error))
        except Exception as another:
            logger.warning("a listener to the run's failure failed: %s", first_line(another))
        raise


def reason_of(error: BaseException) -> str:
    """Return the reason of a failed run in words."""
    return str(error) if isinstance(error, TrainingError) else f"{type(error).__name__}: {error}"
