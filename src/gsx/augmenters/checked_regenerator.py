"""Regenerators as augmenters use them: results are corrected, checked and counted."""

import logging
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import torch
from torch import Tensor

from gsx.augmenters.checks import Checks, defect, match_colour, violations
from gsx.core.data.reduction import projected
from gsx.core.data.scene import View
from gsx.core.errors import TrainingError
from gsx.core.shapes import Float
from gsx.core.training.augmenter import AugmenterContext
from gsx.core.training.regenerator import Checkable, Regenerator, RegeneratorContext, Request
from gsx.core.training.render import render
from gsx.core.training.run import Run

logger = logging.getLogger(__name__)

MOST_DROPPED = 0.5
"""Losing more than this share of the pictures at one scale is an error."""
FEWEST = 8
"""Pictures that are awaited before that is an error, where they are requested a few at a time."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Redrawn:
    """What became of a request."""

    scale: int
    image: Float[Tensor, "3 H W"] | None
    """Values may lie beyond [0, 1]; None: it is dropped."""
    problem: str = ""
    """Why it is dropped."""
    warnings: dict[str, str] = field(default_factory=dict)
    """Violations of a picture that is kept, by check."""


@dataclass(eq=False, kw_only=True)
class Tally:
    """Counts of the pictures that an augmenter requested and lost."""

    name: str
    """Of the augmenter."""
    remedies: list[str] = field(default_factory=list)
    """What helps where too many are lost."""
    pending: list[Redrawn] = field(default_factory=list)
    """Requests that are in no account yet; without their pictures."""
    latest: dict[str, Any] = field(default_factory=dict)
    """The last account."""
    requested: Counter[str] = field(default_factory=Counter)
    """All requests so far, by scale."""
    dropped: Counter[str] = field(default_factory=Counter)
    """Those of them that were dropped."""

    def recall(self, accounts: Sequence[Mapping[str, Any]]) -> None:
        """Counts what a run requested before it was interrupted."""
        for account in accounts:
            self.requested.update(account["asked"])
            self.dropped.update(account["dropped"])

    def account(self, event: int, whole: bool = True) -> dict[str, Any]:
        """Counts pending requests, dropped ones and warnings by scale, and logs the losses.

        Args:
            whole: they are all of an event; otherwise losses are compared with those of the run.

        Raises:
            TrainingError: more than half of the pictures of a scale could not be used.
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
        """Counts pictures that are kept although a check warns of them, by check and scale."""
        counts: dict[str, dict[str, int]] = {}
        for check in dict.fromkeys(check for one in redrawn for check in one.warnings):
            strays = [one for one in redrawn if check in one.warnings]
            counts[check] = by_scale(strays)
            first = strays[0].warnings[check]
            logger.warning("%s: %d of %d pictures kept although %s", self.name, len(strays), len(redrawn), first)
        return counts

    def account_at(self, step: int) -> dict[str, Any]:
        """Returns the account of the pictures requested at a step; empty where there were none.

        Raises:
            TrainingError: more than half of the pictures of a scale could not be used, over the run.
        """
        if self.pending:
            self.account(step - 1, whole=False)
        return self.latest if self.latest.get("event") == step - 1 else {}


def by_scale(redrawn: Sequence[Redrawn]) -> dict[str, int]:
    """Counts requests at each scale; keys as JSON has them."""
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
        """Wraps the regenerator of a role; checks: the augmenter's, None: those of the role."""
        limits = f"checks.{role}" if checks is None else f"augmenter.{context.name}.checks"
        tally = Tally(name=context.name, remedies=[f"choose another regenerator/{role}", f"loosen {limits}"])
        return cls(inner=context.regenerator(role), checks=checks or context.checks[role], tally=tally)

    def refuse(self, views: Sequence[View], scales: Sequence[int], moved: bool) -> None:
        """Raises ConfigError or InputError before training if the regenerator cannot redraw these (`Checkable`)."""
        if isinstance(self.inner, Checkable):
            self.inner.check(views, scales, moved)

    def prepare(self, run: Run, context: AugmenterContext) -> dict[str, float]:
        """Lets the regenerator learn from training views and the model at every event; returns figures for the log."""
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
            samples: results whose mean counts.
            project: whether enlarged pictures are moved to the nearest one that reduces to the request's.
        """
        results = [self.regenerate([copy_for_sample(one, n) for one in requests]) for n in range(samples)]
        redrawn = [self.checked(request, of_one, project) for request, *of_one in zip(requests, *results, strict=True)]
        self.tally.pending += [replace(one, image=None) for one in redrawn]
        return redrawn

    def regenerate(self, requests: Sequence[Request]) -> list[Tensor]:
        """Calls the regenerator.

        Raises:
            TrainingError: it does not return a picture for each request.
        """
        returned: Any = self.inner.regenerate(requests)
        message = f"{type(self.inner).__name__}.regenerate was asked for {len(requests)} pictures and returned"
        remedy = "it is to return a tensor [3, h, w] for each, in order"
        if not isinstance(returned, Iterable):
            raise TrainingError(f"{message} {type(returned).__name__}: {remedy}")
        pictures = list(returned)
        if other := [type(one).__name__ for one in pictures if not isinstance(one, Tensor)]:
            raise TrainingError(f"{message} {other[0]} among them: {remedy}")
        if len(pictures) != len(requests):
            raise TrainingError(f"{message} {len(pictures)}: {remedy}")
        return pictures

    def checked(self, request: Request, results: Sequence[Tensor], project: bool) -> Redrawn:
        """Takes the mean of the results, corrects its colour, and drops it if a check says so."""
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


def copy_for_sample(request: Request, sample: int) -> Request:
    """Copies a request with the seed of a sample; a regenerator may write into its picture."""
    return replace(request, seed=request.seed + sample, image=request.image.clone())


class Redrawing:
    """Base of augmenters whose pictures come from a checked regenerator: accounts for them (`Accounting`)."""

    regenerator: CheckedRegenerator

    def account(self, step: int) -> dict[str, Any]:
        """Reports the pictures requested at a step."""
        return self.regenerator.tally.account_at(step)

    def recall(self, accounts: Sequence[Mapping[str, Any]]) -> None:
        """Counts what the run requested before it was interrupted."""
        self.regenerator.tally.recall(accounts)
