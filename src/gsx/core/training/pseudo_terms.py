"""Terms of augmenters in the loss of a training view: render their pseudo views, compare, send gradients back."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import TypeAlias

import torch
from torch import Tensor

from gsx.core.data.camera import Camera
from gsx.core.data.window import Window
from gsx.core.shapes import Float
from gsx.core.training.backbone import Observation, PseudoViewListener
from gsx.core.training.parameter_table import shared_colour
from gsx.core.training.pseudo_views import PseudoView, Term, mask_windows, pseudo_loss
from gsx.core.training.render import CameraImage, observe, render_for_training
from gsx.core.training.run import Run

Divided: TypeAlias = tuple[Term, Sequence[tuple[PseudoView, float]]]
"""(term, its parts that reuse the training view's render)"""


def request_terms(run: Run, step: int, views: Sequence[int]) -> list[list[Term]]:
    """Collects the augmenters' terms for each training view, and passes new pseudo views to the backbone."""
    requested = [[augmenter.term(run, step, view) for augmenter in run.augmenters.values()] for view in views]
    terms = [[term for term in of_view if term is not None] for of_view in requested]
    if isinstance(run.backbone, PseudoViewListener):
        made = [pseudo for of_view in terms for term in of_view for pseudo in term.made]
        run.backbone.pseudo_views_made(made, step)
    return [[term for term in of_view if term.parts] for of_view in terms]


def without_windows(term: Term, camera: Camera, windows: Sequence[Window]) -> Term:
    """Masks windows of the training camera in the pseudo views of a term."""
    if not windows:
        return term
    return replace(term, parts=[(mask_windows(view, camera, windows), weight) for view, weight in term.parts])


def reusable_parts(term: Term, cameras: Sequence[Camera], random_background: bool) -> Divided:
    """Separates the parts of a term whose cameras draw what one of `cameras` does; none of unobserved terms."""
    if random_background or not (term.shared and term.observed):
        return term, ()
    reused = [part for part in term.parts if any(map(part[0].camera.draws_as, cameras))]
    return replace(term, parts=[part for part in term.parts if part not in reused]), reused


def backward_terms(run: Run, terms: Sequence[Term], step: int, observations: list[Observation]) -> dict[str, float]:
    """Runs backward for all terms, first those without shared parameters; returns their values by name."""
    ordered = sorted(terms, key=lambda term: term.shared)
    return {term.name: backward_term(run, term, step, observations) for term in ordered}


def backward_term(run: Run, term: Term, step: int, observations: list[Observation]) -> float:
    """Runs backward for a term and returns its value; appends the observations of its renders."""
    total = 0.0
    for view, weight in term.parts:
        drawn, rendering, *_ = render_for_training(run, view.camera, step, run.background)
        loss = weight * difference_from(run, rendering.image, view, term)
        loss.backward()
        total += float(loss.detach())
        gradient = rendering.screen.means2d_offset.grad  # not finite in a step that will be skipped
        finite = math.isfinite(total) and (gradient is None or bool(torch.isfinite(gradient).all()))
        if term.observed and finite:
            observations.append(observe(run, drawn, rendering, step, weight))
    if not term.shared:
        for parameter in shared_colour(run.backbone.table):
            parameter.grad = None
    return total


def difference_from(run: Run, image: Float[Tensor, "3 h w"], view: PseudoView, term: Term) -> Float[Tensor, ""]:
    """Returns the loss of a render of a pseudo view as its term measures it, compiled where renders are."""
    backend = run.raster.backend.on(image.device.type, learning=True)
    return pseudo_loss(image, view, term.squared, term.ssim_weight, backend)


def reused_losses(run: Run, renders: Sequence[CameraImage], divided: Sequence[Divided]) -> Iterator[tuple[str, Tensor]]:
    """Yields (name of the term, loss) of each pseudo view that is compared with a render of the training view."""
    for term, reused in divided:
        for pseudo, weight in reused:
            image = next(image for camera, image in renders if pseudo.camera.draws_as(camera))
            yield term.name, weight * difference_from(run, image, pseudo, term)
