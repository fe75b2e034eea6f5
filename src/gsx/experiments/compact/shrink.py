"""The smallest model within a quality budget: primitives and colour bands that no picture needs go, others learn on.

The importance of a row is what the pictures of all training views lose without it: at their size, and in windows at
twice their focal length, where small Gaussians count. The share of rows that goes is found by bisection, for one degree
of colour after the other. Each candidate takes fitted colours of its degree, learns on and is evaluated on training
views that it does not learn from, against the whole model after the same.
"""

import logging
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace

import torch
from torch import Tensor

from gsx.backbones.sh_degrees import colour_fits, fitted, take_coefficients
from gsx.core.data.camera import Camera
from gsx.core.data.scene import View
from gsx.core.data.window import Window
from gsx.core.errors import TrainingError, first_line
from gsx.core.plugins import Plugins
from gsx.core.shapes import Bool, Float
from gsx.core.training.importance import Probe, draws_per_view
from gsx.core.training.parameter_table import keep_rows, size_of
from gsx.core.training.run import Run
from gsx.experiments.compact.fine_tuning import BANDS, copied_model, degree_of_run, fine_tuned, split_views
from gsx.experiments.compact.quality import least_file_loss, zoomed_psnr

logger = logging.getLogger(__name__)

CLOSER = 2.0
"""Times the focal length of the windows in which rows count, too."""
RESERVE = 0.5
"""Largest share of the budget that is reserved for what a quantised file loses."""


@dataclass(frozen=True, kw_only=True)
class ShrinkOptions:
    """The quality budget and the effort of the search."""

    max_drop: float
    """dB of PSNR, at any zoom."""
    steps: int
    """Steps of fine-tuning of each candidate."""
    tries: int = 5
    """Bisections: the share of rows is found to 2^-tries."""
    zooms: tuple[float, ...] = (1.0, 2.0)
    """Times the training resolution at which candidates are evaluated, where there is truth."""


@dataclass(frozen=True, kw_only=True)
class Candidate:
    """A smaller model and its quality."""

    removed: float
    """Share of the rows that went."""
    degree: int
    """Highest degree of colour; -1: the model has no bands of its own."""
    primitives: int
    megabytes: float
    psnr: dict[str, float]
    """PSNR by zoom, dB."""
    drop: float
    """Largest loss at any zoom against the whole model after the same fine-tuning, dB."""

    def as_json(self) -> dict[str, object]:
        """Returns its values; without quality where it could not be trained."""
        return asdict(self) if math.isfinite(self.drop) else asdict(self) | {"psnr": {}, "drop": None}


