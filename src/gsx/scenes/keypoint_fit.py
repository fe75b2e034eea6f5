"""Fit of a model's cameras to its keypoints: the movement of a whole picture, and the focal length of each photo.

A wrong pose, focal length or lens shifts the keypoints of a picture together; noise shifts each on its own. To separate
them, a movement is fitted to every other keypoint of an image and has to predict those in between. Keypoints without a
ray and points behind a camera are counted.
"""

import math
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from gsx.core.shapes import Bool, Float
from gsx.scenes.colmap_model import Model, ModelImage
from gsx.scenes.pose_files import some_names
from gsx.scenes.undistort import pinhole_of, rays_of, undistort_points

LEAST = 32  # observations of an image from which its movement is estimated
FLAT = 1e3  # a point farther to the side than so many times its depth lies in the plane of the camera's centre
REWEIGHTED = 5  # fits with robust weights from the residuals of the last one
FOCAL = 6  # column of the focal length among `movements`


@dataclass(frozen=True)
class Unmeasured:
    """Numbers of observations that are left out, or infinitely wrong."""

    no_ray: int = 0
    """Keypoints for which the lens has no ray, or that are not finite."""
    behind: int = 0
    """Observed points behind their camera."""
    blind: tuple[str, ...] = ()
    """Images without a keypoint that has a ray."""

    def __str__(self) -> str:
        """Return clauses to append to a sentence; an empty string if all observations are measured."""
        no_ray = f"; keypoints for which the lens has no ray, left out: {self.no_ray}" if self.no_ray else ""
        blind = f"; no keypoint is left of {some_names(self.blind)}" if self.blind else ""
        behind = f"; observed points that lie behind their camera: {self.behind}" if self.behind else ""
        return no_ray + blind + behind


def straight_keypoints(image: ModelImage, intrinsics: Any) -> Float[Tensor, "K 2"]:
    """Return keypoints in px of the pinhole of `intrinsics`, a pycolmap camera; NaN for those without a ray."""
    return undistort_points(intrinsics, pinhole_of(intrinsics), image.keypoints)


def with_rays(keypoints: Float[Tensor, "K 2"], intrinsics: Any) -> Float[Tensor, "K 2"]:
    """Return keypoints in px of a pycolmap camera; NaN for those without a ray."""
    return torch.where(rays_of(intrinsics, keypoints).isfinite(), keypoints, torch.nan)


def known(pixels: Float[Tensor, "K 2"]) -> Bool[Tensor, "K"]:
    """Return which pixel positions are finite."""
    return pixels.isfinite().all(dim=1)


def unmeasured(model: Model) -> Unmeasured:
    """Count the unusable observations of a model; InputError as `pinhole_of`."""
    rays = [known(straight_keypoints(image, model.cameras[image.camera_id])) for image in model.images]
    ahead = [(image.observed @ image.rotation.T + image.translation)[:, 2] > 0 for image in model.images]
    return counted([image.name for image in model.images], rays, [~one for one in ahead])


def counted(names: list[str], rays: list[Bool[Tensor, "_"]], behind: list[Bool[Tensor, "_"]]) -> Unmeasured:
    """Count unusable observations, by image: which keypoints have a ray, and which points lie behind the camera."""
    return Unmeasured(
        no_ray=sum(int((~one).sum()) for one in rays),
        behind=sum(int((one & other).sum()) for one, other in zip(rays, behind, strict=True)),
        blind=tuple(name for name, one in zip(names, rays, strict=True) if len(one) and not bool(one.any())),
    )


def shift_of(model: Model) -> float | None:
    """Return the root mean square shift of pictures against their observations, model's px; None: too few."""
    squares = [explained(image, model.cameras[image.camera_id]) for image in model.images]
    finite = [square for square in squares if square is not None and math.isfinite(square)]
    return math.sqrt(max(0.0, sum(finite) / len(finite))) if finite else None


def explained(image: ModelImage, intrinsics: Any) -> float | None:
    """Return the mean square movement, px^2, that half an image's keypoints predict for the other; None: too few."""
    measured = offsets(image, intrinsics)
    if measured is None:
        return None
    columns, off = measured
    products = [predicted(columns, off, slice(start, None, 2), slice(1 - start, None, 2)) for start in range(2)]
    pinhole = pinhole_of(intrinsics)
    mean_square = (pinhole.focal_length_x**2 + pinhole.focal_length_y**2) / 2
    return mean_square * sum(products) / len(products)


