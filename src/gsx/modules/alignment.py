"""Where a photograph was taken, told from what a model shows near there.

A model is drawn by a camera, with depth z. The pixel at p shows the point X = z ((p - c) / f, 1) of the camera's frame;
a photograph that was taken from elsewhere shows it at pi(R X + t), (R, t) being the motion from the camera to where it
was taken. The motion sought is the one whose photograph explains the render best, beside a gain and an offset: by least
squares on slopes of the photograph, looked up there again and again (Lucas and Kanade 1981), coarse to fine, in which
pixels that differ by more than the usual count little. Directions that pictures do not tell (a turn from a move, before
a distant wall) are held by a prior.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, grid_sample

from gsx.core.data.camera import Camera
from gsx.core.data.masks import grown
from gsx.core.shapes import Bool, Float
from gsx.formats.turned import cross_matrix
from gsx.modules.shifts import ALIKE, BORDER, LEAST, SMALLEST, by_medians, central, grey, robust

ROUNDS, ENOUGH = 10, 0.02
"""Of the search at each size; px, of the last of them."""
COVERED = 0.5
"""Alpha of a pixel that has a depth."""
HELD = 1000.0
"""Pixels that say as much as the prior does of a pose that is wrong by 1 px, where nothing is known of its error."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Motion:
    """From one camera's frame to another's: X' = rotation X + move. float64."""

    rotation: Float[Tensor, "3 3"]
    move: Float[Tensor, "3"]
    """Scene units."""

    def of(self, points: Float[Tensor, "3 P"]) -> Float[Tensor, "3 P"]:
        """Points of the first frame in the second."""
        return self.rotation @ points + self.move[:, None]

    def twist(self) -> Float[Tensor, "6"]:
        """Rotation vector, rad, and move; of small rotations."""
        skew = (self.rotation - self.rotation.T) / 2
        return torch.cat([torch.stack([skew[2, 1], skew[0, 2], skew[1, 0]]), self.move])

    def after(self, other: "Motion") -> "Motion":
        """The other one, and then this."""
        return Motion(rotation=self.rotation @ other.rotation, move=self.of(other.move[:, None])[:, 0])

    def then(self, turn: Float[Tensor, "3"], move: Float[Tensor, "3"]) -> "Motion":
        """This, and then a rotation vector, rad, and a move."""
        rotation = rotation_by(turn)
        return Motion(rotation=rotation @ self.rotation, move=rotation @ self.move + move)


STILL = Motion(rotation=torch.eye(3, dtype=torch.float64), move=torch.zeros(3, dtype=torch.float64))


def rotation_by(turn: Float[Tensor, "3"]) -> Float[Tensor, "3 3"]:
    """The rotation about a vector by its length, rad."""
    return torch.linalg.matrix_exp(cross_matrix(turn))


def motion_to(camera: Camera, other: Camera) -> Motion:
    """From one camera's frame to another's."""
    rotation = other.rotation.double() @ camera.rotation.double().T
    return Motion(rotation=rotation, move=other.translation.double() - rotation @ camera.translation.double())


def moved(camera: Camera, motion: Motion) -> Camera:
    """The camera where the motion leads."""
    rotation, translation = camera.rotation.double(), camera.translation.double()
    # to a rotation again: what rounding adds up over many motions would stretch it
    u, _, v = torch.linalg.svd(motion.rotation @ rotation)
    translation = motion.rotation @ translation + motion.move
    return replace(camera, rotation=(u @ v).to(camera.rotation), translation=translation.to(camera.translation))


