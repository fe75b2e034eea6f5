"""Projection of Gaussians to the screen (docs/explanation/numerics.md; 3D-GS sections 3.1 and 3.2)."""

import math
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from gsx.core.backend import EAGER
from gsx.core.data.camera import Camera, Frame
from gsx.core.device import upload
from gsx.core.errors import InputError
from gsx.core.gaussians.splats import Splats
from gsx.core.rasterizer.bags import sum_runs
from gsx.core.rasterizer.geometry import geometry
from gsx.core.rasterizer.selection import chosen_rows, lens_of, select_splats, select_through, slope_bounds
from gsx.core.rasterizer.settings import RasterSettings
from gsx.core.shapes import Bool, Float, Int

FOCAL_LIMIT = 1e12
"""Bound of focal lengths, px, and of slopes x/z and y/z."""


@dataclass(frozen=True, eq=False, kw_only=True)
class ScreenSplats:
    """M splats near the raster; positions in px of the camera's frame, pixel centres at +0.5."""

    ids: Int[Tensor, "M"]
    """Row of each splat in the input."""
    means: Float[Tensor, "M 2"]
    depths: Float[Tensor, "M"]
    """Camera z, scene units."""
    covariances: Float[Tensor, "M 3"]
    """xx, xy, yy after dilation, px^2."""
    conic_factors: Float[Tensor, "M 3"]
    """(u0, u1, u2): half the inverse covariance is U^T U with U = [[u0, u1], [0, u2]]."""
    log_opacities: Float[Tensor, "M"]
    """ln of the opacity, compensated for dilation by the settings."""
    channels: Float[Tensor, "M C"]
    absgrad: Float[Tensor, "M 2"] | None = None
    """Zeros whose gradient becomes, per axis, the sum over pixels of the absolute gradient of the mean, px."""
    weigh: bool = False
    """True: the compositor returns each splat's largest blending weight."""
    dropped: int
    """Number of splats left out because a value, its projection or its square is not finite."""


def intrinsics_of(camera: Camera, intrinsics: Float[Tensor, "4"] | None) -> Float[Tensor, "4"]:
    """Returns `intrinsics`, or the camera's (fx, fy, cx, cy), in float64."""
    if intrinsics is None:
        return torch.tensor([camera.fx, camera.fy, camera.cx, camera.cy], dtype=torch.float64)
    return intrinsics.double()


def on_frame(intrinsics: Float[Tensor, "4"], frame: Frame) -> Float[Tensor, "4"]:
    """Returns intrinsics with the principal point on the frame."""
    return intrinsics + intrinsics.new_tensor([0, 0, frame.left, frame.top])


def refuse_unusable(camera: Camera, intrinsics: Float[Tensor, "4"], margin: float) -> None:
    """Raises InputError for a camera that cannot project."""
    fx, fy, cx, cy = intrinsics.tolist()
    words = f"fx={fx}, fy={fy}, cx={cx}, cy={cy}, near={camera.near}"
    if not (0 < fx < FOCAL_LIMIT and 0 < fy < FOCAL_LIMIT and 0 <= camera.near < math.inf):
        raise InputError(f"a camera has {words}: give focal lengths in (0, {FOCAL_LIMIT:g}) px, near at least 0")
    slopes = torch.cat(slope_bounds(on_frame(intrinsics.detach(), camera.frame), camera.frame, margin))
    if not float(slopes.abs().amax()) < FOCAL_LIMIT:
        raise InputError(
            f"a camera has {words} and sees {FOCAL_LIMIT:g} focal lengths off its axis: check its intrinsics"
        )
    if not bool(torch.isfinite(camera.rotation).all() & torch.isfinite(camera.translation).all()):
        pose = f"rotation {camera.rotation.tolist()}, translation {camera.translation.tolist()}"
        raise InputError(f"the pose of a camera is not finite ({pose}): correct it")


@torch.no_grad()
def drawable(splats: Splats, camera: Camera, settings: RasterSettings) -> Bool[Tensor, "N"]:
    """Marks all splats except those that a render from this camera drops because of their values."""
    numbers = lens_of(camera, on_frame(intrinsics_of(camera, None), camera.frame), settings.dilation, settings)
    numbers = numbers.to(splats.means.device)
    return select_splats(splats, camera.to_camera(splats.means), numbers, EAGER)[0]


