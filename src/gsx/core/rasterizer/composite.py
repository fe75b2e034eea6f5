"""Front-to-back blending over tiles and its gradient, in O(pairs + pixels) memory.

The list of a tile is cut into blocks of K splats, the last one padded. Tiles are taken in batches of similar list
length; a batch blends one block of each of its tiles at a time, front to back; tiles whose list has ended or whose
pixels have all stopped leave the batch. The backward pass recomputes alphas from the transmittance saved before each
block, back to front, so that the colour behind a splat is a sum of small terms, not a difference of large ones. Blocks
are dense [B, K, P] arrays: B tiles, K splats, P pixels of a tile. exponent.py has ln alpha.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from gsx.core.rasterizer.exponent import (
    absolute_gradient,
    exponent_rows,
    gradient_by_splat,
    log_alphas,
    row_gradient,
)
from gsx.core.rasterizer.grid import TileGrid, pixel_centres
from gsx.core.rasterizer.intersections import TileIntersections
from gsx.core.rasterizer.projection import ScreenSplats
from gsx.core.rasterizer.settings import NOTHING, Precision, RasterSettings
from gsx.core.shapes import Float, Int


@dataclass(frozen=True, eq=False, kw_only=True)
class Blocks:
    """Lists of all tiles, cut into blocks of K entries."""

    splats: Int[Tensor, "S K"]
    """Row of the screen splat; M is padding."""
    tiles: Int[Tensor, "S"]
    """Tile of each block."""
    starts: Int[Tensor, "T"]
    """First block of each tile."""
    counts: Int[Tensor, "T"]
    """Blocks of each tile."""


def make_blocks(intersections: TileIntersections, chunk: int, splats: int) -> Blocks:
    """Cuts each tile's list into blocks of `chunk` entries; `splats`: number M of screen splats."""
    lengths = intersections.starts.diff()
    counts = (lengths + (chunk - 1)) // chunk
    tiles = torch.repeat_interleave(torch.arange(len(counts), device=counts.device), counts)
    starts = counts.cumsum(0) - counts
    number = torch.arange(len(tiles), device=counts.device) - starts[tiles]
    lane = torch.arange(chunk, device=counts.device)
    entry = intersections.starts[:-1].long()[tiles, None] + number[:, None] * chunk + lane
    padded = torch.cat([intersections.splats, intersections.splats.new_tensor([splats])])
    last = torch.where(entry < intersections.starts[1:][tiles, None], entry, len(intersections.splats))
    return Blocks(splats=padded[last], tiles=tiles, starts=starts, counts=counts)


@dataclass(frozen=True, eq=False, kw_only=True)
class Tables:
    """Input of blending, by block."""

    rows: Float[Tensor, "S K V"]
    """Rows of `exponent_rows` for each list entry, in the exact dtype."""
    offsets: Float[Tensor, "S K 2"]
    """Mean relative to the tile's centre, px."""
    channels: Float[Tensor, "S K C"]
    basis: Float[Tensor, "3 P"]
    """(x, y, 1) at the pixels of a tile, in the evaluation dtype."""
    inside: Float[Tensor, "T P"]
    """1 at pixels of the raster, 0 outside it."""
    settings: RasterSettings
    precision: Precision


def make_tables(
    means: Float[Tensor, "M 2"],
    conic_factors: Float[Tensor, "M 3"],
    log_opacities: Float[Tensor, "M"],
    channels: Float[Tensor, "M C"],
    blocks: Blocks,
    grid: TileGrid,
    settings: RasterSettings,
) -> Tables:
    """Gathers the input of each list entry, with invisible padding and a channel of ones for coverage."""
    features = torch.cat([means, conic_factors, log_opacities[:, None], channels, torch.ones_like(means[:, :1])], 1)
    nothing = means.new_zeros(1, features.shape[1])
    nothing[0, 5] = NOTHING
    precision = Precision.of(settings, means.dtype)
    table = torch.cat([features, nothing]).to(precision.exact).index_select(0, blocks.splats.view(-1))
    table = table.view(*blocks.splats.shape, features.shape[1])
    offsets = table[..., :2] - grid.centres(blocks.tiles, table)[:, None]
    one = means.new_ones(1, grid.height, grid.width, dtype=precision.accumulation)
    return Tables(
        rows=exponent_rows(offsets, table[..., 2:5], table[..., 5]),
        offsets=offsets,
        channels=table[..., 6:].to(precision.accumulation).contiguous(),
        basis=pixel_centres(grid.tile, means.new_empty(0, dtype=precision.evaluation)),
        inside=grid.to_tiles(one)[:, 0],
        settings=settings,
        precision=precision,
    )


