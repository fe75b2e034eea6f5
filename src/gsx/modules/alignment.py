"""Pose of the camera that took a photo, estimated from a render near it.

A render with depth z has the point X = z ((p - c) / f, 1) of the camera's frame at pixel p; a photo from a pose (R, t)
relative to that camera has it at pi(R X + t). The estimate is the (R, t) that fits the photo to the render best up to a
gain and an offset: robust least squares on slopes of the photo (Lucas and Kanade 1981), coarse to fine. A prior holds
directions that images do not determine (a turn from a move, in front of a distant wall).
"""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TypeAlias

import torch
from torch import Tensor
from torch.nn.functional import grid_sample

from gsx.core.data.camera import Camera
from gsx.core.data.masks import grown
from gsx.core.errors import ConfigError
from gsx.core.shapes import Bool, Float
from gsx.formats.turned import cross_matrix
from gsx.modules.image_shift import (
    BORDER,
    MIN_PIXELS,
    MIN_SIDE,
    NEGLIGIBLE,
    Grey,
    Mask,
    halve,
    median_residual,
    robust_weights,
    slope,
    smoothed_grey,
)

Points: TypeAlias = Float[Tensor, "3 P"]
Pixels: TypeAlias = Float[Tensor, "2 P"]
"""Positions, px."""
Numbers: TypeAlias = Float[Tensor, "P"]

ROUNDS, MIN_STEP = 10, 0.02
"""Most iterations at each size; step at which they end, px."""
COVERED = 0.5
"""Least alpha of a pixel that has a depth."""
PRIOR_WEIGHT = 1000.0
"""Pixels that weigh as much as the prior of a pose that is 1 px off, where its error is unknown."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Motion:
    """A motion from one camera's frame to another's: X' = rotation X + move. float64."""

    rotation: Float[Tensor, "3 3"]
    move: Float[Tensor, "3"]
    """Scene units."""

    def apply(self, points: Points) -> Points:
        """Returns points of the first frame in the second."""
        return self.rotation @ points + self.move[:, None]

    def twist(self) -> Float[Tensor, "6"]:
        """Returns rotation vector, rad, and move; for small rotations."""
        skew = (self.rotation - self.rotation.T) / 2
        return torch.cat([torch.stack([skew[2, 1], skew[0, 2], skew[1, 0]]), self.move])

    def after(self, other: "Motion") -> "Motion":
        """Returns the composition: `other` first, then this."""
        return Motion(rotation=self.rotation @ other.rotation, move=self.apply(other.move[:, None])[:, 0])

    def then(self, turn: Float[Tensor, "3"], move: Float[Tensor, "3"]) -> "Motion":
        """Returns the composition: this first, then a rotation vector, rad, and a move."""
        rotation = rotation_by(turn)
        return Motion(rotation=rotation @ self.rotation, move=rotation @ self.move + move)


STILL = Motion(rotation=torch.eye(3, dtype=torch.float64), move=torch.zeros(3, dtype=torch.float64))


def rotation_by(turn: Float[Tensor, "3"]) -> Float[Tensor, "3 3"]:
    """Returns the rotation about a vector by its length, rad."""
    return torch.linalg.matrix_exp(cross_matrix(turn))


def motion_to(camera: Camera, other: Camera) -> Motion:
    """Returns the motion from one camera's frame to another's."""
    rotation = other.rotation.double() @ camera.rotation.double().T
    return Motion(rotation=rotation, move=other.translation.double() - rotation @ camera.translation.double())


def move_camera(camera: Camera, motion: Motion) -> Camera:
    """Returns the camera after a motion of its frame."""
    rotation, translation = camera.rotation.double(), camera.translation.double()
    # a rotation again: rounding of many motions would stretch it
    u, _, v = torch.linalg.svd(motion.rotation @ rotation)
    translation = motion.rotation @ translation + motion.move
    return replace(camera, rotation=(u @ v).to(camera.rotation), translation=translation.to(camera.translation))


