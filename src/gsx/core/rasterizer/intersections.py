"""Which splats reach which tiles, front to back. Nothing here is differentiated.

A splat is cut into its rows of tiles; on each row the ellipse alpha >= alpha_min spans an exact interval of columns, so
no candidate is made that is no intersection. Screen splats come nearest first, hence so do their intersections, and one
stable sort by tile keeps them so.
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from gsx.core.data.camera import Camera, Frame
from gsx.core.errors import TooManyPairs
from gsx.core.rasterizer.grid import TileGrid
from gsx.core.rasterizer.projection import ScreenSplats
from gsx.core.rasterizer.settings import WINDOW_TILE, RasterSettings
from gsx.core.shapes import Bool, Float, Int

FAR = 1 << 20
"""Pixels and tiles farther out than any raster; keeps integers in range."""
CUTOFF_SLACK = 1e-3
"""Added to ln(alpha / alpha_min) when tiles are chosen, so that rounding never drops a pixel at the cut-off."""
WINDOW_REACH = 1.25
"""Px from its centre within which all light of a pixel lies where windows are kept: half a diagonal, and as much as a
window grows where a needle leaves light at both of its sides."""


@dataclass(frozen=True, eq=False, kw_only=True)
class TileIntersections:
    """P intersections of splats and tiles, sorted by tile, within a tile by depth."""

    splats: Int[Tensor, "P"]
    """Row of the screen splat."""
    tiles: Int[Tensor, "P"]
    """Tile, row-major over the grid."""
    starts: Int[Tensor, "T_plus_1"]
    """First intersection of each tile, then P."""
    slots: Int[Tensor, "P"]
    """Place of each in the list sorted by splat, nearest splat first: a permutation."""
    order: Int[Tensor, "V"]
    """Rows of the screen splats that have a tile in their box, nearest first."""
    counts: Int[Tensor, "V"]
    """How many each of them has."""
    radii: Int[Tensor, "M"]
    """Published radius in px, ceil(3 sqrt(largest eigenvalue)); 0 where the splat touches no tile."""


def published_radii(covariances: Float[Tensor, "M 3"]) -> Float[Tensor, "M"]:
    """Those of 3D-GS: rounded up (3D-GS, forward.cu)."""
    return three_sigma(covariances).ceil()


def three_sigma(covariances: Float[Tensor, "M 3"]) -> Float[Tensor, "M"]:
    """3 sqrt(lambda_max) with the published floor of 0.1 under the inner root (3D-GS, forward.cu)."""
    xx, xy, yy = covariances.unbind(1)
    spread = ((xx - yy) / 2).square() + xy.square()
    return 3 * ((xx + yy) / 2 + spread.clamp_min(0.1).sqrt()).sqrt()


def published_windows(
    means: Float[Tensor, "M 2"], radii: Float[Tensor, "M"], frame: Frame
) -> tuple[Int[Tensor, "M 2"], Int[Tensor, "M 2"]]:
    """First and past-the-last frame pixel of the 16 px tiles that 3D-GS assigns to each splat (3D-GS, forward.cu)."""
    size = [-(-frame.width // WINDOW_TILE), -(-frame.height // WINDOW_TILE)]
    grid = torch.tensor(size, device=means.device, dtype=torch.int32)
    corner = means - 0.5  # the published mean is relative to integer pixel positions
    edges = (corner - radii[:, None], corner + radii[:, None] + (WINDOW_TILE - 1))
    first, last = (torch.minimum((edge / WINDOW_TILE).nan_to_num().clamp(0, FAR).int(), grid) for edge in edges)
    return WINDOW_TILE * first, WINDOW_TILE * last


def on_raster(first: Int[Tensor, "M 2"], last: Int[Tensor, "M 2"], camera: Camera) -> Bool[Tensor, "M"]:
    """Whether windows of the frame share a pixel with the raster: all that are not empty, unless it is a crop."""
    corner = torch.tensor([camera.frame.left, camera.frame.top], device=first.device, dtype=first.dtype)
    size = torch.tensor(camera.size, device=first.device, dtype=first.dtype)
    return (last.minimum(corner + size) > first.maximum(corner)).all(1)


def reach_of(settings: RasterSettings) -> float:
    """How far from a pixel's centre a splat still matters to it, px."""
    return WINDOW_REACH if settings.pixel == "window" else 0.0


