"""Poses of training photos, corrected with the model if they are wrong.

Poses that are off by a pixel blur the model. A test measures the spread of shifts between photos and renders that the
left and right halves of photos share (`modules.image_shift`). Above a threshold each pose moves to its estimate from
the model (`modules.alignment`), a few times, while the model learns from better poses. The common motion of all
cameras, which only moves the world, is removed. Test photos are not used.
"""

import logging
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from statistics import median
from typing import Annotated, Any, ClassVar

import torch
from torch import Tensor

from gsx.core.data.camera import Camera
from gsx.core.data.scene import View
from gsx.core.ranges import Range
from gsx.core.shapes import Float
from gsx.core.training.module import ModuleContext
from gsx.core.training.render import render
from gsx.core.training.run import Run
from gsx.formats.turned import cross_matrix
from gsx.modules.alignment import Motion, estimate_camera, median_depth, motion_to, refuse_lens, rotation_by
from gsx.modules.corrections import Correction, CorrectionOptions, Times, ViewCache, ViewCount, log_test, sample
from gsx.modules.derived_views import change_pose, reduce_view
from gsx.modules.image_shift import estimate_shift
from gsx.modules.photo_pairs import REDUCTION, Image, Mask, render_reduced, shared_spread

logger = logging.getLogger(__name__)

CORRELATED_PIXELS = 250
"""Pixels of a photo, about 16 x 16, that share the model's errors: together they weigh as much as one."""
MIN_ERROR = 0.5
"""Smallest expected error of a pose, px of a photo (standard deviation)."""
MEDIAN_SQUARE = 0.4549
"""Median of the square of a standard normal variable."""
MIN_PIXELS = 1 << 13
"""Fewest pixels of a view from which a pose is estimated: small photos are not reduced."""


@dataclass(frozen=True, kw_only=True)
class PoseOptions(CorrectionOptions):
    """Options; values in conf/module/poses.yaml."""

    key: ClassVar[str] = "poses"
    times: Times = 7
    """Number of corrections, at shares that grow by the same factor: an early model adapts soonest."""
    spread: Annotated[float, Range(0, 100)] = 0.12
    """`auto`: standard deviation of shifts along an axis, px, above which poses are corrected."""
    views: ViewCount = 24
    """Most photos that the test uses."""


