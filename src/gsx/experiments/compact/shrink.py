"""The smallest model within a quality budget: rows and bands of colour that no picture needs go, others learn on.

What a row is worth is what the pictures of all training views lose without it, at their own size and in windows at
twice their focal length, where small Gaussians count. How many go, in the order of `reduction`, is found by bisection,
for one degree of colour after the other. A try takes the colours of that degree that come nearest to what they were,
learns on by the rates that training ended with, and is judged by training views that it does not learn from, beside the
whole model after the same.
"""

import logging
import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from statistics import fmean

import torch
from torch import Tensor
from torch.nn import Parameter

from gsx.backbones.colour_fits import colour_fits, fitted, take_coefficients
from gsx.core.data.camera import Camera
from gsx.core.data.scene import View
from gsx.core.data.window import Window
from gsx.core.errors import TrainingError, first_line
from gsx.core.gaussians.drawn import splats_of
from gsx.core.gaussians.sh import colour_of_constant, degree_of
from gsx.core.gaussians.splats import Gaussians
from gsx.core.plugins import Plugins
from gsx.core.quality.metrics import psnr
from gsx.core.shapes import Bool, Float
from gsx.core.training.guard import Guard
from gsx.core.training.importance import ROUNDING, Probe, draws_per_view
from gsx.core.training.module import Modules
from gsx.core.training.parameter_table import edit, restored_table, size_of, table_tensors
from gsx.core.training.render import render
from gsx.core.training.run import Run
from gsx.core.training.sampler import Sampler
from gsx.core.training.trainer import train_step
from gsx.experiments.compact.reduction import Reduction

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
    merging: bool
    """Whether rows could be merged with neighbours."""
    primitives: int
    megabytes: float
    psnr: dict[str, float]
    """By zoom."""
    drop: float
    """The largest loss at any zoom against the whole model that has learnt on as well, dB."""


