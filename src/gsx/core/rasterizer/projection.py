"""World Gaussians to screen Gaussians, stable by construction (docs/numerics.md; 3D-GS sections 3.1 and 3.2)."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from gsx.core.camera import Camera, Frame
from gsx.core.errors import InputError
from gsx.core.rasterizer.settings import RasterSettings
from gsx.core.shapes import Bool, Float, Int
from gsx.core.splats import Splats

OPACITY_SLACK = 1e-3
"""ln of an opacity may exceed 0 by this, for rounding."""
SQUARABLE = 0.4
"""Lengths in px stay below this power of their dtype's largest number: 3e15 in float32."""
LENS_LIMIT = 1e12
"""No lens has a focal length of so many px, or sees so many focal lengths off its axis."""


@dataclass(frozen=True, eq=False, kw_only=True)
class ScreenSplats:
    """M splats in front of the camera. Positions in pixels of the camera's frame, pixel centres at +0.5."""

    ids: Int[Tensor, "M"]
    """Row of the splat in the input."""
    means: Float[Tensor, "M 2"]
    depths: Float[Tensor, "M"]
    """Camera z, scene units."""
    covariances: Float[Tensor, "M 3"]
    """xx, xy, yy after dilation, px^2."""
    factors: Float[Tensor, "M 3"]
    """(u0, u1, u2): half the inverse covariance is U^T U with U = [[u0, u1], [0, u2]]."""
    log_opacities: Float[Tensor, "M"]
    channels: Float[Tensor, "M C"]
    dropped: int
    """Splats left out because a value or a projection of theirs is not finite, or its square is not."""


def rotate_back(quats: Float[Tensor, "M 4"], vectors: Float[Tensor, "M V 3"]) -> Float[Tensor, "M V 3"]:
    """R(q)^T v for quaternions (w, x, y, z) of any length; a zero quaternion is the identity."""
    # the largest part first: the square of a long quaternion would overflow. q / max(|q|, 1e-12) in the end
    largest = quats.detach().abs().amax(1, keepdim=True).clamp_min(1e-12)
    unit = torch.nn.functional.normalize(quats / largest, dim=1, eps=1.0)[:, None, :].expand(-1, vectors.shape[1], -1)
    w, axis = unit[..., :1], unit[..., 1:]
    twice_cross = 2 * torch.linalg.cross(axis, vectors)
    return vectors - w * twice_cross + torch.linalg.cross(axis, twice_cross)


def lens_of(camera: Camera, intrinsics: Float[Tensor, "4"] | None) -> Float[Tensor, "4"]:
    """(fx, fy, cx, cy) of the camera's raster in float64, `intrinsics` where they are given."""
    if intrinsics is None:
        return torch.tensor([camera.fx, camera.fy, camera.cx, camera.cy], dtype=torch.float64)
    return intrinsics.double()


def on_frame(lens: Float[Tensor, "4"], frame: Frame) -> Float[Tensor, "4"]:
    """The lens with its principal point counted on the frame."""
    return lens + lens.new_tensor([0, 0, frame.left, frame.top])


def slope_bounds(
    lens: Float[Tensor, "4"], frame: Frame, margin: float
) -> tuple[Float[Tensor, "2"], Float[Tensor, "2"]]:
    """Smallest and largest (x/z, y/z) over the frame widened by `margin` half-extents: asymmetric off centre."""
    focal, centre = lens[:2], lens[2:]
    size = lens.new_tensor([frame.width, frame.height])
    extra = margin * size / (2 * focal)
    return -centre / focal - extra, (size - centre) / focal + extra


@torch.no_grad()
def steepest_slope(lens: Float[Tensor, "4"], frame: Frame, margin: float) -> Float[Tensor, ""]:
    """Largest |x/z| or |y/z| within the bounds."""
    return torch.cat(slope_bounds(lens, frame, margin)).abs().amax()


def refuse_unusable(camera: Camera, lens: Float[Tensor, "4"], margin: float) -> None:
    """Raise InputError for a camera through which nothing can be projected."""
    fx, fy, cx, cy = lens.tolist()
    words = f"fx={fx}, fy={fy}, cx={cx}, cy={cy}, near={camera.near}"
    if not (0 < fx < LENS_LIMIT and 0 < fy < LENS_LIMIT and 0 <= camera.near < math.inf):
        raise InputError(f"a camera has {words}: focal lengths must be in (0, {LENS_LIMIT:g}) px, near at least 0")
    if not float(steepest_slope(on_frame(lens, camera.frame), camera.frame, margin)) < LENS_LIMIT:
        raise InputError(f"a camera has {words} and sees {LENS_LIMIT:g} focal lengths off its axis: check its lens")
    if not bool(torch.isfinite(camera.rotation).all() & torch.isfinite(camera.translation).all()):
        pose = f"rotation {camera.rotation.tolist()}, translation {camera.translation.tolist()}"
        raise InputError(f"the pose of a camera is not finite: {pose}")


def clamped_slopes(
    camera_points: Float[Tensor, "M 3"], lens: Float[Tensor, "4"], frame: Frame, margin: float
) -> tuple[Float[Tensor, "M"], Float[Tensor, "M"]]:
    """x/z and y/z, clamped to `slope_bounds`."""
    low, high = slope_bounds(lens, frame, margin)
    slopes = camera_points[:, :2] / camera_points[:, 2:]
    x, y = slopes.clamp(low.to(slopes), high.to(slopes)).unbind(1)
    return x, y


