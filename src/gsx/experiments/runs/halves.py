"""Training views as a model shows them that was not fitted to them: half of the views, by one of the other half.

The run's own renders of its training views are too clean to learn repair from. These have what renders of new places
lack, and photographs to compare with (ours; every n-th view: Difix, Wu et al. 2025).
"""

import logging
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeAlias

import torch
from torch import Tensor

from gsx.core.data.resize import to_uint8
from gsx.core.data.scene import Scene
from gsx.core.errors import InputError, LostModel, TrainingError
from gsx.core.files import replace_file
from gsx.core.plugins import load_plugins
from gsx.core.seeds import derived_seed
from gsx.core.shapes import Float, UInt8
from gsx.core.training.backbone import Backbone
from gsx.core.training.photo_cache import PhotoCache
from gsx.core.training.render import render
from gsx.core.training.run import Run
from gsx.core.training.sampler import Sampler
from gsx.core.training.trainer import train_step
from gsx.core.training.training_views import TrainingViews
from gsx.experiments.runs.guard import Guard

logger = logging.getLogger(__name__)

HALVES = 2
Anew: TypeAlias = Callable[[Scene, int, torch.Generator, TrainingViews], Backbone[Any]]
"""(scene, steps, generator, how its views are seen) -> a backbone of the run's options at step 0."""


def held_out_renders(run: Run, anew: Anew, share: float, seed: int) -> list[Float[Tensor, "3 h w"]]:
    """The training views in order, each rendered by the model of the half without it, in 8 bits.

    Each model begins anew and ends after `share` of the steps that the run has taken, by a schedule of that length. It
    draws from generators of its own: the run goes on as if nothing had been. What is rendered is kept in the run's
    folder until the next time.

    Raises:
        InputError: there are not two training views.
    """
    if len(run.scene.train) < HALVES:
        raise InputError(f"scene '{run.scene.name}' has one training view: half of that is nothing to learn from")
    steps = max(1, round(share * run.step))
    path = run.folder / "regenerators" / f"halves_{run.step:07d}_{steps}.safetensors"
    renders = read_renders(path, len(run.scene.train)) if path.is_file() else None
    if renders is None:
        renders = made(run, anew, steps, seed)
        write_renders(path, renders)
    return [render.float() / 255 for render in renders]


def made(run: Run, anew: Anew, steps: int, seed: int) -> list[UInt8[Tensor, "3 h w"]]:
    """The renders of both models."""
    logger.info("two models of half of the training views each are trained for %d steps", steps)
    begun, views = time.perf_counter(), run.train_views
    shown: dict[int, Tensor] = {}
    for half in range(HALVES):
        model = trained(without(run, anew, half, steps, seed), run.raise_if_stopping)
        numbers = range(half, len(views), HALVES)
        shown |= {n: to_uint8(run.as_photo(render(model, views[n].camera).image, views[n])) for n in numbers}
    logger.info("each has rendered the views that it does not know, %.0f s", time.perf_counter() - begun)
    return [shown[number] for number in range(len(views))]


def without(run: Run, anew: Anew, half: int, steps: int, seed: int) -> Run:
    """A run like this one at its step 0, of so many steps, on the views of the other half alone."""
    views = [view for number, view in enumerate(run.train_views) if number % HALVES != half]
    scene = replace(run.scene, train=views, test=[])
    own = derived_seed("halves", seed, run.step, half)
    generator = torch.Generator().manual_seed(own)
    modules = {
        name: module.restarted(replace(module.context, scene=scene, iterations=steps))
        for name, module in run.modules.items()
    }
    training_views = TrainingViews(scene=scene, modules=modules)
    backbone = anew(scene, steps, generator, training_views)
    return Run(
        config=run.config,
        folder=run.folder,
        backbone=backbone,
        raster=backbone.raster,
        training=run.training,
        views=training_views,
        iterations=steps,
        photos=PhotoCache(run.device),
        generator=generator,
        sampler=Sampler(len(views), own, batch=run.training.batch),
    )


def trained(run: Run, raise_if_stopping: Callable[[], None]) -> Run:
    """The run at its end; nobody but the guard against numbers that are not finite listens.

    `raise_if_stopping`: of the run that it is trained for.

    Raises:
        TrainingError: it was lost; the run that it is trained for is not.
    """
    plugins = load_plugins([], points=[])
    with plugins.listening([Guard()]):
        while not run.complete:
            raise_if_stopping()
            try:
                train_step(run, plugins)
            except LostModel as error:
                raise TrainingError(f"a model of half of the views was lost: {error}") from error
    return run


# -- files -------------------------------------------------------------------------------------------------------------


def write_renders(path: Path, renders: Sequence[UInt8[Tensor, "3 h w"]]) -> None:
    """Keep renders in place of those of earlier events."""
    from safetensors.torch import save

    path.parent.mkdir(parents=True, exist_ok=True)
    replace_file(path, save({str(number): render.contiguous() for number, render in enumerate(renders)}))
    for old in path.parent.glob("halves_*.safetensors"):
        if old != path:
            old.unlink()


def read_renders(path: Path, count: int) -> list[UInt8[Tensor, "3 h w"]] | None:
    """Renders as `write_renders` left them; None if the file is damaged."""
    from safetensors import SafetensorError
    from safetensors.torch import load

    try:
        found = load(path.read_bytes())
        return [found[str(number)] for number in range(count)]
    except (OSError, SafetensorError, KeyError) as error:
        logger.warning("%s cannot be read (%s): its renders are made again", path, error)
        return None
