"""Copies of a finished run that learn on: with other rows, from some views, at falling learning rates."""

import copy
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import torch

from gsx.core.data.scene import Scene, View
from gsx.core.gaussians.sh import degree_of
from gsx.core.plugins import Plugins
from gsx.core.training.backbone import Backbone
from gsx.core.training.module import Modules
from gsx.core.training.parameter_table import ParameterTable, edit
from gsx.core.training.run import Run
from gsx.core.training.sampler import Sampler
from gsx.core.training.trainer import train_step
from gsx.experiments.runs.guard import Guard

ONE_IN = 8
"""One of this many training views validates."""
FEWEST = 2
"""Fewest validation views; of fewer than three training views all validate, and all are learnt from."""
BANDS = (0, 3, 8, 15)
"""Coefficients without the constant one, by degree of colour."""


def split_views(run: Run) -> tuple[list[View], list[View]]:
    """Splits the training views into (views to learn from, validation views), the latter spread over the order."""
    views = run.train_views
    count = max(FEWEST, len(views) // ONE_IN)
    if len(views) <= count:
        return list(views), list(views)
    chosen = {round((i + 0.5) * len(views) / count) for i in range(count)}
    return [view for i, view in enumerate(views) if i not in chosen], [views[i] for i in sorted(chosen)]


def copied_model(run: Run) -> Backbone[Any]:
    """Copies a run's model, which then learns by itself; scene, views and generator stay shared."""
    return copy.deepcopy(run.backbone, shared_by_copies(run))


def shared_by_copies(run: Run) -> dict[int, object]:
    """Returns what copies of a run's parts share, as the memo of `copy.deepcopy`."""
    contexts = [module.context for module in run.modules.values()]
    shared = [run.scene, run.views, run.generator, *run.scene.train, *run.scene.test, *contexts]
    return {id(value): value for value in shared}


def modules_for(run: Run, scene: Scene) -> Modules:
    """Copies a run's modules for a scene whose training views have their corrections."""
    others = {name: module for name, module in run.modules.items() if not module.in_views}
    copies = copy.deepcopy(others, shared_by_copies(run))
    return {
        name: module.restarted(replace(module.context, scene=scene)) if module.in_views else copies[name]
        for name, module in run.modules.items()
    }


def fine_tuned(run: Run, views: Sequence[View], degree: int, steps: int, plugins: Plugins) -> Run:
    """Trains a copy of a run on some training views; bands above the degree stay zero. No step of the run is counted.

    Raises:
        TrainingError: the model is lost.
    """
    learner = extended(run, views, steps)
    cut_bands(learner.backbone.table, degree)
    with plugins.listening([Guard()]):
        for _ in range(steps):
            train_step(learner, plugins)
            cut_bands(learner.backbone.table, degree)
    modules = {name: module if module.in_views else learner.modules[name] for name, module in run.modules.items()}
    return replace(run, backbone=learner.backbone, views=replace(run.views, modules=modules))


def extended(run: Run, views: Sequence[View], steps: int) -> Run:
    """Copies a run to one that ends so many steps later and has these training views, as they are corrected now.

    Learning rates fall to nothing from what they were before any cooldown.
    """
    scene, iterations = replace(run.scene, train=list(views)), run.step + steps
    return replace(
        run,
        backbone=copied_model(run),
        progress=replace(run.progress),
        sampler=Sampler(len(views), 0, batch=run.training.batch),
        iterations=iterations,
        views=replace(run.views, scene=scene, modules=modules_for(run, scene)),
        training=replace(run.training, cooldown=steps / iterations),
    )


def degree_of_run(run: Run) -> int:
    """Returns the degree of colour of a table with bands; -1 where networks make colours."""
    rest = run.backbone.table.parameters.get("sh_rest")
    return -1 if rest is None else degree_of(rest.shape[1])


@torch.no_grad()
def cut_bands(table: ParameterTable, degree: int) -> None:
    """Sets the bands above a degree to zero."""
    if "sh_rest" in table.parameters:
        table.parameters["sh_rest"][:, BANDS[degree] :] = 0


def drop_bands(table: ParameterTable, degree: int) -> None:
    """Removes the bands above a degree, with their moments; only a model of that degree draws what is left."""
    if "sh_rest" in table.parameters:
        edit(table, "sh_rest", *[lambda rows: rows[:, : BANDS[degree]]] * 2)
