"""Which splats can be drawn, and which of them a camera may show; found before anything is computed of them."""

import functools
import math
import operator
from typing import NamedTuple

import torch
from torch import Tensor

from gsx.core.backend import Backend
from gsx.core.data.camera import Camera, Frame
from gsx.core.gaussians.splats import Splats
from gsx.core.rasterizer.settings import CUTOFF_SLACK, WINDOW_TILE, RasterSettings
from gsx.core.shapes import Bool, Float, Int

OPACITY_SLACK = 1e-3
"""ln of an opacity may exceed 0 by this, for rounding."""
SQUARABLE = 0.4
"""Lengths in px stay below this power of their dtype's largest number: 3e15 in float32."""
LEAST_SPREAD = 0.32
"""px^2 that the published radius has at least between the axes of a covariance (3D-GS, forward.cu: root of 0.1)."""


class Lens(NamedTuple):
    """What the selection needs to know of a camera, each a number in float64; lengths in px of the frame."""

    fx: Tensor
    fy: Tensor
    cx: Tensor
    cy: Tensor
    lowest_x: Tensor
    """Slopes x/z, y/z are clamped here in the Jacobian."""
    lowest_y: Tensor
    highest_x: Tensor
    highest_y: Tensor
    near: Tensor
    """Scene units."""
    dilation: Tensor
    """px^2."""
    left: Tensor
    """Edges of the raster, with a tile around it."""
    right: Tensor
    top: Tensor
    bottom: Tensor
    deviations: Tensor
    """How many standard deviations away a splat still counts."""
    stretch: Tensor
    """By how much the rotation lengthens vectors: 1 but for matrices that are none."""


def slope_bounds(
    intrinsics: Float[Tensor, "4"], frame: Frame, margin: float
) -> tuple[Float[Tensor, "2"], Float[Tensor, "2"]]:
    """Smallest and largest (x/z, y/z) over the frame widened by `margin` half-extents: asymmetric off centre."""
    focal, centre = intrinsics[:2], intrinsics[2:]
    size = intrinsics.new_tensor([frame.width, frame.height])
    extra = margin * size / (2 * focal)
    return -centre / focal - extra, (size - centre) / focal + extra


def lens_of(
    camera: Camera, intrinsics: Float[Tensor, "4"], dilation: float, settings: RasterSettings
) -> Float[Tensor, "16"]:
    """The numbers of a `Lens`; `intrinsics` count on the frame. Slopes' bounds are differentiable in these."""
    frame, around = camera.frame, max(WINDOW_TILE, settings.tile_size)
    edges = (
        *(frame.left - around, frame.left + camera.width + around),
        *(frame.top - around, frame.top + camera.height + around),
    )
    limit = math.sqrt(2 * (OPACITY_SLACK - math.log(settings.alpha_min) + CUTOFF_SLACK))
    numbers = intrinsics.new_tensor([camera.near, dilation, *edges, max(3.0, limit)])
    stretch = torch.linalg.norm(camera.rotation.detach().to(intrinsics), 2).clamp_min(1)[None]
    return torch.cat([intrinsics, *slope_bounds(intrinsics, frame, settings.jacobian_margin), numbers, stretch])


def usable(
    means: Float[Tensor, "N 3"],
    scales: Float[Tensor, "N 3"],
    quats: Float[Tensor, "N 4"],
    log_opacities: Float[Tensor, "N"],
    colours: Float[Tensor, "N C"],
) -> Bool[Tensor, "N"]:
    """False for splats with a value that is not finite (an opacity of 0, ln -inf, is fine) or an opacity above 1."""
    columns = (column for values in (means, scales, quats, colours) for column in values.unbind(1))
    return torch.isfinite(functools.reduce(operator.add, columns)) & (log_opacities <= OPACITY_SLACK)


