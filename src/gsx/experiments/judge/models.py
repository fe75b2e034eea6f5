"""Run folders and splat files as methods."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from gsx.core.data.camera import Camera
from gsx.core.data.scene import Scene
from gsx.core.errors import InputError
from gsx.core.plugins import Plugins
from gsx.core.training.run import Run
from gsx.experiments.judge.methods import Entry, Model
from gsx.experiments.judge.view_names import bare
from gsx.experiments.runs.build import build
from gsx.experiments.runs.compose import compose
from gsx.experiments.runs.file_axes import start_in_scene
from gsx.experiments.runs.load_scene import unit_of
from gsx.experiments.runs.open import open_run
from gsx.experiments.runs.settings import Settings
from gsx.experiments.runs.start_file import composition_of
from gsx.formats.splat_files import read_splats
from gsx.formats.suffixes import splat_file_at, suffix_of

SAME_POSE = 1e-3
"""Largest distance of two cameras of one view that is rounding, as a share of the scene's extent."""
OF_EVALUATION = ("eval.", "metrics.", "regenerator/upscale@eval.")
"""Settings that concern figures, not how a splat file is rendered."""


def is_model(path: Path) -> bool:
    """Returns whether a path is a run folder or a splat file, not a folder of pictures."""
    file = splat_file_at(path)
    return (path / "config.yaml").is_file() or (bool(suffix_of(file)) and file.is_file())


def opened_model(entry: Entry, overrides: Sequence[str], settings: Settings, plugins: Plugins, scene: Scene) -> Model:
    """Opens a run folder or a splat file for the views of a scene.

    Raises:
        InputError: it cannot be read, is in other coordinates, or shows none of the views.
    """
    if (entry.path / "config.yaml").is_file():
        return opened_run(entry, settings, plugins, scene)
    return opened_file(entry, overrides, settings, plugins, scene)


def opened_run(entry: Entry, settings: Settings, plugins: Plugins, scene: Scene) -> Model:
    """Opens a run folder; InputError: its views of the same names have other poses."""
    run, own = open_run(entry.path, plugins)
    refuse_other_poses(entry, run, settings, scene)
    facts = {"backbone": own.backbone.component.name, "step": run.step, "train_seconds": run.progress.seconds}
    model = Model(entry, run, scene, settings.evaluation, facts)
    model.notes += remarks_on_views(run, scene)
    return model


def refuse_other_poses(entry: Entry, run: Run, settings: Settings, scene: Scene) -> None:
    """Raises InputError if views of a run have other poses than those of the same names in the scene."""
    unit = float(getattr(settings.scene.options, "unit", 1.0))
    if unit_of(run) != unit:
        raise InputError(f"{entry.path} was trained with scene.unit={unit_of(run):g}, the scene has {unit:g}")
    own = cameras_by_name(run)
    between = torch.tensor(run.scene.origin, dtype=torch.float64) - torch.tensor(scene.origin, dtype=torch.float64)
    for view in scene.test:
        if (camera := own.get(bare(view.name))) is None:
            continue
        distance = float((camera.centre.double() + between - view.camera.centre.double()).norm())
        if distance > SAME_POSE * scene.extent:
            raise InputError(
                f"{entry.path}: its view '{view.name}' stands {distance:.3g} units from that of the scene: the "
                "run was trained in other coordinates, measure it on its own scene"
            )


def cameras_by_name(run: Run) -> dict[str, Camera]:
    """Returns the cameras of a run's views by their names without suffix, which prepared scenes keep."""
    return {bare(view.name): view.camera for view in (*run.train_views, *run.scene.test)}


def remarks_on_views(run: Run, scene: Scene) -> Iterator[str]:
    """Yields a note if a run was trained on test views, or shares no view with them."""
    test = {bare(view.name) for view in scene.test}
    if trained := {bare(view.name) for view in run.train_views} & test:
        yield f"it was trained on {len(trained)} of the {len(scene.test)} test views: its figures are too good"
    if not cameras_by_name(run).keys() & {bare(view.name) for view in (*scene.test, *scene.train)}:
        yield "none of its views has the name of a view of the scene: check that it shows the same scene"


def opened_file(entry: Entry, overrides: Sequence[str], settings: Settings, plugins: Plugins, scene: Scene) -> Model:
    """Opens a splat file by the rules that it states."""
    file = splat_file_at(entry.path)
    words = [word for word in overrides if not word.startswith(OF_EVALUATION)]
    own = compose(composition_of(file, words), plugins)
    content = read_splats(file, own.general.axes)
    if not len(content.gaussians.means):
        raise InputError(f"{file} holds no splats: choose another file")
    start, doubts = start_in_scene(own, scene, content)
    run = build(own, scene, Path(), start=start)
    facts: dict[str, Any] = {"backbone": "splat file", "file": file.name}
    model = Model(entry, run, scene, replace(own.evaluation, supersample=settings.evaluation.supersample), facts)
    model.notes += doubts
    return model
