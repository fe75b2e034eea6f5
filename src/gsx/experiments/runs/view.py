"""`gsx view`: a run, also during training by another process, or a splat file."""

import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

from gsx.core.errors import CheckpointError, InputError
from gsx.core.plugins import Plugins
from gsx.engine.threads import watch_cores
from gsx.experiments.run_folder import checkpoint
from gsx.experiments.run_folder.files import read_run, state_of
from gsx.experiments.runs.open import open_run
from gsx.experiments.runs.progress import read_curves
from gsx.experiments.runs.rasterizer_path import compile_in_background
from gsx.experiments.runs.start_file import rules_of
from gsx.experiments.viewer.pictures import FileModel, RunModel
from gsx.experiments.viewer.server import Viewer
from gsx.experiments.viewer.training import status_of
from gsx.formats.splat_files import read_around

EVERY = 2.0
"""Seconds between checks of a run's folder."""


class WatchedRun:
    """A run that another process may train, at its newest checkpoint."""

    def __init__(self, folder: Path, plugins: Plugins) -> None:
        self.run, self.settings = open_run(folder, plugins)
        raster = self.run.raster
        self.run.raster = replace(raster, path="eager")  # the first pictures do not wait for a compiler
        self.compiling = compile_in_background(raster, self.run.device, partial(setattr, self.run, "raster"))
        self.checked = time.monotonic()

    def refresh(self) -> bool:
        """Restore a newer checkpoint; return True if there was one."""
        if time.monotonic() - self.checked < EVERY:
            return False
        self.checked = time.monotonic()
        sidecars = checkpoint.sidecars(self.run.folder / "checkpoints")
        if not sidecars or checkpoint.step_of(sidecars[-1]) <= self.run.step:
            return False
        try:
            checkpoint.restore(self.run)
        except (CheckpointError, OSError):  # half written, or gone already: check again later
            return False
        self.run.progress.curves = read_curves(self.run.folder)
        return True

    def state(self) -> str:
        """Return the state of the run in words."""
        return f"{status_of(self.run)}, {state_of(read_run(self.run.folder))[0]}"


def view_run(folder: Path, plugins: Plugins, host: str, port: int, announce: Callable[[str], None]) -> None:
    """Show a run until Ctrl-C; raise InputError if the port is taken, or as `open_run`."""
    watched = WatchedRun(folder, plugins)
    viewer = Viewer(RunModel(watched.run), f"{watched.run.scene.name}, {folder.name}", host, port)
    viewer.show_status(watched.state())
    announce(viewer.address)
    try:
        viewer.serve(lambda: False, lambda: viewer.changed(watched.state()) if watched.refresh() else None)
    finally:
        viewer.stop()


def view_file(path: Path, axes: str, host: str, port: int, announce: Callable[[str], None]) -> None:
    """Show a splat file until Ctrl-C; `axes`: of the file."""
    watch_cores()
    gaussians, origin = read_around(path, axes)
    if not len(gaussians.means):
        raise InputError(f"{path} holds no splats: choose another file")
    raster = rules_of(path)
    viewer = Viewer(FileModel(gaussians, raster, origin), path.name, host, port)
    viewer.show_status(f"{len(gaussians.means):,} splats{', opacities compensated' if raster.compensate else ''}")
    announce(viewer.address)
    try:
        viewer.serve(lambda: False)
    finally:
        viewer.stop()
