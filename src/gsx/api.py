"""gsx from Python: the command line's functions, with pictures as tensors and figures as dictionaries.

    import gsx

    run = gsx.train("scene=demo", iterations=300)
    picture = run.render(run.scene.test[0], zoom=4)
    print(run.evaluate(zoom=[1, 2, 4])["psnr"])

Messages go to the logger `gsx`; `gsx.show_messages()` shows them.
"""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from gsx.builtin import plugins
from gsx.core.data.camera import Camera
from gsx.core.data.images import write_image
from gsx.core.data.scene import Scene, View
from gsx.core.errors import ConfigError, InputError, command
from gsx.core.files import expand_home
from gsx.core.gaussians.splats import Gaussians
from gsx.core.ranges import ZOOMS
from gsx.core.rasterizer import RasterSettings
from gsx.core.shapes import Float
from gsx.core.training.render import render, render_gaussians
from gsx.core.training.run import Run
from gsx.engine.processes import processes
from gsx.engine.threads import watch_cores
from gsx.experiments.minutes.planned import planned, without_length
from gsx.experiments.runs.compose import compose
from gsx.experiments.runs.execute import evaluate_again
from gsx.experiments.runs.export import export, refuse_export
from gsx.experiments.runs.job import train as train_job
from gsx.experiments.runs.logs import set_up_logging as show_messages
from gsx.experiments.runs.open import open_run
from gsx.experiments.runs.overrides import is_override, plain, words_of
from gsx.experiments.runs.render_views import view_named
from gsx.experiments.runs.settings import Settings
from gsx.experiments.runs.start_file import rules_of
from gsx.experiments.tables.sweep import is_table
from gsx.formats.axis_names import AUTO, SPECIFIED
from gsx.formats.origin import NO_ORIGIN
from gsx.formats.splat_files import SpzForm, read_around
from gsx.formats.suffixes import SPZ_VERSIONS, splat_file_at
from gsx.scenes.origin import relative_camera

__all__ = ["SplatFile", "TrainedRun", "load", "show_messages", "train", "write_image"]


@dataclass(frozen=True, eq=False)
class TrainedRun:
    """An opened run folder: scene and model, with methods to render, evaluate and export."""

    run: Run
    """Backbone, rasterizer settings, curves and all else (`gsx.core.training.run`)."""
    settings: Settings

    @property
    def folder(self) -> Path:
        """Folder with config.yaml, metrics.jsonl, evaluation.json, checkpoints, point_cloud.ply and report.html."""
        return self.run.folder

    @property
    def report(self) -> Path:
        """Page with pictures and figures."""
        return self.folder / "report.html"

    @property
    def step(self) -> int:
        """Number of trained steps."""
        return self.run.step

    @property
    def scene(self) -> Scene:
        """Training and test views with their cameras: `scene.test[0].camera`, `scene.test[0].image()`.

        Camera positions are relative to `scene.origin`, which is (0, 0, 0) except for georeferenced scenes.
        """
        return self.run.scene

    def render(self, seen: Camera | View | str, zoom: float = 1) -> Float[Tensor, "3 H W"]:
        """Render the model for a camera, a view, or a view by name; colours in [0, 1].

        zoom: factor on the raster and the focal length.

        Raises:
            InputError: there is no view of that name (the nearest is named), or zoom is not in `ZOOMS`.
        """
        if isinstance(zoom, str) or zoom is None or float(zoom) not in ZOOMS:
            raise InputError(f"zoom is {zoom!r}: give a number {ZOOMS}")
        return render(self.run, camera_in(self.run, seen).zoom(float(zoom)), self.settings.evaluation.tile_pixels).image

    def evaluate(self, **options: Any) -> dict[str, Any]:
        """Evaluate the run on its test views, as `gsx eval` does, and write evaluation.json, pictures and report anew.

        Options are those of the group eval, for example zoom=[1, 2, 4].

        Raises:
            ConfigError: an option or its value is wrong.
            InputError: another process trains or evaluates in the folder.
        """
        words = [f"eval.{name}={json.dumps(plain(name, value))}" for name, value in options.items()]
        return evaluate_again(self.folder, plugins(), words)

    def export(
        self,
        path: str | Path,
        seen: Camera | View | str | None = None,
        local: bool = False,
        axes: str = SPECIFIED,
        spz_version: int = SPZ_VERSIONS[0],
    ) -> Path:
        """Write the model as a splat file or a page (.html), by suffix; return its path.

        seen: write only the splats of that view or camera. local: positions relative to `scene.origin`, which the file
        states if it can. axes (rub, rdf) and spz_version (3, 4): of .spz.

        Raises:
            InputError: the format is not written, the view is unknown, or options of .spz are wrong.
        """
        refuse_export(path := Path(path), spz := SpzForm(version=spz_version, axes=axes))
        export(self.run, path, None if seen is None else camera_in(self.run, seen), spz, local=local)
        return path

    def __repr__(self) -> str:
        return f"<run of {self.step} steps in {self.folder}>"