def closer_window(camera: Camera) -> tuple[Camera, Window]:
    """Returns (the middle of a camera's frame at twice its focal length; its place in the whole raster at that focal
    length)."""
    closer = camera.zoom(CLOSER)
    width, height = (max(1, round(side / CLOSER)) for side in closer.size)
    window = Window((closer.width - width) // 2, (closer.height - height) // 2, width, height)
    return window.of(closer), window


def pictures_of(view: View) -> list[tuple[Camera, Bool[Tensor, "H W"] | None]]:
    """Returns (camera, pixels that count) of the two pictures of a view in which rows are important."""
    counted, (closer, window) = view.counted(), closer_window(view.camera)
    if counted is None:
        return [(view.camera, None), (closer, None)]
    finer = counted.repeat_interleave(int(CLOSER), 0).repeat_interleave(int(CLOSER), 1)
    return [(view.camera, counted), (closer, finer[window.pixels])]


def probe_of(run: Run) -> Probe:
    """Returns a probe of the run's model as it stands."""
    return Probe(model=run.backbone, views=run.views, step=run.model_step)


def importance_of(run: Run, views: Sequence[View], generator: torch.Generator) -> Float[Tensor, "N"]:
    """Sums the squared changes of the views' pictures without each row."""
    importance, probe = torch.zeros(len(run.backbone.table), device=run.device), probe_of(run)
    for view in views:
        for camera, counted in pictures_of(view):
            importance += probe.render(camera).squared_changes(counted, draws_per_view(views), generator)
    return importance


def colours_of_lower_degrees(
    run: Run, views: Sequence[View], generator: torch.Generator
) -> list[Float[Tensor, "n 3 N"]]:
    """Fits coefficients of each degree below the model's, those that change the pictures of the views least."""
    highest = degree_of_run(run)
    if highest < 1:
        return []
    fits = colour_fits(probe_of(run), views, generator, highest - 1)
    return [fitted(fits, degree) for degree in range(highest)]


def important(importance: Float[Tensor, "N"], share: float) -> Bool[Tensor, "N"]:
    """Marks the rows that stay if a share of them goes, the least important first; at least one stays."""
    count, kept = len(importance), torch.ones_like(importance, dtype=torch.bool)
    kept[importance.double().argsort(stable=True)[: min(count - 1, round(share * count))]] = False
    return kept


class Search:
    """Candidates for one run, which itself stays as it is."""

    def __init__(self, run: Run, options: ShrinkOptions, plugins: Plugins, generator: torch.Generator) -> None:
        self.run, self.options, self.plugins = run, options, plugins
        self.training, self.validation = split_views(run)
        self.before = zoomed_psnr(run, self.validation, options.zooms)
        self.importance = importance_of(run, run.train_views, generator)
        self.colours = colours_of_lower_degrees(run, run.train_views, generator)
        whole = self.fine_tuned(run, degree_of_run(run))
        self.reference = zoomed_psnr(whole, self.validation, options.zooms)
        lost = least_file_loss(whole, self.validation, self.reference)
        self.reserve = lost if lost <= RESERVE * options.max_drop else 0.0
        """PSNR kept for what a quantised file loses, dB."""
        self.candidates: list[Candidate] = []
        rows, size = size_of(run.backbone.table)
        self.untouched = Candidate(
            removed=0.0,
            degree=degree_of_run(run),
            primitives=rows,
            megabytes=size / 1e6,
            psnr=self.before,
            drop=0.0,
        )

    def fine_tuned(self, run: Run, degree: int) -> Run:
        """Trains a smaller model on the views that it is not evaluated on."""
        return fine_tuned(run, self.training, degree, self.options.steps, self.plugins)

    def reduced(self, share: float, degree: int) -> Run:
        """Returns the run with a share of its rows less, and colours of a degree."""
        model = copied_model(self.run)
        if 0 <= degree < len(self.colours):
            every = torch.ones_like(self.importance, dtype=torch.bool)
            take_coefficients(model.table, every, self.colours[degree])
        keep_rows(model.table, important(self.importance, share))
        return replace(self.run, backbone=model)

    def evaluate(self, share: float, degree: int) -> Candidate:
        """Evaluates a candidate, once; one that cannot be trained has an infinite drop."""
        for known in self.candidates:
            if (known.removed, known.degree) == (share, degree):
                return known
        smaller = self.reduced(share, degree)
        try:
            psnr = zoomed_psnr(self.fine_tuned(smaller, degree), self.validation, self.options.zooms)
        except TrainingError as error:
            logger.warning("with %.0f %% fewer rows the model cannot be trained (%s)", 100 * share, first_line(error))
            psnr = dict.fromkeys(self.before, -math.inf)
        rows, size = size_of(smaller.backbone.table)
        candidate = Candidate(
            removed=share,
            degree=degree,
            primitives=rows,
            megabytes=size_with(smaller, degree, size) / 1e6,
            psnr=psnr,
            drop=max(self.reference[zoom] - psnr[zoom] for zoom in psnr),
        )
        self.candidates.append(candidate)
        self.log(candidate)
        return candidate

    def log(self, candidate: Candidate) -> None:
        """Logs a candidate and whether it is within the budget."""
        psnr = ", ".join(f"x{zoom} {value:.2f}" for zoom, value in candidate.psnr.items())
        logger.info(
            "%d primitives (%.0f %% less), degree %d: %s dB, drop %.3f %s %.3g dB",
            *(candidate.primitives, 100 * candidate.removed, candidate.degree, psnr),
            *(candidate.drop, "<=" if self.allowed(candidate) else ">"),
            self.options.max_drop - self.reserve,
        )

    def allowed(self, candidate: Candidate) -> bool:
        """Returns whether it is within the budget, with what its quantised file will lose."""
        return candidate.drop + self.reserve <= self.options.max_drop

    def smallest(self) -> Candidate:
        """Searches the smallest model within the budget; the untouched one if there is none."""
        degree = degree_of_run(self.run)
        best = self.fewest_rows(degree, 0.0, 1.0) or self.untouched
        for lower in range(degree - 1, -1, -1):
            smaller = self.smaller(best, lower)
            if smaller is None:
                break
            best = smaller
        return best

    def smaller(self, best: Candidate, degree: int) -> Candidate | None:
        """Searches a candidate of a lower degree that is within the budget and smaller than another."""
        candidate = self.evaluate(best.removed, degree)
        if self.allowed(candidate):
            return candidate
        least = self.share_as_small(best, degree)
        if not self.allowed(self.evaluate(least, degree)):  # with fewer rows still less
            return None
        return self.fewest_rows(degree, least, best.removed)

    def fewest_rows(self, degree: int, least: float, most: float) -> Candidate | None:
        """Bisects the share of rows that goes between two; returns the best within the budget, None: there is none."""
        best = None
        while most - least > 2**-self.options.tries:
            share = (least + most) / 2
            candidate = self.evaluate(share, degree)
            if self.allowed(candidate):
                best, least = candidate, share
            else:
                most = share
        return best

    def share_as_small(self, best: Candidate, degree: int) -> float:
        """Returns the share of rows without which a model of a degree is as small as another."""
        _, size = size_of(self.run.backbone.table)
        return max(0.0, 1 - best.megabytes / (size_with(self.run, degree, size) / 1e6))

    def trained(self, candidate: Candidate) -> Run:
        """Returns the run with a candidate's model, fine-tuned on all training views."""
        run = self.run
        if candidate not in self.candidates:
            return run
        smaller = self.reduced(candidate.removed, candidate.degree)
        return fine_tuned(smaller, run.train_views, candidate.degree, self.options.steps, self.plugins)


def size_with(run: Run, degree: int, size: int) -> int:
    """Subtracts the bands above a degree from the bytes of a model."""
    rest = run.backbone.table.parameters.get("sh_rest")
    return size if rest is None else size - rest[:, BANDS[degree] :].numel() * rest.element_size()