def screen_axes(
    splats: Splats,
    camera_points: Float[Tensor, "M 3"],
    ids: Int[Tensor, "M"],
    camera: Camera,
    lens: Float[Tensor, "4"],
    margin: float,
) -> tuple[Float[Tensor, "M 2 3"], Float[Tensor, "M 3"]]:
    """J W R diag(s) as axes diag(sizes): rows without unit, and standard deviations in px at the splat's depth."""
    slope_x, slope_y = clamped_slopes(camera_points, lens, camera.frame, margin)
    world_to_camera = camera.rotation.to(camera_points)
    longest = lens[:2].detach().amax()
    stretch_x, stretch_y = (lens[:2] / longest).to(camera_points)
    row_x = stretch_x * (world_to_camera[0] - slope_x[:, None] * world_to_camera[2])
    row_y = stretch_y * (world_to_camera[1] - slope_y[:, None] * world_to_camera[2])
    sizes = splats.scales[ids] * (longest.to(camera_points) / camera_points[:, 2:])
    return rotate_back(splats.quats[ids], torch.stack([row_x, row_y], 1)), sizes


def covariance_and_factor(
    axes: Float[Tensor, "M 2 3"], sizes: Float[Tensor, "M 3"], dilation: float
) -> tuple[Float[Tensor, "M 3"], Float[Tensor, "M 3"]]:
    """Dilated covariance (xx, xy, yy) and the factor U; with rows p, q of axes diag(sizes) the former is P P^T + d I.

    Its determinant is |p x q|^2 + d (|p|^2 + |q|^2) + d^2 by Lagrange's identity: no cancellation, never negative;
    p x q comes from the unscaled rows, so that a needle's thickness is not a difference of products of its length.
    """
    p, q = (axes * sizes[:, None, :]).unbind(1)
    pp, pq, qq = (p * p).sum(1), (p * q).sum(1), (q * q).sum(1)
    xx, yy = pp + dilation, qq + dilation
    others = sizes.roll(-1, 1) * sizes.roll(-2, 1)
    area = torch.linalg.cross(axes[:, 0], axes[:, 1]) * others * yy.rsqrt()[:, None]  # |p x q| / sqrt(yy)
    remainder = area.square().sum(1) + dilation * (pp / yy + 1)  # determinant / yy: squares of px, not fourth powers
    u0 = (2 * remainder).rsqrt()
    return torch.stack([xx, pq, yy], 1), torch.stack([u0, -pq / yy * u0, (2 * yy).rsqrt()], 1)


def camera_points(splats: Splats, camera: Camera) -> Float[Tensor, "N 3"]:
    """Positions in the camera's frame, in float64: float32 is too coarse far from the origin or through a long lens."""
    means = splats.means.double()
    return means @ camera.rotation.T.to(means) + camera.translation.to(means)


@torch.no_grad()
def usable(splats: Splats) -> Bool[Tensor, "N"]:
    """False for splats with a value that is not finite (an opacity of 0, ln -inf, is fine) or an opacity above 1."""
    total = splats.means.sum(1) + splats.scales.sum(1) + splats.quats.sum(1) + splats.colours.sum(1)
    return torch.isfinite(total) & (splats.log_opacities <= OPACITY_SLACK)


@torch.no_grad()
def in_range(
    splats: Splats, points: Float[Tensor, "N 3"], lens: Float[Tensor, "4"], frame: Frame, margin: float
) -> Bool[Tensor, "N"]:
    """Splats before the camera whose mean and axes in px can be squared in their dtype, as can 1 / depth."""
    largest = torch.finfo(splats.means.dtype).max
    x, y, z = points.abs().unbind(1)
    size = splats.scales.abs().amax(1).clamp_min(1).double() * (1 + steepest_slope(lens, frame, margin))
    fits = size.maximum(x).maximum(y) * lens[:2].amax() < largest**SQUARABLE * z
    return fits & (x.maximum(y).maximum(z) <= largest)


def project(
    splats: Splats, camera: Camera, settings: RasterSettings, intrinsics: Float[Tensor, "4"] | None = None
) -> ScreenSplats:
    """The usable splats in front of the near plane as the camera sees them; differentiable in every input.

    `intrinsics` (fx, fy, cx, cy) take the place of the camera's own, in px of its raster.

    Raises:
        InputError: no picture can be taken with the camera's numbers.
    """
    margin, lens = settings.jacobian_margin, lens_of(camera, intrinsics)
    refuse_unusable(camera, lens, margin)
    lens = on_frame(lens, camera.frame).to(splats.means.device)
    points = camera_points(splats, camera)
    # selecting comes before any division (spec 12); a depth that rounds to the near plane is not beyond it
    in_front = points[:, 2].to(splats.means) > camera.near
    good = usable(splats) & (in_range(splats, points, lens, camera.frame, margin) | ~in_front)
    ids = (good & in_front).nonzero()[:, 0]
    points = points[ids]
    means = points[:, :2] / points[:, 2:] * lens[:2] + lens[2:]
    points = points.to(splats.means)
    axes, sizes = screen_axes(splats, points, ids, camera, lens, margin)
    covariances, factors = covariance_and_factor(axes, sizes, settings.dilation)
    return ScreenSplats(
        ids=ids,
        means=means.to(splats.means),
        depths=points[:, 2],
        covariances=covariances,
        factors=factors,
        log_opacities=splats.log_opacities[ids],
        channels=splats.colours[ids],
        dropped=len(good) - int(good.sum()),
    )
