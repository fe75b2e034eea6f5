"""Filters for any backbone: those of Mip-Splatting (Yu et al. 2024), and rules for zoomed cameras alone.

The 3D filter widens each Gaussian by what the finest training camera can resolve, at the same integrated opacity. The
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
from gsx.core.shapes import Bool, Float, Int
from gsx.core.training.backbone import BackboneContext
from gsx.core.training.parameter_table import ParameterTable
from gsx.core.training.pseudo_views import PseudoView
from gsx.core.training.schedule import Schedule
from gsx.formats.smoothing import LEAST_SHARE, logit_of_log, smoothed

FILTERS = ("none", "mip", "magnified", "resampled")
RATES = ("release", "paper")
MATCHED = {"area": 1 / 12, "bicubic": 0.1, "lanczos": 0.05}
"""Variance of the Gaussian whose frequency response is near a filter's up to three quarters of the Nyquist frequency of
the pictures that it makes, px^2 (a box's is its own)."""
ENOUGH_VIEWS = 9
"""So many views of one density allow what one allows: below them noise and wrong poses take what they add."""
LEAST_DEPTH = 1e-3
"""Depths are held above this before anything is divided by them, scene units (Mip-Splatting, compute_3D_filter)."""


@dataclass(frozen=True, kw_only=True)
class MipOptions:
    """Numbers of the filters; values in conf/backbone, with their sources."""

    variance: Annotated[float, Range(1e-6, 1000)]
    """Of the 3D filter, px^2 at the finest camera."""
    kernel: Annotated[float, Range(0, 1000)]
    """Variance of the 2D filter, px^2 at every render resolution; 0: by the filter that reduced the photographs."""
    margin: Annotated[float, Range(0, 100)]
    """Fraction of the raster beside it in which a camera still counts as seeing a point."""
    near: Annotated[float, Range(0, 1e6)]
    """Points nearer than this count as not visible, scene units."""
    every: Interval
    """Published steps between updates of the 3D filter after density control, every event of which updates it too."""
    stop: Steps
    """Published step from which the 3D filter is frozen."""
    rate: str = "release"
    """What the finest camera is of those that see a primitive. `release`: one of the largest focal length of all, at
    the least depth of any. `paper`: the one with the largest quotient of its own focal length and depth, which is the
    same where all focal lengths are."""
    views: Annotated[float, Range(1, 4)] = 1.0
    """The most by which several views that sample a place alike narrow its filter."""
    pseudo: bool = False
    """Pseudo views narrow the filters of what they see, by as much as their pixels are trusted."""

    def __post_init__(self) -> None:
        if self.rate not in RATES:
            raise ValueError(f"backbone.mip.rate is '{self.rate}'; choose {' or '.join(RATES)}")


class Filter:
    """What is done to Gaussians so that they do not alias; here nothing."""

    note = ""
    """A splat file's comment on the 3D filter; empty: there is none."""

    def rules(self, raster: RasterSettings) -> RasterSettings:
        """Returns the rasterizer's rules with the 2D filter."""
        return raster

    def refresh(self, table: ParameterTable, means: Float[Tensor, "N 3"], step: int = 0) -> None:
        """Brings the column `filter`, if there is one, to where the primitives are after a step."""

    def due(self, step: int) -> bool:
        """Returns whether to do so at a step without a density event."""
        return False

    def pseudo_views_made(self, views: Sequence[PseudoView]) -> None:
        """Receives the pseudo views that were made for the step under way."""

    def narrows(self, step: int) -> bool:
        """Returns whether sizes after a step are smaller for finer views: the picture is to go on as it was."""
        return False

    def smoothed(
        self,
        scales: Float[Tensor, "M 3"],
        log_opacities: Float[Tensor, "M"],
        table: ParameterTable,
        rows: Int[Tensor, "M"] | None,
    ) -> tuple[Float[Tensor, "M 3"], Float[Tensor, "M"]]:
        """Returns scales and log-opacities after the 3D filter; `rows` of the table, None: all."""
        return scales, log_opacities


@dataclass(frozen=True, kw_only=True)
class ZoomedRule(Filter):
    """Gaussians as they are, dilated by what the finest training camera dilates them by, whatever camera draws them."""

    zoomed: str
    """`RasterSettings.zoomed`."""
    cameras: Sequence[Camera]
    """Those of the training views."""

    def rules(self, raster: RasterSettings) -> RasterSettings:
        """Adds the focal length that dilation belongs to."""
        focal = max(camera.focal for camera in self.cameras)
        try:
            return replace(raster, zoomed=self.zoomed, training_focal=focal)
        except ValueError as error:
            raise ConfigError(f"backbone.filter={self.zoomed}: {error}") from error


@dataclass(frozen=True, kw_only=True)
class MipFilter(Filter):
    """Both filters of Mip-Splatting; sizes of the 3D filter are a column of the table, world units."""

    options: MipOptions
    context: BackboneContext
    """With the cameras of the training views."""
    schedule: Schedule
    density_ends: int
    """Step from which the filter has a clock of its own."""
    new_views: list[PseudoView] = field(default_factory=list)
    """Pseudo views made for the step under way, if they narrow the filter."""
    note: str = "3D filter fused into scales and opacities"

    def rules(self, raster: RasterSettings) -> RasterSettings:
        """Returns dilation by the kernel, with compensated opacities."""
        kernel = self.options.kernel or MATCHED[self.context.scene.reduction.filter]
        return replace(raster, dilation=kernel, compensate=True)

    def refresh(self, table: ParameterTable, means: Float[Tensor, "N 3"], step: int = 0) -> None:
        """Computes sizes from where the primitives are after a step (Mip-Splatting, compute_3D_filter)."""
        points, options, views = means.detach(), self.options, self.context.views
        cameras = views.raster_cameras(step + 1)
        sizes = filter_sizes(points, cameras, options)
        if options.views > 1:
            sizes = sizes / several_views(points, cameras, sizes, options)
        if options.pseudo:
            narrow_by_pseudo_views(table, points, self.new_views, sizes, options)
            sizes = sizes.minimum(table["earned"])
        table.columns["filter"] = sizes

    def due(self, step: int) -> bool:
        """Returns true at intervals after density control until the filter freezes (Mip-Splatting), or if narrowing."""
        inside = self.density_ends < step < self.schedule.step(self.options.stop)
        return self.narrows(step) or (inside and step % self.schedule.interval(self.options.every) == 0)

    def narrows(self, step: int) -> bool:
        """Returns whether renders become finer, or pseudo views that narrow the filter were made."""
        return self.context.views.changes_after(step) or bool(self.new_views)

    def pseudo_views_made(self, views: Sequence[PseudoView]) -> None:
        """Keeps those of this step, if they narrow the filter."""
        self.new_views[:] = views if self.options.pseudo else []

    def smoothed(
        self,
        scales: Float[Tensor, "M 3"],
        log_opacities: Float[Tensor, "M"],
        table: ParameterTable,
        rows: Int[Tensor, "M"] | None,
    ) -> tuple[Float[Tensor, "M 3"], Float[Tensor, "M"]]:
        """Widens Gaussians by the column `filter`."""
        sizes = table["filter"]
        return smoothed(scales, log_opacities, sizes if rows is None else sizes[rows])


def filter_named(
    name: str, options: MipOptions, context: BackboneContext, schedule: Schedule, density_ends: int
) -> Filter:
    """Builds the filter of that name.

    For the 3D filter, which bounds what can be learnt, supersampled training counts as finer cameras; not for the
    dilation, which is a part of what is learnt.
    """
    if name == "none":
        return Filter()
    if name in ("magnified", "resampled"):
        return ZoomedRule(zoomed=name, cameras=[view.camera for view in context.scene.train])
    return MipFilter(options=options, context=context, schedule=schedule, density_ends=density_ends)


def checked_filter(name: str) -> None:
    """Raises ValueError for a name that is no filter."""
    if name not in FILTERS:
        raise ValueError(f"backbone.filter is '{name}'; choose one of {', '.join(FILTERS)}")


def visible_depths(
    points: Float[Tensor, "N 3"], camera: Camera, options: MipOptions
) -> tuple[Float[Tensor, "N"], Bool[Tensor, "N"]]:
    """Returns (depth z, whether the camera counts as seeing the point) (Mip-Splatting, compute_3D_filter)."""
    local = camera.to_camera(points).to(points)
    depth = local[:, 2].clamp_min(LEAST_DEPTH)
    column = local[:, 0] / depth * camera.fx + camera.cx
    row = local[:, 1] / depth * camera.fy + camera.cy
    across = (column >= -options.margin * camera.width) & (column <= (1 + options.margin) * camera.width)
    down = (row >= -options.margin * camera.height) & (row <= (1 + options.margin) * camera.height)
    return depth, (local[:, 2] > options.near) & across & down


@torch.no_grad()
def filter_sizes(points: Float[Tensor, "N 3"], cameras: Sequence[Camera], options: MipOptions) -> Float[Tensor, "N"]:
    """Returns the standard deviation of the 3D filter at each point, world units (Mip-Splatting, compute_3D_filter).

    It is sqrt(variance) times the depth over the focal length of the finest camera that sees the point
    (`MipOptions.rate`). Points that no camera sees get the largest size of the others.

    Raises:
        InputError: no camera sees any point.
    """
    nearest = torch.full_like(points[:, 0], torch.inf)
    focal = max(camera.fx for camera in cameras)
    for camera in cameras:
        depth, visible = visible_depths(points, camera, options)
        if options.rate == "paper":  # as far away as a camera of the largest focal length would be that is as fine
            depth = depth * (focal / camera.fx)
        nearest = torch.where(visible, nearest.minimum(depth), nearest)
    visible = torch.isfinite(nearest)
    if len(points) and not bool(visible.any()):
        raise InputError(
            f"none of {len(points)} primitives is seen by any of {len(cameras)} training cameras, so "
            "backbone.filter=mip knows no resolution: check that points and cameras belong together, or do without the "
            "filters by backbone.filter=none"
        )
    farthest = nearest[visible].max() if len(points) else nearest.new_zeros(())
    return torch.where(visible, nearest, farthest) / focal * options.variance**0.5


@torch.no_grad()
def absorb(table: ParameterTable, before: Float[Tensor, "N"], after: Float[Tensor, "N"]) -> None:
    """Changes stored scales and opacities so that pictures stay when the 3D filter narrows from `before` to `after`.

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
    """Returns how many times as finely all views sample each point as the finest one alone, from 1 to `options.views`.

    It is a third of the square root of their number, each counted by its density over the finest one's, squared.
    """
    views, deviation = torch.zeros_like(sizes), options.variance**0.5
    for camera in cameras:
        depth, visible = visible_depths(points, camera, options)
        views += visible * (sizes / deviation * camera.fx / depth).square().clamp_max(1)
    return (views.sqrt() / ENOUGH_VIEWS**0.5).clamp(1, options.views)


def narrow_by_pseudo_views(
    table: ParameterTable,
    points: Float[Tensor, "N 3"],
    views: Sequence[PseudoView],
    sizes: Float[Tensor, "N"],
    options: MipOptions,
) -> None:
    """Lowers the column `earned` to the smallest size that pseudo views have allowed; infinite where none has."""
    earned = table.columns.get("earned", torch.full_like(sizes, torch.inf))
    for view in views:
        earned = earned.minimum(pseudo_view_sizes(points, view, sizes, options))
    table.columns["earned"] = earned


@torch.no_grad()
def pseudo_view_sizes(
    points: Float[Tensor, "N 3"], view: PseudoView, sizes: Float[Tensor, "N"], options: MipOptions
) -> Float[Tensor, "N"]:
    """Returns the filter of what a pseudo view sees; infinite where it sees nothing.

    It is what the view's density allows where its pixels count whole, `sizes` where they do not count, and between them
    by logarithms.
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