@dataclass(eq=False)
class SplatFile:
    """Gaussians of a splat file of any program."""

    path: Path
    gaussians: Gaussians
    raster: RasterSettings
    """Rasterizer settings: those of 3D-GS, or of Mip-Splatting if the file says so (SplatRenderMode: mip)."""
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Offset subtracted from positions of a file far from (0, 0, 0); `render` moves cameras likewise."""

    def render(
        self, seen: Camera | View, background: Sequence[float] | Float[Tensor, "3"] = (0, 0, 0)
    ) -> Float[Tensor, "3 H W"]:
        """Render the splats for a camera or a view over a background; colours in [0, 1].

        Raises:
            InputError: the background is not a colour.
        """
        try:
            over = torch.as_tensor(background, dtype=torch.float32).reshape(3)
        except (TypeError, ValueError, RuntimeError) as error:
            raise InputError(f"background is {background!r}: give three values, red, green and blue") from error
        if not bool(((over >= 0) & (over <= 1)).all()):  # nor is nan
            raise InputError(f"background is {background!r}: give red, green and blue in [0, 1]")
        return render_gaussians(self.gaussians, relative_camera(camera_of(seen), self.origin), self.raster, over)

    def __repr__(self) -> str:
        return f"<{len(self.gaussians.means):,} splats of {self.path}>"


def camera_in(run: Run, view: Camera | View | str) -> Camera:
    """Return a camera, that of a view, or that of a run's view by name."""
    return camera_of(view_named(run, view) if isinstance(view, str) else view)


def camera_of(view: Camera | View) -> Camera:
    """Return a camera, or that of a view; raise InputError for anything else."""
    camera = view.camera if isinstance(view, View) else view
    if not isinstance(camera, Camera):
        raise InputError(f"{view!r} is not a camera: give one, a view of `run.scene`, or for a run the name of a view")
    return camera


def train(*words: str, **values: Any) -> TrainedRun:
    """Train, evaluate and report: `gsx WORDS... KEY=VALUE...`.

    Keys with dots or a slash are words as on the command line; keys with dots can also be dictionaries:
    `gsx.train("regenerator/upscale=lanczos", "eval.zoom=[1,2]", training={"batch": 2}, iterations=900)`.

    Raises:
        ConfigError, InputError: the configuration or the scene is wrong; no folder was made.
        TrainingError: training failed; the run folder holds the last step.
        KeyboardInterrupt: it was stopped; `gsx resume` continues the folder.
    """
    for word in words:
        if not (isinstance(word, str) and is_override(word) and not word.startswith("-")):
            raise ConfigError(f"gsx.train cannot use {word!r}: give settings, for example 'scene=colmap'")
    overrides, folders = without_length([*words, *words_of(values)]), list[Path]()
    if is_table(overrides) or processes() > 1:
        raise ConfigError("gsx.train trains one run in one process: tables and torchrun are for the command line")
    settings = planned(compose(overrides, loaded := plugins()), overrides, loaded)
    if train_job(settings, loaded, folders):
        raise KeyboardInterrupt(f"{command('resume', folders[0])} continues")
    return load_run(folders[0])


def load(
    path: str | Path,
    raster: RasterSettings | None = None,
    origin: tuple[float, float, float] = NO_ORIGIN,
    axes: str = AUTO,
) -> TrainedRun | SplatFile:
    """Open a run folder or a splat file of any format (`gsx.formats.suffixes.READABLE`).

    raster: rasterizer settings in place of those that a splat file states. origin: of the cameras' coordinates,
    `run.scene.origin` for views of a georeferenced run. axes: of the splat file: auto (stated, else by format), rub,
    rdf, or any three letters.

    Raises:
        InputError: it is neither, or damaged; or `raster`, `origin` or `axes` are set for a run, which has its own.
        CheckpointError: the run has no usable checkpoint.
    """
    path = splat_file_at(expand_home(path))
    if path.is_dir():
        for name, is_set in {"raster": raster is not None, "origin": any(origin), "axes": axes != AUTO}.items():
            if is_set:
                raise InputError(f"{path} is a run, rendered as it was trained: {name} is for splat files")
        return load_run(path)
    if not path.exists():
        raise InputError(f"'{path}' does not exist: give a run folder or a splat file")
    watch_cores()
    gaussians, subtracted = read_around(path, axes, origin)
    return SplatFile(path, gaussians, raster or rules_of(path), subtracted)


def load_run(folder: Path) -> TrainedRun:
    """Open a run folder; errors as `load`."""
    return TrainedRun(*open_run(folder.resolve(), plugins()))
