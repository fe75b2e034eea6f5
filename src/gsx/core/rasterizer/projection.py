"""Stable projection of world Gaussians to the screen (docs/explanation/numerics.md; 3D-GS sections 3.1 and 3.2)."""

import math
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from gsx.core.backend import EAGER
from gsx.core.data.camera import Camera, Frame
from gsx.core.device import uploaded
from gsx.core.errors import InputError
from gsx.core.gaussians.splats import Splats
from gsx.core.rasterizer.bags import runs_added
from gsx.core.rasterizer.geometry import geometry
from gsx.core.rasterizer.selection import chosen_rows, lens_of, selected, slope_bounds
from gsx.core.rasterizer.settings import RasterSettings
from gsx.core.shapes import Bool, Float, Int

FOCAL_LIMIT = 1e12
"""No camera has a focal length of so many px, or sees so many focal lengths off its axis."""


@dataclass(frozen=True, eq=False, kw_only=True)
class ScreenSplats:
    """M splats that the camera may show. Positions in pixels of the camera's frame, pixel centres at +0.5."""

    ids: Int[Tensor, "M"]
    """Row of the splat in the input."""
    means: Float[Tensor, "M 2"]
    depths: Float[Tensor, "M"]
    """Camera z, scene units."""
    covariances: Float[Tensor, "M 3"]
    """xx, xy, yy after dilation, px^2."""
    conic_factors: Float[Tensor, "M 3"]
    """(u0, u1, u2): half the inverse covariance is U^T U with U = [[u0, u1], [0, u2]]."""
    log_opacities: Float[Tensor, "M"]
    """Compensated for dilation where the settings ask for it."""
    channels: Float[Tensor, "M C"]
    absgrad: Float[Tensor, "M 2"] | None = None
    """Zeros whose gradient becomes, per axis, the sum over pixels of the absolute gradient of the mean, px."""
    weigh: bool = False
    """Whether the compositor is to return the largest blending weight of every splat."""
    dropped: int
    """Splats left out because a value or a projection of theirs is not finite, or its square is not."""


def intrinsics_of(camera: Camera, intrinsics: Float[Tensor, "4"] | None) -> Float[Tensor, "4"]:
    """(fx, fy, cx, cy) of the camera's raster in float64, `intrinsics` where they are given."""
    if intrinsics is None:
        return torch.tensor([camera.fx, camera.fy, camera.cx, camera.cy], dtype=torch.float64)
    return intrinsics.double()


def on_frame(intrinsics: Float[Tensor, "4"], frame: Frame) -> Float[Tensor, "4"]:
    """Intrinsics with the principal point counted on the frame."""
    return intrinsics + intrinsics.new_tensor([0, 0, frame.left, frame.top])


@torch.no_grad()
def steepest_slope(intrinsics: Float[Tensor, "4"], frame: Frame, margin: float) -> Float[Tensor, ""]:
    """Largest |x/z| or |y/z| within the bounds."""
    return torch.cat(slope_bounds(intrinsics, frame, margin)).abs().amax()


def refuse_unusable(camera: Camera, intrinsics: Float[Tensor, "4"], margin: float) -> None:
    """Raise InputError for a camera through which nothing can be projected."""
    fx, fy, cx, cy = intrinsics.tolist()
    words = f"fx={fx}, fy={fy}, cx={cx}, cy={cy}, near={camera.near}"
    if not (0 < fx < FOCAL_LIMIT and 0 < fy < FOCAL_LIMIT and 0 <= camera.near < math.inf):
        raise InputError(f"a camera has {words}: focal lengths must be in (0, {FOCAL_LIMIT:g}) px, near at least 0")
    if not float(steepest_slope(on_frame(intrinsics, camera.frame), camera.frame, margin)) < FOCAL_LIMIT:
        raise InputError(
            f"a camera has {words} and sees {FOCAL_LIMIT:g} focal lengths off its axis: check its intrinsics"
        )
    if not bool(torch.isfinite(camera.rotation).all() & torch.isfinite(camera.translation).all()):
        pose = f"rotation {camera.rotation.tolist()}, translation {camera.translation.tolist()}"
        raise InputError(f"the pose of a camera is not finite: {pose}")


