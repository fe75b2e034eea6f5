"""Which splats reach which tiles, front to back. Nothing here is differentiated."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from gsx.core.camera import Camera, Frame
from gsx.core.errors import InputError
from gsx.core.rasterizer.grid import TileGrid
from gsx.core.rasterizer.projection import ScreenSplats
from gsx.core.rasterizer.settings import WINDOW_TILE, RasterSettings
from gsx.core.shapes import Float, Int

FAR = 1 << 20
"""Pixels and tiles farther out than any raster; keeps integers in range."""
REACH_SLACK = 1e-4
"""Added to ln(alpha / alpha_min) when tiles are chosen, so that rounding never drops a pixel at the cut-off."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Pairs:
    """P splat-tile pairs sorted by tile, within a tile by depth."""

    splats: Int[Tensor, "P"]
    """Row of the screen splat."""
    tiles: Int[Tensor, "P"]
    """Tile, row-major over the grid."""
    starts: Int[Tensor, "T_plus_1"]
    """First pair of each tile, then P."""
    radii: Int[Tensor, "M"]
    """Published radius in px, ceil(3 sqrt(largest eigenvalue)); 0 where the splat touches no tile."""


def published_radii(covariances: Float[Tensor, "M 3"]) -> Float[Tensor, "M"]:
    """ceil(3 sqrt(lambda_max)) with the published floor of 0.1 under the inner root (spec 3.1, step 5)."""
    xx, xy, yy = covariances.unbind(1)
    spread = ((xx - yy) / 2).square() + xy.square()
    return (3 * ((xx + yy) / 2 + spread.clamp_min(0.1).sqrt()).sqrt()).ceil()


