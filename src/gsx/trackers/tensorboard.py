"""TensorBoard: curves of metrics.jsonl, evaluation, zoom table, test pictures and configuration."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gsx.core.data.images import read_image
from gsx.core.files import expand_home
from gsx.core.packages import require
from gsx.core.plugins import hookimpl
from gsx.core.training.run import Run
from gsx.trackers.figures import PictureCount, evaluation_figures, line_figures, markdown, pictures, zoom_table


@dataclass(frozen=True, kw_only=True)
class TensorBoardOptions:
    """Options of the tracker; values in conf/tracker/tensorboard.yaml."""

    name: str
    folder: str
    """Folder with a subfolder per run; empty: `tensorboard` in the run folder."""
    pictures: PictureCount


class TensorBoard:
    """Tracker that writes event files.

    Raises:
        ConfigError: tensorboard is not installed.
    """

    def __init__(self, options: TensorBoardOptions) -> None:
        require("tracker tensorboard", ("tensorboard",), "gsx[tensorboard]")
        self.options = options
        self.writer: Any = None
        self.sent = 0

    @hookimpl
    def gsx_run_started(self, run: Run) -> None:
        """Opens an event file that replaces later steps of earlier files."""
        from torch.utils.tensorboard import SummaryWriter

        folder = events_folder(run, self.options.folder)
        resumed = any(folder.glob("events.out.tfevents.*"))
        self.writer = SummaryWriter(str(folder), purge_step=run.step + 1 if resumed else None)
        self.sent = len(run.progress.curves) if resumed else 0
        self.writer.add_text("config", indented((run.folder / "config.yaml").read_text(encoding="utf-8")), run.step)
        self.send(run)

    @hookimpl
    def gsx_step_finished(self, run: Run) -> None:
        """Writes new lines."""
        self.send(run)

    @hookimpl
    def gsx_training_finished(self, run: Run) -> None:
        """Closes the file of an interrupted run."""
        if not run.complete:
            self.writer.close()

    @hookimpl
    def gsx_evaluated(self, run: Run, evaluation: dict[str, Any]) -> None:
        """Writes metrics, zoom table and pictures."""
        for tag, value in evaluation_figures(evaluation).items():
            self.writer.add_scalar(tag, value, evaluation["step"])
        self.writer.add_text("zoom", markdown(zoom_table(evaluation)), evaluation["step"])
        for tag, path in pictures(run.folder / "renders", self.options.pictures).items():
            self.writer.add_image(tag, read_image(path), evaluation["step"])

    @hookimpl
    def gsx_run_finished(self) -> None:
        """Closes the file."""
        self.writer.close()

    @hookimpl
    def gsx_run_failed(self, run: Run, reason: str) -> None:
        """Writes the reason and closes the file."""
        self.writer.add_text("failed", indented(reason), run.step)
        self.writer.close()

    def send(self, run: Run) -> None:
        """Writes new lines to the disk at once, since a resumed run needs those before its checkpoint."""
        lines = run.progress.curves[self.sent :]
        for line in lines:
            for tag, value in line_figures(line).items():
                self.writer.add_scalar(tag, value, int(line["step"]))
        self.sent = len(run.progress.curves)
        if lines:
            self.writer.flush()


def events_folder(run: Run, folder: str) -> Path:
    """Returns the folder of a run's event files, with the same path below `folder` as below `output`."""
    if not folder:
        return run.folder / "tensorboard"
    place, output = run.folder.resolve(), Path(run.config["output"]).resolve()
    return expand_home(folder) / (place.relative_to(output) if place.is_relative_to(output) else place.name)


def indented(text: str) -> str:
    """Indents a text, so that Markdown shows it as code."""
    return "".join(f"    {line}\n" for line in text.splitlines())
