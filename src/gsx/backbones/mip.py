"""Filters for any backbone: those of Mip-Splatting (Yu et al. 2024), and rules for zoomed cameras.

The 3D filter widens each Gaussian to the resolution of the finest training camera, at the same integrated opacity. The
2D filter is a rule of the rasterizer: a dilation of `kernel` px^2 with compensated opacity.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Annotated

import torch
from torch import Tensor
from torch.nn.functional import logsigmoid

from gsx.core.data.camera import Camera
from gsx.core.errors import ConfigError, InputError
from gsx.core.ranges import Interval, Range, Steps
from gsx.core.rasterizer import RasterSettings
from gsx.core.rasterizer.settings import LEAST_VARIANCE
from gsx.core.shapes import Bool, Float, Int
from gsx.core.training.backbone import BackboneContext
from gsx.core.training.parameter_table import ParameterTable
from gsx.core.training.pseudo_views import PseudoView
from gsx.core.training.schedule import Schedule
from gsx.formats.smoothing import LEAST_SHARE, logit_of_log, smoothed

FILTERS = ("none", "mip", "magnified", "resampled")
RATES = ("release", "paper")
MATCHED = {"area": 1 / 12, "bicubic": 0.1, "lanczos": 0.05}
"""Variance of the Gaussian that fits a filter's frequency response up to 3/4 of the Nyquist frequency, px^2."""
ENOUGH_VIEWS = 9
"""Views of one density above which the filter narrows: fewer only average noise and pose errors."""
LEAST_DEPTH = 1e-3
"""Lower bound of depths in divisions, scene units (Mip-Splatting, compute_3D_filter)."""


@dataclass(frozen=True, kw_only=True)
class MipOptions:
    """Options of the filters; values in conf/backbone, with their sources."""

    variance: Annotated[float, Range(1e-6, 1000)]
    """Variance of the 3D filter, px^2 at the finest camera."""
    kernel: Annotated[float, Range(0, 1000)]
    """Variance of the 2D filter, px^2 at every render resolution; 0: by the filter that reduced the photos."""
    margin: Annotated[float, Range(0, 100)]
    """Border around the raster in which points count as visible, as a fraction of its sides."""
    near: Annotated[float, Range(0, 1e6)]
    """Least depth of a visible point, scene units."""
    every: Interval
    """Published steps between updates of the 3D filter after density control, whose events also update it."""
    stop: Steps
    """Published step from which the 3D filter is frozen."""
    rate: str = "release"
    """Finest camera of a primitive, release: the largest focal length of all cameras over the least depth; paper: the
    largest quotient of one camera's focal length and depth."""
    views: Annotated[float, Range(1, 4)] = 1.0
    """Largest factor by which several equally fine views narrow a filter."""
    pseudo: bool = False
    """True: pseudo views narrow the filters of visible primitives, weighted by their pixel weights."""

    def __post_init__(self) -> None:
        if self.rate not in RATES:
            raise ValueError(f"backbone.mip.rate is '{self.rate}'; choose {' or '.join(RATES)}")


class Filter:
    """Antialiasing filter; this base class does nothing."""

    note = ""
    """Comment on the 3D filter in splat files; empty: none."""

    def rules(self, raster: RasterSettings) -> RasterSettings:
        """Returns the rasterizer's rules with the 2D filter."""
        return raster

    def refresh(self, table: ParameterTable, means: Float[Tensor, "N 3"], step: int = 0) -> None:
        """Updates the column `filter`, if any, to the positions after a step."""

    def due(self, step: int) -> bool:
        """Returns whether to refresh at a step without a density event."""
        return False

    def pseudo_views_made(self, views: Sequence[PseudoView]) -> None:
        """Receives the new pseudo views of the current step."""

    def narrows(self, step: int) -> bool:
        """Returns whether finer views make sizes smaller after a step, so that `absorb` is needed."""
        return False


@dataclass(frozen=True, kw_only=True)
class ZoomedRule(Filter):
    """Dilation by that of the finest training camera for all cameras, without a 3D filter."""

    zoomed: str
    """`RasterSettings.zoomed`."""
    cameras: Sequence[Camera]
    """Training cameras."""

    def rules(self, raster: RasterSettings) -> RasterSettings:
        """Returns the rules with the focal length that dilation refers to."""
        focal = max(camera.focal for camera in self.cameras)
        try:
            return replace(raster, zoomed=self.zoomed, training_focal=focal)
        except ValueError as error:
            raise ConfigError(f"backbone.filter={self.zoomed}: {error}") from error


