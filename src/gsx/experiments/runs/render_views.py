"""Pictures of a run: its test views, one view by name, an orbit; and of a run or a file along a camera path."""

import logging
from collections.abc import Callable, Sequence
from pathlib import Path

import torch
from torch import Tensor

from gsx.core.data.camera import Camera
from gsx.core.data.images import write_image
from gsx.core.data.scene import View
from gsx.core.errors import InputError, nearest
from gsx.core.files import remove_partial
from gsx.core.shapes import Float
from gsx.core.training.render import render, render_gaussians
from gsx.core.training.run import Run
from gsx.engine.threads import watch_cores
from gsx.experiments.reports.pictures import file_names
from gsx.experiments.runs.orbit import orbit_cameras, write_animation
from gsx.experiments.runs.settings import Settings
from gsx.experiments.runs.start_file import refuse_nothing_in_view, rules_of
from gsx.experiments.viewer.camera_path import CameraPath
from gsx.formats.axis_names import AUTO
from gsx.formats.splat_files import read_around
from gsx.scenes.origin import relative_camera

logger = logging.getLogger(__name__)

FRAMES = "frame_[0-9][0-9][0-9][0-9][0-9].png"
"""Pictures of a path."""
Draw = Callable[[Camera], Float[Tensor, "3 H W"]]


def view_named(run: Run, name: str) -> View:
    """Return a training or test view by name; raise InputError with the nearest name if there is none."""
    views = {view.name: view for view in [*run.scene.test, *run.train_views]}
    if name not in views:
        known = nearest(name, list(views)) or f" The first are {', '.join(list(views)[:3])}."
        raise InputError(f"Unknown view '{name}' of scene '{run.scene.name}'.{known}")
    return views[name]


def render_test_views(run: Run, settings: Settings, folder: Path, zoom: float) -> None:
    """Write every test view at `zoom` times the training resolution as PNG; raise InputError if none is held out."""
    if not run.scene.test:
        raise InputError(
            f"{run.folder} has no test views, all are trained on (scene.split=none): give --orbit FILE, or "
            "cameras with --path JSON"
        )
    folder.mkdir(parents=True, exist_ok=True)
    remove_partial(folder, below=False)
    names = [f"{name}.png" for name in file_names([view.name for view in run.scene.test])]
    for view, name in zip(run.scene.test, names, strict=True):
        write_image(folder / name, render(run, view.camera.zoom(zoom), settings.evaluation.tile_pixels).image)
    without_others(folder, "*.png", names, run.folder)


def render_orbit(run: Run, settings: Settings, path: Path, frames: int, fps: float, zoom: float) -> None:
    """Animate a closed path around the scene."""
    remove_partial(path.parent, below=False)
    pixels = settings.evaluation.tile_pixels
    cameras = (camera.zoom(zoom) for camera in orbit_cameras(run.scene, frames))
    write_animation(path, (render(run, camera, pixels).image for camera in cameras), fps)


def run_pictures(run: Run, settings: Settings) -> Draw:
    """Return a function that renders a run for any camera in the coordinates of the scene's files."""
    pixels, origin = settings.evaluation.tile_pixels, run.scene.origin
    return lambda camera: render(run, relative_camera(camera, origin), pixels).image


def file_pictures(path: Path, cameras: Sequence[Camera] = (), axes: str = AUTO) -> Draw:
    """Return a function that renders a splat file over black; raise InputError if no splat is in view of `cameras`."""
    watch_cores()
    (gaussians, origin), raster = read_around(path, axes), rules_of(path)
    if cameras:
        around = [relative_camera(camera, origin) for camera in cameras]
        refuse_nothing_in_view(gaussians, around, "camera of the path", path, origin)
    return lambda camera: render_gaussians(gaussians, relative_camera(camera, origin), raster, torch.zeros(3))


def render_path(
    way: CameraPath, draw: Draw, to: Path, movie: bool, zoom: float, run_folder: Path | None = None
) -> Path:
    """Write the frames of a camera path as an animation or numbered PNGs in a folder; return that.

    run_folder: of the rendered run.
    """
    cameras = way.cameras(zoom)
    if movie:
        remove_partial(to.parent, below=False)
        write_animation(to, (draw(camera) for camera in cameras), way.fps)
        return to
    to.mkdir(parents=True, exist_ok=True)
    remove_partial(to, below=False)
    names = [f"frame_{number:05d}.png" for number in range(len(cameras))]
    for name, camera in zip(names, cameras, strict=True):
        write_image(to / name, draw(camera))
    if others := without_others(to, FRAMES, names, run_folder):
        logger.warning(
            "%s also holds %d frames of a longer path, from %s on: remove them before you make a film",
            *(to, len(others), others[0].name),
        )
    return to


def without_others(folder: Path, pattern: str, names: Sequence[str], run_folder: Path | None) -> list[Path]:
    """Remove other pictures from a folder of a run's renders; return those that are left in any other folder."""
    others = sorted(set(folder.glob(pattern)) - {folder / name for name in names})
    if run_folder is None or folder.resolve().parent != run_folder.resolve() / "renders":
        return others
    for file in others:
        file.unlink(missing_ok=True)
    return []
