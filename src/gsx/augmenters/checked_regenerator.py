"""Regenerators of augmenters: results are corrected, checked and counted.

Trust in an upscaler is measured on the scene's own photos, reduced and enlarged again. Learning from these is the idea
of ZSSR (Shocher et al. 2018); here they only measure.
"""

import logging
import math
import statistics
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import torch
from torch import Tensor

from gsx.augmenters.checks import Checks, defect, match_colour, violations
from gsx.core.data.reduction import projected
from gsx.core.data.resize import resize, to_uint8
from gsx.core.data.scene import View
from gsx.core.data.window import Window
from gsx.core.errors import TrainingError
from gsx.core.quality.metrics import psnr
from gsx.core.shapes import Float
from gsx.core.training.augmenter import AugmenterContext
from gsx.core.training.regenerator import Checkable, Regenerator, RegeneratorContext, Request
from gsx.core.training.render import render
from gsx.core.training.run import Run

logger = logging.getLogger(__name__)

MOST_DROPPED = 0.5
"""Largest share of dropped pictures at one scale."""
FEWEST = 8
"""Least pictures before that share is an error, for requests of a few pictures at a time."""
PHOTOS = 8
"""Most photos that are enlarged for the measurement."""
MOST_GAIN = 100.0
"""Bound of a single gain, dB: an oracle makes no error at all."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Redrawn:
    """Result of a request."""

    scale: int
    image: Float[Tensor, "3 H W"] | None
    """Values may lie beyond [0, 1]; None: dropped."""
    problem: str = ""
    """Reason for dropping it."""
    warnings: dict[str, str] = field(default_factory=dict)
    """Violations of a kept picture, by check."""


@dataclass(eq=False, kw_only=True)
class Tally:
    """Counts of an augmenter's requested and dropped pictures."""

    name: str
    """Name of the augmenter."""
    remedies: list[str] = field(default_factory=list)
    """Remedies for too many dropped pictures."""
    pending: list[Redrawn] = field(default_factory=list)
    """Results that no account includes yet, without their pictures."""
    latest: dict[str, Any] = field(default_factory=dict)
    """The last account."""
    requested: Counter[str] = field(default_factory=Counter)
    """All requests so far, by scale."""
    dropped: Counter[str] = field(default_factory=Counter)
    """Dropped pictures so far, by scale."""

    def recall(self, accounts: Sequence[Mapping[str, Any]]) -> None:
        """Adds the accounts of a run before its interruption."""
        for account in accounts:
            self.requested.update(account["asked"])
            self.dropped.update(account["dropped"])

    def account(self, event: int, whole: bool = True) -> dict[str, Any]:
        """Counts pending requests, dropped ones and warnings by scale, and logs the losses.

        Args:
            whole: they are all of an event; otherwise the losses of the run count.

        Raises:
            TrainingError: more than half of the pictures of a scale were dropped.
        """
        redrawn, self.pending = self.pending, []
        requested, dropped = by_scale(redrawn), by_scale([one for one in redrawn if one.problem])
        self.requested.update(requested)
        self.dropped.update(dropped)
        for scale, count in dropped.items():
            reason = next(one.problem for one in redrawn if one.problem and str(one.scale) == scale)
            logger.warning("%s: %d of %d x%s pictures dropped: %s", self.name, count, requested[scale], scale, reason)
            lost, total = (count, requested[scale]) if whole else (self.dropped[scale], self.requested[scale])
            if lost > MOST_DROPPED * total and (whole or total >= FEWEST):
                raise TrainingError(
                    f"augmenter {self.name} lost {lost} of {total} pictures at x{scale}, step {event}: {reason}; "
                    f"{', or '.join(self.remedies)}"
                )
        self.latest = {"event": event, "asked": requested, "dropped": dropped, "warned": self.warned(redrawn)}
        return self.latest

    def warned(self, redrawn: Sequence[Redrawn]) -> dict[str, dict[str, int]]:
        """Counts kept pictures with warnings, by check and scale."""
        counts: dict[str, dict[str, int]] = {}
        for check in dict.fromkeys(check for one in redrawn for check in one.warnings):
            strays = [one for one in redrawn if check in one.warnings]
            counts[check] = by_scale(strays)
            first = strays[0].warnings[check]
            logger.warning("%s: %d of %d pictures kept although %s", self.name, len(strays), len(redrawn), first)
        return counts

    def account_at(self, step: int) -> dict[str, Any]:
        """Returns the account of the pictures requested at a step, empty without any; errors as `account`."""
        if self.pending:
            self.account(step - 1, whole=False)
        return self.latest if self.latest.get("event") == step - 1 else {}


def by_scale(redrawn: Sequence[Redrawn]) -> dict[str, int]:
    """Counts requests by scale; keys are strings, as in JSON."""
    counts = Counter(one.scale for one in redrawn)
    return {str(scale): counts[scale] for scale in sorted(counts)}


