"""Poses of training photographs, corrected beside the model where they are found to be wrong.

Structure from motion, or whoever wrote the poses down, may be off by a pixel: then photographs pull at the model in
different directions, and it becomes blurred. Whether they are is judged once: what left and right halves of photographs
have in common of the shifts by which they lie beside the model's renders (`modules.shifts`). If so, each pose is
moved to where its photograph was taken by the model's word (`modules.alignment`), a few times, while the model
goes on learning from poses that are better each time. What all motions have in common moves the world and no
photograph: it is taken from them again. Test photographs play no part.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import Annotated

import torch
from torch import Tensor

from gsx.core.data.camera import Camera
from gsx.core.data.scene import View
from gsx.core.gaussians.turned import cross_matrix
from gsx.core.ranges import Range, Share
from gsx.core.shapes import Bool, Float
from gsx.modules.alignment import Motion, motion_to, rotation_by
from gsx.modules.exposure import shared_spread
from gsx.modules.occasions import MadeOf, due_at, occasions, refuse_wrong, some_photographs
from gsx.modules.pinned import posed
from gsx.modules.shifts import shift_of

CORRELATED_PIXELS = 250
"""Of a photograph, about 16 x 16: neighbours differ by the same errors of the model, and say as much as one of them."""
LEAST_ERROR = 0.5
"""Px of a photograph by which a pose is expected to be wrong, at least (standard deviation)."""
MEDIAN_SQUARE = 0.4549
"""Of normally distributed numbers of variance 1."""


@dataclass(frozen=True, kw_only=True)
class PoseOptions:
    """Options; values in conf/config.yaml."""

    when: str = "never"
    """auto: where photographs lie beside what the model shows."""
    start: Share = 0.2
    """Share of the steps after which that is judged, and poses are corrected first."""
    until: Share = 0.7
    """Share of the steps after which they are corrected last."""
    times: Annotated[int, Range(1, 1000)] = 7
    """How often they are, at shares that grow by the same factor: a model that knows little yet gives way soonest."""
    spread: Annotated[float, Range(0, 100)] = 0.12
    """`auto`: px of shifts (standard deviation along an axis), from which on poses are corrected."""
    views: Annotated[int, Range(3, 10**6)] = 24
    """Photographs that are judged by, at most."""

    def __post_init__(self) -> None:
        refuse_wrong("poses", self)


@dataclass(eq=False)
class Poses:
    """Of a run's training photographs. No pose is another than the scene's before `correct`."""

    options: PoseOptions = field(default_factory=PoseOptions)
    cameras: Sequence[Camera] = ()
    """The scene's, in order."""
    iterations: int = 0
    matrices: Float[Tensor, "N 3 4"] | None = None
    """camera_from_world, rotation and translation; None: those of the scene."""
    error: float = math.nan
    """Px by which the prior of the last correction took the scene's poses to be wrong, standard deviation."""
    corrected: int = 0
    """The last step before which they were: not again where that step is taken anew."""
    seen: MadeOf = field(default_factory=MadeOf)
    """Views that were asked for, and what they are by the poses of the moment."""

    def steps(self) -> list[int]:
        """The steps before which poses are corrected, if they are, the first of them after that is judged; none where
        nobody asks."""
        return occasions(self.options, self.iterations)

    def due(self, number: int) -> bool:
        """Whether they are judged or corrected before this step."""
        return due_at(number, self.steps(), self.corrected, self.matrices is not None)

    def judged_by(self, views: Sequence[View]) -> list[View]:
        """The photographs that they are judged by: the same in every run."""
        return some_photographs(views, self.options.views, "poses")

    def needed(self, spread: float) -> bool:
        """Whether a spread of shifts, px, asks for corrections."""
        return self.options.when == "always" or spread > self.options.spread

    def expected_error(self, number: int, usual: float) -> float:
        """Px by which the prior of a correction takes the scene's poses to be wrong: as many as is usual at the first
        one, then ever fewer by the same factor, LEAST_ERROR at the last one. Held loosely those that are far off come
        near; held firmly the small errors of each correction do not add up. A run that goes on longer holds them no
        less."""
        if self.matrices is None:
            return max(LEAST_ERROR, usual)  # which may be nan
        steps = self.steps()
        left = len(steps) - 1 - steps.index(number)
        return LEAST_ERROR * max(1.0, self.error / LEAST_ERROR) ** (left / (left + 1))

    # -- what others see -----------------------------------------------------------------------------------------------

    def views(self, views: Sequence[View]) -> Sequence[View]:
        """The training views, in order, by the poses of the moment; the same ones until these change."""
        if self.matrices is None:
            return views
        pairs = zip(views, self.matrices, strict=True)
        return self.seen.views(views, lambda: [posed(view, at(view.camera, matrix)) for view, matrix in pairs])

    # -- what changes them ---------------------------------------------------------------------------------------------

    def correct(
        self, before: Sequence[Camera], after: Sequence[Camera], depth: float, number: int, error: float
    ) -> float:
        """Move each pose from one camera to another before a step, less what all motions have in common; returns how
        far pictures move by that, px (root of the mean square). depth: at which moves are weighed against turns, scene
        units; error: what the prior expected (`expected_error`)."""
        after = without_common(before, after, depth)
        self.take(torch.stack([torch.cat([c.rotation, c.translation[:, None]], 1).double() for c in after]))
        self.corrected, self.error = number, error
        steps = torch.stack([in_px(b, a, depth) for b, a in zip(before, after, strict=True)])
        return math.sqrt(float(steps.square().sum(1).mean()))

    def take(self, matrices: Float[Tensor, "N 3 4"] | None) -> None:
        """These from now on."""
        self.matrices, self.seen = matrices, MadeOf()

    def tensors(self) -> dict[str, Tensor]:
        """What a checkpoint holds of them; nothing where they are the scene's."""
        if self.matrices is None:
            return {}
        error = torch.tensor(self.error, dtype=torch.float64)
        return {"matrices": self.matrices, "corrected": torch.tensor(self.corrected), "error": error}

    def restore(self, tensors: dict[str, Tensor]) -> None:
        """Go on from a checkpoint's tensors; none: poses are the scene's."""
        self.take(tensors["matrices"].clone() if tensors else None)
        self.corrected = int(tensors["corrected"]) if tensors else 0
        self.error = float(tensors.get("error", math.nan))  # nothing is known of it in older checkpoints


