"""The segment schedule: blocks of all tiles at once, in few large kernels, as a GPU needs it.

The share of light that passes each block comes first; an associative scan turns it into the transmittance before every
block; then all blocks are blended at once, and summed by tile. The backward pass scans from behind. A block belongs to
one tile, whose gradient is read by the tile's number; pixels are contiguous, so that neighbouring threads read the same
entry.
"""

from dataclasses import dataclass
from itertools import pairwise
from typing import TypeAlias

import torch
from torch import Tensor

from gsx.core.rasterizer.bags import bag_sums, edges_of
from gsx.core.rasterizer.grid import TileGrid, basis_of
from gsx.core.rasterizer.intersections import TileIntersections, sum_by_splat
from gsx.core.rasterizer.settings import Precision
from gsx.core.shapes import Float, Int
from gsx.engine.compiling import fused
from gsx.engine.kernels import (
    TABLE,
    Rules,
    blended,
    compiled_loop,
    entry_gradients,
    fade,
    make_rows,
    slopes,
    sums_of,
    weighted_picture,
)

LEAST_BLOCKS = 2
"""torch compiles anew for a single one."""

Rows: TypeAlias = Float[Tensor, "S K F"]
"""Columns of every entry (`kernels.make_rows`)."""
Light: TypeAlias = Float[Tensor, "S P"]
"""A number at every pixel of each block."""
Blocks: TypeAlias = Int[Tensor, "S"]
"""A number of each block."""
Gradient: TypeAlias = Float[Tensor, "T C_1 P"]
"""Gradient of each tile's channels and coverage."""
Slopes: TypeAlias = Float[Tensor, "S 2_K P"]
"""Slopes of all entries, then their weights."""


# -- loops ---------------------------------------------------------------------------------------------------------


def light(rows: Rows, before: Light, x: Tensor, y: Tensor, rules: Rules) -> list[Light]:
    """Returns what each block adds to each channel and, last, to the coverage."""
    return blended(rows, x, y, before, [0.0] * (rules.channels + 1), rules)[1]


def block_picture(lights: list[Light], before: Light, tiles: Blocks, gradient: Gradient, rules: Rules) -> Light:
    """Returns the gradient-weighted picture of each block alone."""
    return weighted_picture(lights, gradient[tiles].unbind(1), before, rules)


def entry_slopes(
    rows: Rows, before: Light, behind: Light, tiles: Blocks, gradient: Gradient, x: Tensor, y: Tensor, rules: Rules
) -> Slopes:
    """Returns `slopes` of every entry at every pixel, then the weights.

    In one tensor: for few entries the compiler would otherwise compute each of them from the rows again.
    """
    slope, weight, _ = slopes(rows, x, y, before, behind, list(gradient[tiles].unbind(1)), rules)
    return torch.stack([*slope, *weight], 1)


def entry_sums(
    rows: Rows, found: Slopes, tiles: Blocks, gradient: Gradient, x: Tensor, y: Tensor, products: Tensor, rules: Rules
) -> Float[Tensor, "S K V"]:
    """Returns `sums_of` the slopes and weights in `found`; a loop of its own: sums over pixels need other threads."""
    slope, weight = found.chunk(2, 1)
    return sums_of(rows, slope, weight, x, y, products, list(gradient[tiles].unbind(1)), rules)


# -- lists in blocks -----------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False, kw_only=True)
class Segments:
    """Lists of T tiles cut into S blocks of K entries, tile after tile; blocks behind the last tile's draw nothing."""

    entries: Int[Tensor, "S K"]
    """Row of the screen splat; M, one past the last, is padding."""
    tiles: Blocks
    """Tile of each block; the last one for blocks that have none."""
    number: Blocks
    """Number of each block within its tile, from 0; -1 where it has none."""
    left: Blocks
    """Blocks of its tile behind each."""
    edges: Int[Tensor, "T_1"]
    """First block of each tile, then one past the last."""
    places: Int[Tensor, "P"]
    """Entry of each pair, pairs sorted by splat."""
    doublings: int
    """Doublings from 1 to at least the number of blocks of any tile."""


