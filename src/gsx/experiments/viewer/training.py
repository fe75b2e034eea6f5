"""A model in a browser while it is trained in the same process."""

import time

from gsx.core.plugins import hookimpl
from gsx.core.training.run import Run, Step
from gsx.experiments.viewer.pictures import RunModel
from gsx.experiments.viewer.server import Viewer


class TrainingViewer:
    """Listener: shows the model between steps, for a share of the time that they take."""

    def __init__(self, run: Run, host: str, port: int, share: float) -> None:
        self.viewer = Viewer(RunModel(run), f"{run.scene.name}, {run.folder.name}", host, port, training=True)
        self.share, self.begun = share, time.monotonic()

    @hookimpl
    def gsx_step_finished(self, run: Run, step: Step) -> None:
        """Show pictures while there is time for them, or while training is paused."""
        viewer = self.viewer
        viewer.changed(told_of(run))
        allowed = self.share * (time.monotonic() - self.begun)
        while viewer.frames.spent < allowed and viewer.frames.show_next():
            pass
        if viewer.paused:
            viewer.serve(until=lambda: not viewer.paused or run.stopping)

    @hookimpl
    def gsx_training_finished(self, run: Run) -> None:
        """Close; `gsx view RUN` goes on."""
        self.viewer.stop()


def told_of(run: Run) -> str:
    """How a run stands, in words."""
    psnr = next((line["test_psnr"] for line in reversed(run.curves) if "test_psnr" in line), None)
    held_out = f", held-out PSNR {psnr:.2f} dB" if psnr is not None else ""
    return f"step {run.step:,} of {run.iterations:,}, {len(run.backbone.table):,} primitives{held_out}"
