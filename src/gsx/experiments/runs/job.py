"""A run from settings to its end as a program carries it out: signals, log file, and how to go on."""

import logging
import signal
import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gsx.core.errors import ConfigError, command
from gsx.core.files import remove_partial
from gsx.engine.cache import in_use
from gsx.engine.processes import processes, say
from gsx.engine.signals import STOPPING, handled_signals
from gsx.experiments.runs.logs import logged_to

if TYPE_CHECKING:
    from gsx.core.plugins import Plugins
    from gsx.core.training.run import Run
    from gsx.experiments.runs.settings import Settings

logger = logging.getLogger("gsx.cli")

INTERRUPTED = 130
"""Exit code after Ctrl-C, as shells report it."""


@contextmanager
def interruptible(run: "Run", onwards: str) -> Iterator[object]:
    """Ends training after the current step at the first Ctrl-C, and the program at a second, or after training.

    The signals by which a cluster takes a machine back (STOPPING) end training, too; they may come again until the
    checkpoint is written. Then the first is sent again, to whoever waited for it before; the log says how to go
    `onwards`. Threads but the main one hear no signals.

    Yields:
        A listener that restores the handlers when training is over.
    """
    from gsx.core.plugins import hookimpl

    received: list[int] = []

    def stop(number: int, frame: Any) -> None:
        run.progress.stopping = True
        received.append(number)
        give_back(signal.SIGINT)

    def give_back(*numbers: int) -> None:
        for number in numbers:
            signal.signal(number, before[number])

    class UntilTrained:
        @hookimpl(trylast=True)  # the checkpoint first
        def gsx_training_finished(self) -> None:
            give_back(*before)

    main = threading.current_thread() is threading.main_thread()
    before = {int(number): signal.signal(number, stop) for number in (signal.SIGINT, *handled_signals()) if main}
    try:
        yield UntilTrained()
    finally:
        give_back(*before)
    if received and received[0] in STOPPING and not run.complete:
        name = signal.Signals(received[0]).name
        logger.info("stopped at step %d by %s; go on with: %s", run.step, name, onwards)
        signal.raise_signal(received[0])
        raise SystemExit(128 + received[0])  # it was not fatal: there is no result to hand over either way


def train(settings: "Settings", loaded: "Plugins", folders: list[Path]) -> int:
    """Trains one composed experiment in a new folder, or goes on in that of its composition; `folders` learns which.

    Returns 0, or INTERRUPTED where it was stopped before its end.
    """
    from gsx.experiments.runs.open import start

    if settings.general.reuse:
        return reused(settings, loaded, folders)
    with in_use(), ExitStack() as claims:
        run = start(settings, loaded, claims)
        folders.append(run.folder)
        return carry_out(run, settings, loaded, keep_states=True)


def reused(settings: "Settings", loaded: "Plugins", folders: list[Path]) -> int:
    """Trains what is left of a composition in its own folder; see `train`."""
    from gsx.experiments.run_folder.claims import claimed_name
    from gsx.experiments.run_folder.run_key import place_of, scene_stamp
    from gsx.experiments.runs.open import resume_or_start

    if processes() > 1:
        raise ConfigError("reuse=true is for one process: leave it out under torchrun, folder=NAME and `gsx resume` do")
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
    """Finishes what a process left of a finished run that was killed at its very end: partial files, no report.

    The folder's name must be claimed.
    """
    from gsx.experiments.reports.report import write_report
    from gsx.experiments.run_folder.claims import claimed
    from gsx.experiments.run_folder.files import reported

    with claimed(folder):
        remove_partial(folder)
        if not reported(folder):
            write_report(folder)


def carry_out(run: "Run", settings: "Settings", loaded: "Plugins", keep_states: bool = False) -> int:
    """Trains to the end or to Ctrl-C, and says then how to go on; `keep_states`: see `execute`."""
    from gsx.experiments.runs.execute import execute
    from gsx.experiments.runs.settings import named_code

    trust = ["--trust"] if named_code(settings) else []
    onwards = "the same command" if settings.general.reuse else command("resume", run.folder, *trust)
    try:
        with interruptible(run, onwards) as listener, loaded.listening([listener]), logged_to(run.folder):
            execute(run, settings, loaded, keep_states)
        if run.complete:
            return 0
        say(f"gsx: stopped at step {run.step}; go on with: {onwards}\n", as_error=True)
    except KeyboardInterrupt:
        say(f"\ngsx: interrupted after step {run.step}; go on with: {onwards}\n", as_error=True)
    return INTERRUPTED
