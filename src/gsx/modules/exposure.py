"""Exposure and white balance of each photograph, learnt beside the model where photographs differ in them.

A photograph is compared with A [r, g, b, 1]^T of its render, A of 3 x 4 numbers per training photograph, learnt by Adam
(3D-GS release, `exposure_lr_init`, `exposure_lr_final`). Ours: whether there are any is judged first; they begin where
photographs and renders say instead of at the identity, and are set right by these a few times, since renders say little
at first; their mean stays the identity, so that the model has the exposure of the mean photograph; and Adam keeps the
steps of each photograph apart. One Adam over all of them, as published, goes on moving a photograph while others are
shown: by several rates a visit, where one is meant. Behind A comes a bilateral grid, where light is found to differ
within photographs (`modules.bilateral_grid`).
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Annotated, TypeAlias

import torch
from torch import Tensor

from gsx.core.ranges import Range, Share
from gsx.core.shapes import Bool, Float
from gsx.core.training.schedule import log_linear
from gsx.modules.bilateral_grid import WHOLE, first_matrices, slopes_of_light, through_grid, without_common
from gsx.modules.occasions import WHEN, due_at, occasions, refuse_wrong, some_photographs

PositiveRate = Annotated[float, Range(1e-9, 1)]
BETAS, EPS = (0.9, 0.99), 1e-8
"""Of Adam; a photograph is seen a few dozen times in a short run."""
DARK, LIGHT = 0.05, 0.95
"""Display values that tell a gain: below them noise does, above them they may be saturated."""
FEWEST_PIXELS, FEWEST_OF_BLOCK, FEWEST_VIEWS = 64, 16, 3
"""That tell a gain; that of a part of a picture; that tell a spread."""


@dataclass(frozen=True, kw_only=True)
class ExposureOptions:
    """Options; values in conf/config.yaml."""

    when: str = "never"
    """auto: where photographs differ."""
    start: Share = 0.2
    """Share of the steps after which it is judged, and exposures are told first."""
    until: Share = 0.7
    """Share of the steps after which they are told last."""
    times: Annotated[int, Range(1, 1000)] = 5
    """How often they are, at shares that grow by the same factor; once where there are grids."""
    spread: Annotated[float, Range(0, 1)] = 0.06
    """`auto`: of log gains (standard deviation), from which on photographs have exposures of their own; as they have
    where they have grids."""
    grid: str = "never"
    """auto: a bilateral grid of each photograph, where light differs within photographs."""
    grid_spread: Annotated[float, Range(0, 1)] = 0.08
    """`auto`: of slopes of log gains, from the middle of a photograph to its sides (standard deviation), from which on
    there are grids."""
    views: Annotated[int, Range(3, 10**6)] = 24
    """Photographs that are judged by, at most."""
    rate: PositiveRate = 0.01
    rate_final: PositiveRate = 0.001
    """Of Adam at the first and at the last step; their logarithm is interpolated."""

    def __post_init__(self) -> None:
        refuse_wrong("exposure", self)
        if self.grid not in WHEN:
            raise ValueError(f"training.exposure.grid is '{self.grid}'; choose from {', '.join(WHEN)}")
        if self.when == "never" != self.grid:
            raise ValueError(
                f"training.exposure.grid is '{self.grid}', but training.exposure.when is 'never': a grid comes behind "
                "an exposure; set training.exposure.when=auto"
            )


# -- what photographs and renders say ----------------------------------------------------------------------------------


Pair: TypeAlias = tuple[Float[Tensor, "3 H W"], Float[Tensor, "3 H W"], Bool[Tensor, "H W"] | None]
"""Render, photograph, which pixels count."""


@dataclass(frozen=True, eq=False)
class Light:
    """What a render and a photograph say of that one's light."""

    gains: Float[Tensor, "3 3"]
    """Log gains of the whole picture, of its left and of its right half; nan where nothing is told."""
    slopes: Float[Tensor, "3 2 3"] | None
    """Of log gains (`slopes_of_light`); None: not asked."""


