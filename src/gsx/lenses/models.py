"""Lens models of COLMAP in torch, differentiable, with the rays that they show.

All four share one form. A ray becomes a point of a plane: (x/z, y/z), or for a fisheye the same direction at a distance
equal to its angle from the axis. A rational polynomial, tangential and thin-prism terms then move the point (COLMAP,
sensor/models.h).
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from itertools import chain
from typing import Any

import torch
from torch import Tensor

from gsx.core.backend import Backend
from gsx.core.device import upload
from gsx.core.errors import InputError
from gsx.core.shapes import Bool, Float
from gsx.lenses.distortion import Coefficients, Form, bent, distorted, in_view, jacobian, radial_factor, turned
from gsx.lenses.unscented import project_through_lens, select_through_lens

LARGEST_ANGLE = math.radians(89.0)
"""Largest angle of a ray from the axis: splats behind the camera plane are not drawn."""
ANGLES, AZIMUTHS = 1780, 72
"""Places at which the map is checked for a fold: one each 0.05 degrees, one each 5 degrees."""
LEAST_AREA = 0.01
"""Least Jacobian determinant of the distortion, by that at the axis: at a fold it is 0."""
NEWTON_STEPS = 20
SAME = 1e-9
"""Largest residual of an inverted distortion, relative to the focal length."""
NONE4, NONE3, NONE2 = (0.0,) * 4, (0.0,) * 3, (0.0,) * 2
IDENTITY = (1.0, 0.0, 0.0, 1.0)


@dataclass(frozen=True, kw_only=True)
class Distortion:
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
        x, y, z = points.double().unbind(1)
        valid = in_view(self.coefficients, x, y, z)
        x, y, z = torch.where(valid, x, 0.0), torch.where(valid, y, 0.0), torch.where(valid, z, 1.0)
        slopes = torch.stack(bent(self.coefficients, self.form, x, y, z), 1)
        return torch.where(valid[:, None], slopes, torch.nan).to(points)

    def straighten(self, slopes: Float[Tensor, "P 2"]) -> Float[Tensor, "P 2"]:
        """Return slopes of rays by their distorted slopes; NaN where there is no ray."""
        back = turned(self.coefficients, self.form, *slopes.double().unbind(1), back=True)
        plane = self._undistorted(torch.stack(back, 1))
        radius = plane.norm(dim=1, keepdim=True)
        factor = torch.where(radius > 0, radius.tan() / radius, 1.0) if self.fisheye else 1.0
        return torch.stack(turned(self.coefficients, self.form, *(plane * factor).unbind(1)), 1).to(slopes)

    def turned(self, turn: Sequence[float]) -> "Distortion":
        """Return the lens of a camera that is turned about its axis; turn: rows of the 2 x 2 matrix."""
        rows = torch.tensor(turn, dtype=torch.float64).view(2, 2) @ torch.tensor(self.turn).double().view(2, 2)
        a, b, c, d = rows.flatten().tolist()
        return replace(self, turn=(a, b, c, d))

    # -- projection of Gaussians ---------------------------------------------------------------------------------------

    def selection(self, backend: Backend) -> Callable[..., Bool[Tensor, "N"]]:
        """Return `select_through_lens` of this lens."""
        kernel = backend.kernel(select_through_lens, self.form)
        return lambda points, *others: kernel(points, *others, upload(self.numbers, points.device))

    def projection(self, backend: Backend, variant: tuple[bool, bool]) -> Callable[..., tuple[Tensor | None, ...]]:
        """Return `project_through_lens` of this lens."""
        kernel = backend.kernel(project_through_lens, self.form, variant=variant)
        return lambda points, *others: kernel(points, *others, upload(self.numbers, points.device))

    @cached_property
    def form(self) -> Form:
        """Terms that are not 0."""
        return Form(
            fisheye=self.fisheye,
            radial=max((n for n, k in enumerate(self.radial, 1) if k), default=0),
            divisor=max((n for n, k in enumerate(self.divisor, 1) if k), default=0),
            tangential=any(self.tangential),
            prism=any(self.prism),
            turned=self.turn != IDENTITY,
        )

    @cached_property
    def coefficients(self) -> Coefficients:
        """Coefficients as floats."""
        steepest = math.tan(self.limit) if self.fisheye else self.limit
        return self._distortion._replace(steepest=steepest)

    @cached_property
    def numbers(self) -> Float[Tensor, "16"]:
        """Coefficients as a tensor, float64."""
        *parts, steepest = self.coefficients
        return torch.tensor([*chain(*parts), steepest], dtype=torch.float64)

    # -- inverse -------------------------------------------------------------------------------------------------------

    @property
    def _distortion(self) -> Coefficients:
        """Coefficients without the steepest slope, which follows from them."""
        return Coefficients(self.radial, self.divisor, self.tangential, self.prism, self.turn, math.inf)

    def _undistorted(self, places: Float[Tensor, "P 2"]) -> Float[Tensor, "P 2"]:
        """Invert `distorted` by Newton's method from the inverse of the radial part; NaN where it has none."""
        lens = self._distortion, self.form
        lengths, last = places.norm(dim=1), min(self.limit, math.tan(LARGEST_ANGLE))
        radii = torch.linspace(0, last, ANGLES, dtype=torch.float64, device=places.device)
        table = radii * radial_factor(*lens, radii.square())
        nearest = torch.searchsorted(table.cummax(0).values, lengths).clamp(max=ANGLES - 1)
        plane = places * (radii[nearest] / lengths.clamp_min(1e-30))[:, None]
        for _ in range(NEWTON_STEPS):
            a, b, c, d = jacobian(*lens, *plane.unbind(1))
            x, y = (torch.stack(distorted(*lens, *plane.unbind(1)), 1) - places).unbind(1)
            step = torch.stack([d * x - b * y, a * y - c * x], 1) / (a * d - b * c)[:, None]
            plane = plane - step.nan_to_num()
            plane = plane * (last / plane.norm(dim=1).clamp_min(last))[:, None]
        left = torch.stack(distorted(*lens, *plane.unbind(1)), 1) - places
        return torch.where((left.norm(dim=1) <= SAME * (1 + lengths))[:, None], plane, torch.nan)

    # -- folds ---------------------------------------------------------------------------------------------------------

    @cached_property
    def limit(self) -> float:
        """Radius on the plane up to which the picture grows in all directions, at most that of `LARGEST_ANGLE`."""
        lens = self._distortion, self.form
        angles = torch.linspace(0, LARGEST_ANGLE, ANGLES + 1, dtype=torch.float64)
        radii = angles if self.fisheye else angles.tan()
        turns = torch.linspace(0, 2 * math.pi, AZIMUTHS + 1, dtype=torch.float64)[:-1]
        x, y = (radii[:, None] * side for side in (turns.cos(), turns.sin()))
        (a, b, c, d), (across, down) = jacobian(*lens, x, y), distorted(*lens, x, y)
        outward = across * x + down * y >= 0
        grows = ((a * d - b * c > LEAST_AREA) & outward).all(1)
        return float(radii[int(grows.long().cumprod(0).sum()) - 1])


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
