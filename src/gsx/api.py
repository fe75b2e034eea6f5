"""gsx from Python: what the command line does, with pictures as tensors and figures as dictionaries.

    import gsx

    run = gsx.train("scene=demo", iterations=300)
    picture = run.render(run.scene.test[0], zoom=4)
    print(run.evaluate(zoom=[1, 2, 4])["psnr"])

Messages go to the logger `gsx`; `gsx.show_messages()` shows them.
"""

import json
from collections.abc import Mapping, Sequence
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
from gsx.experiments.runs.compose import compose
from gsx.experiments.runs.execute import evaluate_again
from gsx.experiments.runs.export import export, refuse_export
from gsx.experiments.runs.job import train as train_job
from gsx.experiments.runs.logs import set_up_logging as show_messages
from gsx.experiments.runs.open import open_run
from gsx.experiments.runs.overrides import is_override, quoted
from gsx.experiments.runs.render_views import view_named
from gsx.experiments.runs.settings import Settings
from gsx.experiments.runs.start_file import rules_of
from gsx.experiments.tables.sweep import is_table
from gsx.formats.axis_names import AUTO, SPECIFIED
from gsx.formats.origin import NO_ORIGIN
from gsx.formats.splat_files import SpzForm, read_around
from gsx.formats.suffixes import SPZ_VERSIONS, splat_file_at
from gsx.scenes.origin import moved

__all__ = ["SplatFile", "TrainedRun", "load", "show_messages", "train", "write_image"]


@dataclass(frozen=True, eq=False)
class TrainedRun:
    """A run folder, opened: its scene, its model, and what can be done with them."""

    run: Run
    """Everything: backbone, rasterizer rules, curves (`gsx.core.training.run`)."""
    settings: Settings

    @property
    def folder(self) -> Path:
        """Where config.yaml, metrics.jsonl, evaluation.json, checkpoints, point_cloud.ply and report.html are."""
        return self.run.folder

    @property
    def report(self) -> Path:
        """The page to open."""
        return self.folder / "report.html"

    @property
    def step(self) -> int:
        """Steps trained."""
        return self.run.step

    @property
    def scene(self) -> Scene:
        """Training and test views with their cameras: `scene.test[0].camera`, `scene.test[0].image()`.

        Positions of cameras count from `scene.origin`, which is (0, 0, 0) but for georeferenced scenes.
        """
        return self.run.scene

    def render(self, seen: Camera | View | str, zoom: float = 1) -> Float[Tensor, "3 H W"]:
        """Returns the model as a camera, a view, or the view of that name sees it; colours in [0, 1].

        zoom: times the raster and the focal length.

        Raises:
            InputError: there is no view of that name, the nearest is told; or zoom is none of `ZOOMS`.
        """
        if isinstance(zoom, str) or zoom is None or float(zoom) not in ZOOMS:
            raise InputError(f"zoom is {zoom!r}: give a number {ZOOMS}")
        return render(self.run, camera_in(self.run, seen).zoom(float(zoom)), self.settings.evaluation.tile_pixels).image

    def evaluate(self, **options: Any) -> dict[str, Any]:
        """Evaluates the run on its test views, as `gsx eval` does: writes evaluation.json, pictures and report anew.

        Options are those of the group eval, for example zoom=[1, 2, 4].

        Raises:
            ConfigError: there is no such option, or not with that value.
            InputError: somebody trains in the folder, or evaluates it.
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
        """Writes the model as a splat file or a page (.html), by suffix.

        seen: only what is drawn for that view or camera. local: relative to `scene.origin`, which the file states where
        it can. axes (rub, rdf) and spz_version (3, 4): of .spz.

        Raises:
            InputError: no such format is written, there is no such view or form of .spz, or the file is no .spz.
        """
        refuse_export(path := Path(path), spz := SpzForm(version=spz_version, axes=axes))
        export(self.run, path, None if seen is None else camera_in(self.run, seen), spz, local=local)
        return path

    def __repr__(self) -> str:
        return f"<run of {self.step} steps in {self.folder}>"


@dataclass(eq=False)
class SplatFile:
    """The Gaussians of a splat file, by whatever program it was written."""

    path: Path
    gaussians: Gaussians
    raster: RasterSettings
    """Rules it is drawn by: as 3D-GS has them, or as Mip-Splatting where the file says so (SplatRenderMode: mip)."""
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Subtracted from `gaussians`, whose file lies far from (0, 0, 0); `render` moves cameras likewise."""

    def render(
        self, seen: Camera | View, background: Sequence[float] | Float[Tensor, "3"] = (0, 0, 0)
    ) -> Float[Tensor, "3 H W"]:
        """Returns the splats as a camera or a view sees them over a colour; colours in [0, 1].

        Raises:
            InputError: the background is no colour.
        """
        try:
            over = torch.as_tensor(background, dtype=torch.float32).reshape(3)
        except (TypeError, ValueError, RuntimeError) as error:
            raise InputError(f"background is {background!r}: give three values, red, green and blue") from error
        if not bool(((over >= 0) & (over <= 1)).all()):  # nor is nan
            raise InputError(f"background is {background!r}: give red, green and blue in [0, 1]")
        return render_gaussians(self.gaussians, moved(camera_of(seen), self.origin), self.raster, over)

    def __repr__(self) -> str:
        return f"<{len(self.gaussians.means):,} splats of {self.path}>"


