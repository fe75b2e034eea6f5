"""Pinhole cameras, and cameras with a lens.

Conventions (docs/reference/conventions.md): x right, y down, z forward (OpenCV); pixel centres at +0.5, so the raster
covers [0, width] x [0, height]; the principal point (cx, cy) may lie outside the raster, as in crops.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol, runtime_checkable

import torch
from torch import Tensor

from gsx.core.backend import Backend
from gsx.core.device import upload
from gsx.core.errors import InputError
from gsx.core.shapes import Bool, Float

NEAR = 0.2  # 3D-GS rasterizer: splats at camera depth <= 0.2 scene units are culled


@dataclass(frozen=True, kw_only=True)
class Frame:
    """Raster that a crop was cut from, px; tiles and clamped slopes refer to it, so a crop renders the same bits."""

    left: int
    """First column of the crop on the frame; may be negative."""
    top: int
    """First row; may be negative."""
    width: int
    height: int

    def shares(self, across: float, down: float) -> tuple[float, float]:
        """Returns a shift in px as shares of width and height."""
        return across / self.width, down / self.height

    def scaled(self, sx: float, sy: float) -> "Frame":
        """Returns the frame with columns and rows scaled and rounded."""
        left, top, width, height = self.left * sx, self.top * sy, self.width * sx, self.height * sy
        return Frame(left=round(left), top=round(top), width=round(width), height=round(height))


@runtime_checkable
class LensModel(Protocol):
    """Distortion of a camera, from slopes x/z and y/z to distorted ones, to which fx, fy, cx, cy apply.

    It knows no raster, so crops and zooms of a camera share it. Lenses of the same pictures are equal.
    """

    def bend(self, points: Float[Tensor, "P 3"]) -> Float[Tensor, "P 2"]:
        """Returns distorted slopes of points in camera coordinates; NaN where the lens shows none."""

    def straighten(self, slopes: Float[Tensor, "P 2"]) -> Float[Tensor, "P 2"]:
        """Returns slopes of rays by their distorted slopes; NaN where there is no ray."""

    def selection(self, backend: Backend) -> Callable[..., Bool[Tensor, "N"]]:
        """Returns a function that marks Gaussians that `projection` takes.

        Its arguments: points in camera coordinates, scales, quats, the camera's rotation, and the least and the largest
        distorted slopes on the frame.
        """

    def projection(self, backend: Backend, variant: tuple[bool, bool]) -> Callable[..., Any]:
        """Returns a function that projects Gaussians as `geometry` of the rasterizer does, which has more arguments."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Camera:
    """Camera: x_camera = rotation @ x_world + translation, pixel = (fx x/z + cx, fy y/z + cy); a lens bends slopes."""

    rotation: Float[Tensor, "3 3"]
    """Rotation, camera from world."""
    translation: Float[Tensor, "3"]
    """Translation, camera from world, scene units."""
    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int
    near: float = NEAR
    """Largest depth at which splats are not drawn, scene units."""
    cut_from: Frame | None = None
    """Frame of a crop; None: no crop."""
    lens: LensModel | None = None
    """None: a pinhole."""

    @property
    def frame(self) -> Frame:
        """Frame of the raster, or the raster itself."""
        return self.cut_from or Frame(left=0, top=0, width=self.width, height=self.height)

    @property
    def centre(self) -> Float[Tensor, "3"]:
        """Camera centre, -R^T t, world coordinates."""
        return -self.rotation.T @ self.translation

    def to_camera(self, points: Float[Tensor, "P 3"]) -> Float[Tensor, "P 3"]:
        """Transforms world points to camera coordinates, in float64: far from the origin float32 is too coarse."""
        points, double = points.double(), torch.float64
        rotation, translation = (upload(x, points.device, double) for x in (self.rotation.T, self.translation))
        return points @ rotation + translation

    @property
    def size(self) -> tuple[int, int]:
        """(width, height), px."""
        return self.width, self.height

    @property
    def focal(self) -> float:
        """Larger focal length, px."""
        return max(self.fx, self.fy)

    def with_pose_of(self, other: "Camera") -> "Camera":
        """Returns this camera with the pose of another."""
        return replace(self, rotation=other.rotation, translation=other.translation)

    def has_pose_of(self, other: "Camera") -> bool:
        """Returns whether both poses have the same bits."""
        return torch.equal(self.rotation, other.rotation) and torch.equal(self.translation, other.translation)

    def draws_as(self, other: "Camera") -> bool:
        """Returns whether both draw pictures of the same bits."""
        numbers = ("fx", "fy", "cx", "cy", "width", "height", "near", "frame", "lens")
        alike = all(getattr(self, name) == getattr(other, name) for name in numbers)
        return alike and self.has_pose_of(other)

    def resize(self, width: int, height: int) -> "Camera":
        """Returns the same field of view on another raster; intrinsics scale per axis."""
        sx, sy = width / self.width, height / self.height
        return replace(
            self,
            fx=self.fx * sx,
            fy=self.fy * sy,
            cx=self.cx * sx,
            cy=self.cy * sy,
            width=width,
            height=height,
            cut_from=self.cut_from and self.cut_from.scaled(sx, sy),
        )

    def zoom(self, factor: float) -> "Camera":
        """Returns the camera with `factor` times the focal length and raster, rounded to whole pixels."""
        return self.resize(max(1, round(self.width * factor)), max(1, round(self.height * factor)))

    def crop(self, left: int, top: int, width: int, height: int) -> "Camera":
        """Returns the camera of a window with its upper left corner at pixel (left, top).

        Outside the raster, `cull=published` draws nothing, as 3D-GS, and `cull=tight` everything.

        Raises:
            InputError: the window has no pixels.
        """
        if width < 1 or height < 1:
            raise InputError(f"a window of {width} x {height} px has no pixels: give a width and a height of 1 or more")
        frame = replace(self.frame, left=self.frame.left + left, top=self.frame.top + top)
        return replace(self, cx=self.cx - left, cy=self.cy - top, width=width, height=height, cut_from=frame)

    def sees(self, points: Float[Tensor, "P 3"]) -> Bool[Tensor, "P"]:
        """Marks world points with depth > 0 that project onto the raster, occluded or not."""
        pixels, depth = self.project(points)
        return ((pixels >= 0) & (pixels <= pixels.new_tensor(self.size))).all(dim=1) & (depth > 0)

    def shows(self, pixels: Float[Tensor, "P 2"], depths: Float[Tensor, "P"]) -> Bool[Tensor, "P"]:
        """Marks projected points on a pixel of the raster and beyond the near plane."""
        return ((pixels >= 0) & (pixels < pixels.new_tensor(self.size))).all(1) & (depths > self.near)

    def narrow(self, fraction: float) -> "Camera":
        """Returns the camera of the central `fraction` of the raster."""
        width, height = max(1, round(self.width * fraction)), max(1, round(self.height * fraction))
        return self.crop((self.width - width) // 2, (self.height - height) // 2, width, height)

    def project(self, points: Float[Tensor, "P 3"]) -> tuple[Float[Tensor, "P 2"], Float[Tensor, "P"]]:
        """Returns pixel positions (invalid at depths <= 0; NaN where a lens has none) and depths of world points."""
        camera_points = self.to_camera(points)
        depth = camera_points[:, 2]
        focal, centre = depth.new_tensor([self.fx, self.fy]), depth.new_tensor([self.cx, self.cy])
        slopes = camera_points[:, :2] / depth[:, None] if self.lens is None else self.lens.bend(camera_points)
        return (slopes * focal + centre).to(points), depth.to(points)

    def slopes(self, pixels: Float[Tensor, "P 2"]) -> Float[Tensor, "P 2"]:
        """Returns x/z and y/z of the rays through pixel positions; NaN where a lens has none."""
        slopes = torch.stack([(pixels[:, 0] - self.cx) / self.fx, (pixels[:, 1] - self.cy) / self.fy], 1)
        return slopes if self.lens is None else self.lens.straighten(slopes)

    def unproject(self, pixels: Float[Tensor, "P 2"], depths: Float[Tensor, "P"]) -> Float[Tensor, "P 3"]:
        """Returns world points at pixel positions and depths."""
        points = torch.cat([self.slopes(pixels) * depths[:, None], depths[:, None]], 1).double()
        return ((points - self.translation.double()) @ self.rotation.double()).float()


def offsets_from(points: Float[Tensor, "P 3"], centre: Float[Tensor, "3"]) -> Float[Tensor, "P 3"]:
    """Returns points - centre, subtracted in float64, in the dtype of the points; differentiable in both.

    Rounding the centre first would move it by a float32 step of the coordinates (docs/explanation/numerics.md).
    """
    return (points.double() - upload(centre, points.device, torch.float64)).to(points)


def centres_of(cameras: Sequence[Camera]) -> Float[Tensor, "K 3"]:
    """Returns the centres of cameras, world coordinates, float64."""
    return torch.stack([camera.centre.double() for camera in cameras])


def look_at(
    eye: Sequence[float],
    target: Sequence[float],
    *,
    up: Sequence[float] = (0.0, 0.0, 1.0),
    fov_x: float,
    width: int,
    height: int,
    near: float = NEAR,
) -> Camera:
    """Returns a camera at `eye` towards `target`, `up` pointing up in the picture; `fov_x` in radians.

    Raises:
        ValueError: `eye` equals `target`, or `up` is parallel to the viewing direction.
    """
    position, goal = torch.tensor(eye, dtype=torch.float64), torch.tensor(target, dtype=torch.float64)
    forward = goal - position
    right = torch.linalg.cross(forward, torch.tensor(up, dtype=torch.float64))
    if not (forward.norm() > 0 and right.norm() > 1e-9 * forward.norm()):
        raise ValueError(f"look_at needs eye, target and up in general position, got {eye}, {target}, {up}")
    forward, right = forward / forward.norm(), right / right.norm()
    rotation = torch.stack([right, torch.linalg.cross(forward, right), forward])
    focal = width / (2 * math.tan(fov_x / 2))
    return pinhole(rotation, -rotation @ position, focal, width, height, near)


def pinhole(
    rotation: Float[Tensor, "3 3"],
    translation: Float[Tensor, "3"],
    focal: float,
    width: int,
    height: int,
    near: float = NEAR,
) -> Camera:
    """Returns a camera with square pixels and a central principal point; `focal` in px."""
    return Camera(
        rotation=rotation,
        translation=translation,
        fx=focal,
        fy=focal,
        cx=width / 2,
        cy=height / 2,
        width=width,
        height=height,
        near=near,
    )
