"""Gaussian Blending: the light left in a pixel is a uniform rectangle, its window (Koo, Jeong, Kim, AAAI 2026).

Point samples blend as if every splat covered the whole pixel; two that cover different halves hide each other by half.
Here each splat takes its integral over the window, and the window becomes the rectangle of the same light, mean and
variances along the axes as the light behind the splat. The integral is the pixel's filter: there is no dilation.

State of a pixel: `light` left (1 at first), `x`, `y` the window's middle and `wide`, `high` its sides, px. Tiles walk
their lists splat by splat, because each window comes from the one before. Formulas: docs/explanation/numerics.md.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import torch
from torch import Tensor

from gsx.core.errors import ConfigError
from gsx.core.rasterizer.composite import batches, sum_by_splat
from gsx.core.rasterizer.grid import TileGrid, pixel_centres
from gsx.core.rasterizer.intersections import TileIntersections
from gsx.core.rasterizer.projection import ScreenSplats
from gsx.core.rasterizer.settings import Precision, RasterSettings
from gsx.core.shapes import Float, Int

NARROW = 0.1
"""Standard deviations; a narrower window has one alpha, that of its middle (published)."""
LEAST_WINDOW_VARIANCE = 1e-3
"""Floor of a window's variance along each axis, px^2 (published)."""
LEAST_SIGMA = 1e-6
"""Floor of standard deviations, px."""
BATCH_PIXELS = 1 << 15
"""Pixels that walk their lists together."""

PixelWindow: TypeAlias = tuple[Tensor, Tensor, Tensor, Tensor, Tensor]
"""(light, x, y, wide, high), each [B, P]; positions relative to the middle of the tile."""
Row: TypeAlias = tuple[Tensor, ...]
"""(x, y, n1x, n1y, sigma1, sigma2, opacity) of one splat per tile, each [B, 1]."""


@dataclass(frozen=True, eq=False)
class Axis:
    """One axis of a splat, and a window's extent along it: exp(-x^2 / 2 sigma^2) over [low, high]."""

    offset: Float[Tensor, "B P"]
    """Offset of the window's middle from the splat's mean, px."""
    side: Float[Tensor, "B P"]
    sigma: Float[Tensor, "B 1"]

    @property
    def ends(self) -> tuple[Tensor, Tensor]:
        """(low, high)."""
        return self.offset - self.side / 2, self.offset + self.side / 2

    @property
    def heights(self) -> tuple[Tensor, Tensor]:
        """The Gaussian at both ends."""
        low, high = self.ends
        return torch.exp(-0.5 * (low / self.sigma) ** 2), torch.exp(-0.5 * (high / self.sigma) ** 2)

    @property
    def moments(self) -> tuple[Tensor, Tensor, Tensor]:
        """Integrals of 1, x and x^2 times the Gaussian."""
        (low, high), (at_low, at_high) = self.ends, self.heights
        unit, variance = self.sigma * math.sqrt(2), self.sigma**2
        zeroth = self.sigma * math.sqrt(math.pi / 2) * (torch.erf(high / unit) - torch.erf(low / unit))
        return zeroth, variance * (at_low - at_high), variance * (zeroth + low * at_low - high * at_high)


def axes(covariances: Float[Tensor, "M 3"], conic_factors: Float[Tensor, "M 3"]) -> Float[Tensor, "M 4"]:
    """Returns (n1x, n1y, sigma1, sigma2): direction of the longer axis, standard deviations along both, px.

    The smaller eigenvalue is the determinant over the larger one: the difference cancels for needles.
    """
    xx, xy, yy = covariances.unbind(1)
    longer = (xx + yy) / 2 + torch.hypot((xx - yy) / 2, xy)
    shorter = yy / longer / (2 * conic_factors[:, 0].square())
    # in float32 torch's atan2 depends on where a number lies in memory, and crops have other lists of splats
    angle = torch.atan2(2 * xy.double(), xx.double() - yy.double()).to(xy) / 2
    sigmas = torch.stack([longer, shorter], 1).sqrt().clamp_min(LEAST_SIGMA)
    return torch.cat([angle.cos()[:, None], angle.sin()[:, None], sigmas], 1)


