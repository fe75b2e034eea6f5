"""Unusable observations of a COLMAP model: keypoints without a ray, points behind a camera."""

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from gsx.core.shapes import Bool, Float
from gsx.scenes.colmap_model import Model, ModelImage
from gsx.scenes.pose_files import some_names
from gsx.scenes.undistort import pinhole_of, rays_of, undistort_points


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
