"""A model in a browser while it is trained in the same process."""

import time

from gsx.core.plugins import hookimpl
from gsx.core.training.run import Run, StepResult
from gsx.experiments.viewer.pictures import RunModel
from gsx.experiments.viewer.server import Viewer

MOST_CREDIT = 1.0
"""Largest credit of drawing time, s."""


class TrainingViewer:
    """Listener that draws pictures between steps, for a share of the time that they take."""

    def __init__(self, run: Run, host: str, port: int, share: float) -> None:
        self.viewer = Viewer(RunModel(run), f"{run.scene.name}, {run.folder.name}", host, port, training=True)
        self.share, self.credit, self.before = share, 0.0, time.monotonic()

    @hookimpl
    def gsx_step_finished(self, run: Run, step: StepResult) -> None:
        """Draws pictures while there is time for them, or while training is paused."""
        viewer, frames = self.viewer, self.viewer.frames
        viewer.changed(status_of(run))
        spent, self.credit = frames.spent, min(MOST_CREDIT, self.credit + self.share * (time.monotonic() - self.before))
        while frames.spent - spent < self.credit and frames.show_next():
            pass
        self.credit -= frames.spent - spent
        if viewer.paused:
            viewer.serve(until=lambda: not viewer.pausing() or run.progress.stopping)
        self.before = time.monotonic()

    def stop(self) -> None:
        """Closes the server; `gsx view RUN` shows the run again."""
        self.viewer.stop()


def status_of(run: Run) -> str:
    """Describes step, primitives and quality of a run."""
    psnr = next((line["test_psnr"] for line in reversed(run.progress.curves) if "test_psnr" in line), None)
    held_out = f", held-out PSNR {psnr:.2f} dB" if psnr is not None else ""
    return f"step {run.step:,} of {run.iterations:,}, {len(run.backbone.table):,} primitives{held_out}"