@dataclass(frozen=True, kw_only=True)
class MipFilter(Filter):
    """Both filters of Mip-Splatting; the table's column `filter` holds the sizes of the 3D filter, world units."""

    options: MipOptions
    context: BackboneContext
    schedule: Schedule
    density_ends: int
    """Step from which the filter is updated at its own interval."""
    new_views: list[PseudoView] = field(default_factory=list)
    """New pseudo views of the current step, if they narrow the filter."""
    note: str = "3D filter fused into scales and opacities"

    def rules(self, raster: RasterSettings) -> RasterSettings:
        """Returns dilation by the kernel, with compensated opacities."""
        kernel = self.options.kernel or MATCHED[self.context.scene.reduction.filter]
        return replace(raster, dilation=max(kernel, LEAST_VARIANCE), compensate=True)

    def refresh(self, table: ParameterTable, means: Float[Tensor, "N 3"], step: int = 0) -> None:
        """Computes sizes at the positions after a step (Mip-Splatting, compute_3D_filter)."""
        points, options, views = means.detach(), self.options, self.context.views
        cameras = views.raster_cameras(step + 1)
        sizes = filter_sizes(points, cameras, options)
        if options.views > 1:
            sizes = sizes / several_views(points, cameras, sizes, options)
        if options.pseudo:
            smallest = table.columns.get("earned", torch.full_like(sizes, torch.inf))  # by pseudo views so far
            for view in self.new_views:
                smallest = smallest.minimum(pseudo_view_sizes(points, view, sizes, options))
            table.columns["earned"] = smallest
            sizes = sizes.minimum(smallest)
        table.columns["filter"] = sizes

    def due(self, step: int) -> bool:
        """Returns true at intervals between density control and the filter's end, or if it narrows (Mip-Splatting)."""
        inside = self.density_ends < step < self.schedule.step(self.options.stop)
        return self.narrows(step) or (inside and step % self.schedule.interval(self.options.every) == 0)

    def narrows(self, step: int) -> bool:
        """Returns whether renders become finer, or new pseudo views narrow the filter."""
        return self.context.views.changes_after(step) or bool(self.new_views)

    def pseudo_views_made(self, views: Sequence[PseudoView]) -> None:
        """Stores the pseudo views of this step, if they narrow the filter."""
        self.new_views[:] = views if self.options.pseudo else []


def filter_named(
    name: str, options: MipOptions, context: BackboneContext, schedule: Schedule, density_ends: int
) -> Filter:
    """Builds the filter of that name; supersampled training makes the 3D filter finer, but not the dilation."""
    if name == "none":
        return Filter()
    if name in ("magnified", "resampled"):
        return ZoomedRule(zoomed=name, cameras=[view.camera for view in context.scene.train])
    return MipFilter(options=options, context=context, schedule=schedule, density_ends=density_ends)


def checked_filter(name: str) -> None:
    """Raises ValueError for an unknown filter."""
    if name not in FILTERS:
        raise ValueError(f"backbone.filter is '{name}'; choose one of {', '.join(FILTERS)}")


def filtered(
    table: ParameterTable,
    rows: Int[Tensor, "M"] | None,
    scales: Float[Tensor, "M 3"],
    log_opacities: Float[Tensor, "M"],
) -> tuple[Float[Tensor, "M 3"], Float[Tensor, "M"]]:
    """Returns scales and log-opacities of some rows (None: all) after the table's 3D filter, if it has one."""
    if "filter" not in table.columns:
        return scales, log_opacities
    sizes = table["filter"]
    return smoothed(scales, log_opacities, sizes if rows is None else sizes[rows])


def visible_depths(
    points: Float[Tensor, "N 3"], camera: Camera, options: MipOptions
) -> tuple[Float[Tensor, "N"], Bool[Tensor, "N"]]:
    """Returns (depths z, visibility of the points in the raster and its margin) (Mip-Splatting, compute_3D_filter)."""
    local = camera.to_camera(points).to(points)
    depth = local[:, 2].clamp_min(LEAST_DEPTH)
    if camera.lens is None:
        column = local[:, 0] / depth * camera.fx + camera.cx
        row = local[:, 1] / depth * camera.fy + camera.cy
    else:
        column, row = camera.project(points)[0].unbind(1)
    across = (column >= -options.margin * camera.width) & (column <= (1 + options.margin) * camera.width)
    down = (row >= -options.margin * camera.height) & (row <= (1 + options.margin) * camera.height)
    return depth, (local[:, 2] > options.near) & across & down