def in_range(points: Float[Tensor, "N 3"], largest_scales: Float[Tensor, "N"], lens: Lens) -> Bool[Tensor, "N"]:
    """Splats before the camera whose mean and axes in px can be squared in their dtype, as can 1 / depth."""
    largest = torch.finfo(largest_scales.dtype).max
    x, y, z = points.abs().unbind(1)
    steepest = functools.reduce(torch.maximum, (slope.abs() for slope in lens[4:8]))
    size = largest_scales.clamp_min(1).double() * (1 + steepest)
    fits = size.maximum(x).maximum(y) * lens.fx.maximum(lens.fy) < largest**SQUARABLE * z
    return fits & (x.maximum(y).maximum(z) <= largest)


def near_raster(points: Float[Tensor, "N 3"], largest_scales: Float[Tensor, "N"], lens: Lens) -> Bool[Tensor, "N"]:
    """False for splats before the camera of which no published radius and no tile touches the raster.

    The largest eigenvalue of a covariance is at most its trace, and that is at most the trace of a ball as large as the
    longest axis.
    """
    x, y, z = points.unbind(1)
    across, down = x / z, y / z
    steep_x, steep_y = across.clamp(lens.lowest_x, lens.highest_x), down.clamp(lens.lowest_y, lens.highest_y)
    stretch = (lens.fx * lens.fx) * (1 + steep_x * steep_x) + (lens.fy * lens.fy) * (1 + steep_y * steep_y)
    trace = (largest_scales * lens.stretch / z).square() * stretch + (2 * lens.dilation + LEAST_SPREAD)
    reach = lens.deviations * trace.sqrt() + 1
    u, v = lens.fx * across + lens.cx, lens.fy * down + lens.cy
    beside = (u + reach > lens.left) & (u - reach < lens.right)
    return beside & (v + reach > lens.top) & (v - reach < lens.bottom)


def select(
    points: Float[Tensor, "N 3"],
    means: Float[Tensor, "N 3"],
    scales: Float[Tensor, "N 3"],
    quats: Float[Tensor, "N 4"],
    log_opacities: Float[Tensor, "N"],
    colours: Float[Tensor, "N C"],
    numbers: Float[Tensor, "16"],
) -> tuple[Bool[Tensor, "N"], Bool[Tensor, "N"]]:
    """(splats of which nothing is out of range, those of them that the camera may show). `points`: their means in the
    camera's frame, float64. A depth that rounds to the near plane is not beyond it."""
    lens = Lens(*numbers.unbind())
    a, b, c = scales.abs().unbind(1)
    largest_scales = a.maximum(b).maximum(c)
    in_front = points[:, 2].to(means) > lens.near
    good = usable(means, scales, quats, log_opacities, colours)
    good = good & (in_range(points, largest_scales, lens) | ~in_front)
    return good, good & in_front & near_raster(points, largest_scales, lens)


@torch.no_grad()
def selected(
    splats: Splats, points: Float[Tensor, "N 3"], numbers: Float[Tensor, "16"], backend: Backend
) -> tuple[Bool[Tensor, "N"], Bool[Tensor, "N"]]:
    """Calls `select` on splats. The same code serves those without colours, and fields with gaps."""
    colours = splats.colours if splats.colours.shape[1] else splats.means
    fields = (points, splats.means, splats.scales, splats.quats, splats.log_opacities, colours)
    points, means, scales, quats, log_opacities, colours = (value.detach().contiguous() for value in fields)
    return backend.kernel(select)(points, means, scales, quats, log_opacities, colours, numbers.detach())


def chosen_rows(good: Bool[Tensor, "N"], shown: Bool[Tensor, "N"]) -> tuple[Int[Tensor, "M"], int]:
    """(the rows shown, how many are not good). A GPU is waited for once; on a CPU counting first takes longer."""
    if good.device.type == "cpu":
        return shown.nonzero()[:, 0], len(good) - int(good.sum())
    count, lost = torch.stack([shown.sum(), (~good).sum()]).tolist()
    return torch.nonzero_static(shown, size=count)[:, 0], lost
