"""The smallest model within a quality budget: rows and bands of colour that no picture needs go, others learn on.

What a row is worth is what the pictures of all training views lose without it, at their own size and in windows at
twice their focal length, where small Gaussians count. How many go is found by bisection: a try removes the least worth,
learns on by the rates that training ended with, and is judged by training views that it does not learn from, beside the
whole model after the same.
"""

import logging
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from statistics import fmean

import torch
from torch import Tensor

from gsx.core.data.camera import Camera
from gsx.core.data.scene import View
from gsx.core.data.window import Window
from gsx.core.errors import TrainingError, first_line
from gsx.core.gaussians.arrays import degree_of
from gsx.core.gaussians.splat_files import splats_of
from gsx.core.gaussians.splats import Gaussians
from gsx.core.plugins import Plugins
from gsx.core.quality.metrics import psnr
from gsx.core.shapes import Bool, Float
from gsx.core.training.evidence import draws_of_each, looked_at, squared_changes
from gsx.core.training.guard import Guard
from gsx.core.training.parameter_table import edit, keep_rows, restored_table, size_of, table_tensors
from gsx.core.training.render import render
from gsx.core.training.run import Run, Sampler
from gsx.core.training.supersampling import raster_at
from gsx.core.training.trainer import train_step

logger = logging.getLogger(__name__)

ONE_IN = 8
"""Of so many training views one judges."""
FEWEST = 2
"""Views that judge, at least; of fewer than three training views all do, and all are learnt from."""
CLOSER = 2.0
"""Times the focal length of the windows in which rows are worth something, too."""
BANDS = (0, 3, 8, 15)
"""Coefficients beside the constant one, by degree of colour."""


@dataclass(frozen=True, kw_only=True)
class ShrinkOptions:
    """What may be lost, and what is done to lose less."""

    max_drop: float
    """dB of PSNR, at any zoom."""
    steps: int
    """Of learning on after rows have gone."""
    tries: int = 5
    """Of the bisection: the share that goes is found to 2^-tries."""
    zooms: tuple[float, ...] = (1.0, 2.0)
    """Times the training resolution at which views judge, where there is truth."""


@dataclass(frozen=True, kw_only=True)
class Try:
    """A model with less, judged."""

    removed: float
    """Share of the rows that went."""
    degree: int
    """Highest degree of colour that is left; -1: the model has no bands of its own."""
    primitives: int
    megabytes: float
    psnr: dict[str, float]
    """By zoom."""
    drop: float
    """The largest loss at any zoom against the whole model that has learnt on as well, dB."""


