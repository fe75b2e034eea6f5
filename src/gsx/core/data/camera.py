"""Pinhole cameras and their exact algebra.

Conventions (docs/reference/conventions.md): x right, y down, z forward (OpenCV); pixel centres at +0.5, so the raster
covers [0, width] x [0, height]; `cx`, `cy` are honoured everywhere and may lie outside the raster (crops).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from gsx.core.device import uploaded
from gsx.core.errors import InputError
from gsx.core.shapes import Bool, Float

NEAR = 0.2  # 3D-GS rasterizer: splats at camera depth <= 0.2 scene units are culled


@dataclass(frozen=True, kw_only=True)
class Frame:
    """The raster a crop was cut from, in px, relative to which tiles are laid and slopes are clamped.

    It makes the render of a crop the crop of the render, bit for bit.
    """

    left: int
    """Column of the frame at which the raster begins; may be negative."""
    top: int
    width: int
    height: int

    def shares(self, across: float, down: float) -> tuple[float, float]:
        """Return a movement in px as shares of the sides."""
        return across / self.width, down / self.height

    def scaled(self, sx: float, sy: float) -> "Frame":
        """Return the frame on a raster with so many times as many columns and rows."""
        left, top, width, height = self.left * sx, self.top * sy, self.width * sx, self.height * sy
        return Frame(left=round(left), top=round(top), width=round(width), height=round(height))


@dataclass(frozen=True, eq=False, kw_only=True)
class Camera:
    """A pinhole camera: x_camera = rotation @ x_world + translation, pixel = (fx x/z + cx, fy y/z + cy)."""

    rotation: Float[Tensor, "3 3"]
    """Rotation camera_from_world."""
    translation: Float[Tensor, "3"]
    """Translation camera_from_world, in scene units."""
    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int
    near: float = NEAR
    """Splats at this camera depth or nearer are not drawn, in scene units."""
    cut_from: Frame | None = None
    """The frame this raster was cropped from; None: it is not cropped."""

    @property
    def frame(self) -> Frame:
        """The frame the raster lies in."""
        return self.cut_from or Frame(left=0, top=0, width=self.width, height=self.height)

    @property
    def centre(self) -> Float[Tensor, "3"]:
        """Camera centre in world coordinates, -R^T t."""
        return -self.rotation.T @ self.translation

    def to_camera(self, points: Float[Tensor, "P 3"]) -> Float[Tensor, "P 3"]:
        """Return world points in the camera's frame, float64: far from the origin float32 is too coarse."""
        points, double = points.double(), torch.float64
        rotation, translation = (uploaded(x, points.device, double) for x in (self.rotation.T, self.translation))
        return points @ rotation + translation

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) in pixels."""
        return self.width, self.height

    @property
    def focal(self) -> float:
        """The larger focal length, px."""
        return max(self.fx, self.fy)

    def with_pose_of(self, other: "Camera") -> "Camera":
        """Return this camera with the pose of another."""
        return replace(self, rotation=other.rotation, translation=other.translation)

    def has_pose_of(self, other: "Camera") -> bool:
        """Return whether both have one pose, bit for bit."""
        return torch.equal(self.rotation, other.rotation) and torch.equal(self.translation, other.translation)

    def draws_as(self, other: "Camera") -> bool:
        """Return whether both draw the same picture, bit for bit."""
        numbers = ("fx", "fy", "cx", "cy", "width", "height", "near", "frame")
        alike = all(getattr(self, name) == getattr(other, name) for name in numbers)
        return alike and self.has_pose_of(other)

    def resize(self, width: int, height: int) -> "Camera":
        """Return the same field of view on another raster; intrinsics scale per axis."""
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
        """Return the same view sampled more finely: `factor` times the focal length and the raster."""
        return self.resize(max(1, round(self.width * factor)), max(1, round(self.height * factor)))

    def crop(self, left: int, top: int, width: int, height: int) -> "Camera":
        """Return the camera of a window with its upper left corner at pixel (left, top); InputError: it has no pixels.

        Past the raster, `cull=published` draws nothing, as 3D-GS, and `cull=tight` all.
        """
        if width < 1 or height < 1:
            raise InputError(f"a window of {width} x {height} px has no pixels: give a width and a height of 1 or more")
        frame = replace(self.frame, left=self.frame.left + left, top=self.frame.top + top)
        return replace(self, cx=self.cx - left, cy=self.cy - top, width=width, height=height, cut_from=frame)

    def sees(self, points: Float[Tensor, "P 3"]) -> Bool[Tensor, "P"]:
        """Return which world points lie in front of it and within its raster, hidden or not."""
        pixels, depth = self.project(points)
        return ((pixels >= 0) & (pixels <= pixels.new_tensor(self.size))).all(dim=1) & (depth > 0)

    def shows(self, pixels: Float[Tensor, "P 2"], depths: Float[Tensor, "P"]) -> Bool[Tensor, "P"]:
        """Return which projected points lie on a pixel of its raster, beyond its near plane."""
        return ((pixels >= 0) & (pixels < pixels.new_tensor(self.size))).all(1) & (depths > self.near)

    def narrow(self, fraction: float) -> "Camera":
        """Return the camera of the centre `fraction` of the raster, at unchanged focal length."""
        width, height = max(1, round(self.width * fraction)), max(1, round(self.height * fraction))
        return self.crop((self.width - width) // 2, (self.height - height) // 2, width, height)

    def project(self, points: Float[Tensor, "P 3"]) -> tuple[Float[Tensor, "P 2"], Float[Tensor, "P"]]:
        """Return pixel positions and depths of world points; positions mean nothing where depth <= 0."""
        camera_points = self.to_camera(points)
        depth = camera_points[:, 2]
        focal, centre = depth.new_tensor([self.fx, self.fy]), depth.new_tensor([self.cx, self.cy])
        return (camera_points[:, :2] / depth[:, None] * focal + centre).to(points), depth.to(points)

    def unproject(self, pixels: Float[Tensor, "P 2"], depths: Float[Tensor, "P"]) -> Float[Tensor, "P 3"]:
        """Return world points at pixel positions and depths."""
        x = (pixels[:, 0] - self.cx) / self.fx * depths
        y = (pixels[:, 1] - self.cy) / self.fy * depths
        points = torch.stack([x, y, depths], 1).double()
        return ((points - self.translation.double()) @ self.rotation.double()).float()


def offsets_from(points: Float[Tensor, "P 3"], centre: Float[Tensor, "3"]) -> Float[Tensor, "P 3"]:
    """Return points - centre, subtracted in float64 and rounded to the dtype of the points; differentiable in both.

    Rounding the centre first would move it by a float32 step of the coordinates (docs/explanation/numerics.md).
    """
    return (points.double() - uploaded(centre, points.device, torch.float64)).to(points)


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
    """Return a camera at `eye` looking at `target`, `up` pointing up in the picture; field of view in radians.

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
    """Return a camera of square pixels with its principal point at the middle of the raster; focal length in px."""
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