def offsets(image: ModelImage, intrinsics: Any) -> tuple[Float[Tensor, "K 2 8"], Float[Tensor, "K 2"]] | None:
    """Return derivatives by `movements`, and directions of keypoints less those of their points; None: too few."""
    pinhole, observed = pinhole_of(intrinsics), straight_keypoints(image, intrinsics)
    points = image.observed @ image.rotation.T + image.translation
    usable = (points[:, 2] > 0) & (points[:, :2].abs() <= FLAT * points[:, 2:]).all(1) & known(observed)
    x, y, z = points[usable].T
    if len(z) < LEAST:
        return None
    focal = observed.new_tensor([pinhole.focal_length_x, pinhole.focal_length_y])
    centre = observed.new_tensor([pinhole.principal_point_x, pinhole.principal_point_y])
    off = (observed[usable] - centre) / focal - torch.stack([x / z, y / z], 1)
    return movements(x / z, y / z, z), off


def movements(x: Float[Tensor, "K"], y: Float[Tensor, "K"], z: Float[Tensor, "K"]) -> Float[Tensor, "K 2 8"]:
    """Return derivatives of directions by turns about each axis, steps along each, focal length, radial distortion."""
    none, one, squared = torch.zeros_like(x), torch.ones_like(x), x * x + y * y
    across = [-x * y, 1 + x * x, -y, one / z, none, -x / z, x, x * squared]
    down = [-1 - y * y, x * y, x, none, one / z, -y / z, y, y * squared]
    return torch.stack([torch.stack(across, -1), torch.stack(down, -1)], 1)


def focal_change(image: ModelImage, intrinsics: Any) -> tuple[float, float] | None:
    """Return the change of an image's focal length that fits its keypoints best at fixed points, and its uncertainty.

    Both are shares of the focal length; the second is one standard deviation from the residuals themselves (White
    1980). The pose and radial distortion of the image are fitted with it. None: too few observations.
    """
    measured = offsets(image, intrinsics)
    if measured is None:
        return None
    columns, off = measured
    residuals = off
    for _ in range(REWEIGHTED):
        weights = robust_weights(residuals)
        movement, inverse = fitted_movement(columns, off, weights)
        residuals = off - columns @ movement
    left = (weights[:, None, None] * columns * residuals[:, :, None]).sum(1)
    variance = (inverse @ left.T @ left @ inverse)[FOCAL, FOCAL]
    downweighted = float(weights.mean() / weights.square().mean())  # mean slope of the Cauchy score is E[w^2]
    return float(movement[FOCAL]), downweighted * math.sqrt(max(0.0, float(variance)))


def robust_weights(off: Float[Tensor, "K 2"]) -> Float[Tensor, "K"]:
    """Return Cauchy weights of offsets by their median square."""
    squares = off.square().sum(1)
    return 1 / (1 + squares / squares.median().clamp_min(1e-18))


def fitted_movement(
    columns: Float[Tensor, "K 2 8"], off: Float[Tensor, "K 2"], weights: Float[Tensor, "K"]
) -> tuple[Float[Tensor, "8"], Float[Tensor, "8 8"]]:
    """Fit a movement to offsets by weighted least squares; returns it and the inverse of its normal matrix."""
    weighted = (columns * weights[:, None, None]).flatten(0, 1).T
    system, right = weighted @ columns.flatten(0, 1), weighted @ off.flatten()
    scale = system.diagonal().sqrt().clamp_min(1e-12)
    held = system / scale / scale[:, None] + 1e-6 * torch.eye(len(scale), dtype=scale.dtype)
    inverse = torch.linalg.inv(held)
    return torch.linalg.solve(held, right / scale) / scale, inverse / scale / scale[:, None]


def predicted(columns: Float[Tensor, "K 2 8"], off: Float[Tensor, "K 2"], fitted: slice, other: slice) -> float:
    """Fit a movement to some offsets; returns the mean product of the other offsets with its prediction."""
    weights = robust_weights(off)
    movement, _ = fitted_movement(columns[fitted], off[fitted], weights[fitted])
    products = ((columns[other] @ movement) * off[other]).sum(1)
    return float((weights[other] * products).sum() / weights[other].sum())
