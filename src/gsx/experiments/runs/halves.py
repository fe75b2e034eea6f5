"""Renders of training views by a model that was not fitted to them: each half of the views by the model of the other.

A run's renders of its training views are too clean to learn repair from. These have the flaws of renders of new
places, and photos to compare with (ours; every n-th view: Difix, Wu et al. 2025).
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
from gsx.core.errors import InputError, LostModel, TrainingError
from gsx.core.files import replace_file
from gsx.core.plugins import load_plugins
from gsx.core.seeds import derived_seed
from gsx.core.shapes import Float, UInt8
from gsx.core.training.backbone import Backbone
from gsx.core.training.distributed import Ranks
from gsx.core.training.photo_cache import PhotoCache
from gsx.core.training.render import render
from gsx.core.training.run import Run
from gsx.core.training.sampler import Sampler
from gsx.core.training.trainer import train_step
from gsx.core.training.training_views import TrainingViews
from gsx.experiments.runs.guard import Guard

logger = logging.getLogger(__name__)

HALVES = 2
NewBackbone: TypeAlias = Callable[..., Backbone[Any]]
"""Changes of the run's backbone context -> a backbone by the run's options at step 0."""


def held_out_renders(run: Run, new_backbone: NewBackbone, share: float, seed: int) -> list[Float[Tensor, "3 h w"]]:
    """Return the training views in order, each rendered in 8 bits by the model of the other half.

    Each model trains for `share` of the run's steps so far, by a schedule of that length and with its own generators:
    the run itself is unchanged. The renders stay in the run's folder until the next event.

    Raises:
        InputError: the scene has one training view.
    """
    if len(run.scene.train) < HALVES:
        raise InputError(f"scene '{run.scene.name}' has one training view, which cannot be halved: add photos")
    steps = max(1, round(share * run.step))
    path = run.folder / "regenerators" / f"halves_{run.step:07d}_{steps}.safetensors"
    renders = read_renders(path, len(run.scene.train)) if path.is_file() else None
    if renders is None:
        renders = render_halves(run, new_backbone, steps, seed)
        write_renders(path, renders)
    return [render.float() / 255 for render in renders]


def render_halves(run: Run, new_backbone: NewBackbone, steps: int, seed: int) -> list[UInt8[Tensor, "3 h w"]]:
    """Train both models and return their renders of the views they were not trained on."""
    logger.info("training two models on half of the training views each, for %d steps", steps)
    started, views = time.perf_counter(), run.train_views
    renders: dict[int, Tensor] = {}
    for half in range(HALVES):
        model = trained(half_run(run, new_backbone, half, steps, seed), run.raise_if_stopping)
        numbers = range(half, len(views), HALVES)
        renders |= {n: to_uint8(run.as_photo(render(model, views[n].camera).image, views[n])) for n in numbers}
    logger.info("both models have rendered their held-out half, %.0f s", time.perf_counter() - started)
    return [renders[number] for number in range(len(views))]


def half_run(run: Run, new_backbone: NewBackbone, half: int, steps: int, seed: int) -> Run:
    """Return a run like this one at step 0 of `steps`, without the training views of `half`."""
    views = [view for number, view in enumerate(run.train_views) if number % HALVES != half]
    scene = replace(run.scene, train=views, test=[])
    half_seed = derived_seed("halves", seed, run.step, half)
    generator = torch.Generator().manual_seed(half_seed)
    modules = {
        name: module.restarted(replace(module.context, scene=scene, iterations=steps))
        for name, module in run.modules.items()
    }
    training_views = TrainingViews(scene=scene, modules=modules)
    changes = {"scene": scene, "iterations": steps, "generator": generator, "views": training_views}
    backbone = new_backbone(**changes, ranks=Ranks(), begins=True)
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
        sampler=Sampler(len(views), half_seed, batch=run.training.batch),
    )


def trained(run: Run, raise_if_stopping: Callable[[], None]) -> Run:
    """Train to the end with the guard as only listener; `raise_if_stopping`: of the run that it is trained for.

    Raises:
        TrainingError: this model was lost; that run is not.
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


def write_renders(path: Path, renders: Sequence[UInt8[Tensor, "3 h w"]]) -> None:
    """Write renders and remove those of earlier events."""
    from safetensors.torch import save

    path.parent.mkdir(parents=True, exist_ok=True)
    replace_file(path, save({str(number): render.contiguous() for number, render in enumerate(renders)}))
    for old in path.parent.glob("halves_*.safetensors"):
        if old != path:
            old.unlink()


def read_renders(path: Path, count: int) -> list[UInt8[Tensor, "3 h w"]] | None:
    """Read renders of `write_renders`; None if the file is damaged."""
    from safetensors import SafetensorError
    from safetensors.torch import load

    try:
        found = load(path.read_bytes())
        return [found[str(number)] for number in range(count)]
    except (OSError, SafetensorError, KeyError) as error:
        logger.warning("%s cannot be read (%s): rendering again", path, error)
        return None
