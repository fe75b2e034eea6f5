"""Lens models of COLMAP in torch, differentiable, with the rays that they show.

All four share one form. A ray becomes a point of a plane: (x/z, y/z), or for a fisheye the same direction at a distance
equal to its angle from the axis. A rational polynomial, tangential and thin-prism terms then move the point (COLMAP,
sensor/models.h).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Any

import torch
from torch import Tensor

from gsx.core.errors import InputError
from gsx.core.shapes import Bool, Float
from gsx.lenses.unscented import Unscented

LARGEST_ANGLE = math.radians(89.0)
"""Largest angle of a ray from the axis: splats behind the camera plane are not drawn."""
ANGLES, AZIMUTHS = 1780, 72
"""Places at which the map is checked for a fold: one each 0.05 degrees, one each 5 degrees."""
LEAST_AREA = 0.01
"""Least Jacobian determinant of the distortion, by that at the axis: at a fold it is 0."""
NEAR_AXIS = 1e-6
"""Square of a slope below which angle / slope is a series."""
NEWTON_STEPS = 20
SAME = 1e-9
"""Largest residual of an inverted distortion, relative to the focal length."""
NONE4, NONE3, NONE2 = (0.0,) * 4, (0.0,) * 3, (0.0,) * 2
IDENTITY = (1.0, 0.0, 0.0, 1.0)


@dataclass(frozen=True, kw_only=True)
class Distortion(Unscented):
    """A lens of COLMAP (implements `gsx.core.data.camera.LensModel`)."""

    fisheye: bool = False
    """Distances from the axis on the plane are angles instead of slopes."""
    radial: tuple[float, float, float, float] = NONE4
    """Coefficients of r^2, r^4, r^6 and r^8 above the fraction's bar."""
    divisor: tuple[float, float, float] = NONE3
    """Coefficients of r^2, r^4 and r^6 below it."""
    tangential: tuple[float, float] = NONE2
    prism: tuple[float, float] = NONE2
    """Coefficients of r^2 in x and y."""
    turn: tuple[float, float, float, float] = IDENTITY
    """Rows of the turn from the lens's axes to the camera's: photos are turned upright."""

    # -- rays to slopes ------------------------------------------------------------------------------------------------

    def bend(self, points: Float[Tensor, "P 3"]) -> Float[Tensor, "P 2"]:
        """Return distorted slopes of points in camera coordinates; NaN beyond the fold or behind the camera."""
        plane, valid = self._on_plane(points.double())
        return torch.where(valid[:, None], self._turned(self._distorted(plane)), torch.nan).to(points)

    def straighten(self, slopes: Float[Tensor, "P 2"]) -> Float[Tensor, "P 2"]:
        """Return slopes of rays by their distorted slopes; NaN where there is no ray."""
        plane = self._undistorted(self._turned(slopes.double(), back=True))
        radius = plane.norm(dim=1, keepdim=True)
        factor = torch.where(radius > 0, radius.tan() / radius, 1.0) if self.fisheye else 1.0
        return self._turned(plane * factor).to(slopes)

    def turned(self, turn: Sequence[float]) -> "Distortion":
        """Return the lens of a camera that is turned about its axis; turn: rows of the 2 x 2 matrix."""
        rows = torch.tensor(turn, dtype=torch.float64).view(2, 2) @ torch.tensor(self.turn).double().view(2, 2)
        a, b, c, d = rows.flatten().tolist()
        return replace(self, turn=(a, b, c, d))

    # -- steps ---------------------------------------------------------------------------------------------------------

    def _turned(self, places: Float[Tensor, "P 2"], back: bool = False) -> Float[Tensor, "P 2"]:
        if self.turn == IDENTITY:
            return places
        rows = places.new_tensor(self.turn).view(2, 2)
        return places @ (rows if back else rows.T)

    def _on_plane(self, points: Float[Tensor, "P 3"]) -> tuple[Float[Tensor, "P 2"], Bool[Tensor, "P"]]:
        """Return places of points on the plane, 0 where the lens shows none, and where it shows one."""
        across, depth = self._turned(points[:, :2], back=True), points[:, 2]
        squares = across.square().sum(1)
        steepest = math.tan(self.limit) if self.fisheye else self.limit
        valid = (depth > 0) & (squares <= (steepest * depth).square())
        across = torch.where(valid[:, None], across / torch.where(valid, depth, 1.0)[:, None], 0.0)
        if not self.fisheye:
            return across, valid
        squares = across.square().sum(1)
        near = squares < NEAR_AXIS
        slopes = torch.where(near, 1.0, squares).sqrt()
        factor = torch.where(near, 1 - squares / 3 + squares.square() / 5, slopes.atan() / slopes)
        return across * factor[:, None], valid

    def _factor(self, squares: Float[Tensor, "P"]) -> Float[Tensor, "P"]:
        """Return the factor of the radius."""
        above = polynomial((1.0, *self.radial), squares)
        return above / polynomial((1.0, *self.divisor), squares) if any(self.divisor) else above

    def _factor_slope(self, squares: Float[Tensor, "P"]) -> Float[Tensor, "P"]:
        """Return the derivative of the factor by the squared radius."""
        above, below = (derivative((1.0, *coefficients)) for coefficients in (self.radial, self.divisor))
        change = polynomial(above, squares) - self._factor(squares) * polynomial(below, squares)
        return change / polynomial((1.0, *self.divisor), squares)

    def _distorted(self, plane: Float[Tensor, "P 2"]) -> Float[Tensor, "P 2"]:
        x, y = plane.unbind(1)
        (p1, p2), (s1, s2), squares = self.tangential, self.prism, x * x + y * y
        across, down = plane.T * self._factor(squares)
        if any((p1, p2)):
            across = across + 2 * p1 * x * y + p2 * (squares + 2 * x * x)
            down = down + 2 * p2 * x * y + p1 * (squares + 2 * y * y)
        if any((s1, s2)):
            across, down = across + s1 * squares, down + s2 * squares
        return torch.stack([across, down], 1)

    def _jacobian(self, plane: Float[Tensor, "P 2"]) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Return the derivatives of `_distorted` by row: (ax, ay, dx, dy)."""
        x, y = plane.unbind(1)
        (p1, p2), (s1, s2) = self.tangential, self.prism
        factor, slope = self._factor(x * x + y * y), self._factor_slope(x * x + y * y)
        both = 2 * x * y * slope + 2 * (p1 * x + p2 * y)
        return (
            factor + 2 * x * x * slope + 2 * p1 * y + 6 * p2 * x + 2 * s1 * x,
            both + 2 * s1 * y,
            both + 2 * s2 * x,
            factor + 2 * y * y * slope + 2 * p2 * x + 6 * p1 * y + 2 * s2 * y,
        )

    def _undistorted(self, places: Float[Tensor, "P 2"]) -> Float[Tensor, "P 2"]:
        """Invert `_distorted` by Newton's method from the inverse of the radial part; NaN where it has none."""
        lengths, last = places.norm(dim=1), min(self.limit, math.tan(LARGEST_ANGLE))
        radii = torch.linspace(0, last, ANGLES, dtype=torch.float64, device=places.device)
        table = radii * self._factor(radii.square())
        nearest = torch.searchsorted(table.cummax(0).values, lengths).clamp(max=ANGLES - 1)
        plane = places * (radii[nearest] / lengths.clamp_min(1e-30))[:, None]
        for _ in range(NEWTON_STEPS):
            a, b, c, d = self._jacobian(plane)
            x, y = (self._distorted(plane) - places).unbind(1)
            step = torch.stack([d * x - b * y, a * y - c * x], 1) / (a * d - b * c)[:, None]
            plane = plane - step.nan_to_num()
            plane = plane * (last / plane.norm(dim=1).clamp_min(last))[:, None]
        same = (self._distorted(plane) - places).norm(dim=1) <= SAME * (1 + lengths)
        return torch.where(same[:, None], plane, torch.nan)

    # -- folds ---------------------------------------------------------------------------------------------------------

    @cached_property
    def limit(self) -> float:
        """Radius on the plane up to which the picture grows in all directions, at most that of `LARGEST_ANGLE`."""
        angles = torch.linspace(0, LARGEST_ANGLE, ANGLES + 1, dtype=torch.float64)
        radii = angles if self.fisheye else angles.tan()
        turns = torch.linspace(0, 2 * math.pi, AZIMUTHS + 1, dtype=torch.float64)[:-1]
        plane = (radii[:, None, None] * torch.stack([turns.cos(), turns.sin()], 1)).flatten(0, 1)
        a, b, c, d = self._jacobian(plane)
        outward = (self._distorted(plane) * plane).sum(1) >= 0
        grows = ((a * d - b * c > LEAST_AREA) & outward).view(ANGLES + 1, AZIMUTHS).all(1)
        return float(radii[int(grows.long().cumprod(0).sum()) - 1])