def cut(intersections: TileIntersections, splats: int, chunk: int) -> Segments:
    """Cuts lists into blocks of `chunk`; `splats` is the number of screen splats."""
    counts = torch.div(intersections.starts.diff() + (chunk - 1), chunk, rounding_mode="floor")
    edges = edges_of(counts)
    total, most = torch.stack([edges[-1], counts.amax()]).tolist()
    size = max(LEAST_BLOCKS, total)
    place = entry_places(edges, intersections.starts, intersections.tiles, chunk)
    block_tiles = torch.searchsorted(edges[1:], torch.arange(size, device=edges.device), right=True)
    number, left, tiles = within_tiles(block_tiles, edges)
    listed = intersections.splats
    return Segments(
        entries=listed.new_full((size * chunk,), splats).scatter_(0, place, listed).view(size, chunk),
        tiles=tiles,
        number=number,
        left=left,
        edges=edges,
        places=torch.empty_like(place).scatter_(0, intersections.slots, place),
        doublings=max(1, most - 1).bit_length(),
    )


@fused
def entry_places(
    edges: Int[Tensor, "T_1"], starts: Int[Tensor, "T_1"], tiles: Int[Tensor, "P"], chunk: int
) -> Int[Tensor, "P"]:
    """Returns the entry of each pair."""
    return torch.arange(tiles.shape[0], device=tiles.device) + (edges * chunk - starts)[tiles]


@fused
def within_tiles(tile: Blocks, edges: Int[Tensor, "T_1"]) -> tuple[Blocks, Blocks, Blocks]:
    """Returns (number of each block in its tile, how many follow there, the tile); -1, 0 and the last tile past all."""
    last = edges.shape[0] - 2
    near, block = tile.clamp_max(last), torch.arange(tile.shape[0], device=tile.device)
    there = tile <= last
    number, left = block - edges[near], edges[near + 1] - 1 - block
    return torch.where(there, number, -1), torch.where(there, left, 0), near


def parts(total: int, size: int) -> list[slice]:
    """Returns slices of about `size` that cover `total`; none has a single element unless there is only one."""
    edges = [*range(0, max(total - 1, 1), size), total]
    return [slice(a, b) for a, b in pairwise(edges)]


# -- scans ---------------------------------------------------------------------------------------------------------


@fused
def with_earlier(product: Light, number: Blocks, step: Int[Tensor, ""]) -> Light:
    """Returns products over twice as many blocks."""
    earlier = (torch.arange(number.shape[0], device=number.device) - step).clamp_min(0)
    return torch.where((number >= step)[:, None], product * product[earlier], product)


@fused
def one_earlier(product: Light, number: Blocks) -> Light:
    """Shifts values one block back; 1 before the first block of a tile."""
    earlier = (torch.arange(number.shape[0], device=number.device) - 1).clamp_min(0)
    return torch.where((number >= 1)[:, None], product[earlier], 1.0)


@fused
def with_later(own: Light, passed: Light, left: Blocks, step: Int[Tensor, ""]) -> tuple[Light, Light]:
    """Returns (pictures of twice as many blocks, the share of light that passes them)."""
    size = left.shape[0]
    later = (torch.arange(size, device=left.device) + step).clamp_max(size - 1)
    there = (left >= step)[:, None]
    return torch.where(there, own + passed * own[later], own), torch.where(there, passed * passed[later], passed)


@fused
def one_later(own: Light, left: Blocks) -> Light:
    """Shifts values one block forward; 0 behind the last block of a tile."""
    size = left.shape[0]
    later = (torch.arange(size, device=left.device) + 1).clamp_max(size - 1)
    return torch.where((left >= 1)[:, None], own[later], 0.0)


def steps_of(segments: Segments) -> list[Int[Tensor, ""]]:
    """Returns the steps of a scan: 1, 2, 4, ..."""
    return list((2 ** torch.arange(segments.doublings, device=segments.number.device)).unbind())


def before_blocks(passed: Light, segments: Segments) -> Light:
    """Returns the transmittance in front of every block: the product of those of earlier blocks."""
    product = passed
    for step in steps_of(segments):
        product = with_earlier(product, segments.number, step)
    return one_earlier(product, segments.number)


