"""The honest competitor of a zoomed render: the x1 render, enlarged by an upscaler that knows nothing of the model."""

import logging
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import Any, TypeAlias

import torch
from torch import Tensor

from gsx.core.data.masks import black_out
from gsx.core.data.scene import Scene, View
from gsx.core.errors import ConfigError, InputError, TrainingError, first_line
from gsx.core.shapes import Float
from gsx.core.training.regenerator import Checkable, HasProvenance, Regenerator, RegeneratorContext, Request
from gsx.core.training.render import render
from gsx.core.training.run import Run
from gsx.experiments.evaluation.zoomed import Zoomed

logger = logging.getLogger(__name__)

Measured: TypeAlias = Callable[[Float[Tensor, "3 H W"]], Float[Tensor, "3 H W"]]
"""Conversion of a picture to what metrics get."""
REFUSALS = (ConfigError, InputError)
"""Errors by which a regenerator refuses a request."""
FAILURES = (*REFUSALS, TrainingError, RuntimeError, MemoryError)
"""Errors of a regenerator that is built or learns."""


class Competitor:
    """A regenerator that enlarges the x1 renders of held-out views, at the integer zooms that it reaches."""

    def __init__(self, scene: Scene, name: str, regenerator: Regenerator, scales: Sequence[int], step: int = 0) -> None:
        self.scene, self.name, self.regenerator, self.scales = scene, name, regenerator, set(scales)
        self.step = step
        """Step of the run whose renders are enlarged; 0: they are of no run."""

    def enlarge(self, image: Float[Tensor, "3 h w"], view: View, factor: float) -> Float[Tensor, "3 H W"] | None:
        """Returns a view's x1 render, enlarged; None: the upscaler does not reach that zoom, or has failed there."""
        if factor not in self.scales:
            return None
        try:
            return self.result(request_of(self.scene, image, view, int(factor), self.step))
        except Exception as error:  # of any library or function: the model's own figures are kept
            message = "eval.competitor: %s fails at x%g, where its figures are left out (%s)"
            logger.warning(message, self.name, factor, first_line(error))
            self.scales.discard(int(factor))
            return None

    def join(self, zoomed: Zoomed, image: Float[Tensor, "3 h w"], view: View, measured: Measured) -> Zoomed:
        """Adds the enlarged x1 render of a view to its zoomed pictures, `measured` as they are."""
        picture = self.enlarge(image, view, zoomed.factor)
        if picture is None:
            return zoomed
        return replace(zoomed, upscaled=black_out(measured(picture), zoomed.view.counted()))

    def result(self, request: Request) -> Float[Tensor, "3 H W"]:
        """Returns the result of one request, in [0, 1], on the CPU.

        Raises:
            TrainingError: it is no picture of the requested size.
        """
        with torch.no_grad():
            pictures = list(self.regenerator.regenerate([request]))
        shape = [3, *request.result_size]
        if len(pictures) != 1 or not isinstance(pictures[0], Tensor) or list(pictures[0].shape) != shape:
            raise TrainingError(f"{self.name} did not return one picture of shape {shape} for one request")
        picture = pictures[0].detach().cpu().float()
        if not bool(picture.isfinite().all()):
            raise TrainingError(f"{self.name} returned values that are not finite for {request.view.name}")
        return picture.clamp(0, 1)

    def provenance(self) -> dict[str, Any]:
        """Returns the upscaler's name, and the identity of its model if it has one."""
        model = self.regenerator.provenance() if isinstance(self.regenerator, HasProvenance) else {}
        return {"name": self.name, **model}


def request_of(scene: Scene, image: Float[Tensor, "3 h w"], view: View, scale: int, step: int) -> Request:
    """Returns the request to enlarge a view's x1 render."""
    return Request(
        image=image.clone(),  # a regenerator may write into its picture
        scale=scale,
        reduction=scene.reduction,
        camera=view.camera,
        view=view,
        number=next((number for number, one in enumerate(scene.train) if one.name == view.name), 0),
        photo=False,
        seed=0,
        strength=1.0,
        strongest=1.0,
        prompt="",
        step=step,
    )


def competitor_for(
    scene: Scene, name: str, make: Callable[[], Regenerator], zooms: Sequence[float], context: RegeneratorContext
) -> Competitor | None:
    """Builds and prepares the competitor for the integer zooms above 1; None if it reaches none of them.

    Logs why zooms are not reached, with the remedy: a missing package, or factors that the model does not have.
    """
    scales = [int(zoom) for zoom in zooms if zoom > 1 and zoom == int(zoom)]
    scales = [scale for scale in scales if views_with_truth(scene, scale)]
    if not scales:
        return None
    try:
        regenerator = make()
        reached = list(reached_scales(scene, regenerator, scales))
        if reached:
            regenerator.prepare(context)
    except FAILURES as error:
        log_absent(scales, str(error))
        return None
    return Competitor(scene, name, regenerator, reached, context.step) if reached else None


def reached_scales(scene: Scene, regenerator: Regenerator, scales: Sequence[int]) -> Iterator[int]:
    """Yields the scales that a regenerator reaches; logs each reason why it does not reach others, once."""
    reasons: dict[str, list[int]] = {}
    for scale in scales:
        try:
            if isinstance(regenerator, Checkable):
                regenerator.check(views_with_truth(scene, scale), [scale], False)
            yield scale
        except REFUSALS as error:
            reasons.setdefault(str(error), []).append(scale)
    for reason, missing in reasons.items():
        log_absent(missing, reason)


def log_absent(scales: Sequence[int], reason: str) -> None:
    """Logs why zooms have no figures of the competitor."""
    listed = ", ".join(f"x{scale}" for scale in scales)
    logger.info("no upscaled x1 render to compare with at %s: %s", listed, reason)


def views_with_truth(scene: Scene, scale: int) -> list[View]:
    """Returns the held-out views with a photo at that zoom."""
    return [view for view in scene.test if view.zoom(scale) is not None]


def context_of(run: Run, name: str) -> RegeneratorContext:
    """Returns what a regenerator may learn from: the training views alone.

    It does not end with training: a run that is complete is evaluated, also after a signal in its last step.
    """

    return RegeneratorContext(
        views=run.train_views,
        reduction=run.scene.reduction,
        render=lambda camera: render(run, camera).image,
        held_out=refuse_learning(name),
        step=run.step,
        seed=0,
        device=run.device,
        folder=run.folder / "regenerators" / "competitor",
    )


def refuse_learning(name: str) -> Callable[[float], list[Float[Tensor, "3 h w"]]]:
    """Returns a stand-in for renders of other models, which an evaluation does not train; it raises ConfigError."""

    def held_out(share: float) -> list[Float[Tensor, "3 h w"]]:
        raise ConfigError(
            f"{name} learns from renders of other models, which an evaluation does not train: choose another upscaler, "
            "regenerator/upscale@eval.competitor=lanczos"
        )

    return held_out