def cutoff(log_opacities: Float[Tensor, "M"], alpha_min: float) -> Float[Tensor, "M"]:
    """Largest value of s^2 + r^2 at which alpha is still at least alpha_min; negative: nowhere."""
    return log_opacities - math.log(alpha_min) + CUTOFF_SLACK


def tile_ranges(
    screen: ScreenSplats, limits: Float[Tensor, "M"], grid: TileGrid, reach: float
) -> tuple[Int[Tensor, "M 2"], Int[Tensor, "M 2"]]:
    """First and past-the-last tile (counted on the frame) of each splat's bounding box, cut to the raster."""
    half = (2 * limits.clamp_min(0)[:, None] * screen.covariances[:, ::2]).sqrt() + reach
    begin = torch.tensor(grid.first, device=half.device, dtype=torch.int32)
    end = begin + torch.tensor(grid.shape, device=half.device, dtype=torch.int32)
    first, last = touched(screen.means - half, grid.tile), touched(screen.means + half, grid.tile, past=True)
    first, last = first.maximum(begin), last.minimum(end)
    return first, torch.where((limits >= 0)[:, None], last, first).maximum(first)


def touched(edge: Float[Tensor, "*M"], tile: int, past: bool = False) -> Int[Tensor, "*M"]:
    """Tile of the first pixel centre at or right of `edge`; with `past`, one past that of the last at or left of it."""
    pixel = (edge - 0.5).floor() if past else (edge - 0.5).ceil()
    return (pixel / tile).floor().clamp(-FAR, FAR).nan_to_num().int() + int(past)


def row_spans(
    mean: Float[Tensor, "R 2"],
    factor: Float[Tensor, "R 3"],
    limit: Float[Tensor, "R"],
    row: Int[Tensor, "R"],
    tile: int,
    reach: float = 0.0,
) -> tuple[Int[Tensor, "R"], Int[Tensor, "R"]]:
    """First and past-the-last column (counted on the frame) at which the ellipse s^2 + r^2 <= limit meets a tile row,
    or comes as near to its outermost pixel centres as `reach` px.

    Exact: the part of an ellipse between two lines is convex, so its tiles on the row are those of its x-interval.
    """
    u0, u1, u2 = factor.unbind(1)
    top = row * tile + (0.5 - reach) - mean[:, 1]
    height = limit.sqrt() / u2
    low, high = top.maximum(-height), (top + (tile - 1 + 2 * reach)).minimum(height)
    rightmost = -u1 * height * torch.rsqrt(u1 * u1 + u2 * u2)

    def half_width(y: Tensor) -> Tensor:
        return (limit - (u2 * y).square()).clamp_min(0).sqrt()

    at_right, at_left = rightmost.maximum(low).minimum(high), (-rightmost).maximum(low).minimum(high)
    right = mean[:, 0] + (half_width(at_right) - u1 * at_right) / u0
    left = mean[:, 0] - (half_width(at_left) + u1 * at_left) / u0
    first, last = touched(left - reach, tile), touched(right + reach, tile, past=True)
    return first, torch.where(low <= high, last, first)


