"""Axes of a splat file, chosen by its scene."""

import logging
from dataclasses import dataclass, replace
from math import isnan, nan
from statistics import fmean

import torch

from gsx.core.data.scene import Scene
from gsx.core.gaussians.splats import Gaussians
from gsx.core.quality.metrics import psnr
from gsx.core.rasterizer import RasterSettings
from gsx.core.training.render import render_gaussians
from gsx.experiments.runs.settings import Settings
from gsx.experiments.runs.start_file import (
    MOST_VIEWS,
    distance_from_points,
    evident_points,
    in_scene,
    origin_of_file,
    reaching,
    spread,
    start_doubts,
    thinned,
)
from gsx.formats.axis_names import FIXED, SPECIFIED, TRAINED
from gsx.formats.origin import around
from gsx.formats.splat_files import SplatContent, log_axes
from gsx.formats.turned import flipped

logger = logging.getLogger(__name__)

OTHER = {SPECIFIED: TRAINED, TRAINED: SPECIFIED}
"""The two systems that programs write; they differ by 180 degrees about x."""
NEARER = 1.5
"""Ratio of distances from the scene's points that decides."""
MORE_IN_VIEW = 1.2
"""Ratio of shares in view that decides."""
LEAST_IN_VIEW = 0.05
"""Least share in view: with less, neither axes fit."""
MORE_ALIKE = 1.0
"""Difference in PSNR of thumbnails that decides, dB."""
THUMBNAIL, MOST_THUMBNAILS = 96, 4
"""Longer side in px, and number of thumbnails."""


@dataclass(frozen=True, kw_only=True)
class Fit:
    """Fit of splats, in some axes, to a scene."""

    in_view: float
    """Share of splats inside the picture of a view, mean over views."""
    distance: float
    """Median distance of the scene's points from the nearest splat, scene units; NaN: no points, or random ones."""
    likeness: float = nan
    """Mean PSNR of thumbnails against photos, dB; NaN: not needed."""

    def __str__(self) -> str:
        points = "" if isnan(self.distance) else f", points {self.distance:.3g} from the nearest splat"
        pictures = "" if isnan(self.likeness) else f", thumbnails {self.likeness:.1f} dB from photos"
        return f"{self.in_view:.1%} in view{points}{pictures}"


def in_axes_of(scene: Scene, content: SplatContent | None) -> Gaussians | None:
    """Return the Gaussians of a file in its axes, or in those that fit the scene if it states none; log the choice."""
    if content is None:
        return None
    other = OTHER.get(content.axes)
    if content.by in ("given", "stated") or other is None:
        log_axes(content)
        return content.gaussians
    turned = flipped(content.gaussians, torch.tensor([1.0, -1.0, -1.0]))
    fits = {content.axes: fit(content.gaussians, scene), other: fit(turned, scene)}
    best = better(fits)
    if content.by == "specified":
        if best is None and max(fit.in_view for fit in fits.values()) >= LEAST_IN_VIEW:
            candidates = {content.axes: content.gaussians, other: turned}
            fits = {axes: replace(fits[axes], likeness=likeness(candidates[axes], scene)) for axes in fits}
            best = more_alike(fits)
        log_choice(content, fits, best)
        return turned if best == other else content.gaussians
    if best == other:
        log_doubt(content, fits, other)
    return content.gaussians


def start_in_scene(
    settings: Settings, scene: Scene, content: SplatContent | None
) -> tuple[Gaussians | None, list[str]]:
    """Return the Gaussians of the start file in the scene's coordinates, and doubts; errors as `start_doubts`."""
    gaussians = in_axes_of(scene, content)
    start = None if gaussians is None else in_scene(gaussians, scene)
    return start, start_doubts(settings, scene, start)


def fit(gaussians: Gaussians, scene: Scene) -> Fit:
    """Measure the fit of Gaussians of a file to a scene."""
    some = thinned(gaussians)
    some = around(some, origin_of_file(some, scene))
    views = spread([*scene.train, *scene.test], MOST_VIEWS)
    shares = [float(reaching(some, view.camera, 0).double().mean()) for view in views]
    places = evident_points(scene.points)
    distance = distance_from_points(some.means, places) if len(places) else nan
    return Fit(in_view=fmean(shares), distance=distance)


def better(fits: dict[str, Fit]) -> str | None:
    """Return the axes of the better of two fits; None: undecided.

    Clearly nearer points decide, else the share in view, which may stay equal when a table top is turned over.
    """
    (first, a), (second, b) = fits.items()
    if max(a.in_view, b.in_view) < LEAST_IN_VIEW:
        return None
    if a.distance > NEARER * b.distance or b.distance > NEARER * a.distance:
        return first if a.distance < b.distance else second
    if a.in_view > MORE_IN_VIEW * b.in_view or b.in_view > MORE_IN_VIEW * a.in_view:
        return first if a.in_view > b.in_view else second
    return None


def likeness(gaussians: Gaussians, scene: Scene) -> float:
    """Return the mean PSNR of thumbnails of a file's Gaussians against those of photos, dB."""
    gaussians = around(gaussians, origin_of_file(gaussians, scene))
    levels = []
    for view in spread([*scene.train, *scene.test], MOST_THUMBNAILS):
        camera = view.camera.zoom(min(1.0, THUMBNAIL / max(view.camera.size)))
        photo = torch.nn.functional.interpolate(view.image()[None], size=(camera.height, camera.width), mode="area")[0]
        levels.append(psnr(render_gaussians(gaussians, camera, RasterSettings(path="eager"), scene.background), photo))
    return fmean(levels)


def more_alike(fits: dict[str, Fit]) -> str | None:
    """Return the axes with a clearly higher PSNR of thumbnails; None: undecided."""
    (first, a), (second, b) = fits.items()
    if abs(a.likeness - b.likeness) < MORE_ALIKE:
        return None
    return first if a.likeness > b.likeness else second


def log_choice(content: SplatContent, fits: dict[str, Fit], best: str | None) -> None:
    """Log the axes of a file that states none, and the evidence."""
    evidence = "; ".join(f"{axes}: {fit}" for axes, fit in fits.items())
    if best:
        message = "%s: axes %s fit the scene (%s); the file states none; axes=%s chooses the others"
        logger.info(message, content.path, best, evidence, OTHER[best])
    else:
        message = "%s: axes %s (SPZ standard); file and scene do not decide (%s): compare with axes=%s"
        logger.warning(message, content.path, content.axes, evidence, OTHER[content.axes])


def log_doubt(content: SplatContent, fits: dict[str, Fit], other: str) -> None:
    """Warn of a file that would fit the scene better in other axes than those usual for its format."""
    evidence = "; ".join(f"{axes}: {fit}" for axes, fit in fits.items())
    remedy = "export it with y up, as glTF has it" if content.by == FIXED else f"try axes={other}"
    logger.warning(
        "%s: the splats would fit the scene better in axes %s (%s): %s", content.path, other, evidence, remedy
    )