@dataclass(frozen=True, eq=False)
class Reference:
    """A render with depth, float64, and what limits its alignment with a photo."""

    camera: Camera
    image: Grey
    depth: Float[Tensor, "H W"]
    """Camera z, scene units."""
    inside: Mask
    """Pixels that have a depth and count."""
    mask: Mask | None
    """Pixels of the photo that count; None: all."""
    offset: Motion
    """Motion from the prior's pose to that of the camera."""
    prior_weight: float
    """See `estimate_camera`. The same at half the size: a quarter of the pixels, half of the px."""

    def points(self) -> Points:
        """Returns the points of pixels inside, in the camera's frame."""
        camera, (y, x) = self.camera, self.inside.nonzero(as_tuple=True)
        across, down = (x + 0.5 - camera.cx) / camera.fx, (y + 0.5 - camera.cy) / camera.fy
        return torch.stack([across, down, torch.ones_like(across)]) * self.depth[self.inside]

    def halved(self) -> "Reference":
        """Returns the render at half the size; a pixel counts if all four do."""
        width, height = (side // 2 for side in self.camera.size)
        camera = self.camera.crop(0, 0, 2 * width, 2 * height).resize(width, height)
        image, depth, inside = (halve(values) for values in (self.image, self.depth, self.inside))
        mask = None if self.mask is None else halve(self.mask) == 1
        return replace(self, camera=camera, image=image, depth=depth, inside=inside == 1, mask=mask)

    @cached_property
    def excluded(self) -> Float[Tensor, "1 H W"] | None:
        """1 near pixels of the photo that do not count, else 0; None: all count."""
        return None if self.mask is None else grown(~self.mask[None], BORDER).double()

    def project(self, points: Points) -> tuple[Pixels, Bool[Tensor, "P"]]:
        """Projects points; returns (px, which lie in front of the camera, away from borders and excluded pixels)."""
        camera, (x, y, z) = self.camera, points
        deep = z.clamp_min(max(camera.near, 1e-9))
        across, down = camera.fx * x / deep + camera.cx, camera.fy * y / deep + camera.cy
        valid = (z > camera.near) & (across > BORDER) & (across < camera.width - BORDER)
        pixels, valid = torch.stack([across, down]), valid & (down > BORDER) & (down < camera.height - BORDER)
        if self.excluded is not None:
            valid = valid & (sample_image(self.excluded, pixels, "nearest")[0] == 0)
        return pixels, valid


def refuse_lens(camera: Camera) -> None:
    """Raises ConfigError for a camera with a lens: poses are estimated by the derivatives of a pinhole."""
    if camera.lens is not None:
        raise ConfigError("poses are not estimated through a lens: set scene.lens=undistort, or switch poses off")


def estimate_camera(
    camera: Camera,
    image: Float[Tensor, "3 H W"],
    depth: Float[Tensor, "H W"],
    alpha: Float[Tensor, "H W"],
    photo: Float[Tensor, "3 H W"],
    mask: Mask | None,
    prior: Camera | None = None,
    prior_weight: float = PRIOR_WEIGHT,
) -> Camera:
    """Estimates the camera that took a photo from a render near it; unchanged where images do not determine it.

    depth: blending-weighted sum of camera z, scene units. mask: pixels of the photo that count. prior: pose that the
    prior holds (None: the camera's). prior_weight: pixels that weigh as much as the prior of a pose that is 1 px off.
    """
    inside = (alpha > COVERED) & (depth > camera.near * alpha)
    mask = None if mask is None else mask.to(inside.device)
    inside = inside if mask is None else inside & mask
    z = torch.where(inside, depth.double() / alpha.double().clamp_min(COVERED), 1.0)
    target, offset = smoothed_grey(photo), STILL if prior is None else motion_to(prior, camera)
    reference = Reference(camera, smoothed_grey(image), z, inside, mask, offset, prior_weight)
    motion = estimate_motion(reference, target)
    if motion is None or not mismatch(reference, target, motion) <= mismatch(reference, target, STILL) + NEGLIGIBLE:
        return camera
    return move_camera(camera, motion)


def median_depth(depth: Float[Tensor, "H W"], alpha: Float[Tensor, "H W"]) -> float:
    """Returns the median camera z of covered pixels, scene units; nan without any."""
    covered = alpha > COVERED
    return float((depth[covered] / alpha[covered]).median()) if covered.any() else float("nan")


def estimate_motion(reference: Reference, photo: Grey) -> Motion | None:
    """Estimates the motion to the photo's pose, coarse to fine; None where pixels do not determine it."""
    start = None
    if min(photo.shape) >= 2 * MIN_SIDE:
        start = estimate_motion(reference.halved(), halve(photo))
    return refine(reference, photo, start or STILL)


def refine(reference: Reference, photo: Grey, motion: Motion) -> Motion | None:
    """Refines a motion; None where pixels do not determine it, or it diverges."""
    if int(reference.inside.sum()) < MIN_PIXELS:
        return None
    points, values = reference.points(), reference.image[reference.inside]
    # px to rad, and to scene units at the median depth: steps in px have effects of one size
    unit = values.new_tensor([1.0] * 3 + [float(points[2].median())] * 3) / reference.camera.focal
    slopes = torch.stack([slope(photo, 1), slope(photo, 0)])
    residual = None
    for _ in range(ROUNDS):
        moved = motion.apply(points)
        pixels, valid = reference.project(moved)
        if int(valid.sum()) < MIN_PIXELS:
            return None
        [target], (right, down) = sample_image(photo[None], pixels), sample_image(slopes, pixels, "bilinear")
        motions = unit[:, None] * motion_slopes(reference.camera, moved, right, down)
        columns = torch.cat([-motions, values[None], torch.ones_like(values)[None]])
        residual = median_residual(values, target, valid) if residual is None else residual
        off = motion.after(reference.offset).twist() / unit
        fit = fit_with_prior(columns[:, valid], target[valid], residual[valid], off, reference.prior_weight)
        residual = target - fit @ columns
        step = fit[:6]
        motion = motion.then(unit[:3] * step[:3], unit[3:] * step[3:])
        if not bool((motion.twist() / unit).abs().max() < min(photo.shape) / 4):
            return None
        if bool(step.abs().max() < MIN_STEP):
            break
    return motion


def sample_image(images: Float[Tensor, "C H W"], pixels: Pixels, mode: str = "bicubic") -> Float[Tensor, "C P"]:
    """Returns values of images at positions, px."""
    places = 2 * pixels.T / pixels.new_tensor([images.shape[2], images.shape[1]]) - 1
    values = grid_sample(images[None], places[None, None], mode=mode, padding_mode="border", align_corners=False)
    return values[0, :, 0]


def motion_slopes(camera: Camera, points: Points, right: Numbers, down: Numbers) -> Float[Tensor, "6 P"]:
    """Returns slopes of values by a turn, per rad, and a move, per scene unit, of their points, from those per px."""
    x, y, z = points
    across, along = right * camera.fx / z, down * camera.fy / z
    by_point = torch.stack([across, along, -(across * x + along * y) / z])
    return torch.cat([torch.linalg.cross(points, by_point, dim=0), by_point])


def fit_with_prior(
    columns: Float[Tensor, "8 P"], target: Numbers, residual: Numbers, off: Float[Tensor, "6"], prior_weight: float
) -> Float[Tensor, "8"]:
    """Returns coefficients of columns that fit the target, robust by the last residuals, with a prior.

    The first six are a step, px, from a pose that is `off` from the prior's.
    """
    weights = robust_weights(residual)
    variance = float((weights * residual.square()).sum() / weights.sum())
    hold = target.new_full((8,), 1e-9 * len(target))  # a flat image has no slopes, and no gain apart from its offset
    hold[:6] += variance * prior_weight
    system, right = (columns * weights) @ columns.T + torch.diag(hold), (columns * weights) @ target
    right[:6] -= hold[:6] * off
    scale = system.diagonal().sqrt()
    return torch.linalg.solve(system / scale / scale[:, None], right / scale) / scale


def mismatch(reference: Reference, photo: Grey, motion: Motion) -> float:
    """Returns the median difference after a motion, at the same median; infinite without valid pixels."""
    values = reference.image[reference.inside]
    pixels, valid = reference.project(motion.apply(reference.points()))
    if not valid.any():
        return float("inf")
    return float(median_residual(values, sample_image(photo[None], pixels)[0], valid)[valid].abs().median())
