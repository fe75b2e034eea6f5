"""Regenerators as augmenters get them: whatever they make is put right, checked, counted and told."""

import logging
import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Annotated, Any, Protocol, runtime_checkable

import torch
from torch import Tensor

from gsx.core.data.reduction import projected
from gsx.core.data.scene import View
from gsx.core.errors import TrainingError
from gsx.core.quality.metrics import psnr
from gsx.core.ranges import Range
from gsx.core.shapes import Float
from gsx.core.training.regenerator import Refusing, Regenerator, RegeneratorContext, Request

logger = logging.getLogger(__name__)

MOST_DROPPED = 0.5
"""Losing more than this share of the pictures at one scale is an error."""
FEWEST = 8
"""Of pictures that are asked for now and then, at least so many are awaited before that is said."""
LARGEST_DRIFT = 2 / 255
"""Mean colours that differ by more are put right."""
MOST_CORRECTIONS = 4
"""Of a mean colour."""
LEAST_SLOPE = 1e-3
"""Pictures with gentler slopes than this in some direction, display values per px, show no displacement in it."""
ACTIONS = ("drop", "warn", "off")


@dataclass(frozen=True, kw_only=True)
class Check:
    """A limit, and what happens to a picture beyond it."""

    limit: Annotated[float, Range(0, 1e6)]
    action: str
    """drop; warn: it is kept, counted and told; off: nothing is looked at."""

    def __post_init__(self) -> None:
        if self.action not in ACTIONS:
            raise ValueError(f"the action of a check is '{self.action}'; choose drop, warn or off (in YAML 'off')")

    @property
    def active(self) -> bool:
        """Whether anything happens beyond the limit."""
        return self.action != "off"


@dataclass(frozen=True, kw_only=True)
class Checks:
    """What a redrawn picture has to keep of what it was made from; values in conf/checks."""

    colour: Check
    """Largest change of the mean colour, 8-bit levels, after `colour_matched`."""
    agreement: Check
    """Least PSNR between an enlarged picture, reduced again, and its input, dB."""
    displacement: Check
    """Largest displacement, px of the input."""


@runtime_checkable
class WithChecks(Protocol):
    """Options of an augmenter that has checks of its own; the others get those of the regenerator's role."""

    @property
    def checks(self) -> Checks:
        """What a redrawn picture has to keep."""
        ...


@dataclass(frozen=True, eq=False, kw_only=True)
class Redrawn:
    """What has become of a request."""

    scale: int
    image: Float[Tensor, "3 H W"] | None
    """Values may lie beyond [0, 1]; None: it is dropped."""
    problem: str = ""
    """Why it is dropped."""
    warnings: dict[str, str] = field(default_factory=dict)
    """By check, what is told of a picture that is kept."""


@dataclass(eq=False, kw_only=True)
class Tally:
    """What has become of the pictures that an augmenter asked for."""

    name: str
    """Of the augmenter."""
    remedies: list[str] = field(default_factory=list)
    """What helps where too many are lost."""
    pending: list[Redrawn] = field(default_factory=list)
    """Those that no account has been given of; without their pictures."""
    latest: dict[str, Any] = field(default_factory=dict)
    """The last account."""
    asked: Counter[str] = field(default_factory=Counter)
    """All so far, by scale."""
    dropped: Counter[str] = field(default_factory=Counter)
    """Of these."""

    def recall(self, lines: Sequence[Mapping[str, Any]]) -> None:
        """Count what a run asked for before it was interrupted, from lines of metrics.jsonl."""
        for account in (line.get("pseudo", {}).get(self.name) for line in lines):
            if account:
                self.asked.update(account["asked"])
                self.dropped.update(account["dropped"])

    def account(self, event: int, whole: bool = True) -> dict[str, Any]:
        """Pictures asked for, dropped, and by check warned of, by scale; said in the log where there are any.

        `whole`: they are all of an event; otherwise losses are judged over the run.

        Raises:
            TrainingError: more than half of the pictures of a scale could not be used.
        """
        drawn, self.pending = self.pending, []
        asked, dropped = by_scale(drawn), by_scale([one for one in drawn if one.problem])
        self.asked.update(asked)
        self.dropped.update(dropped)
        for scale, count in dropped.items():
            reason = next(one.problem for one in drawn if one.problem and str(one.scale) == scale)
            logger.warning("%s: %d of %d x%s pictures dropped: %s", self.name, count, asked[scale], scale, reason)
            lost, of = (count, asked[scale]) if whole else (self.dropped[scale], self.asked[scale])
            if lost > MOST_DROPPED * of and (whole or of >= FEWEST):
                raise TrainingError(
                    f"augmenter {self.name} lost {lost} of {of} pictures at x{scale}, step {event}: {reason}; "
                    f"{', or '.join(self.remedies)}"
                )
        self.latest = {"event": event, "asked": asked, "dropped": dropped, "warned": self.warned(drawn)}
        return self.latest

    def warned(self, drawn: Sequence[Redrawn]) -> dict[str, dict[str, int]]:
        """Pictures that are kept although a check warns of them, by check and scale."""
        counts: dict[str, dict[str, int]] = {}
        for check in dict.fromkeys(check for one in drawn for check in one.warnings):
            strays = [one for one in drawn if check in one.warnings]
            counts[check] = by_scale(strays)
            first = strays[0].warnings[check]
            logger.warning("%s: %d of %d pictures kept although %s", self.name, len(strays), len(drawn), first)
        return counts

    def account_at(self, step: int) -> dict[str, Any]:
        """The account of the pictures asked for at this step; empty where there were none.

        Raises:
            TrainingError: more than half of the pictures of a scale could not be used, over the run.
        """
        if self.pending:
            self.account(step - 1, whole=False)
        return self.latest if self.latest.get("event") == step - 1 else {}


