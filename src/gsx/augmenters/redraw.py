"""Pictures of pseudo views: requested, redrawn, checked, weighed (the paper, Practical Implementation)."""

import hashlib
import logging
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from gsx.augmenters.consistency import consistent_pixels, exactly_consistent
from gsx.augmenters.pixel_weights import agreeing, in_bytes
from gsx.augmenters.planner import PseudoViewSpec, reduced
from gsx.augmenters.pseudo_options import WEIGHT_MAPS, PseudoOptions
from gsx.augmenters.timing import ramp
from gsx.core.data.images import write_image
from gsx.core.data.reduction import Reduction, as_blocks, projected
from gsx.core.data.resize import to_uint8
from gsx.core.data.window import Window
from gsx.core.errors import TrainingError
from gsx.core.shapes import Float, UInt8
from gsx.core.training.pseudo_views import PseudoView, picture_name
from gsx.core.training.regenerator import Regenerator, Request, colour_matched, strayed, unusable
from gsx.core.training.render import render, splats_for
from gsx.core.training.run import Run
from gsx.core.training.schedule import Schedule

logger = logging.getLogger(__name__)

BATCH = 64
"""Pictures redrawn between two lines of progress."""
MOST_DROPPED = 0.5
"""An event that loses more than this share of its pictures at one scale is an error."""
SHOWN = 3
"""Training views of an event whose pictures are kept to be looked at."""


