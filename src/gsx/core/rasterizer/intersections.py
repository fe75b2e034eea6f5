"""Intersections of splats and tiles, front to back. Nothing here is differentiated.

On each row of tiles the ellipse alpha >= alpha_min of a splat spans an exact interval of columns. Splats are taken
nearest first, and a stable sort by tile keeps that order.
"""

import functools
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from gsx.core.backend import EAGER
from gsx.core.data.camera import Camera, Frame
from gsx.core.device import upload
from gsx.core.errors import TooManyPairs
from gsx.core.gaussians.splats import Splats
from gsx.core.rasterizer.bags import bag_sums, edges_of
from gsx.core.rasterizer.boxes import boxes, spans
from gsx.core.rasterizer.grid import TileGrid
from gsx.core.rasterizer.projection import ScreenSplats, drawable, project
from gsx.core.rasterizer.settings import WINDOW_TILE, RasterSettings
from gsx.core.rasterizer.sorting import sorted_stably
from gsx.core.shapes import Bool, Float, Int

WINDOW_REACH = 1.25
"""Reach of a pixel's window from its centre, px: half a diagonal, and the growth of a window cut by a needle."""


@dataclass(frozen=True, eq=False, kw_only=True)
class TileIntersections:
    """P intersections of splats and tiles, sorted by tile, then by depth."""

    splats: Int[Tensor, "P"]
    """Row of the screen splat."""
    tiles: Int[Tensor, "P"]
    """Tile, row-major on the grid."""
    starts: Int[Tensor, "T_plus_1"]
    """First intersection of each tile, then P."""
    slots: Int[Tensor, "P"]
    """Index of each in the list sorted by splat, nearest first: a permutation."""
    order: Int[Tensor, "M"]
    """Rows of the screen splats, nearest first."""
    counts: Int[Tensor, "M"]
    """Number of intersections of each of them."""
    radii: Int[Tensor, "M"]
    """Published radius ceil(3 sqrt(largest eigenvalue)), px; 0: the splat touches no tile."""


def reach_of(settings: RasterSettings) -> float:
    """Returns the largest distance from a pixel's centre at which a splat affects it, px."""
    return WINDOW_REACH if settings.pixel == "window" else 0.0


@dataclass(frozen=True, eq=False, kw_only=True)
class Boxes:
    """Bounding boxes of M splats in tiles of the frame, and their published radii."""

    first: Int[Tensor, "2 M"]
    """First column, first row."""
    last: Int[Tensor, "2 M"]
    """One past the last column and row."""
    radii: Int[Tensor, "M"]
    """Published radius, px; 0: no tile of the published square touches the raster."""
    limits: Float[Tensor, "M"]
    """Largest s^2 + r^2 with alpha >= alpha_min; negative: nowhere."""