def light_of(pair: Pair, slopes: bool) -> Light:
    """Of a photograph; slopes: whether light may differ within it."""
    if not slopes:
        return Light(of_halves(*pair), None)
    return Light(of_halves(*pair), slopes_of_light(pair[0], pair[1], telling(*pair), FEWEST_OF_BLOCK))


def spreads_of(found: Sequence[Light]) -> tuple[float, float]:
    """Of gains over photographs, and of slopes; nan where these were not asked."""
    gains = torch.stack([one.gains for one in found])
    slopes = [one.slopes for one in found if one.slopes is not None]
    within = shared_spread(*torch.stack(slopes)[:, 1:].flatten(2).unbind(1)) if slopes else math.nan
    return shared_spread(gains[:, 1], gains[:, 2]), within


def telling(
    image: Float[Tensor, "3 H W"], photograph: Float[Tensor, "3 H W"], counted: Bool[Tensor, "H W"] | None
) -> Bool[Tensor, "H W"]:
    """Pixels that count and are neither dark nor light in either."""
    told = ((image > DARK) & (image < LIGHT) & (photograph > DARK) & (photograph < LIGHT)).all(0)
    return told if counted is None else told & counted.to(told.device)


def log_gains(
    image: Float[Tensor, "3 H W"], photograph: Float[Tensor, "3 H W"], counted: Bool[Tensor, "H W"] | None = None
) -> Float[Tensor, "3"]:
    """Median of log(photograph / image) of each channel, over pixels that count and are neither dark nor light in
    either; nan where they are too few."""
    told = telling(image, photograph, counted)
    if int(told.sum()) < FEWEST_PIXELS:
        return torch.full((3,), math.nan)
    return (photograph[:, told] / image[:, told]).log().double().median(dim=1).values.float().cpu()


def of_halves(image: Tensor, photograph: Tensor, counted: Bool[Tensor, "H W"] | None) -> Float[Tensor, "3 3"]:
    """Log gains of the whole picture, of its left and of its right half."""
    half = image.shape[2] // 2
    parts = (slice(None), slice(half), slice(half, None))
    return torch.stack(
        [log_gains(image[..., p], photograph[..., p], None if counted is None else counted[..., p]) for p in parts]
    )


def shared_spread(left: Float[Tensor, "N C"], right: Float[Tensor, "N C"]) -> float:
    """Standard deviation of what is told of photographs, in the mean over channels, without the noise in which halves
    of one differ: the root of the covariance of their halves; 0 where that is negative, or nothing is told."""
    known = (left.isfinite() & right.isfinite()).all(1)
    if int(known.sum()) < FEWEST_VIEWS:
        return 0.0
    centred = [half[known] - half[known].mean(0) for half in (left, right)]
    covariance = (centred[0] * centred[1]).sum(0) / (int(known.sum()) - 1)
    return math.sqrt(max(0.0, float(covariance.mean())))


def relative_gains(found: Sequence[Light]) -> Float[Tensor, "N 3"]:
    """Log gains of photographs beside their mean, which is the model's; 0 where nothing is told."""
    gains = torch.stack([one.gains[0] for one in found])
    return (gains - gains.nanmean(0)).nan_to_num(0.0)


# -- what is learnt ----------------------------------------------------------------------------------------------------