def along_axes(window: PixelWindow, row: Row) -> tuple[Axis, Axis, Tensor]:
    """Returns the window along both axes of the splat, turned by at most 45 degrees, and where its sides keep order."""
    _, x, y, wide, high = window
    mean_x, mean_y, cos, sin, sigma1, sigma2, _ = row
    dx, dy = x - mean_x, y - mean_y
    kept = cos.abs() > sin.abs()
    first, second = torch.where(kept, wide, high), torch.where(kept, high, wide)
    return Axis(dx * cos + dy * sin, first, sigma1), Axis(dy * cos - dx * sin, second, sigma2), kept


def is_narrow(u: Axis, v: Axis) -> Tensor:
    """Returns where the window is so narrow that the alpha of its middle holds."""
    return (u.side < NARROW * u.sigma) | (v.side < NARROW * v.sigma)


def alpha_of(u: Axis, v: Axis, integral: Tensor, opacity: Tensor) -> tuple[Tensor, Tensor]:
    """Returns (mean alpha over the window, where it is that of the middle), not clamped. integral: of the Gaussian."""
    narrow = is_narrow(u, v)
    middle = torch.exp(-0.5 * ((u.offset / u.sigma) ** 2 + (v.offset / v.sigma) ** 2))
    area = integral / (u.side * v.side)
    return opacity * torch.where(narrow, middle, area), narrow


def remainder(
    axis: Axis, moments: tuple[Tensor, Tensor, Tensor], across: Tensor, taken: Tensor, left: Tensor
) -> tuple[Tensor, Tensor]:
    """Returns (middle, side) along an axis of the light behind a splat.

    `moments`: along the axis; `across`: the integral along the other; `taken`: the splat's opacity over the window's
    area.
    """
    _, first, second = moments
    mean = (axis.offset - taken * first * across) / left
    square = (axis.offset**2 + axis.side**2 / 12 - taken * second * across) / left
    return mean, (12 * (square - mean**2).clamp_min(LEAST_WINDOW_VARIANCE)).sqrt()