def polynomial(coefficients: Sequence[float], squares: Float[Tensor, "P"]) -> Float[Tensor, "P"]:
    """Return c0 + c1 s + c2 s^2 + ..., without products of leading zeros."""
    last = max((n for n, coefficient in enumerate(coefficients) if coefficient), default=0)
    value = torch.full_like(squares, coefficients[last])
    for coefficient in reversed(coefficients[:last]):
        value = value * squares + coefficient
    return value


def derivative(coefficients: Sequence[float]) -> list[float]:
    """Return the coefficients of a polynomial's derivative."""
    return [n * coefficient for n, coefficient in enumerate(coefficients)][1:]


NATIVE = (
    *("OPENCV", "FULL_OPENCV", "SIMPLE_RADIAL", "RADIAL"),
    *("OPENCV_FISHEYE", "THIN_PRISM_FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE"),
)
"""COLMAP's names of the models."""


def lens_of(camera: Any) -> Distortion | None:
    """Return the lens of a pycolmap camera; None: it is a pinhole.

    Raises:
        InputError: its model is none of `NATIVE`, or its numbers are not finite.
    """
    if camera.is_perspective_pinhole() and camera.is_undistorted():
        return None
    return _lens_of(camera.model_name, tuple(camera.params[len(camera.focal_length_idxs()) + 2 :].tolist()))


@lru_cache(maxsize=1024)
def _lens_of(name: str, params: tuple[float, ...]) -> Distortion:
    if name not in NATIVE:
        raise InputError(f"scene.lens=native renders {', '.join(NATIVE)}, not {name}: set scene.lens=undistort.")
    if not all(map(math.isfinite, params)):
        raise InputError(f"A {name} camera has distortion {list(params)}: correct its intrinsics.")
    k = (*params, *[0.0] * 8)[:8]
    if name in ("OPENCV", "FULL_OPENCV"):
        return Distortion(radial=(k[0], k[1], k[4], 0.0), divisor=(k[5], k[6], k[7]), tangential=(k[2], k[3]))
    if name == "THIN_PRISM_FISHEYE":
        return Distortion(fisheye=True, radial=(k[0], k[1], k[4], k[5]), tangential=(k[2], k[3]), prism=(k[6], k[7]))
    return Distortion(fisheye="FISHEYE" in name, radial=(k[0], k[1], k[2], k[3]))
