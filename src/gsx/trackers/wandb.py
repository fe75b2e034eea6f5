"""Weights & Biases: curves, evaluation, zoom table, pictures and files, in the run folder or on a server."""

import logging
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gsx.core.errors import ConfigError
from gsx.core.files import write_json
from gsx.core.packages import require
from gsx.core.plugins import hookimpl
from gsx.core.training.run import Run
from gsx.trackers.figures import PictureCount, evaluation_figures, html, kept_state, line_figures, pictures, zoom_table

logger = logging.getLogger(__name__)

STATE = "wandb.json"
"""File in the run folder with W&B's id of the run."""
INTERRUPTED = 130
"""Exit code of a program that Ctrl-C ended."""
DEFAULTS = {
    "WANDB_SILENT": "true",
    "WANDB_CONSOLE": "off",  # log.txt has the lines that it would copy
    "WANDB_INIT_TIMEOUT": "20",  # seconds, of 90
}
"""Environment variables of W&B, unless the user has set them."""


@dataclass(frozen=True, kw_only=True)
class WandBOptions:
    """Options of the tracker; values in conf/tracker/wandb.yaml."""

    name: str
    online: bool
    """False: write to the run folder alone."""
    project: str
    """W&B's project; empty: the scene's name."""
    pictures: PictureCount


class WandB:
    """Tracker that records a run in Weights & Biases.

    Raises:
        ConfigError: wandb is not installed, or has no API key for a server.
    """

    def __init__(self, options: WandBOptions) -> None:
        os.environ["WANDB_ERROR_REPORTING"] = "false"  # else it resolves its address even offline
        for name, value in DEFAULTS.items():
            os.environ.setdefault(name, value)
        require("tracker wandb", ("wandb", "PIL"), "gsx[wandb]")
        self.options = options
        self.record: Any = None
        self.sent = 0
        if options.online:
            refuse_without_key()

    @hookimpl
    def gsx_run_started(self, run: Run) -> None:
        """Creates W&B's run, or resumes that of this run folder.

        A server keeps points and refuses earlier steps. An offline folder receives all points again.
        """
        import wandb

        state = kept_state(run.folder / STATE)
        self.record = wandb.init(
            project=self.options.project or run.scene.name,
            name=run.folder.name,
            id=state.get("run"),
            dir=str(run.folder),
            config={key: value for key, value in run.config.items() if key != "tracker"},
            mode="online" if self.options.online else "offline",
            resume="allow" if self.options.online else None,
            settings=wandb.Settings(symlink=False, reinit="create_new"),
        )
        write_json(run.folder / STATE, {"run": self.record.id})
        self.sent = sum(line["step"] < self.record.starting_step for line in run.progress.curves)
        self.send(run)
        place = self.record.url if self.options.online else Path(self.record.dir).parent
        logger.info("tracker wandb: run %s at %s", self.record.id, place)

    @hookimpl
    def gsx_step_finished(self, run: Run) -> None:
        """Sends new lines."""
        self.send(run)

    @hookimpl
    def gsx_training_finished(self, run: Run) -> None:
        """Marks an interrupted run."""
        if not run.complete:
            self.record.finish(exit_code=INTERRUPTED)

    @hookimpl
    def gsx_evaluated(self, run: Run, evaluation: dict[str, Any]) -> None:
        """Sends metrics, zoom table and pictures."""
        import wandb

        images = pictures(run.folder / "renders", self.options.pictures)
        content: dict[str, Any] = {name: wandb.Image(str(path)) for name, path in images.items()}
        if table := html(zoom_table(evaluation)):
            content["zoom"] = wandb.Html(table, inject=False, data_is_not_path=True)
        self.record.log(evaluation_figures(evaluation) | content, step=evaluation["step"])

    @hookimpl
    def gsx_run_finished(self, run: Run) -> None:
        """Sends files, and marks the run as finished."""
        for name in ("config.yaml", "evaluation.json", "report.html"):
            self.record.save(str(run.folder / name), base_path=str(run.folder), policy="now")
        self.record.finish()

    @hookimpl
    def gsx_run_failed(self, run: Run, reason: str) -> None:
        """Sends the rest, and marks the run as failed."""
        self.send(run)
        self.record.summary["reason"] = reason
        self.record.finish(exit_code=INTERRUPTED if reason.startswith("KeyboardInterrupt") else 1)

    def send(self, run: Run) -> None:
        """Sends new lines; the client writes them in a process of its own."""
        for line in run.progress.curves[self.sent :]:
            self.record.log(line_figures(line), step=int(line["step"]))
        self.sent = len(run.progress.curves)


def refuse_without_key() -> None:
    """Raises ConfigError without an API key, so that W&B does not ask for one during the run."""
    import wandb

    if not wandb.login(prompt=False, verify=False):
        raise ConfigError(
            "tracker.wandb.online=true needs an API key: run `wandb login` once, set WANDB_API_KEY, or leave it out"
        )