def behind_splat(
    light: Tensor,
    x: Tensor,
    y: Tensor,
    wide: Tensor,
    high: Tensor,
    row: Float[Tensor, "B 7"],
    alpha_min: float,
    alpha_max: float,
    stop: float,
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Returns (alpha of one splat in front of each pixel's window, the window behind it: light, x, y, wide, high)."""
    window, columns = (light, x, y, wide, high), tuple(row.unsqueeze(2).unbind(1))
    u, v, kept = along_axes(window, columns)
    mean_x, mean_y, cos, sin, _, _, opacity = columns
    of_u, of_v = u.moments, v.moments
    exact, narrow = alpha_of(u, v, of_u[0] * of_v[0], opacity)
    alpha = torch.where((exact >= alpha_min) & (light >= stop), exact.clamp(max=alpha_max), 0.0)
    taken = opacity * (alpha / exact.clamp_min(1e-30)) / (u.side * v.side)  # less where alpha is clamped
    mean_u, side_u = remainder(u, of_u, of_v[0], taken, 1 - alpha)
    mean_v, side_v = remainder(v, of_v, of_u[0], taken, 1 - alpha)
    moved = (alpha > 0) & ~narrow
    new_wide, new_high = torch.where(kept, side_u, side_v), torch.where(kept, side_v, side_u)
    return (
        alpha,
        light * (1 - alpha),
        torch.where(moved, mean_x + mean_u * cos - mean_v * sin, x),
        torch.where(moved, mean_y + mean_u * sin + mean_v * cos, y),
        torch.where(moved, new_wide, wide),
        torch.where(moved, new_high, high),
    )


# -- the walk over all tiles ---------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Lists:
    """Splats and their lists."""

    rows: Float[Tensor, "M 7"]
    """x, y on the frame, n1x, n1y, sigma1, sigma2, opacity."""
    channels: Float[Tensor, "M C"]
    """Last: ones, for coverage."""
    intersections: TileIntersections
    grid: TileGrid
    settings: RasterSettings


@dataclass(frozen=True, eq=False)
class Met:
    """One splat in front of each of B tiles."""

    tiles: Int[Tensor, "B"]
    entries: Int[Tensor, "B"]
    """Indices into the list of intersections."""
    splats: Int[Tensor, "B"]
    row: Float[Tensor, "B 7"]
    """Positions relative to the middle of the tile."""
    before: PixelWindow
    alpha: Float[Tensor, "B P"]


def walk(lists: Lists, tiles: Int[Tensor, "B"]) -> Iterator[Met]:
    """Yields the splats of some tiles front to back, with the windows that they meet."""
    grid, settings, like = lists.grid, lists.settings, lists.rows
    lengths, starts = lists.intersections.starts.diff()[tiles], lists.intersections.starts[tiles]
    step = settings.backend.on(like.device.type).kernel(behind_splat) if len(tiles) > 1 else behind_splat
    x, y, one = (column.expand(len(tiles), -1) for column in pixel_centres(grid.tile, like))
    inside = grid.to_tiles(like.new_ones(1, grid.height, grid.width))[:, 0]
    window: PixelWindow = (inside[tiles], x, y, one, one)
    rules = settings.alpha_min, settings.alpha_max, settings.transmittance_stop
    for number in range(int(lengths.max()) if len(tiles) else 0):
        going = (lengths > number) & (window[0].amax(1) >= max(settings.transmittance_stop, 1e-30))
        if not bool(going.all()):
            tiles, lengths, starts = tiles[going], lengths[going], starts[going]
            window = tuple(part[going] for part in window)  # type: ignore[assignment]
        if not len(tiles):
            return
        splats = lists.intersections.splats[starts + number]
        row = lists.rows[splats]
        row = torch.cat([row[:, :2] - grid.centres(tiles, like), row[:, 2:]], 1)
        alpha, *behind = step(*window, row, *rules)
        yield Met(tiles, starts + number, splats, row, window, alpha)
        window = tuple(behind)


def tile_batches(lists: Lists) -> Sequence[Int[Tensor, "B"]]:
    """Returns tiles with splats, longest list first, in batches."""
    return batches(lists.intersections.starts.diff(), BATCH_PIXELS // lists.grid.tile**2)


def blend_windows(lists: Lists, max_weights: Float[Tensor, "E"] | None) -> Float[Tensor, "T P C"]:
    """Returns the blended channels of every tile; `max_weights`: receives each intersection's largest weight."""
    tiles = len(lists.intersections.starts) - 1
    pictures = lists.channels.new_zeros(tiles, lists.grid.tile**2, lists.channels.shape[1])
    for batch in tile_batches(lists):
        for met in walk(lists, batch):
            weight = met.before[0] * met.alpha
            pictures.index_add_(0, met.tiles, weight[..., None] * lists.channels[met.splats][:, None])
            if max_weights is not None:
                max_weights[met.entries] = weight.amax(1)
    return pictures


# -- gradients, as published: of a splat in the window that it meets, not of that window -----------------------------


def slopes(u: Axis, v: Axis, opacity: Tensor) -> tuple[Tensor, ...]:
    """Returns derivatives of the mean alpha, not clamped, in the frame of the axes.

    By opacity, both offsets, both variances and the off-diagonal entry. By the heat equation that of a variance is half
    the second derivative by the offset: not singular where both axes are equal.
    """
    area, unit = u.side * v.side, opacity
    (u0, _, u2), (v0, _, v2) = u.moments, v.moments
    (u_low, u_high), (v_low, v_high) = u.heights, v.heights
    wide = (
        u0 * v0 / area,
        unit * v0 * (u_high - u_low) / area,
        unit * u0 * (v_high - v_low) / area,
        unit * v0 * u2 / (2 * u.sigma**4 * area),
        unit * u0 * v2 / (2 * v.sigma**4 * area),
        unit * (u_high - u_low) * (v_high - v_low) / area,
    )
    a, b = u.offset / u.sigma, v.offset / v.sigma
    middle = torch.exp(-0.5 * (a**2 + b**2))
    point = (
        middle,
        -unit * middle * a / u.sigma,
        -unit * middle * b / v.sigma,
        unit * middle * a**2 / (2 * u.sigma**2),
        unit * middle * b**2 / (2 * v.sigma**2),
        unit * middle * a * b / (u.sigma * v.sigma),
    )
    narrow = is_narrow(u, v)
    return tuple(torch.where(narrow, p, w) for p, w in zip(point, wide, strict=True))


def splat_gradients(met: Met, weight: Float[Tensor, "B P"]) -> Float[Tensor, "B P 6"]:
    """Returns `weight` times the derivatives of alpha by mean x, y, covariance xx, xy, yy and ln opacity, by pixel."""
    columns = tuple(met.row.unsqueeze(2).unbind(1))
    u, v, _ = along_axes(met.before, columns)
    _, _, cos, sin, _, _, opacity = columns
    by_opacity, by_u, by_v, by_uu, by_vv, by_uv = (weight * slope for slope in slopes(u, v, opacity))
    return torch.stack(
        [
            -(by_u * cos - by_v * sin),
            -(by_u * sin + by_v * cos),
            by_uu * cos**2 + by_vv * sin**2 - by_uv * cos * sin,
            2 * (by_uu - by_vv) * cos * sin + by_uv * (cos**2 - sin**2),
            by_uu * sin**2 + by_vv * cos**2 + by_uv * cos * sin,
            by_opacity * opacity,
        ],
        -1,
    )


def gradients_of_lists(
    lists: Lists, pictures: Float[Tensor, "T P C"], gradient: Float[Tensor, "T P C"]
) -> tuple[Float[Tensor, "E 8"], Float[Tensor, "E C"]]:
    """Returns (gradients of mean, covariance and ln opacity, then absolute gradients of the mean; of channels).

    One row per intersection. The windows are computed again, front to back.
    """
    count = len(lists.intersections.splats)
    own, channels = lists.rows.new_zeros(count, 8), lists.rows.new_zeros(count, lists.channels.shape[1])
    passed = torch.zeros_like(pictures)
    for batch in tile_batches(lists):
        for met in walk(lists, batch):
            colour, by_colour = lists.channels[met.splats][:, None], gradient[met.tiles]
            weight = met.before[0] * met.alpha
            passed[met.tiles] += weight[..., None] * colour
            rest = (passed[met.tiles] - pictures[met.tiles]) / (1 - met.alpha)[..., None]
            of_alpha = ((met.before[0][..., None] * colour + rest) * by_colour).sum(2) * (met.alpha > 0)
            parts = splat_gradients(met, of_alpha)
            own[met.entries] = torch.cat([parts.sum(1), parts[..., :2].abs().sum(1)], 1)
            channels[met.entries] = (weight[..., None] * by_colour).sum(1)
    return own, channels


class WindowComposite(torch.autograd.Function):
    """Blends the splats of `composite_windows`, which documents the gradient."""

    @staticmethod
    def forward(
        ctx, means, covariances, log_opacities, channels, absgrad, factors, intersections, grid, settings, most
    ):
        rows = torch.cat([means, axes(covariances, factors), log_opacities.exp()[:, None]], 1)
        lists = Lists(rows, torch.cat([channels, torch.ones_like(means[:, :1])], 1), intersections, grid, settings)
        pictures = blend_windows(lists, most)
        ctx.kept = lists, pictures, absgrad is not None
        return grid.to_raster(pictures)

    @staticmethod
    def backward(ctx, gradient):
        lists, pictures, absolute = ctx.kept
        own, channels = gradients_of_lists(lists, pictures, lists.grid.to_tiles(gradient).permute(0, 2, 1))
        values = torch.cat([own, channels[:, :-1]], 1)
        total = sum_by_splat(values, lists.intersections.splats, len(lists.rows))
        absgrad = total[:, 6:8] if absolute else None
        return total[:, :2], total[:, 2:5], total[:, 5], total[:, 8:], absgrad, None, None, None, None, None


def composite_windows(
    screen: ScreenSplats,
    channels: Float[Tensor, "M C"],
    intersections: TileIntersections,
    grid: TileGrid,
    settings: RasterSettings,
) -> tuple[Float[Tensor, "C_plus_1 H W"], Float[Tensor, "M"] | None]:
    """Blends by pixel windows; a `Compositor`.

    The gradient is the published one: it leaves out that a splat moves the windows of those behind it.
    """
    if settings.pixel != "window":
        raise ConfigError("rasterizer.path=window draws pixel windows: set rasterizer.pixel=window instead")
    means, factors = screen.means, screen.conic_factors.detach()
    exact = Precision.of(settings, means.dtype).exact
    most = means.new_zeros(len(intersections.splats), dtype=exact) if screen.weigh else None
    inputs = means, screen.covariances, screen.log_opacities, channels, screen.absgrad, factors
    in_format = [None if values is None else values.to(exact) for values in inputs]
    blended = WindowComposite.apply(*in_format, intersections, grid, settings, most).to(means.dtype)
    if most is None:
        return blended, None
    largest = most.new_zeros(len(means)).scatter_reduce_(0, intersections.splats, most, "amax")
    return blended, largest.to(means.dtype)