@functools.lru_cache(maxsize=64)
def raster_numbers(frame: Frame, size: tuple[int, int], grid: TileGrid, device: torch.device) -> Int[Tensor, "2 5"]:
    """Returns the numbers of a raster for `boxes`, on the device."""
    sides = zip((frame.width, frame.height), (frame.left, frame.top), size, grid.first, grid.shape, strict=True)
    numbers = [
        [-(-whole // WINDOW_TILE), at, at + extent, begin, begin + count] for whole, at, extent, begin, count in sides
    ]
    return upload(torch.tensor(numbers, dtype=torch.int32), device)


@torch.no_grad()
def boxes_of(screen: ScreenSplats, camera: Camera, settings: RasterSettings) -> Boxes:
    """Returns the bounding boxes of splats on the screen."""
    rules = (
        settings.alpha_min,
        settings.tile_size,
        reach_of(settings),
        settings.cull == "published" and settings.pixel == "sample",
    )
    device = screen.means.device
    numbers = raster_numbers(camera.frame, camera.size, TileGrid.of(camera, settings.tile_size), device)
    shapes = screen.means.detach(), screen.covariances.detach(), screen.log_opacities.detach()
    backend = settings.backend.on(device.type) if len(screen.ids) > 1 else EAGER
    *edges, radii, limits = backend.kernel(boxes, *rules)(*shapes, numbers)
    return Boxes(first=torch.stack(edges[:2]), last=torch.stack(edges[2:]), radii=radii, limits=limits)


@torch.no_grad()
def intersect_tiles(screen: ScreenSplats, camera: Camera, settings: RasterSettings) -> TileIntersections:
    """Returns the intersections of each splat with all tiles where its alpha may reach alpha_min.

    Raises:
        TooManyPairs: there are more than `settings.max_pairs`.
    """
    grid, found = TileGrid.of(camera, settings.tile_size), boxes_of(screen, camera, settings)
    # positive floats sort like the integers of their bits, which torch sorts faster; ties stay in their order
    bits = screen.depths.contiguous().view({4: torch.int32, 8: torch.int64}[screen.depths.element_size()])
    order = sorted_stably(bits)[1]
    shapes = screen.means.detach(), screen.conic_factors.detach(), found.limits
    backend = settings.backend.on(order.device.type)
    heights, placed, sides = backend.kernel(in_order)(order, found.first, found.last, *shapes)
    starts = heights.cumsum(0) - heights  # not compiled: a long running sum would use one group of threads
    rank = torch.repeat_interleave(heights, output_size=refuse_too_many(heights, grid, settings))
    find_spans = (backend if min(len(rank), len(order)) > 1 else EAGER).kernel(spans, grid.tile, reach_of(settings))
    row, begin, widths = find_spans(rank, placed, sides, starts)
    line = torch.repeat_interleave(widths, output_size=refuse_too_many(widths, grid, settings))
    row, begin = row - grid.first[1], begin - grid.first[0]
    tiles = backend.kernel(pair_tiles)(line, row, begin, widths.cumsum(0, dtype=torch.int32) - widths, grid.shape[0])
    return sorted_pairs(order, rank, widths, line, tiles, grid, found.radii)


def in_order(
    order: Int[Tensor, "M"],
    first: Int[Tensor, "2 M"],
    last: Int[Tensor, "2 M"],
    means: Float[Tensor, "M 2"],
    conic_factors: Float[Tensor, "M 3"],
    limits: Float[Tensor, "M"],
) -> tuple[Int[Tensor, "M"], Float[Tensor, "M 6"], Int[Tensor, "M 3"]]:
    """Returns each splat's number of tile rows, and shapes and sides for `spans`, nearest splats first."""
    heights = (last[1] - first[1]).clamp_min(0) * (last[0] > first[0])
    shapes = torch.cat([means, conic_factors, limits[:, None]], 1)
    sides = torch.stack([first[1], first[0], last[0]], 1)
    return heights.index_select(0, order), shapes.index_select(0, order), sides.index_select(0, order)


def pair_tiles(
    line: Int[Tensor, "P"], row: Int[Tensor, "R"], begin: Int[Tensor, "R"], before: Int[Tensor, "R"], columns: int
) -> Int[Tensor, "P"]:
    """Returns the tile of each pair; pairs of a span start at its column `begin` with index `before`."""
    place = torch.arange(line.shape[0], device=line.device, dtype=torch.int32)
    return place + (row * columns + begin - before).index_select(0, line)


def sorted_pairs(
    order: Int[Tensor, "M"],
    rank: Int[Tensor, "R"],
    widths: Int[Tensor, "R"],
    line: Int[Tensor, "P"],
    tiles: Int[Tensor, "P"],
    grid: TileGrid,
    radii: Int[Tensor, "M"],
) -> TileIntersections:
    """Sorts intersections by tile; `rank`: splat of each span of `widths` tiles, `line`: span of each intersection."""
    columns, rows = grid.shape
    narrow = torch.int16 if columns * rows <= torch.iinfo(torch.int16).max else torch.int32  # sorted fastest
    tiles, slots = sorted_stably(tiles.to(narrow))
    splats = order.int().index_select(0, rank).index_select(0, line).index_select(0, slots)
    counts = widths.new_zeros(len(order)).index_add_(0, rank, widths)
    edges = torch.arange(columns * rows + 1, device=tiles.device, dtype=torch.int32)
    return TileIntersections(
        splats=splats,
        tiles=tiles.int(),
        starts=torch.searchsorted(tiles.int(), edges),
        slots=slots,
        order=order,
        counts=counts,
        radii=radii,
    )


def sum_by_splat(
    values: Float[Tensor, "E V"], places: Int[Tensor, "P"], order: Int[Tensor, "M"], counts: Int[Tensor, "M"], rows: int
) -> Float[Tensor, "rows V"]:
    """Sums over the entries of each splat in a fixed order; `places`: entry of each pair, pairs sorted by splat.

    `order` and `counts` are those of TileIntersections: a backward pass need not hold its lists of pairs.
    """
    sums = bag_sums(values, places, edges_of(counts))
    return values.new_zeros(rows, values.shape[1]).index_copy_(0, order, sums)


def refuse_too_many(counts: Int[Tensor, "N"], grid: TileGrid, settings: RasterSettings) -> int:
    """Returns their sum; TooManyPairs: it exceeds `max_pairs`."""
    count = int(counts.sum())
    if count > settings.max_pairs:
        raise TooManyPairs(
            f"this picture of {grid.width}x{grid.height} px needs {count:,} splat-tile pairs, more than "
            f"rasterizer.max_pairs={settings.max_pairs:,}: render it in smaller pieces or raise the limit"
        )
    return count


def cap_tiles(every: TileIntersections, cap: int) -> TileIntersections:
    """Keeps the first `cap` intersections of each tile, its nearest splats; 0: all.

    Radii are kept: a splat without tiles still counts as visible, as behind opaque ones.
    """
    if not cap or not len(every.tiles):
        return every
    number = torch.arange(len(every.tiles), device=every.tiles.device) - every.starts[every.tiles.long()]
    kept = number < cap
    lengths = every.starts.diff().clamp(max=cap)
    kept_by_splat = torch.empty_like(kept).index_put_((every.slots,), kept)
    owner = torch.repeat_interleave(every.counts)
    return replace(
        every,
        splats=every.splats[kept],
        tiles=every.tiles[kept],
        starts=torch.cat([every.starts[:1], lengths.cumsum(0).to(every.starts)]),
        slots=(kept_by_splat.cumsum(0) - 1)[every.slots[kept]],
        counts=torch.bincount(owner[kept_by_splat], minlength=len(every.counts)),
    )


@torch.no_grad()
def touches(
    means: Float[Tensor, "N 3"],
    scales: Float[Tensor, "N 3"],
    quats: Float[Tensor, "N 4"],
    camera: Camera,
    settings: RasterSettings,
) -> Bool[Tensor, "N"]:
    """Marks Gaussians whose published 3-sigma square touches the raster (3D-GS, forward.cu), and undrawable ones."""
    opaque = without_colours(means, scales, quats)
    screen, on = on_screen(opaque, camera, settings)
    mask = torch.zeros(len(means), dtype=torch.bool, device=means.device)
    mask.index_copy_(0, screen.ids, on)
    return mask | ~drawable(opaque, camera, settings) if screen.dropped else mask


def without_colours(means: Float[Tensor, "N 3"], scales: Float[Tensor, "N 3"], quats: Float[Tensor, "N 4"]) -> Splats:
    """Returns opaque Gaussians without channels."""
    return Splats(
        means=means, scales=scales, quats=quats, log_opacities=torch.zeros_like(means[:, 0]), colours=means[:, :0]
    )


def on_screen(splats: Splats, camera: Camera, settings: RasterSettings) -> tuple[ScreenSplats, Bool[Tensor, "M"]]:
    """Returns splats near the raster, and marks those whose published square has tiles on it."""
    screen = project(splats, camera, settings)
    return screen, boxes_of(screen, camera, settings).radii > 0
