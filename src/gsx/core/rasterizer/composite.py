"""Front-to-back blending over tiles and its gradient, in O(pairs + pixels) memory.

In tile-centred pixel coordinates log alpha = log o - s^2 - r^2 with s = u0 x + u1 y + k0 and r = u2 y + k1: never
above log o, and as exact as evaluating offsets from the mean directly (docs/numerics.md).

The list of a tile is cut into blocks of K splats, the last one padded. Tiles are taken in batches of similar list
length; a batch blends one block of each of its tiles at a time, front to back; tiles whose list has ended or whose
pixels have all stopped leave the batch. The backward pass recomputes alphas from the transmittance saved before each
block and walks back to front, so that the light behind a splat is a sum of small terms, never a difference of large
ones. The work on a batch's blocks is a function of dense [B, K, P] arrays: B tiles, K splats, P pixels of a tile.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

from gsx.core.rasterizer.grid import TileGrid
from gsx.core.rasterizer.pairs import Pairs
from gsx.core.rasterizer.settings import RasterSettings
from gsx.core.shapes import Float, Int

NOTHING = -1e4
"""Log-opacity of the padding behind a tile's list: exp of it is zero in every dtype."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Blocks:
    """Lists of all tiles in blocks of K, tile after tile."""

    splats: Int[Tensor, "S K"]
    """Row of the screen splat; M, one past the last, is padding."""
    tiles: Int[Tensor, "S"]
    """Tile of each block."""
    starts: Int[Tensor, "T"]
    """First block of each tile."""
    counts: Int[Tensor, "T"]
    """Blocks of each tile."""


def make_blocks(pairs: Pairs, chunk: int, splats: int) -> Blocks:
    """Cut each tile's list into blocks of `chunk`; `splats` is the number M of screen splats."""
    lengths = pairs.starts.diff()
    counts = (lengths + (chunk - 1)) // chunk
    tiles = torch.repeat_interleave(torch.arange(len(counts), device=counts.device), counts)
    starts = counts.cumsum(0) - counts
    number = torch.arange(len(tiles), device=counts.device) - starts[tiles]
    lane = torch.arange(chunk, device=counts.device)
    entry = pairs.starts[:-1].long()[tiles, None] + number[:, None] * chunk + lane
    padded = torch.cat([pairs.splats, pairs.splats.new_tensor([splats])])
    last = torch.where(entry < pairs.starts[1:][tiles, None], entry, len(pairs.splats))
    return Blocks(splats=padded[last], tiles=tiles, starts=starts, counts=counts)


@dataclass(frozen=True, eq=False, kw_only=True)
class Tables:
    """What blending reads, block by block."""

    rows: Float[Tensor, "S K 7"]
    """(u0, u1, k0, 0, u2, k1, log o) of every list entry."""
    offsets: Float[Tensor, "S K 2"]
    """Mean relative to the tile's centre, px."""
    channels: Float[Tensor, "S K C"]
    basis: Float[Tensor, "3 P"]
    """x, y, 1 at the pixels of a tile."""
    inside: Float[Tensor, "T P"]
    """1 at pixels of the raster, 0 at those of border tiles beyond it."""
    settings: RasterSettings


def make_tables(
    means: Float[Tensor, "M 2"],
    factors: Float[Tensor, "M 3"],
    log_opacities: Float[Tensor, "M"],
    channels: Float[Tensor, "M C"],
    blocks: Blocks,
    grid: TileGrid,
    settings: RasterSettings,
) -> Tables:
    """Gather what every list entry needs; padding draws nothing. A channel of ones, for coverage, is appended."""
    features = torch.cat([means, factors, log_opacities[:, None], channels, torch.ones_like(means[:, :1])], 1)
    nothing = means.new_zeros(1, features.shape[1])
    nothing[0, 5] = NOTHING
    table = torch.cat([features, nothing]).index_select(0, blocks.splats.view(-1))
    table = table.view(*blocks.splats.shape, features.shape[1])
    offsets = table[..., :2] - grid.centres(blocks.tiles, means)[:, None]
    u0, u1, u2, log_opacity = table[..., 2:6].unbind(-1)
    x, y = offsets.unbind(-1)
    rows = torch.stack([u0, u1, -(u0 * x + u1 * y), torch.zeros_like(u0), u2, -u2 * y, log_opacity], -1)
    return Tables(
        rows=rows,
        offsets=offsets,
        channels=table[..., 6:].contiguous(),
        basis=grid.basis(means),
        inside=grid.to_tiles(means.new_ones(1, grid.height, grid.width))[:, 0],
        settings=settings,
    )