@torch.no_grad()
def filter_sizes(points: Float[Tensor, "N 3"], cameras: Sequence[Camera], options: MipOptions) -> Float[Tensor, "N"]:
    """Returns the standard deviation of the 3D filter at each point, world units (Mip-Splatting, compute_3D_filter).

    That is sqrt(variance) times depth over focal length of the point's finest camera (`MipOptions.rate`), or the
    largest size if no camera shows it. Raises InputError if no camera shows any point.
    """
    nearest = torch.full_like(points[:, 0], torch.inf)
    focal = max(camera.fx for camera in cameras)
    for camera in cameras:
        depth, visible = visible_depths(points, camera, options)
        if options.rate == "paper":  # equally fine with the largest focal length
            depth = depth * (focal / camera.fx)
        nearest = torch.where(visible, nearest.minimum(depth), nearest)
    visible = torch.isfinite(nearest)
    if len(points) and not bool(visible.any()):
        raise InputError(
            f"none of {len(points)} primitives is visible in any of {len(cameras)} training cameras, so "
            "backbone.filter=mip has no resolution: check that points and cameras belong together, or set "
            "backbone.filter=none"
        )
    farthest = nearest[visible].max() if len(points) else nearest.new_zeros(())
    return torch.where(visible, nearest, farthest) / focal * options.variance**0.5


@torch.no_grad()
def absorb(table: ParameterTable, before: Float[Tensor, "N"], after: Float[Tensor, "N"]) -> None:
    """Changes scales and opacities so that renders stay equal when the 3D filter narrows from `before` to `after`.

    s'^2 = s^2 + before^2 - after^2, o' = o prod_k s_k / s'_k.
    """
    scales = table["log_scales"].exp()
    wider = (scales.square() + (before.square() - after.square()).clamp_min(0)[:, None]).sqrt()
    log_opacities = logsigmoid(table["opacity_logits"]) + (scales / wider).clamp_min(LEAST_SHARE).log().sum(1)
    table["log_scales"].copy_(wider.log())
    table["opacity_logits"].copy_(logit_of_log(log_opacities))


@torch.no_grad()
def several_views(
    points: Float[Tensor, "N 3"], cameras: Sequence[Camera], sizes: Float[Tensor, "N"], options: MipOptions
) -> Float[Tensor, "N"]:
    """Returns the resolution of all views at each point over that of the finest one, from 1 to `options.views`.

    That is sqrt(n / ENOUGH_VIEWS), where n sums the squared relative densities of the views.
    """
    views, deviation = torch.zeros_like(sizes), options.variance**0.5
    for camera in cameras:
        depth, visible = visible_depths(points, camera, options)
        views += visible * (sizes / deviation * camera.fx / depth).square().clamp_max(1)
    return (views.sqrt() / ENOUGH_VIEWS**0.5).clamp(1, options.views)


@torch.no_grad()
def pseudo_view_sizes(
    points: Float[Tensor, "N 3"], view: PseudoView, sizes: Float[Tensor, "N"], options: MipOptions
) -> Float[Tensor, "N"]:
    """Returns filter sizes by one pseudo view; infinite for points outside it.

    Pixel weights interpolate logarithmically between `sizes` (weight 0) and the view's own resolution (weight 1).
    """
    camera = view.camera
    places, depth = camera.project(points)
    inside = (places >= 0) & (places < places.new_tensor(camera.size))
    visible = inside.all(1) & (depth > options.near)
    own = depth.clamp_min(LEAST_DEPTH) / camera.fx * options.variance**0.5
    trust = torch.ones_like(sizes)
    if view.pixel_weight is not None:
        column, row = (places[:, k].long().clamp(0, side - 1) for k, side in enumerate(camera.size))
        trust = view.pixel_weight.to(sizes)[row, column] / 255
    return torch.where(visible, sizes * (own / sizes).clamp_max(1).pow(trust), torch.inf)