def judges(run: Run) -> tuple[list[View], list[View]]:
    """(training views to learn from, training views to judge by), the latter spread over the order."""
    views = run.train_views
    count = max(FEWEST, len(views) // ONE_IN)
    if len(views) <= count:
        return list(views), list(views)
    chosen = {round((i + 0.5) * len(views) / count) for i in range(count)}
    return ([view for i, view in enumerate(views) if i not in chosen], [views[i] for i in sorted(chosen)])


@torch.no_grad()
def figures(
    run: Run, views: Sequence[View], zooms: Sequence[float], gaussians: Gaussians | None = None
) -> dict[str, float]:
    """Mean PSNR over views by zoom, dB, no higher than photographs of 8 bits tell; zooms without truth are left out.
    gaussians: drawn in place of the model."""
    out = {}
    for factor in zooms:
        closer = [zoomed for view in views if (zoomed := view.zoom(factor)) is not None]
        if closer:
            values = [psnr(shown(run, v, gaussians), v.image(), v.counted()) for v in closer]
            out[f"{factor:g}"] = fmean(above_rounding(value) for value in values)
    return out


def above_rounding(decibels: float) -> float:
    """PSNR with the rounding of the photograph to 8 bits added to the squared error: 58.9 dB at most."""
    return -10 * math.log10(10 ** (-decibels / 10) + ROUNDING)


def shown(run: Run, view: View, gaussians: Gaussians | None) -> Float[Tensor, "3 H W"]:
    """A view by the model, or by other Gaussians, at the exposure of its photograph."""
    splats = None if gaussians is None else splats_of(gaussians, view.camera.centre)
    return run.as_photo(render(run, view.camera, splats=splats).image, view).clamp(0, 1).cpu()


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


def probe_of(run: Run) -> Probe:
    """Returns a probe of the run's model as it stands."""
    return Probe(model=run.backbone, views=run.views, step=run.model_step)


def worth_of(run: Run, views: Sequence[View], generator: torch.Generator) -> Float[Tensor, "N"]:
    """What pictures lose without each row: squared changes of values, summed over views and windows."""
    worth, probe = torch.zeros(len(run.backbone.table), device=run.device), probe_of(run)
    for view in views:
        for camera, counted in pictures_of(view):
            worth += probe.render(camera).squared_changes(counted, draws_per_view(views), generator)
    return worth


def seen_colours(run: Run, lower: Sequence[Float[Tensor, "n 3 N"]]) -> Float[Tensor, "N 3"] | None:
    """Colours of rows in the mean over the views that see them; None: they have none of their own."""
    constant = run.backbone.table.parameters.get("sh_dc")
    if constant is None:
        return None
    return colour_of_constant(constant.detach()[:, 0] + (lower[0][0].T if lower else 0.0))


def colours_of_lower_degrees(
    run: Run, views: Sequence[View], generator: torch.Generator
) -> list[Float[Tensor, "n 3 N"]]:
    """For each degree below the model's own the coefficients that change the pictures of views least."""
    highest = degree_of_run(run)
    if highest < 1:
        return []
    fits = colour_fits(probe_of(run), views, generator, highest - 1)
    return [fitted(fits, degree) for degree in range(highest)]


# -- tries -------------------------------------------------------------------------------------------------------------


class Shrinking:
    """The tries on one run. What the run holds afterwards is the last one."""

    def __init__(self, run: Run, options: ShrinkOptions, plugins: Plugins, generator: torch.Generator) -> None:
        self.run, self.options, self.plugins = run, options, plugins
        self.learnt, self.judging = judges(run)
        self.before = figures(run, self.judging, options.zooms)
        self.worth = worth_of(run, run.train_views, generator)
        self.colours = colours_of_lower_degrees(run, run.train_views, generator)
        seen = seen_colours(run, self.colours)
        self.reductions = {
            way: Reduction(run.backbone.table, self.worth, seen if way else None) for way in (True, False)
        }
        """The order of rows by whether they may be merged."""
        self.whole = copied(table_tensors(run.backbone.table))
        self.modules = {name: copied(module.state_dict()) for name, module in run.modules.items()}
        learn_on(run, self.learnt, degree_of_run(run), options.steps, plugins)
        self.reference = figures(run, self.judging, options.zooms)
        """Of the whole model, which has learnt on like every try: views that judge are no longer learnt from."""
        self.tried: list[Try] = []
        degree, (rows, size) = degree_of_run(run), size_of(run.backbone.table)
        self.untouched = Try(removed=0.0, degree=degree, merging=False, primitives=rows, megabytes=size / 1e6,
                             psnr=self.before, drop=0.0)  # fmt: skip
        """The model as it was."""

    def attempt(self, share: float, degree: int, merging: bool) -> Try:
        """Take the share and the bands above a degree away, learn on, judge, unless that has been tried. What cannot be
        learnt on drops without end."""
        for made in self.tried:
            if (made.removed, made.degree, made.merging) == (share, degree, merging):
                return made
        run = self.run
        self.cut(share, degree, merging)
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
            merging=merging,
            primitives=rows,
            megabytes=size_with(run, degree, size) / 1e6,
            psnr=found,
            drop=drop,
        )
        self.tried.append(made)
        told = ", ".join(f"x{zoom} {value:.2f}" for zoom, value in found.items())
        logger.info(
            "%d primitives (%.0f %% less%s), degree %d: %s dB, a drop of %.2f: %s",
            *(
                rows,
                100 * share,
                ", merging" if merging else "",
                degree,
                told,
                drop,
                "kept" if self.allowed(made) else "too much",
            ),
        )
        return made

    def cut(self, share: float, degree: int, merging: bool) -> None:
        """Give the run the whole model, at the exposures that it had, with a share of its rows less, merged or not, and
        colours of a degree."""
        backbone = self.run.backbone
        backbone.table = restored_table(backbone.table, copied(self.whole))
        for name, module in self.run.modules.items():
            module.load_state_dict(self.modules[name])
        if 0 <= degree < len(self.colours):
            every = torch.ones_like(self.worth, dtype=torch.bool)
            take_coefficients(backbone.table, every, self.colours[degree])
        self.reductions[merging].apply(backbone.table, share)

    def allowed(self, made: Try) -> bool:
        """Whether it is within the budget."""
        return made.drop <= self.options.max_drop

    def smallest(self) -> Try:
        """The smallest model within the budget. The run holds one of the tries, or is as it was."""
        degree, merging = degree_of_run(self.run), self.merging_loses_less()
        best = self.fewest_rows(degree, 0.0, 1.0, merging) or self.untouched
        for lower in range(degree - 1, -1, -1):
            found = self.smaller(best, lower, merging)
            if found is None:
                break
            best = found
        return best

    def smaller(self, best: Try, degree: int, merging: bool) -> Try | None:
        """A try of a lower degree that is within the budget and smaller than another; None: none is."""
        made = self.attempt(best.removed, degree, merging)
        if self.allowed(made):
            return made
        least = self.share_as_small(best, degree)
        if not self.allowed(self.attempt(least, degree, merging)):  # with fewer rows still less
            return None
        return self.fewest_rows(degree, least, best.removed, merging)

    def merging_loses_less(self) -> bool:
        """Whether less is lost where half of the rows are merged than where they are removed. Merged ones draw what
        both drew, and learn less from there on: that pays where a model has no rows to spare."""
        if not self.reductions[True].rows:
            return False
        merged, removed = (self.attempt(0.5, degree_of_run(self.run), way) for way in (True, False))
        return merged.drop < removed.drop

    def fewest_rows(self, degree: int, least: float, most: float, merging: bool) -> Try | None:
        """The try of a degree without the largest share of the rows between two, which is found to 2^-tries; None: none
        is within the budget."""
        best = None
        while most - least > 2**-self.options.tries:
            share = (least + most) / 2
            made = self.attempt(share, degree, merging)
            if self.allowed(made):
                best, least = made, share
            else:
                most = share
        return best

    def share_as_small(self, best: Try, degree: int) -> float:
        """The share of the rows without which a model of a degree is as small as another."""
        rows, size = size_of(self.run.backbone.table)
        of_row = size_with(self.run, degree, size) / 1e6 / rows
        return max(0.0, 1 - best.megabytes / (of_row * self.untouched.primitives))

    def within(self, lost: float) -> list[Try]:
        """The model as it was, and tries that leave room in the budget for so many dB that a file loses, smallest
        first."""
        fitting = [made for made in [self.untouched, *self.tried] if made.drop + lost <= self.options.max_drop]
        return sorted(fitting, key=lambda made: made.megabytes)

    def take(self, best: Try) -> None:
        """Make the run what a try was, learnt from all training views."""
        run = self.run
        self.cut(best.removed, best.degree, best.merging)
        if best.removed or best.degree < degree_of_run(run):
            learn_on(run, run.train_views, best.degree, self.options.steps, self.plugins)