@dataclass(frozen=True, eq=False)
class Front:
    """One block of each of B tiles in the forward pass."""

    tiles: Int[Tensor, "B"]
    blocks: Int[Tensor, "B"]
    transmittance: Float[Tensor, "B P"]
    """Transmittance of each pixel before the block; below the stop value, the pixel has ended."""


# -- mathematics of a [B, K, P] batch ------------------------------------------------------------------------------


def alphas_(gaussian: Float[Tensor, "B K P"], settings: RasterSettings) -> Float[Tensor, "B K P"]:
    """Clamps at alpha_max and zeroes below alpha_min, in place (3D-GS, renderCUDA)."""
    least = torch.tensor(settings.alpha_min, dtype=gaussian.dtype)
    below = float(torch.nextafter(least, torch.tensor(-math.inf, dtype=gaussian.dtype)))  # "> below" means ">= least"
    return torch.threshold_(gaussian.clamp_(max=settings.alpha_max), below, 0.0)


def transmittances(alpha: Float[Tensor, "B K P"], start: Float[Tensor, "B P"]) -> Float[Tensor, "B K_plus_1 P"]:
    """Returns the transmittance before each splat and, last, behind all."""
    values = alpha.new_empty(alpha.shape[0], alpha.shape[1] + 1, alpha.shape[2])
    current, *others = values.unbind(1)
    current.copy_(start)
    for a, behind in zip(alpha.unbind(1), others, strict=True):
        torch.addcmul(current, current, a, value=-1, out=behind)
        current = behind
    return values


def stop_(alpha: Float[Tensor, "B K P"], transmittance: Float[Tensor, "B K_plus_1 P"], stop: float) -> None:
    """Zeroes the alphas of the splat that takes its pixel below `stop`, and of those behind it, in place."""
    if bool(transmittance[:, -1].amin() < stop):
        alpha.mul_(transmittance[:, 1:] >= stop)


def blend(tables: Tables, front: Front) -> tuple[Float[Tensor, "B P C"], Float[Tensor, "B P"], Tensor]:
    """Returns the colour that the blocks add, the transmittance behind them, and the blending weights [B, K, P]."""
    log_alpha, _ = log_alphas(tables.rows.index_select(0, front.blocks), tables.basis)
    alpha = alphas_(log_alpha.exp_(), tables.settings).to(tables.precision.accumulation)
    transmittance = transmittances(alpha, front.transmittance)
    stop_(alpha, transmittance, tables.settings.transmittance_stop)
    weight = alpha.mul_(transmittance[:, :-1])
    accumulated = torch.bmm(weight.mT, tables.channels.index_select(0, front.blocks))
    return accumulated, transmittance[:, -1], weight


def unclamp_(slope: Tensor, gaussian: Tensor, settings: RasterSettings) -> None:
    """Applies the straight-through gradient of min(alpha_max, .), in place (3D-GS, backward.cu)."""
    if bool(gaussian.amax() > settings.alpha_max):
        slope.mul_((gaussian / settings.alpha_max).clamp_(min=1.0))


def contribution_behind(
    contribution: Float[Tensor, "B K P"], rest: Float[Tensor, "B P"]
) -> Float[Tensor, "B K_plus_1 P"]:
    """Returns the sum of `rest` and the block, then the sum behind each splat."""
    values = contribution.new_empty(contribution.shape[0], contribution.shape[1] + 1, contribution.shape[2])
    *others, current = values.unbind(1)
    current.copy_(rest)
    for own, before in zip(reversed(contribution.unbind(1)), reversed(others), strict=True):
        torch.add(current, own, out=before)
        current = before
    return values