@torch.no_grad()
def drawable(splats: Splats, camera: Camera, settings: RasterSettings) -> Bool[Tensor, "N"]:
    """False for the splats that a render from this camera leaves out and counts as dropped."""
    numbers = lens_of(camera, on_frame(intrinsics_of(camera, None), camera.frame), settings.dilation, settings)
    numbers = numbers.to(splats.means.device)
    return selected(splats, camera.to_camera(splats.means), numbers, EAGER)[0]


def project(
    splats: Splats, camera: Camera, settings: RasterSettings, intrinsics: Float[Tensor, "4"] | None = None
) -> ScreenSplats:
    """The usable splats in front of the near plane that the camera may show; differentiable in every input.

    `intrinsics` (fx, fy, cx, cy) take the place of the camera's, in px of its raster.

    Raises:
        InputError: no picture can be taken with the camera's numbers.
    """
    own = intrinsics_of(camera, intrinsics)
    refuse_unusable(camera, own, settings.jacobian_margin)
    dilation, drawn = dilations_of(camera, intrinsics, settings)
    lens = lens_of(camera, on_frame(own, camera.frame), dilation, settings)
    numbers = uploaded(lens, splats.means.device)
    points = camera.to_camera(splats.means)
    device = splats.means.device.type
    good, shown = selected(splats, points, numbers, settings.backend.on(device) if len(splats) > 1 else EAGER)
    fields = (points, splats.scales, splats.quats, splats.log_opacities, splats.colours)
    ids, dropped = chosen_rows(good, shown)  # before any division
    points, scales, quats, log_opacities, channels = (take_rows(values, ids) for values in fields)
    compensate = settings.compensate and settings.published_dilation
    # tensors of one element: a number would be a constant, so that each dilation would compile anew, and so would, to
    # torch, a float64 tensor of no dimension
    rules = scales.new_full((1,), dilation), compensate, scales.new_full((1,), drawn) if drawn else None
    shape = numbers[:4], numbers[4:6].to(scales), numbers[6:8].to(scales)
    backend = settings.backend.on(device, learning=True) if len(ids) > 1 else EAGER
    compute = backend.kernel(geometry, variant=(compensate, bool(drawn)))
    means, covariances, conic_factors, compensation = compute(
        points, scales, quats, uploaded(camera.rotation, ids.device, scales.dtype), *shape, *rules
    )
    if drawn and compensation is not None:  # nothing becomes more opaque than alpha_max by it
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


def dilations_of(
    camera: Camera, intrinsics: Float[Tensor, "4"] | None, settings: RasterSettings
) -> tuple[float, float]:
    """(dilation, the dilation that opacities are compensated from or 0), px^2; by `intrinsics` where they are given."""
    if settings.published_dilation:
        return settings.dilation, 0.0
    return settings.dilation_at(camera.focal if intrinsics is None else float(intrinsics[:2].max().detach()))


def select_rows(ctx: Any, values: Float[Tensor, "N *rest"], ids: Int[Tensor, "M"]) -> Float[Tensor, "M *rest"]:
    """Forward: rows, and what their gradients are put together by."""
    ctx.save_for_backward(ids)
    ctx.shape = values.shape
    return values.index_select(0, ids)


class TakeRows(torch.autograd.Function):
    """Selects distinct rows; their gradients are copied back, where indexing would have to add."""

    forward = staticmethod(select_rows)

    @staticmethod
    def backward(ctx, gradient):
        (ids,) = ctx.saved_tensors
        return gradient.new_zeros(ctx.shape).index_copy_(0, ids, gradient), None


def take_rows(values: Float[Tensor, "N *rest"], ids: Int[Tensor, "M"]) -> Float[Tensor, "M *rest"]:
    """`values[ids]` for ids that are all different."""
    return TakeRows.apply(values, ids)


class RepeatRows(torch.autograd.Function):
    """Selects rows by ascending ids, some of them several times; their gradients are added in the order of the list.
    torch's own selection adds them in any order on a GPU."""

    forward = staticmethod(select_rows)

    @staticmethod
    def backward(ctx, gradient):
        (ids,) = ctx.saved_tensors
        if gradient.device.type == "cpu":
            return gradient.new_zeros(ctx.shape).index_add_(0, ids, gradient), None
        return runs_added(gradient.flatten(1), ids, ctx.shape[0]).view(ctx.shape), None


def repeat_rows(values: Float[Tensor, "N *rest"], ids: Int[Tensor, "M"]) -> Float[Tensor, "M *rest"]:
    """`values[ids]` for ids that ascend, with repetitions."""
    return RepeatRows.apply(values, ids)