# -- are they wrong? ---------------------------------------------------------------------------------------------------


def shifts_by_half(
    pictures: Iterable[tuple[Tensor, Tensor, Bool[Tensor, "H W"] | None, float]],
) -> Float[Tensor, "N 2 2"]:
    """How far to the right and down the left and the right half of each photograph lie beside its render, px; nan where
    nothing tells. Pictures are renders, photographs, which pixels count, and px of a photograph in one of theirs."""
    found = [[of_half(*picture, right) for right in (False, True)] for picture in pictures]
    return torch.tensor(found, dtype=torch.float64)


def spread_of_shifts(halves: Float[Tensor, "N 2 2"]) -> float:
    """Px by which photographs lie beside renders, standard deviation along an axis: what left and right halves have in
    common; 0 where too few tell."""
    return shared_spread(halves[:, 0], halves[:, 1])


def usual_shift(halves: Float[Tensor, "N 2 2"]) -> float:
    """The same by the median over photographs and axes, which a few that lie far beside hardly change; 0 where that is
    negative, or nothing tells."""
    known = halves[halves.isfinite().all(2).all(1)]
    if not len(known):
        return 0.0
    left, right = (known - known.median(0).values).unbind(1)
    return math.sqrt(max(0.0, float((left * right).median())) / MEDIAN_SQUARE)


def of_half(
    image: Float[Tensor, "3 H W"],
    photograph: Float[Tensor, "3 H W"],
    counted: Bool[Tensor, "H W"] | None,
    px: float,
    right: bool,
) -> tuple[float, float]:
    """How far to the right and down half a photograph lies beside half a render, each px of which is so many; nan where
    nothing tells."""
    middle = image.shape[2] // 2
    part = slice(middle, None) if right else slice(middle)
    found = shift_of(image[..., part], photograph[..., part], None if counted is None else counted[..., part])
    return (math.nan, math.nan) if found is None else (px * found[0], px * found[1])


def at(camera: Camera, matrix: Float[Tensor, "3 4"]) -> Camera:
    """The camera at a pose camera_from_world."""
    rotation, translation = matrix[:, :3].to(camera.rotation), matrix[:, 3].to(camera.translation)
    return replace(camera, rotation=rotation, translation=translation)


# -- motions of cameras ------------------------------------------------------------------------------------------------


def units(camera: Camera, depth: float) -> Float[Tensor, "6"]:
    """Px by which what lies at a depth moves on the screen per rad and per scene unit."""
    return camera.focal * torch.tensor([1.0] * 3 + [1 / depth] * 3, dtype=torch.float64)


def in_px(before: Camera, after: Camera, depth: float) -> Float[Tensor, "6"]:
    """A motion in px."""
    return units(before, depth) * motion_to(before, after).twist()


def by_world(camera: Camera) -> Float[Tensor, "6 6"]:
    """How a camera's frame moves with the world: the adjoint of its pose."""
    rotation, across = camera.rotation.double(), cross_matrix(camera.translation.double())
    upper = torch.cat([rotation, torch.zeros_like(rotation)], 1)
    return torch.cat([upper, torch.cat([across @ rotation, rotation], 1)])


def without_common(before: Sequence[Camera], after: Sequence[Camera], depth: float) -> list[Camera]:
    """Cameras after their motions, with the world moved back by what these have in common: least squares in px."""
    pairs = list(zip(before, after, strict=True))
    columns = torch.cat([units(b, depth)[:, None] * by_world(b) for b, _ in pairs])
    wanted = torch.cat([in_px(b, a, depth) for b, a in pairs])
    world = torch.linalg.lstsq(columns, wanted[:, None], driver="gelsd").solution[:, 0]
    turn = rotation_by(world[:3])
    back = Motion(rotation=turn.T, move=-turn.T @ world[3:])
    return [in_moved_world(camera, back) for camera in after]


def in_moved_world(camera: Camera, motion: Motion) -> Camera:
    """The camera that sees a moved world as the camera sees it: its pose after the motion."""
    rotation, translation = camera.rotation.double(), camera.translation.double()
    return replace(
        camera,
        rotation=(rotation @ motion.rotation).to(camera.rotation),
        translation=(translation + rotation @ motion.move).to(camera.translation),
    )