def camera_in(run: Run, seen: Camera | View | str) -> Camera:
    """Returns a camera, that of a view, or that of a run's view of that name; see `camera_of` and `view_named`."""
    return camera_of(view_named(run, seen) if isinstance(seen, str) else seen)


def camera_of(seen: Camera | View) -> Camera:
    """Returns a camera, or that of a view.

    Raises:
        InputError: it is neither.
    """
    camera = seen.camera if isinstance(seen, View) else seen
    if not isinstance(camera, Camera):
        raise InputError(f"{seen!r} is no camera: give one, or a view of `run.scene`, or of a run the name of a view")
    return camera


def train(*words: str, **values: Any) -> TrainedRun:
    """Trains, evaluates and reports: `gsx WORDS... KEY=VALUE...`.

    Keys with dots or a slash are words as on the command line, those with dots also dictionaries:
    `gsx.train("regenerator/upscale=lanczos", "eval.zoom=[1,2]", training={"supersample": 2}, iterations=900)`.

    Raises:
        ConfigError, InputError: something is wrong with the configuration or the scene; nothing was made.
        TrainingError: training went wrong; the run folder holds the last step.
        KeyboardInterrupt: it was stopped; `gsx resume` goes on with the folder.
    """
    for word in words:
        if not (isinstance(word, str) and is_override(word) and not word.startswith("-")):
            raise ConfigError(f"gsx.train was given {word!r}: give settings, as 'scene=colmap' and 'scene.path=FOLDER'")
    overrides, folders = [*words, *words_of(values)], list[Path]()
    if is_table(overrides) or processes() > 1:
        raise ConfigError("gsx.train trains one run in one process: tables and torchrun are for the command line")
    if train_job(compose(overrides, loaded := plugins()), loaded, folders):
        raise KeyboardInterrupt(f"{command('resume', folders[0])} goes on")
    return load_run(folders[0])


def load(
    path: str | Path,
    raster: RasterSettings | None = None,
    origin: tuple[float, float, float] = NO_ORIGIN,
    axes: str = AUTO,
) -> TrainedRun | SplatFile:
    """Opens a run folder or a splat file of any kind (`gsx.formats.suffixes.READABLE`).

    raster: the rules by which a splat file is drawn, in place of those that it states.
    origin: from where the coordinates of cameras count, `run.scene.origin` for the views of a georeferenced run.
    axes: of the splat file: auto (what it states, else its format's), rub, rdf, or any three letters.

    Raises:
        InputError: it is neither, or damaged; or `raster`, `origin` or `axes` are set for a run, which has its own.
        CheckpointError: the run has no usable checkpoint.
    """
    path = splat_file_at(expand_home(path))
    if path.is_dir():
        for name, given in {"raster": raster is not None, "origin": any(origin), "axes": axes != AUTO}.items():
            if given:
                raise InputError(f"{path} is a run, drawn as it was trained: {name} is for splat files")
        return load_run(path)
    if not path.exists():
        raise InputError(f"'{path}' does not exist: give a run folder or a splat file")
    watch_cores()
    gaussians, subtracted = read_around(path, axes, origin)
    return SplatFile(path, gaussians, raster or rules_of(path), subtracted)


def load_run(folder: Path) -> TrainedRun:
    """Opens a run folder; errors as `load`."""
    return TrainedRun(*open_run(folder.resolve(), plugins()))


def words_of(values: Mapping[str, Any], below: str = "") -> list[str]:
    """Returns values by name, nested ones too, as words of the command line."""
    words = []
    for name, value in values.items():
        if isinstance(value, Mapping):
            words += words_of(value, f"{below}{name}.")
        else:
            words.append(f"{below}{name}={text_of(plain(name, value))}")
    return words


def text_of(value: Any) -> str:
    """Returns a plain value as the command line has it."""
    if isinstance(value, list):
        return f"[{','.join(map(text_of, value))}]"
    return quoted(value) if isinstance(value, str) else json.dumps(value)


def plain(name: str, value: Any) -> Any:
    """Returns a value as JSON has it: numbers of numpy and torch as those of Python, paths as texts.

    Raises:
        ConfigError: it is of no kind that a configuration holds.
    """
    if isinstance(value, list | tuple):
        return [plain(name, inner) for inner in value]
    if isinstance(value, Path):
        return str(value)
    value = value.tolist() if hasattr(value, "tolist") else value
    if not (value is None or isinstance(value, bool | int | float | str | list)):
        raise ConfigError(f"{name} is a {type(value).__name__}; give a number, a text, a list of them, or null")
    return value
