"""Selection of splats with usable values, and of those near a camera's raster, before the projection."""

import functools
import math
import operator
from typing import NamedTuple

import torch
from torch import Tensor

from gsx.core.backend import Backend
from gsx.core.data.camera import Camera, Frame, LensModel
from gsx.core.gaussians.splats import Splats
from gsx.core.rasterizer.settings import CUTOFF_SLACK, WINDOW_TILE, RasterSettings
from gsx.core.shapes import Bool, Float, Int

OPACITY_SLACK = 1e-3
"""Tolerance of rounding for ln of an opacity above 0."""
SQUARABLE = 0.4
"""Exponent of the bound of lengths in px: largest number of the dtype ^ 0.4, 3e15 in float32."""
LEAST_SPREAD = 0.32
"""Floor of the published radius between the axes of a covariance, px^2 (3D-GS, forward.cu: root of 0.1)."""


class Lens(NamedTuple):
    """Numbers of a camera for the selection, float64; lengths in px of the frame."""

    fx: Tensor
    fy: Tensor
    cx: Tensor
    cy: Tensor
    lowest_x: Tensor
    """Bounds of x/z and y/z in the Jacobian."""
    lowest_y: Tensor
    highest_x: Tensor
    highest_y: Tensor
    near: Tensor
    """Scene units."""
    dilation: Tensor
    """px^2."""
    left: Tensor
    """Edges of the raster with one tile around it."""
    right: Tensor
    top: Tensor
    bottom: Tensor
    deviations: Tensor
    """Reach of a splat, standard deviations."""
    stretch: Tensor
    """Largest singular value of the rotation: 1, or more for other matrices."""


def slope_bounds(
    intrinsics: Float[Tensor, "4"], frame: Frame, margin: float
) -> tuple[Float[Tensor, "2"], Float[Tensor, "2"]]:
    """Returns the smallest and largest (x/z, y/z) over the frame, widened by `margin` half-extents."""
    focal, centre = intrinsics[:2], intrinsics[2:]
    size = intrinsics.new_tensor([frame.width, frame.height])
    extra = margin * size / (2 * focal)
    return -centre / focal - extra, (size - centre) / focal + extra


def lens_of(
    camera: Camera, intrinsics: Float[Tensor, "4"], dilation: float, settings: RasterSettings
) -> Float[Tensor, "16"]:
    """Returns the numbers of a `Lens`, differentiable in `intrinsics`, which are on the frame."""
    frame, around = camera.frame, max(WINDOW_TILE, settings.tile_size)
    edges: tuple[float, ...] = (
        *(frame.left - around, frame.left + camera.width + around),
        *(frame.top - around, frame.top + camera.height + around),
    )
    if camera.lens is not None:  # bounds of a pinhole do not hold: the lens selects
        edges = (-math.inf, math.inf, -math.inf, math.inf)
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
    """Marks splats with finite values and an opacity of at most 1; ln 0 = -inf is valid."""
    columns = (column for values in (means, scales, quats, colours) for column in values.unbind(1))
    return torch.isfinite(functools.reduce(operator.add, columns)) & (log_opacities <= OPACITY_SLACK)


def in_range(points: Float[Tensor, "N 3"], largest_scales: Float[Tensor, "N"], lens: Lens) -> Bool[Tensor, "N"]:
    """Marks splats before the camera whose mean, axes in px and 1 / depth can be squared in their dtype."""
    largest = torch.finfo(largest_scales.dtype).max
    x, y, z = points.abs().unbind(1)
    steepest = functools.reduce(torch.maximum, (slope.abs() for slope in lens[4:8]))
    size = largest_scales.clamp_min(1).double() * (1 + steepest)
    fits = size.maximum(x).maximum(y) * lens.fx.maximum(lens.fy) < largest**SQUARABLE * z
    return fits & (x.maximum(y).maximum(z) <= largest)


def near_raster(points: Float[Tensor, "N 3"], largest_scales: Float[Tensor, "N"], lens: Lens) -> Bool[Tensor, "N"]:
    """Marks splats before the camera whose published radius or tiles may touch the raster.

    The largest eigenvalue of a covariance is at most the trace of a ball with the longest axis as radius.
    """
    x, y, z = points.unbind(1)
    across, down = x / z, y / z
    steep_x, steep_y = across.clamp(lens.lowest_x, lens.highest_x), down.clamp(lens.lowest_y, lens.highest_y)
    stretch = (lens.fx * lens.fx) * (1 + steep_x * steep_x) + (lens.fy * lens.fy) * (1 + steep_y * steep_y)
    trace = (largest_scales * lens.stretch / z).square() * stretch + (2 * lens.dilation + LEAST_SPREAD)
    reach = lens.deviations * trace.sqrt() + 1
    u, v = lens.fx * across + lens.cx, lens.fy * down + lens.cy
    horizontal = (u + reach > lens.left) & (u - reach < lens.right)
    return horizontal & (v + reach > lens.top) & (v - reach < lens.bottom)


def select(
    points: Float[Tensor, "N 3"],
    means: Float[Tensor, "N 3"],
    scales: Float[Tensor, "N 3"],
    quats: Float[Tensor, "N 4"],
    log_opacities: Float[Tensor, "N"],
    colours: Float[Tensor, "N C"],
    numbers: Float[Tensor, "16"],
) -> tuple[Bool[Tensor, "N"], Bool[Tensor, "N"]]:
    """Marks splats with all values in range, and those of them near the raster; `points`: camera means, float64."""
    lens = Lens(*numbers.unbind())
    a, b, c = scales.abs().unbind(1)
    largest_scales = a.maximum(b).maximum(c)
    in_front = points[:, 2].to(means) > lens.near  # rounded as in the render
    good = usable(means, scales, quats, log_opacities, colours)
    good = good & (in_range(points, largest_scales, lens) | ~in_front)
    return good, good & in_front & near_raster(points, largest_scales, lens)


@torch.no_grad()
def select_splats(
    splats: Splats, points: Float[Tensor, "N 3"], numbers: Float[Tensor, "16"], backend: Backend
) -> tuple[Bool[Tensor, "N"], Bool[Tensor, "N"]]:
    """Calls `select` on splats, with one compiled code also for those without colours and for strided fields."""
    colours = splats.colours if splats.colours.shape[1] else splats.means
    fields = (points, splats.means, splats.scales, splats.quats, splats.log_opacities, colours)
    points, means, scales, quats, log_opacities, colours = (value.detach().contiguous() for value in fields)
    return backend.kernel(select)(points, means, scales, quats, log_opacities, colours, numbers.detach())


@torch.no_grad()
def select_through(
    lens: LensModel,
    splats: Splats,
    points: Float[Tensor, "N 3"],
    rotation: Float[Tensor, "3 3"],
    bounds: tuple[Float[Tensor, "2"], Float[Tensor, "2"]],
    backend: Backend,
) -> Bool[Tensor, "N"]:
    """Marks splats that a lens projects; `bounds`: of slopes on the frame."""
    fields = (points, splats.scales, splats.quats, rotation, *bounds)
    return lens.selection(backend)(*(value.detach().contiguous() for value in fields))


def chosen_rows(good: Bool[Tensor, "N"], visible: Bool[Tensor, "N"]) -> tuple[Int[Tensor, "M"], int]:
    """Returns the visible rows and the number of splats that are not good; waits for a GPU only once."""
    if good.device.type == "cpu":
        return visible.nonzero()[:, 0], len(good) - int(good.sum())
    count, lost = torch.stack([visible.sum(), (~good).sum()]).tolist()
    return torch.nonzero_static(visible, size=count)[:, 0], lost
