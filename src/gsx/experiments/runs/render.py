"""Pictures of a run: its test views, one view by name, an orbit."""

from pathlib import Path

from gsx.core.data.images import write_image
from gsx.core.data.scene import View
from gsx.core.errors import InputError, nearest
from gsx.core.files import remove_partial
from gsx.core.training.render import render
from gsx.core.training.run import Run
from gsx.experiments.reports.pictures import file_names
from gsx.experiments.runs.orbit import orbit_cameras, write_animation
from gsx.experiments.runs.settings import Settings


def view_named(run: Run, name: str) -> View:
    """A training or test view by name.

    Raises:
        InputError: there is none; the nearest name is given.
    """
    views = {view.name: view for view in [*run.scene.test, *run.scene.train]}
    if name not in views:
        raise InputError(f"'{name}' is no view of scene '{run.scene.name}'.{nearest(name, list(views))}")
    return views[name]


def render_test_views(run: Run, settings: Settings, folder: Path, zoom: float) -> None:
    """Write every test view at `zoom` times the training resolution as PNG."""
    folder.mkdir(parents=True, exist_ok=True)
    remove_partial(folder, below=False)
    for view, name in zip(run.scene.test, file_names([view.name for view in run.scene.test]), strict=True):
        picture = render(run, view.camera.zoom(zoom), settings.evaluation.tile_pixels)
        write_image(folder / f"{name}.png", picture.image)


def render_orbit(run: Run, settings: Settings, path: Path, frames: int, fps: float, zoom: float) -> None:
    """Animate a closed path around the scene."""
    remove_partial(path.parent, below=False)
    pixels = settings.evaluation.tile_pixels
    cameras = (camera.zoom(zoom) for camera in orbit_cameras(run.scene, frames))
    write_animation(path, (render(run, camera, pixels).image for camera in cameras), fps)