@dataclass(frozen=True, eq=False, kw_only=True)
class Shown:
    """What a model shows to a camera, float64."""

    camera: Camera
    image: Float[Tensor, "H W"]
    depth: Float[Tensor, "H W"]
    """Camera z, scene units."""
    inside: Bool[Tensor, "H W"]
    """Pixels that have a depth and count."""
    counted: Bool[Tensor, "H W"] | None = None
    """Pixels of the photograph that are looked at; None: all."""
    given: Motion = STILL
    """From the pose that the prior holds to that of the camera."""
    held: float
    """Pixels that say as much as the prior does of a pose that is wrong by 1 px: as many at half the size, where as
    large a part of the scene, and as wrong a pose, have a quarter of the pixels and half of the px."""

    def points(self) -> Float[Tensor, "3 P"]:
        """What pixels inside show, in the camera's frame."""
        camera, (y, x) = self.camera, self.inside.nonzero(as_tuple=True)
        across, down = (x + 0.5 - camera.cx) / camera.fx, (y + 0.5 - camera.cy) / camera.fy
        return torch.stack([across, down, torch.ones_like(across)]) * self.depth[self.inside]

    def halved(self) -> "Shown":
        """At half the size; pixels count of which all four do."""
        width, height = (side // 2 for side in self.camera.size)
        image, depth, inside = (
            avg_pool2d(values[None].double(), 2)[0] for values in (self.image, self.depth, self.inside)
        )
        camera = self.camera.crop(0, 0, 2 * width, 2 * height).resize(width, height)
        counted = None if self.counted is None else avg_pool2d(self.counted[None].double(), 2)[0] == 1
        return replace(self, camera=camera, image=image, depth=depth, inside=inside == 1, counted=counted)

    @cached_property
    def masked(self) -> Float[Tensor, "1 H W"] | None:
        """1 near pixels of the photograph that do not count, else 0; None: all count."""
        return None if self.counted is None else grown(~self.counted[None], BORDER).double()

    def seen(self, points: Float[Tensor, "3 P"]) -> tuple[Float[Tensor, "2 P"], Bool[Tensor, "P"]]:
        """(where points of a camera's frame are seen, px; which of them, before the camera, and not near a border of
        the photograph or what does not count of it)."""
        pixels, told = seen_at(self.camera, points)
        return pixels, told if self.masked is None else told & (looked_up(self.masked, pixels, "nearest")[0] == 0)


def aligned(
    camera: Camera,
    image: Float[Tensor, "3 H W"],
    depth: Float[Tensor, "H W"],
    alpha: Float[Tensor, "H W"],
    photograph: Float[Tensor, "3 H W"],
    counted: Bool[Tensor, "H W"] | None,
    given: Camera | None = None,
    held: float = HELD,
) -> Camera:
    """The camera where a photograph was taken, from a render near there; as it is where pictures do not tell.

    depth: blending-weighted sum of camera z, scene units, as the rasterizer has it. given: whose pose the prior holds;
    None: that of the camera. held: pixels that say as much as that of a pose that is wrong by 1 px.
    """
    inside = (alpha > COVERED) & (depth > camera.near * alpha)
    inside = inside if counted is None else inside & counted.to(inside.device)
    z = torch.where(inside, depth.double() / alpha.double().clamp_min(COVERED), 1.0)
    wanted, from_given = grey(photograph), STILL if given is None else motion_to(given, camera)
    counted = None if counted is None else counted.to(inside.device)
    shown = Shown(
        camera=camera, image=grey(image), depth=z, inside=inside, counted=counted, given=from_given, held=held
    )
    found = motion_between(shown, wanted)
    if found is None or not mismatch(shown, wanted, found) <= mismatch(shown, wanted, STILL) + ALIKE:
        return camera
    return moved(camera, found)


def usual_depth(depth: Float[Tensor, "H W"], alpha: Float[Tensor, "H W"]) -> float:
    """Median camera z of what covers pixels, scene units; nan where nothing does."""
    covered = alpha > COVERED
    return float((depth[covered] / alpha[covered]).median()) if covered.any() else float("nan")


def motion_between(shown: Shown, photograph: Float[Tensor, "H W"]) -> Motion | None:
    """From the camera to where a photograph was taken, coarse to fine; None where nothing tells."""
    start = None
    if min(photograph.shape) >= 2 * SMALLEST:
        start = motion_between(shown.halved(), avg_pool2d(photograph[None], 2)[0])
    return refined(shown, photograph, start or STILL)


def refined(shown: Shown, photograph: Float[Tensor, "H W"], motion: Motion) -> Motion | None:
    """The motion found from one near to it; None where nothing tells, or it runs away."""
    if int(shown.inside.sum()) < LEAST:
        return None
    points, still = shown.points(), shown.image[shown.inside]
    # px to rad, and to scene units at the usual depth: steps in px are alike in what they change
    unit = still.new_tensor([1.0] * 3 + [float(points[2].median())] * 3) / shown.camera.focal
    slopes = torch.stack([central(photograph, 1), central(photograph, 0)])
    residual = None
    for _ in range(ROUNDS):
        there = motion.of(points)
        pixels, told = shown.seen(there)
        if int(told.sum()) < LEAST:
            return None
        [wanted], (right, down) = looked_up(photograph[None], pixels), looked_up(slopes, pixels, "bilinear")
        motions = unit[:, None] * by_motion(shown.camera, there, right, down)
        columns = torch.cat([-motions, still[None], torch.ones_like(still)[None]])
        residual = by_medians(still, wanted, told) if residual is None else residual
        off = motion.after(shown.given).twist() / unit
        fit = held_least_squares(columns[:, told], wanted[told], residual[told], off, shown.held)
        residual = wanted - fit @ columns
        step = fit[:6]
        motion = motion.then(unit[:3] * step[:3], unit[3:] * step[3:])
        if not bool((motion.twist() / unit).abs().max() < min(photograph.shape) / 4):
            return None
        if bool(step.abs().max() < ENOUGH):
            break
    return motion


def seen_at(camera: Camera, points: Float[Tensor, "3 P"]) -> tuple[Float[Tensor, "2 P"], Bool[Tensor, "P"]]:
    """(where points of a camera's frame are seen, px; which of them, before the camera and not near a border)."""
    x, y, z = points
    deep = z.clamp_min(max(camera.near, 1e-9))
    across, down = camera.fx * x / deep + camera.cx, camera.fy * y / deep + camera.cy
    told = (z > camera.near) & (across > BORDER) & (across < camera.width - BORDER)
    return torch.stack([across, down]), told & (down > BORDER) & (down < camera.height - BORDER)


def looked_up(
    images: Float[Tensor, "C H W"], pixels: Float[Tensor, "2 P"], mode: str = "bicubic"
) -> Float[Tensor, "C P"]:
    """Values between pixels."""
    places = 2 * pixels.T / pixels.new_tensor([images.shape[2], images.shape[1]]) - 1
    found = grid_sample(images[None], places[None, None], mode=mode, padding_mode="border", align_corners=False)
    return found[0, :, 0]


def by_motion(
    camera: Camera, points: Float[Tensor, "3 P"], right: Float[Tensor, "P"], down: Float[Tensor, "P"]
) -> Float[Tensor, "6 P"]:
    """How values change with a turn, per rad, and a move, per scene unit, of the points they are looked up for; `right`
    and `down`: their slopes, per px."""
    x, y, z = points
    across, along = right * camera.fx / z, down * camera.fy / z
    by_point = torch.stack([across, along, -(across * x + along * y) / z])
    return torch.cat([torch.linalg.cross(points, by_point, dim=0), by_point])


def held_least_squares(
    columns: Float[Tensor, "8 P"],
    wanted: Float[Tensor, "P"],
    residual: Float[Tensor, "P"],
    off: Float[Tensor, "6"],
    held: float,
) -> Float[Tensor, "8"]:
    """Factors of columns whose sum comes closest to what is wanted. The first six are a step, px, from a pose that is
    `off` that of the prior, which says as much as so many pixels; robust by the residuals of the last round."""
    weights = robust(residual)
    variance = float((weights * residual.square()).sum() / weights.sum())
    hold = wanted.new_full((8,), 1e-9 * len(wanted))  # what is plain has no slopes, and no gain beside its offset
    hold[:6] += variance * held
    system, right = (columns * weights) @ columns.T + torch.diag(hold), (columns * weights) @ wanted
    right[:6] -= hold[:6] * off
    scale = system.diagonal().sqrt()
    return torch.linalg.solve(system / scale / scale[:, None], right / scale) / scale


def mismatch(shown: Shown, photograph: Float[Tensor, "H W"], motion: Motion) -> float:
    """Median of what a motion leaves, brought to the same median; infinite where nothing tells."""
    points, still = shown.points(), shown.image[shown.inside]
    pixels, told = shown.seen(motion.of(points))
    if not told.any():
        return float("inf")
    return float(by_medians(still, looked_up(photograph[None], pixels)[0], told)[told].abs().median())