def behind_blocks(passed: Light, own: Light, segments: Segments) -> Light:
    """Returns the gradient-weighted picture behind every block; `own` is that of each block alone.

    (own a, passed a) before (own b, passed b) is (own a + passed a own b, passed a passed b): associative.
    """
    for step in steps_of(segments):
        own, passed = with_later(own, passed, segments.left, step)
    return one_later(own, segments.left)


# -- blending ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False, kw_only=True)
class SegmentJob:
    """One picture to blend."""

    segments: Segments
    grid: TileGrid
    x: Float[Tensor, "P"]
    y: Float[Tensor, "P"]
    products: Float[Tensor, "3 P"]
    """x^2, x y, y^2."""
    rules: Rules
    precision: Precision
    batch: int
    """Blocks whose slopes are held at once."""


def segment_job(
    segments: Segments, grid: TileGrid, rules: Rules, precision: Precision, values: int, device: torch.device
) -> SegmentJob:
    """Collects what the schedule needs; `values`: alphas at once."""
    basis = basis_of(grid.tile, precision.exact, device)
    return SegmentJob(
        segments=segments,
        grid=grid,
        x=basis.x[:, 0],
        y=basis.y[:, 0],
        products=basis.products[..., 0],
        rules=rules,
        precision=precision,
        batch=max(LEAST_BLOCKS, values // (rules.chunk * grid.tile**2)),
    )


@dataclass(frozen=True, eq=False)
class Kept:
    """Values that the backward pass needs from the forward pass."""

    rows: Rows
    passed: Light
    before: Light
    lights: list[Light]


def blend_segments(job: SegmentJob, table: Float[Tensor, "M_1 F"]) -> tuple[Float[Tensor, "T P C_1"], Kept]:
    """Returns (channels and coverage of every tile, what the backward pass needs)."""
    segments, rules = job.segments, job.rules
    centres = job.grid.centres(segments.tiles, table)[:, :, None]
    rows = compiled_loop(make_rows, rules)(table, segments.entries, centres)
    passed = compiled_loop(fade, rules)(rows, job.x, job.y).to(job.precision.accumulation)
    before = before_blocks(passed, segments)
    lights = compiled_loop(light, rules)(rows, before, job.x, job.y)
    blocks = torch.arange(len(rows), device=rows.device)
    sums = [bag_sums(one, blocks, segments.edges) for one in lights]
    return torch.stack(sums, 2), Kept(rows, passed, before, lights)


def segment_moments(job: SegmentJob, kept: Kept, gradient: Gradient) -> Float[Tensor, "S K V"]:
    """Returns the moments of every entry, `batch` blocks at a time."""
    segments, rules = job.segments, job.rules
    own = compiled_loop(block_picture, rules)(kept.lights, kept.before, segments.tiles, gradient)
    behind = behind_blocks(kept.passed, own, segments)
    slopes_loop, sums_loop = compiled_loop(entry_slopes, rules), compiled_loop(entry_sums, rules)
    found = []
    for part in parts(len(own), job.batch):
        rows, tiles = kept.rows[part], segments.tiles[part]
        slope = slopes_loop(rows, kept.before[part], behind[part], tiles, gradient, job.x, job.y)
        found.append(sums_loop(rows, slope, tiles, gradient, job.x, job.y, job.products))
    return torch.cat(found) if len(found) > 1 else found[0]


class SegmentComposite(torch.autograd.Function):
    """Blends the splats of a table (`compiled.padded_table`) by segments."""

    @staticmethod
    def forward(ctx, table, absgrad, intersections, job):
        picture, kept = blend_segments(job, table.to(job.precision.exact))
        if any(ctx.needs_input_grad):
            ctx.kept = (job, (intersections.order, intersections.counts), len(table), kept, absgrad is not None)
        return job.grid.to_raster(picture).to(table.dtype)

    @staticmethod
    def backward(ctx, gradient):
        job, (order, counts), count, kept, absolute = ctx.kept
        by_tile = job.grid.to_tiles(gradient.to(job.precision.accumulation))
        moments = segment_moments(job, kept, by_tile)
        values = compiled_loop(entry_gradients, job.rules)(kept.rows, moments).flatten(0, 1)
        total = sum_by_splat(values, job.segments.places, order, counts, count).to(gradient.dtype)
        width = TABLE + job.rules.channels
        return total[:, :width], total[:-1, width:] if absolute else None, None, None