@dataclass(frozen=True, eq=False, kw_only=True)
class RedrawnView:
    """What has become of a planned pseudo view."""

    scale: int
    view: PseudoView | None
    """None: its picture is dropped."""
    problem: str
    """Why it is dropped."""
    warnings: dict[str, str]
    """By check, what is told of a picture that is kept."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Redrawer:
    """Asks a regenerator for the pictures of pseudo views, and keeps those that stand up to the checks."""

    name: str
    options: PseudoOptions
    regenerator: Regenerator
    schedule: Schedule

    def all_drawn(self, run: Run, event: int, specs: Sequence[PseudoViewSpec]) -> list[RedrawnView]:
        """What has become of each planned view, told batch by batch."""
        drawn: list[RedrawnView] = []
        shown = sorted({spec.parent for spec in specs})[:SHOWN]
        for first in range(0, len(specs), BATCH):
            drawn += self.drawn(run, event, specs[first : first + BATCH], shown)
            logger.info("%s at step %d: %d of %d pictures", self.name, event, len(drawn), len(specs))
        return drawn

    def drawn(self, run: Run, event: int, specs: Sequence[PseudoViewSpec], shown: Sequence[int]) -> list[RedrawnView]:
        """What becomes of each planned view; pictures of the training views `shown` are kept to be looked at."""
        regenerator = self.regenerator
        requests = [self.request(run, event, spec) for spec in specs]
        samples = [regenerator.regenerate([again(r, n) for r in requests]) for n in range(self.options.samples)]
        out: list[RedrawnView] = []
        for spec, request, *results in zip(specs, requests, *samples, strict=True):
            result = torch.stack([result.detach().cpu().float() for result in results]).mean(0)
            one = self.checked(run, event, spec, request, result)
            if one.view is not None and spec.parent in shown:
                self.show(run.folder / "pseudo", spec, request, one.view)
            out.append(one)
        return out

    def checked(self, run: Run, event: int, spec: PseudoViewSpec, request: Request, result: Tensor) -> RedrawnView:
        """The pseudo view of a result, if it may be used."""
        problem, found = unusable(request, result), dict[str, str]()
        if not problem:
            result = colour_matched(request, result)
            if self.options.project == "exact" and request.scale > 1:
                result = projected(result, request.image.cpu(), request.scale, request.reduction)
            found = strayed(request, result, self.options.checks)
            dropped = [told for check, told in found.items() if getattr(self.options.checks, check).action == "drop"]
            problem = "; ".join(dropped)
        named = problem and f"{request.view.name}: {problem}"
        view = None if problem else self.view(run, event, spec, request, result)
        warnings = {} if problem else {check: f"{request.view.name}: {told}" for check, told in found.items()}
        return RedrawnView(scale=spec.scale, view=view, problem=named, warnings=warnings)

    def request(self, run: Run, event: int, spec: PseudoViewSpec) -> Request:
        """What the regenerator is asked for."""
        view = run.scene.train[spec.parent]
        image = render(run, spec.seen).image if spec.outer is None else spec.outer.cut(view.image())
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
            strongest=self.options.strength[0],
            prompt=self.options.prompt.replace("{scene}", run.scene.name),
            step=event,
        )

    @property
    def remedy(self) -> str:
        """What else helps where a regenerator strays too far."""
        enlarging = max(self.options.scales) > 1 and self.options.project == "none"
        return f", or augmenter.{self.name}.project=exact" if enlarging else ""

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
        view = run.scene.train[parent]
        width, height = view.camera.size
        whole = Window(left=0, top=0, width=width, height=height)
        _, camera, covered = reduced(whole, view.camera, factor)
        photo = self.options.base_source == "photo"
        picture = view.image() if photo else render(run, view.camera).image
        reduction = run.scene.reduction if photo else Reduction()  # Mipmap-GS: bilinear, which is the mean of four
        target = to_uint8(reduction.reduce(Window(0, 0, *covered.size).cut(picture), factor))
        return PseudoView(
            camera=camera,
            target=target,
            parent=parent,
            provenance={
                "event": event,
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
            photographs = [view.camera for view in run.scene.train]
            pixel_weight = (
                pixel_weight * weights(splats_for(run, spec.camera), spec.camera, photographs, run.raster).cpu()
            )
        if options.gate > 0 and request.photo and spec.scale > 1:
            agreed = agreeing(result, request.image, spec.scale, request.reduction, options.gate)
            pixel_weight = pixel_weight * window.cut(agreed[None])[0]
        return None if bool((pixel_weight == 1).all()) else in_bytes(pixel_weight)

    def show(self, folder: Path, spec: PseudoViewSpec, request: Request, view: PseudoView) -> None:
        """Keep a picture to be looked at: what was redrawn, enlarged, the result, and their difference."""
        given = as_blocks(spec.inside.cut(request.image), spec.scale)
        result = view.target.float() / 255
        difference = (0.5 + 4 * (result - given)).clamp(0, 1)
        folder.mkdir(parents=True, exist_ok=True)
        write_image(folder / picture_name(self.name, view), torch.cat([given, result, difference], 2))

    def judged(self, event: int, drawn: Sequence[RedrawnView]) -> dict[str, Any]:
        """Pictures asked for, dropped, and by check warned of, by scale; said in the log where there are any.

        Raises:
            TrainingError: more than half of the pictures of a scale could not be used.
        """
        name = self.name
        asked, dropped = by_scale(drawn), by_scale([one for one in drawn if one.view is None])
        warned: dict[str, dict[str, int]] = {}
        for scale, count in dropped.items():
            reason = next(one.problem for one in drawn if one.problem and str(one.scale) == scale)
            logger.warning("%s: %d of %d x%s pictures dropped: %s", name, count, asked[scale], scale, reason)
            if count > MOST_DROPPED * asked[scale]:
                raise TrainingError(
                    f"augmenter {name} lost {count} of {asked[scale]} pictures at x{scale}, step {event}: {reason}; "
                    f"choose another regenerator/{self.options.role}, or loosen augmenter.{name}.checks{self.remedy}"
                )
        for check in dict.fromkeys(check for one in drawn for check in one.warnings):
            strays = [one for one in drawn if check in one.warnings]
            warned[check] = by_scale(strays)
            first = strays[0].warnings[check]
            logger.warning("%s: %d of %d pictures kept although %s", name, len(strays), len(drawn), first)
        return {"asked": asked, "dropped": dropped, "warned": warned}


def again(request: Request, number: int) -> Request:
    """The request for its n-th sample."""
    return replace(request, seed=request.seed + number)


def by_scale(drawn: Sequence[RedrawnView]) -> dict[str, int]:
    """How many there are at each scale; keys as JSON has them."""
    counts = Counter(one.scale for one in drawn)
    return {str(scale): counts[scale] for scale in sorted(counts)}