@dataclass(eq=False)
class Exposures:
    """Of a run's training photographs. Nothing is learnt, and no picture changed, before `begin`."""

    options: ExposureOptions = field(default_factory=ExposureOptions)
    names: Sequence[str] = ()
    """Of the photographs."""
    iterations: int = 0
    device: torch.device = field(default_factory=lambda: torch.device("cpu"))
    matrices: Float[Tensor, "N 3 4"] | None = None
    moments: Float[Tensor, "2 N 3 4"] = field(default_factory=lambda: torch.zeros(2, 0, 3, 4))
    """Adam's means of gradients and of their squares."""
    grids: Float[Tensor, "N rank 3 4"] | None = None
    """Matrices of bilateral grids; None: light does not differ within photographs."""
    grid_moments: Float[Tensor, "2 N rank 3 4"] = field(default_factory=lambda: torch.zeros(2, 0, 0, 3, 4))
    visits: Float[Tensor, "N"] = field(default_factory=lambda: torch.zeros(0))
    """Steps of each photograph."""
    told_last: int = 0
    """The last step before which they were told: not again where that step is taken anew."""
    shown: set[int] = field(default_factory=set)
    """Photographs of the step under way."""

    def steps(self) -> list[int]:
        """The steps before which exposures are told, if they are, the first of them after photographs are judged; none
        where nobody asks."""
        return occasions(self.options, self.iterations)

    def due(self, number: int) -> bool:
        """Whether photographs are judged, or exposures told, before this step; grids know more than gains tell."""
        return self.grids is None and due_at(number, self.steps(), self.told_last, self.matrices is not None)

    def judge(self, look: Callable[[int], Pair], number: int) -> tuple[float, float]:
        """Judge by some photographs before a step, and begin with the gains of all, if these are spread enough, or have
        to be, and with grids likewise; returns both spreads, nan for what was not asked.

        look: (render, photograph, which pixels count) of the photograph of that number; each is looked at once at most.
        """
        own, everyone = self.options, range(len(self.names))
        found = {index: self.told(look(index)) for index in some_photographs(everyone, own.views, "exposures")}
        spread, within = spreads_of(list(found.values()))
        with_grids = own.grid == "always" or within > own.grid_spread
        if own.when == "always" or spread > own.spread or with_grids:
            found |= {index: self.told(look(index)) for index in everyone if index not in found}
            self.correct([found[index] for index in everyone], with_grids, number)
        return spread, within

    def tell(self, look: Callable[[int], Pair], number: int) -> float:
        """Set right before a step what is learnt; returns by how much that was off: log gains of photographs at their
        exposures (root of the mean square). look: as above, renders at the exposures of their photographs."""
        found = [light_of(look(index), slopes=False) for index in range(len(self.names))]
        self.correct(found, with_grids=False, number=number)
        return float(relative_gains(found).square().mean().sqrt())

    def told(self, pair: Pair) -> Light:
        """Of a photograph's light."""
        return light_of(pair, slopes=self.options.grid != "never")

    @torch.no_grad()
    def correct(self, found: Sequence[Light], with_grids: bool, number: int) -> None:
        """Learn on from what there is, with the gains and slopes that were found of each photograph before a step."""
        gains = relative_gains(found).exp()
        now = torch.eye(3, 4).expand(len(found), -1, -1) if self.matrices is None else self.matrices.cpu()
        slopes = [one.slopes[0] for one in found if with_grids and one.slopes is not None]
        self.begin(
            centred_on_identity(gains[:, :, None] * now), first_matrices(torch.stack(slopes)) if slopes else None
        )
        self.told_last = number

    def begin(self, matrices: Float[Tensor, "N 3 4"], grids: Float[Tensor, "N rank 3 4"] | None = None) -> None:
        """Learn from these on."""
        self.matrices = matrices.to(self.device).requires_grad_()
        self.moments, self.visits = torch.zeros(2, *matrices.shape, device=self.device), torch.zeros(len(matrices))
        self.grids = None if grids is None else grids.to(self.device).requires_grad_()
        self.grid_moments = torch.zeros(2, *(() if grids is None else grids.shape), device=self.device)

    def applied(
        self,
        image: Float[Tensor, "3 H W"],
        name: str,
        learning: bool = False,
        edges: tuple[float, float, float, float] = WHOLE,
    ) -> Float[Tensor, "3 H W"]:
        """The render as the photograph of that name would have it, on the device that learns; as it is where there are
        no exposures. learning: the photograph is one of the step under way. edges: of what is rendered, as shares of
        the photograph's sides."""
        if self.matrices is None:
            return image
        index = self.names.index(name)
        if learning:
            self.shown.add(index)
        matrix, grid = self.matrices[index], None if self.grids is None else self.grids[index]
        out = transformed(image.to(self.device), matrix if learning else matrix.detach())
        return out if grid is None else through_grid(out, grid if learning else grid.detach(), edges)

    def rate(self, number: int) -> float:
        """Of step `number`."""
        own, first = self.options, round(self.options.start * self.iterations)
        return log_linear(number - first, self.iterations - first, own.rate, own.rate_final)

    @torch.no_grad()
    def update(self, number: int) -> None:
        """One step of Adam for each photograph that was shown; the mean of the matrices stays the identity, that of
        grids zero."""
        if self.matrices is None or self.matrices.grad is None:
            return
        learnt = [(self.matrices, self.moments), (self.grids, self.grid_moments)]
        for index in sorted(self.shown):
            self.visits[index] += 1
            for values, moments in learnt:
                if values is not None and values.grad is not None:
                    direction = adam_direction(moments[:, index], values.grad[index], float(self.visits[index]))
                    values[index] -= self.rate(number) * direction
        self.matrices.copy_(centred_on_identity(self.matrices))
        if self.grids is not None:
            self.grids.copy_(without_common(self.grids))
        self.forget()

    def forget(self) -> None:
        """Drop the gradients of a step."""
        self.shown.clear()
        for values in (self.matrices, self.grids):
            if values is not None:
                values.grad = None

    def tensors(self) -> dict[str, Tensor]:
        """What a checkpoint holds of them; nothing where there are none."""
        if self.matrices is None:
            return {}
        own = {"matrices": self.matrices.detach(), "moments": self.moments, "visits": self.visits}
        own["told_last"] = torch.tensor(self.told_last)
        return own if self.grids is None else own | {"grids": self.grids.detach(), "grid_moments": self.grid_moments}

    def restore(self, tensors: dict[str, Tensor]) -> None:
        """Go on from a checkpoint's tensors; none: there are no exposures."""
        self.matrices, self.grids, self.told_last = None, None, 0
        if tensors:
            self.told_last = int(tensors.get("told_last", 0))  # not in checkpoints of earlier versions
            grids = tensors.get("grids")
            self.begin(tensors["matrices"].clone(), None if grids is None else grids.clone())
            self.moments, self.visits = tensors["moments"].to(self.device).clone(), tensors["visits"].clone()
            if grids is not None:
                self.grid_moments = tensors["grid_moments"].to(self.device).clone()