def intersect_tiles(screen: ScreenSplats, camera: Camera, settings: RasterSettings) -> TileIntersections:
    """Of every splat with every tile where its alpha may reach alpha_min.

    Raises:
        TooManyPairs: more than `settings.max_pairs` pairs would be needed.
    """
    with torch.no_grad():
        grid = TileGrid.of(camera, settings.tile_size)
        limits = cutoff(screen.log_opacities, settings.alpha_min)
        radii = published_radii(screen.covariances)
        window_first, window_last = published_windows(screen.means, radii, camera.frame)
        first, last = tile_ranges(screen, limits, grid, reach_of(settings))
        if settings.cull == "published" and settings.pixel == "sample":
            first = first.maximum(window_first // grid.tile)
            last = last.minimum(window_last // grid.tile).maximum(first)
        seen = on_raster(window_first, window_last, camera)
        radii = torch.where(seen, radii, 0.0).nan_to_num().clamp_max(FAR).int()
        return reached_tiles(screen, limits, first, last, grid, settings, radii)


def reached_tiles(
    screen: ScreenSplats,
    limits: Float[Tensor, "M"],
    first: Int[Tensor, "M 2"],
    last: Int[Tensor, "M 2"],
    grid: TileGrid,
    settings: RasterSettings,
    radii: Int[Tensor, "M"],
) -> TileIntersections:
    """The intersections, given each splat's box of tiles (first, past the last)."""
    # positive floats sort like the integers of their bits, which torch sorts faster; ties stay in their order
    bits = screen.depths.contiguous().view({4: torch.int32, 8: torch.int64}[screen.depths.element_size()])
    order = torch.argsort(bits, stable=True)
    order = order[((last > first).all(1))[order]]
    heights = (last - first)[order, 1]
    refuse_too_many(int(heights.sum()), grid, settings)
    rank = torch.repeat_interleave(heights)
    # one gather of floats and one of integers for every row of tiles, in the order of memory
    shapes = torch.cat([screen.means, screen.conic_factors, limits[:, None]], 1)[order].index_select(0, rank)
    top = first[order, 1] - (heights.cumsum(0) - heights).int()
    top, left, right = torch.stack([top, first[order, 0], last[order, 0]], 1).index_select(0, rank).unbind(1)
    row = top + torch.arange(len(rank), device=rank.device, dtype=torch.int32)
    reach = reach_of(settings)
    begin, end = row_spans(shapes[:, :2], shapes[:, 2:5], shapes[:, 5], row, grid.tile, reach)
    begin, end = begin.maximum(left), end.minimum(right)
    widths = (end - begin).clamp_min_(0).long()
    refuse_too_many(int(widths.sum()), grid, settings)
    return sorted_pairs(order, rank, row - grid.first[1], begin - grid.first[0], widths, grid, radii)


def sorted_pairs(
    order: Int[Tensor, "V"],
    rank: Int[Tensor, "R"],
    row: Int[Tensor, "R"],
    begin: Int[Tensor, "R"],
    widths: Int[Tensor, "R"],
    grid: TileGrid,
    radii: Int[Tensor, "M"],
) -> TileIntersections:
    """Expand spans of `widths` tiles from column `begin` of a tile row into intersections, and sort them by tile."""
    columns, rows = grid.shape
    line = torch.repeat_interleave(widths)
    before = widths.cumsum(0) - widths
    place = torch.arange(len(line), device=line.device)
    narrow = torch.int16 if columns * rows <= torch.iinfo(torch.int16).max else torch.int32  # sorted fastest
    tiles = (place + (row * columns + begin - before).index_select(0, line)).to(narrow)
    tiles, slots = torch.sort(tiles, stable=True)
    counts = torch.zeros_like(order).index_add_(0, rank, widths)
    edges = torch.arange(columns * rows + 1, device=tiles.device, dtype=torch.int32)
    return TileIntersections(
        splats=order[rank].index_select(0, line).index_select(0, slots),
        tiles=tiles.int(),
        starts=torch.searchsorted(tiles.int(), edges),
        slots=slots,
        order=order,
        counts=counts,
        radii=radii,
    )


def refuse_too_many(count: int, grid: TileGrid, settings: RasterSettings) -> None:
    """Raise TooManyPairs before memory for too many pairs is asked for."""
    if count > settings.max_pairs:
        raise TooManyPairs(
            f"this picture of {grid.width}x{grid.height} px needs {count:,} splat-tile pairs, more than "
            f"rasterizer.max_pairs={settings.max_pairs:,}: render it in smaller pieces or raise the limit"
        )