def added_accounts(accounts: Sequence[dict[str, dict[str, Any]]]) -> dict[str, dict[str, Any]]:
    """The accounts of several processes as those of one, by augmenter."""
    out = {}
    for name in dict.fromkeys(name for by_name in accounts for name in by_name):
        own = [by_name[name] for by_name in accounts if name in by_name]
        checks = dict.fromkeys(check for account in own for check in account["warned"])
        out[name] = {
            "event": own[0]["event"],
            "asked": added([account["asked"] for account in own]),
            "dropped": added([account["dropped"] for account in own]),
            "warned": {check: added([account["warned"].get(check, {}) for account in own]) for check in checks},
        }
    return out


def added(counts: Iterable[Mapping[str, int]]) -> dict[str, int]:
    """Sums by scale."""
    total: Counter[str] = Counter()
    for count in counts:
        total.update(count)
    return dict(sorted(total.items(), key=lambda item: float(item[0])))


def by_scale(drawn: Sequence[Redrawn]) -> dict[str, int]:
    """How many there are at each scale; keys as JSON has them."""
    counts = Counter(one.scale for one in drawn)
    return {str(scale): counts[scale] for scale in sorted(counts)}


@dataclass(frozen=True, eq=False, kw_only=True)
class CheckedRegenerator:
    """A regenerator, the checks of its pictures, and their tally."""

    inner: Regenerator
    checks: Checks
    tally: Tally

    def refuse(self, views: Sequence[View], scales: Sequence[int], moved: bool) -> None:
        """Before training: raise ConfigError or InputError if it can say already that it will not do (`Refusing`)."""
        if isinstance(self.inner, Refusing):
            self.inner.check(views, scales, moved)

    def prepare(self, context: RegeneratorContext) -> dict[str, float]:
        """Learn from the scene, if there is anything to learn; figures for the log. To be called at every event."""
        return self.inner.prepare(context)

    def redraw(self, requests: Sequence[Request], *, samples: int = 1, project: bool = False) -> list[Redrawn]:
        """What becomes of each request, in order.

        `samples`: of each the mean of so many results counts. `project`: enlarged pictures are moved to the nearest
        one that reduces to the request's.
        """
        results = [self.results([own_copy(one, n) for one in requests]) for n in range(samples)]
        drawn = []
        for request, *of_one in zip(requests, *results, strict=True):
            drawn.append(self.checked(request, of_one, project))
        self.tally.pending += [replace(one, image=None) for one in drawn]
        return drawn

    def results(self, requests: Sequence[Request]) -> list[Tensor]:
        """What the regenerator makes of requests.

        Raises:
            TrainingError: it is not a picture for each.
        """
        found: Any = self.inner.regenerate(requests)
        told = f"{type(self.inner).__name__}.regenerate was asked for {len(requests)} pictures and returned"
        remedy = "it is to return a tensor [3, h, w] for each, in order"
        if not isinstance(found, Iterable):
            raise TrainingError(f"{told} {type(found).__name__}: {remedy}")
        pictures = list(found)
        if other := [type(one).__name__ for one in pictures if not isinstance(one, Tensor)]:
            raise TrainingError(f"{told} {other[0]} among them: {remedy}")
        if len(pictures) != len(requests):
            raise TrainingError(f"{told} {len(pictures)}: {remedy}")
        return pictures

    def checked(self, request: Request, results: Sequence[Tensor], project: bool) -> Redrawn:
        """The mean of the results, put right, if it may be used."""
        name, problems = request.view.name, [told for one in results if (told := unusable(request, one))]
        if problems:
            return Redrawn(scale=request.scale, image=None, problem=f"{name}: {problems[0]}")
        result = torch.stack([one.detach().cpu().float() for one in results]).mean(0)
        result = colour_matched(request, result)
        if project and request.scale > 1:
            result = projected(result, request.image.cpu(), request.scale, request.reduction)
        found = strayed(request, result, self.checks)
        dropped = [told for check, told in found.items() if getattr(self.checks, check).action == "drop"]
        if dropped:
            return Redrawn(scale=request.scale, image=None, problem=f"{name}: {'; '.join(dropped)}")
        return Redrawn(
            scale=request.scale, image=result, warnings={check: f"{name}: {told}" for check, told in found.items()}
        )