class Poses(Correction):
    """Poses of a run's training photos; those of the scene before the first correction."""

    options: PoseOptions
    seconds_key = "pose_seconds"
    figures_key = "poses"
    count_key = "poses"
    thresholds = ("spread",)
    in_views = True

    def __init__(self, options: PoseOptions, context: ModuleContext) -> None:
        super().__init__(options, context)
        for view in context.scene.train if options.when != "never" else ():
            refuse_lens(view.camera)
        self.matrices: Float[Tensor, "N 3 4"] | None = None
        """camera_from_world, rotation and translation; None: the scene's."""
        self.error = math.nan
        """Expected error of the scene's poses at the last correction, px, standard deviation."""
        self.cache = ViewCache()

    def transform_views(self, views: Sequence[View], step: int | None) -> Sequence[View]:
        """Returns the views with corrected poses."""
        if self.matrices is None:
            return views
        pairs = zip(views, self.matrices, strict=True)
        return self.cache.get(views, lambda: [change_pose(view, with_pose(view.camera, m)) for view, m in pairs])

    # -- estimates -----------------------------------------------------------------------------------------------------

    def estimate(self, run: Run, step: int) -> dict[str, float]:
        """Tests poses, at first, and corrects them if they are wrong."""
        views, usual, metrics = run.train_views, math.nan, dict[str, float]()
        if not self.active:
            halves = half_shifts(photo_pairs(run, sample(views, self.options.views, "poses")))
            metrics["pose_spread"], usual = shared_spread(*halves.unbind(1)), usual_shift(halves)
            if not self.wrong(metrics["pose_spread"], step):
                return metrics | {"poses": 0}
        metrics["poses"], metrics["pose_motion"] = len(views), self.align(run, views, usual, step)
        logger.info("step %d: poses refined, RMS motion %.2f px", step, metrics["pose_motion"])
        return metrics

    def wrong(self, spread: float, step: int) -> bool:
        """Compares the spread of shifts, px, with the threshold and logs it; returns True if poses need correction."""
        wrong = spread > self.options.spread or self.options.when == "always"
        verdict = "refining poses" if wrong else "poses kept"
        log_test(step, "pose error", spread, self.options.spread, "{:.2f} px".format, verdict)
        return wrong

    def align(self, run: Run, views: Sequence[View], usual: float, step: int) -> float:
        """Moves each pose to its estimate; returns the RMS motion, px. usual: shift of photos, px; nan: unknown."""
        after, depths, error = list[Camera](), list[float](), self.expected_error(step, usual)
        weight = CORRELATED_PIXELS / error**2
        for view, scene_view in zip(views, self.context.scene.train, strict=True):
            small, rendering = render_reduced(run, view, min_pixels=MIN_PIXELS)
            assert rendering.depth is not None
            pictures = rendering.image, rendering.depth, rendering.alpha, small.image(), small.counted()
            after.append(estimate_camera(small.camera, *pictures, prior=scene_view.camera, prior_weight=weight))
            depths.append(median_depth(rendering.depth, rendering.alpha))
        known = [depth for depth in depths if math.isfinite(depth)]
        depth = median(known) if known else run.scene.extent
        return self.correct([view.camera for view in views], after, depth, step, error)

    def expected_error(self, step: int, usual: float) -> float:
        """Returns the error of the scene's poses that the prior of a correction assumes, px.

        The usual shift at the first correction, shrinking by the same factor to MIN_ERROR at the last. A weak prior
        lets poses that are far off move; a strong one keeps small errors of corrections from adding up. A run that
        resumes with more steps does not weaken it.
        """
        if self.matrices is None:
            return max(MIN_ERROR, usual)  # which may be nan
        steps = self.milestones()
        left = len(steps) - 1 - steps.index(step)
        return MIN_ERROR * max(1.0, self.error / MIN_ERROR) ** (left / (left + 1))

    def correct(
        self, before: Sequence[Camera], after: Sequence[Camera], depth: float, step: int, error: float
    ) -> float:
        """Moves each pose from one camera to another, less the common motion; returns the RMS motion, px.

        depth: scene units, converts moves to px. error: expected by the prior, px.
        """
        after = without_common(before, after, depth)
        self.take(torch.stack([torch.cat([c.rotation, c.translation[:, None]], 1).double() for c in after]))
        self.last_estimate, self.error = step, error
        motions = torch.stack([motion_px(b, a, depth) for b, a in zip(before, after, strict=True)])
        return math.sqrt(float(motions.square().sum(1).mean()))

    def take(self, matrices: Float[Tensor, "N 3 4"] | None) -> None:
        """Uses these poses from now on."""
        self.matrices, self.cache = matrices, ViewCache()

    # -- files ---------------------------------------------------------------------------------------------------------

    def state_dict(self) -> dict[str, Tensor]:
        """Returns the corrected poses; empty where there are none."""
        if self.matrices is None:
            return {}
        error = torch.tensor(self.error, dtype=torch.float64)
        return {"matrices": self.matrices, "corrected": torch.tensor(self.last_estimate), "error": error}

    def load_state_dict(self, tensors: Mapping[str, Tensor]) -> None:
        """Restores a checkpoint; empty: poses are the scene's."""
        self.take(tensors["matrices"].clone() if tensors else None)
        self.last_estimate = int(tensors["corrected"]) if tensors else 0
        self.error = float(tensors.get("error", math.nan))  # older checkpoints lack it

    @classmethod
    def figures(cls, lines: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
        """Returns the step of the test, the spread of shifts, the number of corrected poses, and the motions."""
        first, motions = lines[0], [line["pose_motion"] for line in lines if "pose_motion" in line]
        tested = {"step": first["step"], "spread": first.get("pose_spread"), "corrected": first["poses"]}
        return tested | {"motions": motions}

    @classmethod
    def remarks(cls, evaluation: Mapping[str, Any]) -> Iterator[str]:
        """Reports corrected training poses; test poses are not corrected."""
        figures = evaluation.get("poses") or {}
        if figures.get("corrected"):
            error = "off" if figures["spread"] is None else f"off by {figures['spread']:.2f} px"
            yield (
                f"poses of training photos were {error}, they are corrected from step {figures['step']:,} on: those of "
                "test views are the scene's; eval.poses=aligned looks past that"
            )


def photo_pairs(run: Run, views: Sequence[View]) -> Iterator[tuple[Image, Image, Mask | None, float]]:
    """Yields (render, photo, pixels that count, px of the photo per pixel) of reduced views."""
    for view in views:
        run.raise_if_stopping()
        small = reduce_view(view, run.scene.reduction, REDUCTION)
        image = render(run, small.camera).image
        yield image, small.image(), small.counted(), view.camera.focal / small.camera.focal


# -- test --------------------------------------------------------------------------------------------------------------


def half_shifts(pairs: Iterable[tuple[Image, Image, Mask | None, float]]) -> Float[Tensor, "N 2 2"]:
    """Returns the shifts of both halves of each photo from its render, to the right and down, px; nan: unknown."""
    shifts = [[half_shift(*pair, right) for right in (False, True)] for pair in pairs]
    return torch.tensor(shifts, dtype=torch.float64)


def usual_shift(halves: Float[Tensor, "N 2 2"]) -> float:
    """Returns the spread of shifts by the median over photos and axes, robust to outliers; px."""
    known = halves[halves.isfinite().all(2).all(1)]
    if not len(known):
        return 0.0
    left, right = (known - known.median(0).values).unbind(1)
    return math.sqrt(max(0.0, float((left * right).median())) / MEDIAN_SQUARE)


def half_shift(image: Image, photo: Image, mask: Mask | None, px: float, right: bool) -> tuple[float, float]:
    """Returns the shift to the right and down of half a photo from half its render; px: of the photo per pixel."""
    middle = image.shape[2] // 2
    part = slice(middle, None) if right else slice(middle)
    shift = estimate_shift(image[..., part], photo[..., part], None if mask is None else mask[..., part])
    return (math.nan, math.nan) if shift is None else (px * shift[0], px * shift[1])


# -- motions of cameras ------------------------------------------------------------------------------------------------


def with_pose(camera: Camera, matrix: Float[Tensor, "3 4"]) -> Camera:
    """Returns the camera at a pose camera_from_world."""
    rotation, translation = matrix[:, :3].to(camera.rotation), matrix[:, 3].to(camera.translation)
    return replace(camera, rotation=rotation, translation=translation)


def px_per_unit(camera: Camera, depth: float) -> Float[Tensor, "6"]:
    """Returns the motion on the screen of points at a depth, px per rad and per scene unit."""
    return camera.focal * torch.tensor([1.0] * 3 + [1 / depth] * 3, dtype=torch.float64)


def motion_px(before: Camera, after: Camera, depth: float) -> Float[Tensor, "6"]:
    """Returns a motion in px."""
    return px_per_unit(before, depth) * motion_to(before, after).twist()


def adjoint(camera: Camera) -> Float[Tensor, "6 6"]:
    """Returns the motion of a camera's frame with the world: the adjoint of its pose."""
    rotation, across = camera.rotation.double(), cross_matrix(camera.translation.double())
    upper = torch.cat([rotation, torch.zeros_like(rotation)], 1)
    return torch.cat([upper, torch.cat([across @ rotation, rotation], 1)])


def without_common(before: Sequence[Camera], after: Sequence[Camera], depth: float) -> list[Camera]:
    """Returns cameras after their motions less the common one, by least squares in px."""
    pairs = list(zip(before, after, strict=True))
    columns = torch.cat([px_per_unit(b, depth)[:, None] * adjoint(b) for b, _ in pairs])
    motions = torch.cat([motion_px(b, a, depth) for b, a in pairs])
    world = torch.linalg.lstsq(columns, motions[:, None], driver="gelsd").solution[:, 0]
    turn = rotation_by(world[:3])
    back = Motion(rotation=turn.T, move=-turn.T @ world[3:])
    return [in_moved_world(camera, back) for camera in after]


def in_moved_world(camera: Camera, motion: Motion) -> Camera:
    """Returns the camera with the same view of a moved world."""
    rotation, translation = camera.rotation.double(), camera.translation.double()
    return replace(
        camera,
        rotation=(rotation @ motion.rotation).to(camera.rotation),
        translation=(translation + rotation @ motion.move).to(camera.translation),
    )