@dataclass(frozen=True, eq=False)
class Front:
    """One block of each of B tiles, as the forward pass met them."""

    tiles: Int[Tensor, "B"]
    blocks: Int[Tensor, "B"]
    transmittance: Float[Tensor, "B P"]
    """Of every pixel before the block; below the stop value: the pixel has ended."""


# -- mathematics of a [B, K, P] batch ------------------------------------------------------------------------------


def exponents(rows: Float[Tensor, "B K 7"], basis: Float[Tensor, "3 P"]) -> tuple[Tensor, Tensor]:
    """s and r of every splat at every pixel, each [B, K, P]."""
    flat = rows.view(-1, 7)
    shape = (*rows.shape[:2], basis.shape[1])
    return (flat[:, :3] @ basis).view(shape), (flat[:, 4:6] @ basis[1:]).view(shape)


def gaussians(rows: Float[Tensor, "B K 7"], s: Float[Tensor, "B K P"], r: Float[Tensor, "B K P"]) -> Tensor:
    """o exp(-s^2 - r^2), before clamp and cut-off, [B, K, P]."""
    return torch.addcmul(rows[:, :, 6:], s, s, value=-1).addcmul_(r, r, value=-1).exp_()


def just_below(value: float, dtype: torch.dtype) -> float:
    """The number of `dtype` under `value`, so that 'x > it' means 'x >= value' there."""
    return float(torch.nextafter(torch.tensor(value, dtype=dtype), torch.tensor(-math.inf, dtype=dtype)))


def alphas_(gaussian: Float[Tensor, "B K P"], settings: RasterSettings) -> Float[Tensor, "B K P"]:
    """In place: clamped at alpha_max, zero below alpha_min (spec 3.4)."""
    below = just_below(settings.alpha_min, gaussian.dtype)
    return torch.threshold_(gaussian.clamp_(max=settings.alpha_max), below, 0.0)


def transmittances(alpha: Float[Tensor, "B K P"], start: Float[Tensor, "B P"]) -> Float[Tensor, "B K_plus_1 P"]:
    """Transmittance before each splat and, last, behind all of them."""
    values = alpha.new_empty(alpha.shape[0], alpha.shape[1] + 1, alpha.shape[2])
    current, *others = values.unbind(1)
    current.copy_(start)
    for a, behind in zip(alpha.unbind(1), others, strict=True):
        torch.addcmul(current, current, a, value=-1, out=behind)
        current = behind
    return values


def stop_(alpha: Float[Tensor, "B K P"], transmittance: Float[Tensor, "B K_plus_1 P"], stop: float) -> None:
    """In place: zero the alphas of the splat that would take its pixel below `stop`, and of those behind it."""
    if bool(transmittance[:, -1].amin() < stop):
        alpha.mul_(transmittance[:, 1:] >= stop)


def blend(tables: Tables, front: Front) -> tuple[Float[Tensor, "B P C"], Float[Tensor, "B P"], Tensor]:
    """Light that the blocks add, the transmittance behind them, and the blending weights [B, K, P]."""
    rows = tables.rows.index_select(0, front.blocks)
    alpha = alphas_(gaussians(rows, *exponents(rows, tables.basis)), tables.settings)
    transmittance = transmittances(alpha, front.transmittance)
    stop_(alpha, transmittance, tables.settings.transmittance_stop)
    weight = alpha.mul_(transmittance[:, :-1])
    light = torch.bmm(weight.mT, tables.channels.index_select(0, front.blocks))
    return light, transmittance[:, -1], weight


def unclamp_(slope: Tensor, gaussian: Tensor, settings: RasterSettings) -> None:
    """In place: the straight-through gradient of min(alpha_max, .), as in the published backward (spec 4)."""
    if bool(gaussian.amax() > settings.alpha_max):
        slope.mul_((gaussian / settings.alpha_max).clamp_(min=1.0))


def light_behind(light: Float[Tensor, "B K P"], rest: Float[Tensor, "B P"]) -> Float[Tensor, "B K_plus_1 P"]:
    """First the sum of the whole block and `rest`, the light behind it; then the sum behind each splat."""
    values = light.new_empty(light.shape[0], light.shape[1] + 1, light.shape[2])
    *others, current = values.unbind(1)
    current.copy_(rest)
    for own, before in zip(reversed(light.unbind(1)), reversed(others), strict=True):
        torch.add(current, own, out=before)
        current = before
    return values


@dataclass(frozen=True, eq=False)
class FrontGradient:
    """Gradients of B blocks, and the light of the blocks and all behind them."""

    rows: Float[Tensor, "B K 6"]
    """Of (u0, u1, k0, u2, k1, log o)."""
    channels: Float[Tensor, "B K C"]
    absolute: Float[Tensor, "B K 2"] | None
    """Sum over pixels of the absolute gradient of the mean, per axis."""
    rest: Float[Tensor, "B P"]