def adam_direction(moments: Float[Tensor, "2 *S"], gradient: Float[Tensor, "*S"], steps: float) -> Float[Tensor, "*S"]:
    """Adam's, of one photograph's numbers at its step of that number; its moments are changed in place."""
    means = []
    for moment, beta, value in zip(moments, BETAS, (gradient, gradient.square()), strict=True):
        moment.mul_(beta).add_((1 - beta) * value)
        means.append(moment / (1 - beta**steps))
    return means[0] / (means[1].sqrt() + EPS)


def transformed(image: Float[Tensor, "3 H W"], matrix: Float[Tensor, "3 4"]) -> Float[Tensor, "3 H W"]:
    """A [r, g, b, 1]^T of every pixel."""
    return (matrix[:, :3] @ image.flatten(1)).view_as(image) + matrix[:, 3, None, None]


def saturated(
    image: Float[Tensor, "3 H W"], photograph: Float[Tensor, "3 H W"], exposures: Exposures
) -> Float[Tensor, "3 H W"]:
    """A render at the exposure of its photograph, where there are any: a saturated value says "at least 1", and more
    is no error."""
    if exposures.matrices is None:
        return image
    return torch.where((photograph >= 1) & (image > 1), photograph, image)


def centred_on_identity(matrices: Float[Tensor, "N 3 4"]) -> Float[Tensor, "N 3 4"]:
    """The matrices less what their mean is off the identity."""
    return matrices - matrices.mean(0) + torch.eye(3, 4, device=matrices.device)


# -- pictures that are judged ------------------------------------------------------------------------------------------


def best_matrix(
    image: Float[Tensor, "3 H W"], truth: Float[Tensor, "3 H W"], counted: Bool[Tensor, "H W"]
) -> Float[Tensor, "3 4"]:
    """The matrix that brings the pixels that count closest to the truth, by least squares."""
    counted = counted.to(image.device)
    rows = torch.cat([image, torch.ones_like(image[:1])])[:, counted].double().T.cpu()
    wanted = truth[:, counted].double().T.cpu()
    return torch.linalg.lstsq(rows, wanted, driver="gelsd").solution.T.float().to(image.device)  # of lower rank: least