@dataclass(frozen=True, eq=False)
class FrontGradient:
    """Gradients of B blocks, and the colour of the blocks and all behind them."""

    rows: Float[Tensor, "B K 6"]
    """Result of `row_gradient`."""
    channels: Float[Tensor, "B K C"]
    absolute: Float[Tensor, "B K 2"] | None
    """Sum over pixels of the absolute gradient of the mean, per axis."""
    rest: Float[Tensor, "B P"]


def front_gradient(
    tables: Tables, front: Front, gradient: Float[Tensor, "B C P"], rest: Float[Tensor, "B P"], absolute: bool
) -> FrontGradient:
    """Returns the gradient of a front; `rest`: colour behind it, times the gradient of the picture."""
    rows = tables.rows.index_select(0, front.blocks)
    log_alpha, kept = log_alphas(rows, tables.basis)
    gaussian, exact = log_alpha.exp_(), tables.precision.exact
    alpha = alphas_(gaussian.clone(), tables.settings).to(tables.precision.accumulation)
    transmittance = transmittances(alpha, front.transmittance)
    stop_(alpha, transmittance, tables.settings.transmittance_stop)
    weight = alpha * transmittance[:, :-1]
    contribution = torch.bmm(tables.channels.index_select(0, front.blocks), gradient).mul_(weight)
    behind = contribution_behind(contribution, rest)
    # d loss / d log alpha = w c.g - (colour behind) alpha / (1 - alpha)
    slope = contribution.addcdiv_(behind[:, 1:].mul_(alpha), 1 - alpha, value=-1)
    unclamp_(slope, gaussian, tables.settings)
    slope = slope.to(exact)  # sums over pixels are exact
    return FrontGradient(
        rows=row_gradient(slope, kept, tables.basis),
        channels=torch.bmm(weight.to(exact), gradient.mT.to(exact)),
        absolute=absolute_gradient(slope, kept, rows) if absolute else None,
        rest=behind[:, 0],
    )


# -- the walk over all tiles ---------------------------------------------------------------------------------------


def batches(counts: Int[Tensor, "T"], size: int) -> Sequence[Int[Tensor, "B"]]:
    """Returns the tiles with a count above 0, largest first, in batches of `size` (at least 1)."""
    order = torch.argsort(counts, descending=True, stable=True)[: int((counts > 0).sum())]
    return order.split(max(1, size))


def walk(
    tables: Tables, blocks: Blocks, tiles: Int[Tensor, "B"]
) -> Iterator[tuple[Front, Float[Tensor, "B P C"], Float[Tensor, "B K P"]]]:
    """Yields (front, added colour, weights) of a batch of tiles, front to back."""
    transmittance = tables.inside[tiles]
    number = 0
    while len(tiles):
        front = Front(tiles, blocks.starts[tiles] + number, transmittance)
        accumulated, transmittance, weight = blend(tables, front)
        yield front, accumulated, weight
        number += 1
        going = (blocks.counts[tiles] > number) & (transmittance.amax(1) >= tables.settings.transmittance_stop)
        if not bool(going.all()):
            tiles, transmittance = tiles[going], transmittance[going]


def blend_all(
    tables: Tables, blocks: Blocks, keep: bool, max_weights: Float[Tensor, "S K"] | None
) -> tuple[Float[Tensor, "T P C"], list[Front]]:
    """Blends all tiles and returns them; with `keep`, also the fronts for the backward pass.

    `max_weights` receives each list entry's largest blending weight, unless it is None.
    """
    pictures = tables.channels.new_zeros(len(blocks.counts), tables.basis.shape[1], tables.channels.shape[2])
    fronts: list[Front] = []
    size = tables.settings.batch_values // (tables.settings.chunk * tables.settings.tile_size**2)
    for batch in batches(blocks.counts, size):
        for front, accumulated, weight in walk(tables, blocks, batch):
            pictures.index_add_(0, front.tiles, accumulated)
            if max_weights is not None:
                max_weights[front.blocks] = weight.amax(2).to(max_weights)
            if keep:
                fronts.append(front)
    return pictures, fronts


