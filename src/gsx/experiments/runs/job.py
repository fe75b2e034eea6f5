"""A run from settings to its end as a program carries it out: signals, log file, and how to continue."""

import logging
import signal
import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

from gsx.core.errors import ConfigError, command
from gsx.core.files import remove_partial
from gsx.core.plugins import Plugins, hookimpl
from gsx.core.training.run import Run
from gsx.engine.cache import in_use
from gsx.engine.processes import processes, say
from gsx.engine.signals import INTERRUPTED, STOPPING, handled_signals
from gsx.experiments.reports.report import write_report
from gsx.experiments.run_folder.claims import claimed, claimed_name
from gsx.experiments.run_folder.files import reported
from gsx.experiments.run_folder.run_key import place_of, scene_stamp
from gsx.experiments.runs.execute import execute
from gsx.experiments.runs.logs import logged_to
from gsx.experiments.runs.open import resume_or_start, start
from gsx.experiments.runs.settings import Settings, named_code

logger = logging.getLogger("gsx.cli")


@contextmanager
def interruptible(run: Run, remedy: str) -> Iterator[object]:
    """End training after the current step at the first Ctrl-C, and the program at a second, or after training.

    The signals by which a cluster takes a machine back (STOPPING) end training, too, and may repeat until the
    checkpoint is written. Then the first is raised again for its earlier handler; the log says how to continue
    (`remedy`). Only the main thread receives signals.

    Yields:
        A listener that restores the handlers when training is over.
    """
    received: list[int] = []

    def stop(number: int, frame: Any) -> None:
        run.progress.stopping = True
        received.append(number)
        restore(signal.SIGINT)

    def restore(*numbers: int) -> None:
        for number in numbers:
            signal.signal(number, before[number])

    class UntilTrained:
        @hookimpl(trylast=True)  # after the checkpoint
        def gsx_training_finished(self) -> None:
            restore(*before)

    main = threading.current_thread() is threading.main_thread()
    before = {int(number): signal.signal(number, stop) for number in (signal.SIGINT, *handled_signals()) if main}
    try:
        yield UntilTrained()
    finally:
        restore(*before)
    if received and received[0] in STOPPING and not run.complete:
        name = signal.Signals(received[0]).name
        logger.info("stopped at step %d by %s; continue with: %s", run.step, name, remedy)
        signal.raise_signal(received[0])
        raise SystemExit(128 + received[0])  # the handler returned: end all the same, there is no result


def train(settings: Settings, loaded: Plugins, folders: list[Path]) -> int:
    """Train a composition in a new folder or, with reuse=true, in its own; append that to `folders`.

    Returns 0, or INTERRUPTED if training stopped early.
    """
    if settings.general.reuse:
        return train_rest(settings, loaded, folders)
    with in_use(), ExitStack() as claims:
        run = start(settings, loaded, claims)
        folders.append(run.folder)
        return carry_out(run, settings, loaded, keep_states=True)


def train_rest(settings: Settings, loaded: Plugins, folders: list[Path]) -> int:
    """Train what is left of a composition in its own folder; see `train`."""
    if processes() > 1:
        raise ConfigError("reuse=true is for one process: with torchrun use folder=NAME and `gsx resume` instead")
    stamp = scene_stamp(settings.resolved)
    folder = place_of(settings.resolved, stamp, settings.idle)
    folders.append(folder)
    with in_use(), claimed_name(folder), ExitStack() as claims:
        run = resume_or_start(settings, loaded, stamp, claims)
        if run is None:
            finish_leftovers(folder)
            return 0
        return carry_out(run, settings, loaded, keep_states=True)


def finish_leftovers(folder: Path) -> None:
    """Remove partial files and write a missing report of a finished run that was killed at its very end.

    The folder's name must be claimed.
    """
    with claimed(folder):
        remove_partial(folder)
        if not reported(folder):
            write_report(folder)


def carry_out(run: Run, settings: Settings, loaded: Plugins, keep_states: bool = False) -> int:
    """Train to the end or to Ctrl-C, and then print how to continue; `keep_states`: see `execute`."""
    trust = ["--trust"] if named_code(settings) else []
    remedy = "the same command" if settings.general.reuse else command("resume", run.folder, *trust)
    try:
        with interruptible(run, remedy) as listener, loaded.listening([listener]), logged_to(run.folder):
            execute(run, settings, loaded, keep_states)
        if run.complete:
            return 0
        say(f"gsx: stopped at step {run.step}; continue with: {remedy}\n", as_error=True)
    except KeyboardInterrupt:
        say(f"\ngsx: interrupted after step {run.step}; continue with: {remedy}\n", as_error=True)
    return INTERRUPTED