def project(
    splats: Splats, camera: Camera, settings: RasterSettings, intrinsics: Float[Tensor, "4"] | None = None
) -> ScreenSplats:
    """Projects the usable splats beyond the near plane and near the raster; differentiable in every input.

    `intrinsics` (fx, fy, cx, cy) replace the camera's, px of its raster.

    Raises:
        InputError: the camera cannot project.
    """
    own = intrinsics_of(camera, intrinsics)
    refuse_unusable(camera, own, settings.jacobian_margin)
    dilation, drawn = settings.dilation_at(float(own[:2].detach().max()))
    lens = lens_of(camera, on_frame(own, camera.frame), dilation, settings)
    numbers = upload(lens, splats.means.device)
    points = camera.to_camera(splats.means)
    device = splats.means.device.type
    backend = settings.backend.on(device) if len(splats) > 1 else EAGER
    good, visible = select_splats(splats, points, numbers, backend)
    bounds = numbers[4:6].to(splats.scales), numbers[6:8].to(splats.scales)
    rotation = upload(camera.rotation, points.device, splats.scales.dtype)
    if camera.lens is not None:
        visible &= select_through(camera.lens, splats, points, rotation, bounds, backend)
    fields = (points, splats.scales, splats.quats, splats.log_opacities, splats.colours)
    ids, dropped = chosen_rows(good, visible)  # before any division
    points, scales, quats, log_opacities, channels = (take_rows(values, ids) for values in fields)
    compensate = settings.compensate and settings.published_dilation
    # tensors of one element: torch would compile again for each number, and for each 0-dimensional float64 tensor
    rules = scales.new_full((1,), dilation), compensate, scales.new_full((1,), drawn) if drawn else None
    backend = settings.backend.on(device, learning=True) if len(ids) > 1 else EAGER
    gaussians, variant = (points, scales, quats, rotation, numbers[:4], *rules), (compensate, bool(drawn))
    if camera.lens is None:
        screen = backend.kernel(geometry, variant=variant)(*gaussians, *bounds)
    else:
        screen = camera.lens.projection(backend, variant)(*gaussians)
    means, covariances, conic_factors, compensation = screen
    if drawn and compensation is not None:  # opacities stay at most alpha_max
        most = log_opacities.clamp_min(math.log(settings.alpha_max))
        compensation = torch.minimum(compensation, most - log_opacities)
    return ScreenSplats(
        ids=ids,
        means=means,
        depths=points[:, 2].to(scales),
        covariances=covariances,
        conic_factors=conic_factors,
        log_opacities=log_opacities if compensation is None else log_opacities + compensation,
        channels=channels,
        dropped=dropped,
    )


def select_rows(ctx: Any, values: Float[Tensor, "N *rest"], ids: Int[Tensor, "M"]) -> Float[Tensor, "M *rest"]:
    """Selects rows, and saves the ids for the backward pass."""
    ctx.save_for_backward(ids)
    ctx.shape = values.shape
    return values.index_select(0, ids)


class TakeRows(torch.autograd.Function):
    """Autograd function of distinct rows; the backward pass copies, where indexing adds."""

    forward = staticmethod(select_rows)

    @staticmethod
    def backward(ctx, gradient):
        (ids,) = ctx.saved_tensors
        return gradient.new_zeros(ctx.shape).index_copy_(0, ids, gradient), None


def take_rows(values: Float[Tensor, "N *rest"], ids: Int[Tensor, "M"]) -> Float[Tensor, "M *rest"]:
    """Returns `values[ids]` for distinct ids."""
    return TakeRows.apply(values, ids)


class RepeatRows(torch.autograd.Function):
    """Autograd function of rows by ascending ids; the backward pass adds in a fixed order, also on a GPU."""

    forward = staticmethod(select_rows)

    @staticmethod
    def backward(ctx, gradient):
        (ids,) = ctx.saved_tensors
        if gradient.device.type == "cpu":
            return gradient.new_zeros(ctx.shape).index_add_(0, ids, gradient), None
        return sum_runs(gradient.flatten(1), ids, ctx.shape[0]).view(ctx.shape), None


def repeat_rows(values: Float[Tensor, "N *rest"], ids: Int[Tensor, "M"]) -> Float[Tensor, "M *rest"]:
    """Returns `values[ids]` for ascending ids with repetitions."""
    return RepeatRows.apply(values, ids)
