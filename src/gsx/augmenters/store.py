"""Files of pseudo views: what a run made at an event, until no checkpoint needs it."""

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gsx.augmenters.timing import event_at
from gsx.core.errors import InputError
from gsx.core.training.checkpoint import sidecars, step_of
from gsx.core.training.pseudo_views import PseudoView, load_views, save_views
from gsx.core.training.run import Run

logger = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class Store:
    """The pseudo views of one augmenter in the folder of a run, a file an event."""

    name: str
    iterations: int
    events: Sequence[int]
    span: int

    def write(self, run: Run, event: int, views: Sequence[PseudoView], facts: dict[str, Any]) -> None:
        """Keep the pseudo views of an event in place of those that no checkpoint needs any more."""
        path = self.path(run, event)
        path.parent.mkdir(parents=True, exist_ok=True)
        save_views(path, views, facts)
        self.forget(run, event)

    def path(self, run: Run, event: int) -> Path:
        """Where the pseudo views of an event are kept while a checkpoint may need them."""
        return run.folder / "pseudo" / f"{self.name}_{event:07d}.safetensors"

    def files(self, run: Run) -> list[Path]:
        """Those that there are, oldest first."""
        return sorted((run.folder / "pseudo").glob(f"{self.name}_{'[0-9]' * 7}.safetensors"))

    def forget(self, run: Run, event: int) -> None:
        """Remove the files of events in whose windows no checkpoint lies, but for that of the current one."""
        steps = map(step_of, sidecars(run.folder / "checkpoints"))
        needed = {event} | {event_at(step + 1, self.events, self.span) for step in steps}
        kept = {self.path(run, number) for number in needed if number is not None}
        for path in self.files(run):
            if path not in kept:
                path.unlink()

    def recalled(self, run: Run, event: int) -> list[PseudoView]:
        """The pseudo views that the run had made before it was interrupted.

        None where it was made longer since, so that its events and windows lie elsewhere: the next one goes on.

        Raises:
            InputError: the file is gone or damaged.
        """
        path = self.path(run, event)
        latest = [path] if path.is_file() else self.files(run)[-1:]
        try:
            if latest and (found := load_views(latest[0]))[1]["iterations"] != self.iterations:
                logger.info("%s rests until its next event: the run has become longer", self.name)
                return []
            return found[0] if latest == [path] else load_views(path)[0]
        except (OSError, ValueError) as error:
            raise InputError(
                f"{path} cannot be read ({error}): it holds the pseudo views of step {event}, without which the run "
                f"cannot go on at step {run.step}; restore the file, or train anew"
            ) from error
