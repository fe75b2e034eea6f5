"""Pictures of pseudo views: requested, redrawn, weighed (the paper, Practical Implementation)."""

import hashlib
import logging
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import torch
from torch import Tensor

from gsx.augmenters.checked_regenerator import CheckedRegenerator
from gsx.augmenters.consistency import consistent_pixels, exactly_consistent
from gsx.augmenters.pixel_weights import agreeing, in_bytes
from gsx.augmenters.planner import PseudoViewSpec, reduced
from gsx.augmenters.pseudo_options import WEIGHT_MAPS, PseudoOptions
from gsx.augmenters.store import picture_name
from gsx.augmenters.timing import ramp
from gsx.core.data.camera import Camera
from gsx.core.data.images import write_image
from gsx.core.data.masks import where_counted
from gsx.core.data.reduction import Reduction, as_blocks
from gsx.core.data.resize import to_uint8
from gsx.core.data.scene import View
from gsx.core.data.window import Window
from gsx.core.shapes import Float, UInt8
from gsx.core.training.pseudo_views import PseudoView
from gsx.core.training.regenerator import Request
from gsx.core.training.render import render, splats_for
from gsx.core.training.run import Run
from gsx.core.training.schedule import Schedule

logger = logging.getLogger(__name__)

BATCH = 64
"""Pictures redrawn between two lines of progress."""
SHOWN = 3
"""Training views of an event whose pictures are kept to be looked at."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Redrawer:
    """Asks a regenerator for the pictures of pseudo views, and weighs those that stood up to the checks."""

    name: str
    options: PseudoOptions
    regenerator: CheckedRegenerator
    schedule: Schedule

    def all_drawn(self, run: Run, event: int, specs: Sequence[PseudoViewSpec]) -> list[PseudoView]:
        """The pseudo views of what was planned, but for those whose pictures are dropped; told batch by batch."""
        views: list[PseudoView] = []
        shown = sorted({spec.parent for spec in specs})[:SHOWN]
        for first in range(0, len(specs), BATCH):
            batch = specs[first : first + BATCH]
            views += self.drawn(run, event, batch, shown)
            logger.info("%s at step %d: %d of %d pictures", self.name, event, first + len(batch), len(specs))
        return views

    def drawn(self, run: Run, event: int, specs: Sequence[PseudoViewSpec], shown: Sequence[int]) -> list[PseudoView]:
        """The pseudo views of some plans; pictures of the training views `shown` are kept to be looked at."""
        options, views = self.options, []
        requests = [self.request(run, event, spec) for spec in specs]
        run.refuse_if_stopping()
        redrawn = self.regenerator.redraw(requests, samples=options.samples, project=options.project == "exact")
        for spec, request, one in zip(specs, requests, redrawn, strict=True):
            if one.image is not None:
                view = self.view(run, event, spec, request, one.image)
                views.append(view)
                if spec.parent in shown:
                    self.show(run.folder / "pseudo", spec, request, view)
        return views

    def request(self, run: Run, event: int, spec: PseudoViewSpec) -> Request:
        """What the regenerator is asked for."""
        run.refuse_if_stopping()
        view = run.train_views[spec.parent]
        image = render(run, spec.seen).image if spec.outer is None else photographed(run, view, spec.outer, spec.seen)
        return Request(
            image=image,
            scale=spec.scale,
            reduction=run.scene.reduction,
            camera=spec.seen,
            view=view,
            number=spec.parent,
            photo=spec.outer is not None,
            seed=spec.seed,
            strength=ramp(self.options.strength, event, self.options.timing, self.schedule),
            strongest=max(self.options.strength),
            prompt=self.options.prompt.replace("{scene}", run.scene.name),
            step=event,
        )

    def view(
        self, run: Run, event: int, spec: PseudoViewSpec, request: Request, result: Float[Tensor, "3 H W"]
    ) -> PseudoView:
        """The pseudo view of a result: its window, in 8 bits."""
        a, inside = spec.scale, spec.inside
        target = to_uint8(result.clamp(0, 1))
        if self.options.project == "exact" and a > 1 and request.photo:
            target = exactly_consistent(result, to_uint8(request.image), a, request.reduction)
        window = Window(left=a * inside.left, top=a * inside.top, width=a * inside.width, height=a * inside.height)
        kept = window.cut(target).contiguous()
        shares = {}
        if request.photo and a > 1:
            same = consistent_pixels(target, to_uint8(request.image), a, request.reduction)
            shares = {"consistent": float(inside.cut(same[None].float()).mean())}
        known = request.photo and a > 1 and self.options.coarse_weight > 0
        return PseudoView(
            camera=spec.camera,
            target=kept,
            parent=spec.parent,
            pixel_weight=self.pixel_weight(run, spec, request, target.float() / 255, window),
            coarse=to_uint8(inside.cut(request.image)).contiguous() if known else None,
            coarse_weight=self.options.coarse_weight if known else 0.0,
            reduction=request.reduction,
            provenance={
                "event": event,
                "made_after_step": run.step,
                "view": request.view.name,
                "kind": spec.kind,
                "scale": a,
                "source": "photo" if request.photo else "render",
                "seed": request.seed,
                "strength": request.strength,
                **shares,
                "sha256": hashlib.sha256(kept.numpy().tobytes()).hexdigest(),
            },
        )

    def coarser_view(self, run: Run, event: int, parent: int, factor: int) -> PseudoView:
        """The training camera at a fraction of its size, without what fills no block at the right and below."""
        run.refuse_if_stopping()
        view = run.train_views[parent]
        width, height = view.camera.size
        whole = Window(left=0, top=0, width=width, height=height)
        _, camera, covered = reduced(whole, view.camera, factor)
        photo = self.options.base_source == "photo"
        picture = photographed(run, view, whole, view.camera) if photo else render(run, view.camera).image
        reduction = run.scene.reduction if photo else Reduction()  # Mipmap-GS: bilinear, which is the mean of four
        target = to_uint8(reduction.reduce(Window(0, 0, *covered.size).cut(picture), factor))
        return PseudoView(
            camera=camera,
            target=target,
            parent=parent,
            provenance={
                "event": event,
                "made_after_step": run.step,
                "view": view.name,
                "kind": "coarser",
                "scale": 1 / factor,
                "source": "photo" if photo else "render",
                "sha256": hashlib.sha256(target.numpy().tobytes()).hexdigest(),
            },
        )

    def pixel_weight(
        self, run: Run, spec: PseudoViewSpec, request: Request, result: Float[Tensor, "3 H W"], window: Window
    ) -> UInt8[Tensor, "h w"] | None:
        """How much each pixel of a window of the result counts; None where all count whole."""
        options, pixel_weight = self.options, torch.ones(window.height, window.width)
        weights = WEIGHT_MAPS[options.weight_map]
        if weights is not None:
            photographs = [view.camera for view in run.train_views]
            drawn = partial(splats_for, run)
            pixel_weight = pixel_weight * weights(drawn, spec.camera, photographs, spec.parent, run.raster).cpu()
        if options.gate > 0 and request.photo and spec.scale > 1:
            agreed = agreeing(result, request.image, spec.scale, request.reduction, options.gate)
            pixel_weight = pixel_weight * window.cut(agreed[None])[0]
        return None if bool((pixel_weight == 1).all()) else in_bytes(pixel_weight)

    def show(self, folder: Path, spec: PseudoViewSpec, request: Request, view: PseudoView) -> None:
        """Keeps a picture to be looked at: what was redrawn, enlarged, the result, and their difference."""
        given = as_blocks(spec.inside.cut(request.image), spec.scale)
        result = view.target.float() / 255
        difference = (0.5 + 4 * (result - given)).clamp(0, 1)
        folder.mkdir(parents=True, exist_ok=True)
        write_image(folder / picture_name(self.name, view), torch.cat([given, result, difference], 2))


def photographed(run: Run, view: View, window: Window, camera: Camera) -> Float[Tensor, "3 h w"]:
    """A window of a photograph, `camera` its own; where that does not count the render stands in."""
    photo, counted = window.cut(view.image()), view.counted()
    return photo if counted is None else where_counted(photo, render(run, camera).image.cpu(), counted[window.pixels])