def published_windows(
    means: Float[Tensor, "M 2"], radii: Float[Tensor, "M"], frame: Frame
) -> tuple[Int[Tensor, "M 2"], Int[Tensor, "M 2"]]:
    """First and past-the-last frame pixel of the 16 px tiles that 3D-GS assigns to each splat (spec 3.1, step 6)."""
    size = [-(-frame.width // WINDOW_TILE), -(-frame.height // WINDOW_TILE)]
    grid = torch.tensor(size, device=means.device, dtype=torch.int32)
    corner = means - 0.5  # the published mean is relative to integer pixel positions
    edges = (corner - radii[:, None], corner + radii[:, None] + (WINDOW_TILE - 1))
    first, last = (torch.minimum((edge / WINDOW_TILE).nan_to_num().clamp(0, FAR).int(), grid) for edge in edges)
    return WINDOW_TILE * first, WINDOW_TILE * last


def reach(log_opacities: Float[Tensor, "M"], alpha_min: float) -> Float[Tensor, "M"]:
    """Largest value of s^2 + r^2 at which alpha is still at least alpha_min; negative: nowhere."""
    return log_opacities - math.log(alpha_min) + REACH_SLACK


def tile_ranges(
    screen: ScreenSplats, limits: Float[Tensor, "M"], grid: TileGrid
) -> tuple[Int[Tensor, "M 2"], Int[Tensor, "M 2"]]:
    """First and past-the-last tile (counted on the frame) of each splat's bounding box, cut to the raster."""
    half = (2 * limits.clamp_min(0)[:, None] * screen.covariances[:, ::2]).sqrt()
    begin = torch.tensor(grid.first, device=half.device, dtype=torch.int32)
    end = begin + torch.tensor(grid.shape, device=half.device, dtype=torch.int32)
    # a tile counts where one of its pixel centres, at +0.5, lies inside
    first = ((screen.means - half - 0.5).ceil() / grid.tile).floor().nan_to_num().clamp(-FAR, FAR).int()
    last = ((screen.means + half - 0.5).floor() / grid.tile).floor().nan_to_num().clamp(-FAR, FAR).int() + 1
    first, last = first.maximum(begin), last.minimum(end)
    return first, torch.where((limits >= 0)[:, None], last, first).maximum(first)


def least_exponent(
    mean: Float[Tensor, "P 2"], factor: Float[Tensor, "P 3"], corner: Int[Tensor, "P 2"], tile: int
) -> Float[Tensor, "P"]:
    """Smallest s^2 + r^2 over the rectangle of a tile's pixel centres; exact for the convex quadratic."""
    low = corner + 0.5 - mean
    high = low + (tile - 1)
    u0, u1, u2 = factor.unbind(1)
    nearest_x, nearest_y = (torch.minimum(torch.maximum(torch.zeros_like(low), low), high)).unbind(1)
    # on the vertical edge nearest the mean the best y, and on the horizontal edge the best x
    curvature_y = u1 * u1 + u2 * u2
    best_y = (-u0 * u1 / curvature_y * nearest_x).maximum(low[:, 1]).minimum(high[:, 1])
    best_x = (-u1 / u0 * nearest_y).maximum(low[:, 0]).minimum(high[:, 0])

    def exponent(x: Tensor, y: Tensor) -> Tensor:
        return (u0 * x + u1 * y).square() + (u2 * y).square()

    return torch.minimum(exponent(nearest_x, best_y), exponent(best_x, nearest_y))


def expand(counts: Int[Tensor, "M"]) -> tuple[Int[Tensor, "P"], Int[Tensor, "P"]]:
    """For each of sum(counts) items: its owner and its number within the owner."""
    owner = torch.repeat_interleave(torch.arange(len(counts), device=counts.device), counts)
    before = counts.cumsum(0) - counts
    return owner, torch.arange(len(owner), device=counts.device) - before[owner]


def pair(screen: ScreenSplats, camera: Camera, settings: RasterSettings) -> Pairs:
    """Pairs of every splat with every tile where its alpha may reach alpha_min.

    Raises:
        InputError: more than `settings.max_pairs` pairs would be needed.
    """
    with torch.no_grad():
        grid = TileGrid.of(camera, settings.tile_size)
        limits = reach(screen.log_opacities, settings.alpha_min)
        radii = published_radii(screen.covariances)
        window_first, window_last = published_windows(screen.means, radii, camera.frame)
        first, last = tile_ranges(screen, limits, grid)
        if settings.cull == "published":
            first = first.maximum(window_first // grid.tile)
            last = last.minimum(window_last // grid.tile).maximum(first)
        splats, tiles = reached_tiles(screen, limits, first, last, grid, settings)
        seen = (window_last > window_first).all(1)
        columns, rows = grid.shape
        return Pairs(
            splats=splats,
            tiles=tiles,
            starts=torch.searchsorted(tiles, torch.arange(columns * rows + 1, device=tiles.device, dtype=torch.int32)),
            radii=torch.where(seen, radii, 0.0).nan_to_num().clamp_max(FAR).int(),
        )


def reached_tiles(
    screen: ScreenSplats,
    limits: Float[Tensor, "M"],
    first: Int[Tensor, "M 2"],
    last: Int[Tensor, "M 2"],
    grid: TileGrid,
    settings: RasterSettings,
) -> tuple[Int[Tensor, "P"], Int[Tensor, "P"]]:
    """(splat, tile) of every pair, sorted by tile, then depth; tiles that the ellipse misses are left out."""
    order = torch.argsort(screen.depths, stable=True)
    spans = (last - first)[order]
    counts = spans.long().prod(1)
    refuse_too_many(int(counts.sum()), grid, settings)
    owner, number = expand(counts)
    splat, columns = order[owner], spans[owner, 0]
    position = first[splat] + torch.stack([number % columns, number // columns], 1).int()
    nearest = least_exponent(screen.means[splat], screen.factors[splat], position * grid.tile, grid.tile)
    kept = (nearest <= limits[splat]).nonzero()[:, 0]
    column, row = (position[kept] - torch.tensor(grid.first, device=kept.device)).unbind(1)
    tiles, by_tile = torch.sort((row * grid.shape[0] + column).int(), stable=True)
    return splat[kept][by_tile], tiles


def refuse_too_many(count: int, grid: TileGrid, settings: RasterSettings) -> None:
    """Raise InputError before memory for too many pairs is asked for."""
    if count > settings.max_pairs:
        raise InputError(
            f"this picture of {grid.width}x{grid.height} px needs {count:,} splat-tile pairs, more than "
            f"rasterizer.max_pairs={settings.max_pairs:,}: render it in smaller pieces or raise the limit"
        )