def all_gradients(
    tables: Tables, fronts: list[Front], gradient: Float[Tensor, "T C P"], absolute: bool
) -> tuple[Float[Tensor, "S K 6"], Float[Tensor, "S K C"], Float[Tensor, "S K 2"] | None]:
    """Returns each list entry's gradients: row, channels and, with `absolute`, the absolute one of its mean."""
    shape, of_pair = tables.rows.shape[:2], tables.rows
    rest = gradient.new_zeros(gradient.shape[0], gradient.shape[2])
    rows, channels = of_pair.new_zeros(*shape, 6), of_pair.new_zeros(*shape, tables.channels.shape[2])
    means = of_pair.new_zeros(*shape, 2) if absolute else None
    for front in reversed(fronts):
        of_tiles, behind = gradient.index_select(0, front.tiles), rest.index_select(0, front.tiles)
        part = front_gradient(tables, front, of_tiles, behind, absolute)
        rest.index_copy_(0, front.tiles, part.rest)
        rows.index_copy_(0, front.blocks, part.rows)
        channels.index_copy_(0, front.blocks, part.channels)
        if means is not None and part.absolute is not None:
            means.index_copy_(0, front.blocks, part.absolute)
    return rows, channels, means


def sum_by_splat(values: Float[Tensor, "E V"], splats: Int[Tensor, "E"], count: int) -> Float[Tensor, "M V"]:
    """Sums over the list entries of each splat in a fixed order, which index_add_ has on a CPU only."""
    if values.device.type == "cpu":
        return values.new_zeros(count, values.shape[1]).index_add_(0, splats, values)
    order = torch.argsort(splats, stable=True)
    lengths = torch.bincount(splats, minlength=count)
    return torch.segment_reduce(values[order], "sum", lengths=lengths, axis=0, initial=0)


class Composite(torch.autograd.Function):
    """Autograd function of blended channels, then coverage (the sum of weights), on the raster of `grid`.

    `absgrad`: leaf of zeros whose gradient becomes, per axis, the sum over pixels of the absolute gradient of the mean,
    px; None: not computed. `max_weights` receives each list entry's largest blending weight, unless it is None.
    """

    @staticmethod
    def forward(ctx, means, conic_factors, log_opacities, channels, absgrad, blocks, grid, settings, max_weights):
        tables = make_tables(means, conic_factors, log_opacities, channels, blocks, grid, settings)
        keep = any(ctx.needs_input_grad)
        pictures, fronts = blend_all(tables, blocks, keep, max_weights)
        if keep:
            ctx.kept = (tables, blocks, grid, fronts, len(means), absgrad is not None)
        return grid.to_raster(pictures).to(means.dtype)

    @staticmethod
    def backward(ctx, gradient):
        tables, blocks, grid, fronts, count, absolute = ctx.kept
        tiles = grid.to_tiles(gradient).to(tables.precision.accumulation)
        rows, channels, means = all_gradients(tables, fronts, tiles, absolute)
        by_splat = gradient_by_splat(rows, tables.rows, tables.offsets)
        parts = [by_splat, channels[..., :-1], *([] if means is None else [means])]
        total = sum_by_splat(torch.cat(parts, -1).flatten(0, 1), blocks.splats.view(-1), count + 1)[:-1]
        total = total.to(gradient.dtype)
        width = 6 + channels.shape[2] - 1
        absgrad = total[:, width:] if absolute else None
        return (total[:, :2], total[:, 2:5], total[:, 5], total[:, 6:width], absgrad, None, None, None, None)


def composite_eager(
    screen: ScreenSplats,
    channels: Float[Tensor, "M C"],
    intersections: TileIntersections,
    grid: TileGrid,
    settings: RasterSettings,
) -> tuple[Float[Tensor, "C_plus_1 H W"], Float[Tensor, "M"] | None]:
    """Blends in eager torch; a `Compositor`."""
    blocks = make_blocks(intersections, settings.chunk, len(screen.ids))
    by_entry = screen.means.new_zeros(blocks.splats.shape) if screen.weigh else None
    inputs = (screen.means, screen.conic_factors, screen.log_opacities, channels, screen.absgrad)
    blended = Composite.apply(*inputs, blocks, grid, settings, by_entry)
    if by_entry is None:
        return blended, None
    zeros = by_entry.new_zeros(len(screen.ids) + 1)
    return blended, zeros.scatter_reduce_(0, blocks.splats.view(-1), by_entry.view(-1), "amax")[:-1]
