"""TensorBoard: lines of metrics.jsonl as curves, figures of the evaluation, test pictures and the configuration."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from gsx.core.data.images import read_image
from gsx.core.files import expand_home, read_json
from gsx.core.packages import require
from gsx.core.plugins import hookimpl
from gsx.core.ranges import Range
from gsx.core.training.run import Run
from gsx.trackers.figures import evaluation_figures, line_figures


@dataclass(frozen=True, kw_only=True)
class TensorBoardOptions:
    """Options of the tracker; values in conf/tracker/tensorboard.yaml."""

    name: str
    folder: str
    """Folder with one inside for each run; empty: `tensorboard` in the run folder."""
    pictures: Annotated[int, Range(0, 10**6)]
    """Test views, each with its truth, that are written when the run is evaluated."""


class TensorBoard:
    """Listener: writes event files.

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
        """Opens an event file that hides what earlier ones hold after the checkpoint."""
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
        """Writes figures and pictures."""
        for tag, value in evaluation_figures(evaluation).items():
            self.writer.add_scalar(tag, value, evaluation["step"])
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
        """Writes new lines to the disk at once: what a checkpoint covers must be there when a run goes on."""
        lines = run.progress.curves[self.sent :]
        for line in lines:
            for tag, value in line_figures(line).items():
                self.writer.add_scalar(tag, value, int(line["step"]))
        self.sent = len(run.progress.curves)
        if lines:
            self.writer.flush()


def events_folder(run: Run, folder: str) -> Path:
    """Returns the folder of a run's event files; its path below `folder` is that below `output`."""
    if not folder:
        return run.folder / "tensorboard"
    place, output = run.folder.resolve(), Path(run.config["output"]).resolve()
    return expand_home(folder) / (place.relative_to(output) if place.is_relative_to(output) else place.name)


def pictures(renders: Path, count: int) -> dict[str, Path]:
    """Finds the pictures of the first `count` drawn test views, by tag."""
    views = read_json(renders / "index.json")["views"][:count]
    return {
        f"{view['name']}/{kind}": renders / Path(view["files"][kind]).name
        for view in views
        for kind in ("render", "truth")
    }


def indented(text: str) -> str:
    """Indents a text so that Markdown leaves it as it is."""
    return "".join(f"    {line}\n" for line in text.splitlines())