def front_gradient(
    tables: Tables, front: Front, gradient: Float[Tensor, "B C P"], rest: Float[Tensor, "B P"], absolute: bool
) -> FrontGradient:
    """Gradient of a front; `rest` is the light behind it, weighted by the gradient of the picture."""
    rows = tables.rows.index_select(0, front.blocks)
    s, r = exponents(rows, tables.basis)
    gaussian = gaussians(rows, s, r)
    alpha = alphas_(gaussian.clone(), tables.settings)
    transmittance = transmittances(alpha, front.transmittance)
    stop_(alpha, transmittance, tables.settings.transmittance_stop)
    weight = alpha * transmittance[:, :-1]
    light = torch.bmm(tables.channels.index_select(0, front.blocks), gradient).mul_(weight)
    behind = light_behind(light, rest)
    # d loss / d log alpha = w c.g - (light behind) alpha / (1 - alpha)
    slope = light.addcdiv_(behind[:, 1:].mul_(alpha), 1 - alpha, value=-1)
    unclamp_(slope, gaussian, tables.settings)
    return FrontGradient(
        rows=row_gradient(slope, s, r, tables.basis),
        channels=torch.bmm(weight, gradient.mT),
        absolute=absolute_gradient(slope, s, r, rows) if absolute else None,
        rest=behind[:, 0],
    )


def row_gradient(
    slope: Float[Tensor, "B K P"], s: Float[Tensor, "B K P"], r: Float[Tensor, "B K P"], basis: Float[Tensor, "3 P"]
) -> Float[Tensor, "B K 6"]:
    """Gradient of (u0, u1, k0, u2, k1, log o) from that of log alpha: d/ds = -2 s slope, d/dr = -2 r slope."""
    flat, columns = (-1, slope.shape[2]), -2 * basis.T
    by_s = (slope * s).view(flat) @ columns
    by_r = (slope * r).view(flat) @ columns[:, 1:]
    parts = torch.cat([by_s, by_r, slope.view(flat).sum(1, keepdim=True)], 1)
    return parts.view(*slope.shape[:2], 6)


def absolute_gradient(
    slope: Float[Tensor, "B K P"], s: Float[Tensor, "B K P"], r: Float[Tensor, "B K P"], rows: Float[Tensor, "B K 7"]
) -> Float[Tensor, "B K 2"]:
    """Sum over pixels of |d loss / d mean| in px, per axis: s and r fall by (u0, u1) and (0, u2) per pixel of mean."""
    u0, u1, u2 = rows[:, :, 0, None], rows[:, :, 1, None], rows[:, :, 4, None]
    by_x = 2 * (slope * s * u0).abs_().sum(2)
    by_y = 2 * (slope * (s * u1 + r * u2)).abs_().sum(2)
    return torch.stack([by_x, by_y], 2)


# -- the walk over all tiles ---------------------------------------------------------------------------------------