def judges(run: Run) -> tuple[list[View], list[View]]:
    """(training views to learn from, training views to judge by), the latter spread over the order."""
    views = run.scene.train
    count = max(FEWEST, len(views) // ONE_IN)
    if len(views) <= count:
        return list(views), list(views)
    chosen = {round((i + 0.5) * len(views) / count) for i in range(count)}
    return ([view for i, view in enumerate(views) if i not in chosen], [views[i] for i in sorted(chosen)])


@torch.no_grad()
def figures(
    run: Run, views: Sequence[View], zooms: Sequence[float], gaussians: Gaussians | None = None
) -> dict[str, float]:
    """Mean PSNR over views by zoom, dB; zooms without truth are left out. gaussians: drawn in place of the model."""
    out = {}
    for factor in zooms:
        closer = [zoomed for view in views if (zoomed := view.zoom(factor)) is not None]
        if closer:
            out[f"{factor:g}"] = fmean(psnr(shown(run, v, gaussians), v.image(), v.counted()) for v in closer)
    return out


def shown(run: Run, view: View, gaussians: Gaussians | None) -> Float[Tensor, "3 H W"]:
    """A view by the model, or by other Gaussians, at the exposure of its photograph."""
    splats = None if gaussians is None else splats_of(gaussians, view.camera.centre)
    return run.exposures.applied(render(run, view.camera, splats=splats).image, view.name).clamp(0, 1).cpu()


# -- what is worth least -----------------------------------------------------------------------------------------------


def closer_window(camera: Camera) -> tuple[Camera, Window]:
    """(the middle of a camera's frame at twice its focal length, on a raster of about its size; where that lies in the
    whole raster at twice the focal length)."""
    closer = camera.zoom(CLOSER)
    width, height = (max(1, round(side / CLOSER)) for side in closer.size)
    window = Window((closer.width - width) // 2, (closer.height - height) // 2, width, height)
    return window.of(closer), window


def pictures_of(view: View) -> list[tuple[Camera, Bool[Tensor, "H W"] | None]]:
    """(camera, which pixels count) of the two pictures of a view that rows are worth something in."""
    counted, (closer, window) = view.counted(), closer_window(view.camera)
    if counted is None:
        return [(view.camera, None), (closer, None)]
    finer = counted.repeat_interleave(int(CLOSER), 0).repeat_interleave(int(CLOSER), 1)
    return [(view.camera, counted), (closer, finer[window.pixels])]


def worth_of(run: Run, views: Sequence[View], generator: torch.Generator) -> Float[Tensor, "N"]:
    """What pictures lose without each row: squared changes of values, summed over views and windows."""
    worth = torch.zeros(len(run.backbone.table), device=run.device)
    supersample = run.resolution.supersample_at(run.model_step)
    form = partial(raster_at, scene=run.scene, supersample=supersample)
    for view in views:
        for camera, counted in pictures_of(view):
            drawn, seen = looked_at(run.backbone, camera, form, run.background, run.model_step)
            worth += squared_changes(drawn, seen, counted, len(worth), draws_of_each(views), generator)
    return worth


def without_least(worth: Float[Tensor, "N"], share: float) -> Bool[Tensor, "N"]:
    """Rows that stay when that share goes."""
    kept = torch.ones_like(worth, dtype=torch.bool)
    kept[worth.argsort(stable=True)[: min(len(worth) - 1, round(share * len(worth)))]] = False
    return kept


# -- tries -------------------------------------------------------------------------------------------------------------


class Shrinking:
    """The tries on one run. What the run holds afterwards is the last one."""

    def __init__(self, run: Run, options: ShrinkOptions, plugins: Plugins, generator: torch.Generator) -> None:
        self.run, self.options, self.plugins = run, options, plugins
        self.learnt, self.judging = judges(run)
        self.before = figures(run, self.judging, options.zooms)
        self.worth = worth_of(run, run.scene.train, generator)
        self.whole = copied(table_tensors(run.backbone.table))
        learn_on(run, self.learnt, degree_of_run(run), options.steps, plugins)
        self.reference = figures(run, self.judging, options.zooms)
        """Of the whole model, which has learnt on like every try: views that judge are no longer learnt from."""
        self.tried: list[Try] = []

    def attempt(self, share: float, degree: int) -> Try:
        """Take the share and the bands above a degree away, learn on, judge. What cannot be learnt on drops without
        end."""
        run = self.run
        self.cut(share)
        try:
            learn_on(run, self.learnt, degree, self.options.steps, self.plugins)
            found = figures(run, self.judging, self.options.zooms)
        except TrainingError as error:
            logger.warning("with %.0f %% less it could not learn on (%s)", 100 * share, first_line(error))
            found = dict.fromkeys(self.before, -math.inf)
        rows, size = size_of(run.backbone.table)
        drop = max(self.reference[zoom] - found[zoom] for zoom in found)
        made = Try(
            removed=share,
            degree=degree,
            primitives=rows,
            megabytes=size_with(run, degree, size) / 1e6,
            psnr=found,
            drop=drop,
        )
        self.tried.append(made)
        told = ", ".join(f"x{zoom} {value:.2f}" for zoom, value in found.items())
        logger.info(
            "%d primitives (%.0f %% less), degree %d: %s dB, a drop of %.2f: %s",
            *(rows, 100 * share, degree, told, drop, "kept" if self.allowed(made) else "too much"),
        )
        return made

    def cut(self, share: float) -> None:
        """Give the run the whole model without the share of its rows that is worth least."""
        backbone = self.run.backbone
        backbone.table = restored_table(backbone.table, copied(self.whole))
        keep_rows(backbone.table, without_least(self.worth, share))

    def allowed(self, made: Try) -> bool:
        """Whether it is within the budget."""
        return made.drop <= self.options.max_drop

    def smallest(self) -> Try:
        """The smallest model within the budget: rows first, then bands; the run holds it, unless it is as it was."""
        best = Try(removed=0.0, degree=degree_of_run(self.run), primitives=len(self.worth), megabytes=0.0,
                   psnr=self.before, drop=0.0)  # fmt: skip
        share, step = 0.5, 0.25
        for _ in range(self.options.tries):
            made = self.attempt(share, best.degree)
            best = made if self.allowed(made) else best
            share, step = share + (step if self.allowed(made) else -step), step / 2
        for degree in range(best.degree - 1, -1, -1):
            made = self.attempt(best.removed, degree)
            if not self.allowed(made):
                break
            best = made
        return best

    def within(self, lost: float) -> list[Try]:
        """The model as it was, and tries that leave room in the budget for so many dB that a file loses, smallest
        first."""
        whole = Try(removed=0.0, degree=degree_of_run(self.run), primitives=len(self.worth), megabytes=math.inf,
                    psnr=self.before, drop=0.0)  # fmt: skip
        fitting = [made for made in [whole, *self.tried] if made.drop + lost <= self.options.max_drop]
        return sorted(fitting, key=lambda made: (made.primitives, made.megabytes))

    def take(self, best: Try) -> None:
        """Make the run what a try was, learnt from all training views."""
        run = self.run
        self.cut(best.removed)
        if best.removed or best.degree < degree_of_run(run):
            learn_on(run, run.scene.train, best.degree, self.options.steps, self.plugins)


def copied(tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    """Tensors of their own."""
    return {name: value.detach().clone() for name, value in tensors.items()}


def degree_of_run(run: Run) -> int:
    """Of the colours of a table with bands; -1 where networks make them."""
    rest = run.backbone.table.parameters.get("sh_rest")
    return -1 if rest is None else degree_of(rest.shape[1])


def size_with(run: Run, degree: int, size: int) -> int:
    """Bytes of a model whose bands above a degree are zero."""
    rest = run.backbone.table.parameters.get("sh_rest")
    return size if rest is None else size - rest[:, BANDS[degree] :].numel() * rest.element_size()


def learn_on(run: Run, views: Sequence[View], degree: int, steps: int, plugins: Plugins) -> None:
    """So many steps more from some training views, by the rates and rules of the last step; bands above the degree stay
    zero."""
    step, seconds, scene, sampler = run.step, run.seconds, run.scene, run.sampler
    run.scene, run.sampler = replace(scene, train=list(views)), Sampler(len(views), 0, batch=run.training.batch)
    try:
        cut_bands(run, degree)
        with plugins.listening([Guard()]):
            for _ in range(steps):
                train_step(run, plugins)
                cut_bands(run, degree)
    finally:
        run.step, run.seconds, run.scene, run.sampler = step, seconds, scene, sampler


@torch.no_grad()
def cut_bands(run: Run, degree: int) -> None:
    """Set the bands above a degree to zero."""
    if "sh_rest" in run.backbone.table.parameters:
        run.backbone.table.parameters["sh_rest"][:, BANDS[degree] :] = 0


def shorten_colours(run: Run, degree: int) -> None:
    """Drop the bands above a degree, with their moments, from the table; what draws it has to be built for that."""
    if "sh_rest" in run.backbone.table.parameters:
        edit(run.backbone.table, "sh_rest", *[lambda rows: rows[:, : BANDS[degree]]] * 2)


def told(tries: Sequence[Try]) -> list[dict[str, object]]:
    """Tries as JSON has them; without figures where a try could not learn on."""
    return [asdict(made) if math.isfinite(made.drop) else asdict(made) | {"psnr": {}, "drop": None} for made in tries]