def own_copy(request: Request, sample: int) -> Request:
    """A request by the seed of a sample, with a picture that a regenerator may write into."""
    return replace(request, seed=request.seed + sample, image=request.image.clone())


def colour_matched(request: Request, result: Float[Tensor, "3 H W"]) -> Float[Tensor, "3 H W"]:
    """The result, its mean colour put right where it is more than LARGEST_DRIFT off at the resolution of its input:
    where light is reduced a finer picture has another mean, and one correction is not enough."""
    for _ in range(MOST_CORRECTIONS):
        low, given = both_reduced(request, result)
        drift = low.mean((1, 2)) - given.mean((1, 2))
        if float(drift.abs().max()) <= LARGEST_DRIFT:
            break
        result = result - drift[:, None, None]
    return result


def both_reduced(
    request: Request, result: Float[Tensor, "3 H W"]
) -> tuple[Float[Tensor, "3 h w"], Float[Tensor, "3 h w"]]:
    """(a result as coarse as its input, the input), without the rim of the window, which was reduced from pixels beyond
    it."""
    reduction = request.reduction
    return reduction.inner(reduction.reduce(result, request.scale)), reduction.inner(request.image.cpu())


def unusable(request: Request, result: Tensor) -> str:
    """Why a result is no picture of what was asked for; empty for one that is."""
    expected = (3, *request.result_size)
    if tuple(result.shape) != expected:
        return f"it is {tuple(result.shape)} and should be {expected}"
    if not result.is_floating_point():
        return f"its values are {str(result.dtype).removeprefix('torch.')} and should be display values in [0, 1]"
    if not bool(torch.isfinite(result).all()):
        return "it holds values that are not finite"
    return ""


def strayed(request: Request, result: Float[Tensor, "3 H W"], checks: Checks) -> dict[str, str]:
    """How a result differs from its input by more than a check allows, in words by the check's name."""
    low, given = both_reduced(request, result.cpu().float().clamp(0, 1))
    drift = 255 * float((low.mean((1, 2)) - given.mean((1, 2))).abs().max())
    agreement = psnr(low, given) if request.scale > 1 else math.inf
    shift = displacement(low, given) if checks.displacement.active else 0.0
    words = {
        "colour": (drift > checks.colour.limit, f"its mean colour is {drift:.1f} levels off"),
        "agreement": (agreement < checks.agreement.limit, f"reduced it is {agreement:.1f} dB from its input"),
        "displacement": (shift > checks.displacement.limit, f"it is displaced by {shift:.2f} px"),
    }
    return {name: told for name, (beyond, told) in words.items() if beyond and getattr(checks, name).active}


def displacement(image: Float[Tensor, "3 h w"], reference: Float[Tensor, "3 h w"]) -> float:
    """Length of the shift that explains their difference best to first order, px; 0 where nothing could show one.

    The least-squares solution of image - reference = shift . gradient (Lucas and Kanade 1981).
    """
    if min(reference.shape[1:]) < 3:
        return 0.0
    grey, other = reference.double().mean(0), image.double().mean(0)
    dx = (grey[1:-1, 2:] - grey[1:-1, :-2]) / 2
    dy = (grey[2:, 1:-1] - grey[:-2, 1:-1]) / 2
    difference = (other - grey)[1:-1, 1:-1]
    slopes = torch.stack([dx.flatten(), dy.flatten()])
    system, right = slopes @ slopes.T, slopes @ difference.flatten()
    if float(torch.linalg.eigvalsh(system)[0]) < LEAST_SLOPE**2 * slopes.shape[1]:
        return 0.0
    return float(torch.linalg.solve(system, right).norm())