@dataclass(frozen=True, eq=False, kw_only=True)
class CheckedRegenerator:
    """A regenerator, the checks of its pictures, and their tally."""

    inner: Regenerator
    checks: Checks
    tally: Tally

    @classmethod
    def of_role(cls, context: AugmenterContext, role: str, checks: Checks | None = None) -> "CheckedRegenerator":
        """Wraps the regenerator of a role; checks: None for those of the role."""
        limits = f"checks.{role}" if checks is None else f"augmenter.{context.name}.checks"
        tally = Tally(name=context.name, remedies=[f"choose another regenerator/{role}", f"loosen {limits}"])
        return cls(inner=context.regenerator(role), checks=checks or context.checks[role], tally=tally)

    def refuse(self, views: Sequence[View], scales: Sequence[int], moved: bool) -> None:
        """Raises ConfigError or InputError if the regenerator cannot redraw these views (`Checkable`)."""
        if isinstance(self.inner, Checkable):
            self.inner.check(views, scales, moved)

    def prepare(self, run: Run, context: AugmenterContext) -> dict[str, float]:
        """Prepares the regenerator for an event with training views and the model; returns figures for the log."""
        return self.inner.prepare(
            RegeneratorContext(
                views=run.train_views,
                reduction=run.scene.reduction,
                render=lambda camera: render(run, camera).image,
                held_out=lambda share: context.held_out(run, share, context.seed),
                step=run.step,
                seed=context.seed,
                device=run.device,
                folder=run.folder / "regenerators",
                raise_if_stopping=run.raise_if_stopping,
            )
        )

    def redraw(self, requests: Sequence[Request], *, samples: int = 1, project: bool = False) -> list[Redrawn]:
        """Redraws, corrects and checks pictures, in order.

        Args:
            samples: number of results to average.
            project: move enlarged pictures to the nearest one that reduces to the request's.
        """
        results = []
        for sample in range(samples):  # copies, as a regenerator may write into its pictures
            copies = [replace(one, seed=one.seed + sample, image=one.image.clone()) for one in requests]
            results.append(self.regenerate(copies))
        redrawn = [self.checked(request, of_one, project) for request, *of_one in zip(requests, *results, strict=True)]
        self.tally.pending += [replace(one, image=None) for one in redrawn]
        return redrawn

    def regenerate(self, requests: Sequence[Request]) -> list[Tensor]:
        """Calls the regenerator; TrainingError: it does not return a picture for each request."""
        returned: Any = self.inner.regenerate(requests)
        message = f"{type(self.inner).__name__}.regenerate got {len(requests)} requests and returned"
        remedy = "return a tensor [3, h, w] for each, in order"
        if not isinstance(returned, Iterable):
            raise TrainingError(f"{message} {type(returned).__name__}: {remedy}")
        pictures = list(returned)
        if other := [type(one).__name__ for one in pictures if not isinstance(one, Tensor)]:
            raise TrainingError(f"{message} {other[0]} among them: {remedy}")
        if len(pictures) != len(requests):
            raise TrainingError(f"{message} {len(pictures)}: {remedy}")
        return pictures

    def checked(self, request: Request, results: Sequence[Tensor], project: bool) -> Redrawn:
        """Averages the results, corrects the colour, and drops the picture if a check fails."""
        name, scale = request.view.name, request.scale
        if defects := [text for one in results if (text := defect(request, one))]:
            return Redrawn(scale=scale, image=None, problem=f"{name}: {defects[0]}")
        result = torch.stack([one.detach().cpu().float() for one in results]).mean(0)
        result = match_colour(request, result)
        if project and scale > 1:
            result = projected(result, request.image.cpu(), scale, request.reduction)
        beyond = violations(request, result, self.checks)
        if dropped := [text for check, text in beyond.items() if getattr(self.checks, check).action == "drop"]:
            return Redrawn(scale=scale, image=None, problem=f"{name}: {'; '.join(dropped)}")
        return Redrawn(scale=scale, image=result, warnings={check: f"{name}: {text}" for check, text in beyond.items()})


class Redrawing:
    """Base of augmenters with a checked regenerator: reports its pictures (`Accounting`)."""

    regenerator: CheckedRegenerator

    def account(self, step: int) -> dict[str, Any]:
        """Reports the pictures requested at a step."""
        return self.regenerator.tally.account_at(step)

    def recall(self, accounts: Sequence[Mapping[str, Any]]) -> None:
        """Adds the accounts of the run before its interruption."""
        self.regenerator.tally.recall(accounts)


def gain_over_filter(run: Run, regenerator: CheckedRegenerator, scale: int, event: int) -> float:
    """Returns by how much the regenerator enlarges reduced photos better than Lanczos' filter: mean gain in PSNR, dB.

    Raises:
        TrainingError: a result is no picture of the right size.
    """
    requests = [request_of(run, number, scale, event) for number in evenly(run.train_views)]
    results = regenerator.regenerate(requests)
    return statistics.fmean(map(gain, requests, results))


def evenly(views: Sequence[View]) -> list[int]:
    """Returns the numbers of up to PHOTOS views, evenly spread."""
    count = min(PHOTOS, len(views))
    return [number * len(views) // count for number in range(count)]


def request_of(run: Run, number: int, scale: int, event: int) -> Request:
    """Returns the request to enlarge a reduced photo; sides that `scale` does not divide lose their rest."""
    view = run.train_views[number]
    width, height = (side // scale * scale for side in view.camera.size)
    window = Window(0, 0, width, height)
    low = run.scene.reduction.reduce(window.cut(view.image()), scale)
    camera = window.of(view.camera).resize(width // scale, height // scale)
    return Request(
        image=to_uint8(low).float() / 255, scale=scale, reduction=run.scene.reduction, camera=camera, view=view,
        number=number, photo=False, seed=0, strength=1.0, strongest=1.0, prompt="", step=event,
    )  # fmt: skip


def gain(request: Request, result: Float[Tensor, "3 H W"]) -> float:
    """Returns the gain in PSNR of a result over Lanczos' filter, against the photo that was reduced, dB."""
    height, width = request.result_size
    if tuple(result.shape) != (3, height, width):
        raise TrainingError(f"an enlarged photo is {tuple(result.shape)} and should be {(3, height, width)}")
    photo = Window(0, 0, width, height).cut(request.view.image())
    by_filter = resize(to_uint8(request.image), width, height, "lanczos").float() / 255
    better = psnr(result.cpu().float().clamp(0, 1), photo) - psnr(by_filter, photo)
    return max(-MOST_GAIN, min(MOST_GAIN, better)) if not math.isnan(better) else 0.0