def copied(tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
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
    """So many steps more from some training views, by the rules of the last step, with learning rates that go down to
    nothing from what they were before any cooldown; bands above the degree stay zero."""
    with extended(run, views, steps), plugins.listening([Guard()]):
        cut_bands(run, degree)
        for _ in range(steps):
            train_step(run, plugins)
            cut_bands(run, degree)


@contextmanager
def extended(run: Run, views: Sequence[View], steps: int) -> Iterator[None]:
    """The run as one that ends so many steps later, with these training views; afterwards nothing has been counted."""
    names = ("progress", "iterations", "sampler", "training", "views")
    before = {name: getattr(run, name) for name in names}
    run.progress, scene = replace(run.progress), replace(run.scene, train=list(views))
    run.sampler = Sampler(len(views), 0, batch=run.training.batch)
    run.iterations = run.step + steps
    run.views = replace(run.views, scene=scene, modules=modules_for(run, views))
    run.training = replace(run.training, cooldown=steps / run.iterations)
    try:
        yield
    finally:
        for name, value in before.items():
            setattr(run, name, value)


def modules_for(run: Run, views: Sequence[View]) -> Modules:
    """Returns the run's modules for some of its views as they are corrected now: poses and masks are theirs already."""
    context = replace(run.modules["poses"].context, scene=replace(run.scene, train=list(views)))
    corrected = {name: run.modules[name].restarted(replace(context, name=name)) for name in ("poses", "distractors")}
    return {**run.modules, **corrected}


@torch.no_grad()
def cut_bands(run: Run, degree: int) -> None:
    """Set the bands above a degree to zero."""
    if "sh_rest" in run.backbone.table.parameters:
        run.backbone.table.parameters["sh_rest"][:, BANDS[degree] :] = 0


def shorten_colours(run: Run, degree: int) -> None:
    """Drop the bands above a degree, with their moments, from the table; what draws it has to be built for that."""
    if "sh_rest" in run.backbone.table.parameters:
        edit(run.backbone.table, "sh_rest", *[lambda rows: rows[:, : BANDS[degree]]] * 2)


@contextmanager
def without_bands(run: Run, degree: int) -> Iterator[None]:
    """Hold the bands above a degree back, for a while in which nothing is drawn or learnt."""
    parameters = run.backbone.table.parameters
    whole = parameters.get("sh_rest")
    if whole is not None:
        parameters["sh_rest"] = Parameter(whole.detach()[:, : BANDS[degree]])
    try:
        yield
    finally:
        if whole is not None:
            parameters["sh_rest"] = whole


def told(tries: Sequence[Try]) -> list[dict[str, object]]:
    """Tries as JSON has them; without figures where a try could not learn on."""
    return [asdict(made) if math.isfinite(made.drop) else asdict(made) | {"psnr": {}, "drop": None} for made in tries]