def batches(blocks: Blocks, settings: RasterSettings) -> list[Int[Tensor, "B"]]:
    """Tiles that have a list, longest first, in batches that hold about `batch_values` alphas at once."""
    order = torch.argsort(blocks.counts, descending=True, stable=True)[: int((blocks.counts > 0).sum())]
    return list(order.split(max(1, settings.batch_values // (settings.chunk * settings.tile_size**2))))


def walk(
    tables: Tables, blocks: Blocks, tiles: Int[Tensor, "B"]
) -> Iterator[tuple[Front, Float[Tensor, "B P C"], Float[Tensor, "B K P"]]]:
    """(front, light, weights) of a batch of tiles, front to back."""
    transmittance = tables.inside[tiles]
    number = 0
    while len(tiles):
        front = Front(tiles, blocks.starts[tiles] + number, transmittance)
        light, transmittance, weight = blend(tables, front)
        yield front, light, weight
        number += 1
        going = (blocks.counts[tiles] > number) & (transmittance.amax(1) >= tables.settings.transmittance_stop)
        if not bool(going.all()):
            tiles, transmittance = tiles[going], transmittance[going]


def blend_all(
    tables: Tables, blocks: Blocks, keep: bool, heaviest: Float[Tensor, "S K"] | None
) -> tuple[Float[Tensor, "T P C"], list[Front]]:
    """Blend every tile; returns the tiles and, if `keep`, the fronts for the backward pass.

    `heaviest`, where given, receives each list entry's largest blending weight.
    """
    pictures = tables.basis.new_zeros(len(blocks.counts), tables.basis.shape[1], tables.channels.shape[2])
    fronts: list[Front] = []
    for batch in batches(blocks, tables.settings):
        for front, light, weight in walk(tables, blocks, batch):
            pictures.index_add_(0, front.tiles, light)
            if heaviest is not None:
                heaviest[front.blocks] = weight.amax(2)
            if keep:
                fronts.append(front)
    return pictures, fronts


def all_gradients(
    tables: Tables, fronts: list[Front], gradient: Float[Tensor, "T C P"], absolute: bool
) -> tuple[Float[Tensor, "S K 6"], Float[Tensor, "S K C"], Float[Tensor, "S K 2"] | None]:
    """Gradients of every list entry: of its row, its channels and, if asked, the absolute one of its mean."""
    shape = tables.rows.shape[:2]
    rest = gradient.new_zeros(gradient.shape[0], gradient.shape[2])
    rows, channels = gradient.new_zeros(*shape, 6), torch.zeros_like(tables.channels)
    means = gradient.new_zeros(*shape, 2) if absolute else None
    for front in reversed(fronts):
        seen, behind = gradient.index_select(0, front.tiles), rest.index_select(0, front.tiles)
        part = front_gradient(tables, front, seen, behind, absolute)
        rest.index_copy_(0, front.tiles, part.rest)
        rows.index_copy_(0, front.blocks, part.rows)
        channels.index_copy_(0, front.blocks, part.channels)
        if means is not None and part.absolute is not None:
            means.index_copy_(0, front.blocks, part.absolute)
    return rows, channels, means


def splat_gradient(rows: Float[Tensor, "S K 6"], tables: Tables) -> Float[Tensor, "S K 6"]:
    """Gradient of (mean x, mean y, u0, u1, u2, log o) from that of (u0, u1, k0, u2, k1, log o)."""
    by_u0, by_u1, by_k0, by_u2, by_k1, by_opacity = rows.unbind(-1)
    x, y = tables.offsets.unbind(-1)
    u0, u1, u2 = tables.rows[..., 0], tables.rows[..., 1], tables.rows[..., 4]
    by_mean = [-u0 * by_k0, -u1 * by_k0 - u2 * by_k1]
    return torch.stack([*by_mean, by_u0 - x * by_k0, by_u1 - y * by_k0, by_u2 - y * by_k1, by_opacity], -1)


def sum_by_splat(values: Float[Tensor, "E V"], splats: Int[Tensor, "E"], count: int) -> Float[Tensor, "M V"]:
    """Sums over the list entries of each splat, always in the same order (as index_add_ is, but on a CPU only)."""
    if values.device.type == "cpu":
        return values.new_zeros(count, values.shape[1]).index_add_(0, splats, values)
    order = torch.argsort(splats, stable=True)
    lengths = torch.bincount(splats, minlength=count)
    return torch.segment_reduce(values[order], "sum", lengths=lengths, axis=0, initial=0)


class Composite(torch.autograd.Function):
    """See `composite` for the arguments."""

    @staticmethod
    def forward(ctx, means, factors, log_opacities, channels, probe, blocks, grid, settings, heaviest):
        tables = make_tables(means, factors, log_opacities, channels, blocks, grid, settings)
        keep = any(ctx.needs_input_grad)
        pictures, fronts = blend_all(tables, blocks, keep, heaviest)
        if keep:
            ctx.kept = (tables, blocks, grid, fronts, len(means), probe is not None)
        return grid.to_raster(pictures)

    @staticmethod
    def backward(ctx, gradient):
        tables, blocks, grid, fronts, count, absolute = ctx.kept
        rows, channels, means = all_gradients(tables, fronts, grid.to_tiles(gradient), absolute)
        parts = [splat_gradient(rows, tables), channels[..., :-1], *([] if means is None else [means])]
        total = sum_by_splat(torch.cat(parts, -1).flatten(0, 1), blocks.splats.view(-1), count + 1)[:-1]
        width = 6 + channels.shape[2] - 1
        probe = total[:, width:] if absolute else None
        return (total[:, :2], total[:, 2:5], total[:, 5], total[:, 6:width], probe, None, None, None, None)


def composite(
    means: Float[Tensor, "M 2"],
    factors: Float[Tensor, "M 3"],
    log_opacities: Float[Tensor, "M"],
    channels: Float[Tensor, "M C"],
    blocks: Blocks,
    grid: TileGrid,
    settings: RasterSettings,
    *,
    probe: Float[Tensor, "M 2"] | None = None,
    heaviest: Float[Tensor, "S K"] | None = None,
) -> Float[Tensor, "C_plus_1 H W"]:
    """Blended channels, then coverage (the sum of weights), on the raster of `grid`.

    `probe` is a leaf of zeros whose gradient becomes, per axis, the sum over pixels of the absolute gradient of the
    mean (px). `heaviest` receives the largest blending weight of each list entry.
    """
    return Composite.apply(means, factors, log_opacities, channels, probe, blocks, grid, settings, heaviest)
