"""The segment schedule: blocks of all tiles at once, in few large kernels, which is what a GPU wants.

The share of light that passes each block comes first; an associative scan makes of it the transmittance before every
block; then all blocks are blended at once, and summed by tile. On the way back the scan runs from behind.
"""

from dataclasses import dataclass
from itertools import pairwise

import torch
from torch import Tensor

from gsx.core.rasterizer.bags import bag_sums, edges_of
from gsx.core.rasterizer.grid import TileGrid, basis_of
from gsx.core.rasterizer.intersections import TileIntersections, sum_by_splat
from gsx.core.rasterizer.settings import Precision
from gsx.core.shapes import Float, Int
from gsx.engine.compiling import fused
from gsx.engine.kernels import TABLE, Rules
from gsx.engine.segment_kernels import SegmentKernels, segment_kernels

LEAST_BLOCKS = 2
"""torch compiles anew for a single one."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Segments:
    """Lists of T tiles cut into S blocks of K entries, tile after tile; blocks behind the last tile's draw nothing."""

    entries: Int[Tensor, "S K"]
    """Row of the screen splat; M, one past the last, is padding."""
    tiles: Int[Tensor, "S"]
    """Tile of each block; the last one for blocks that have none."""
    number: Int[Tensor, "S"]
    """Of each block within its tile, from 0; -1 where it has none."""
    left: Int[Tensor, "S"]
    """Blocks of its tile behind each."""
    edges: Int[Tensor, "T_1"]
    """First block of each tile, then one past the last."""
    places: Int[Tensor, "P"]
    """Entry of each pair, pairs sorted by splat."""
    doublings: int
    """How often 1 has to be doubled to reach the number of blocks of any tile."""


def cut(intersections: TileIntersections, splats: int, chunk: int) -> Segments:
    """Cuts lists into blocks of `chunk`; `splats` is the number of screen splats."""
    counts = torch.div(intersections.starts.diff() + (chunk - 1), chunk, rounding_mode="floor")
    edges = edges_of(counts)
    total, most = torch.stack([edges[-1], counts.amax()]).tolist()
    size = max(LEAST_BLOCKS, total)
    place = entry_places(edges, intersections.starts, intersections.tiles, chunk)
    number, left, tiles = within_tiles(blocks_tiles(edges, size), edges)
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


def blocks_tiles(edges: Int[Tensor, "T_1"], size: int) -> Int[Tensor, "S"]:
    """Tile of each of `size` blocks; one past the last behind all."""
    return torch.searchsorted(edges[1:], torch.arange(size, device=edges.device), right=True)


@fused
def entry_places(
    edges: Int[Tensor, "T_1"], starts: Int[Tensor, "T_1"], tiles: Int[Tensor, "P"], chunk: int
) -> Int[Tensor, "P"]:
    """Entry of each pair."""
    return torch.arange(tiles.shape[0], device=tiles.device) + (edges * chunk - starts)[tiles]


@fused
def within_tiles(
    tile: Int[Tensor, "S"], edges: Int[Tensor, "T_1"]
) -> tuple[Int[Tensor, "S"], Int[Tensor, "S"], Int[Tensor, "S"]]:
    """(number of each block within its tile, how many follow there, the tile); -1, 0 and the last tile behind all."""
    last = edges.shape[0] - 2
    near, block = tile.clamp_max(last), torch.arange(tile.shape[0], device=tile.device)
    there = tile <= last
    number, left = block - edges[near], edges[near + 1] - 1 - block
    return torch.where(there, number, -1), torch.where(there, left, 0), near


@fused
def with_earlier(product: Float[Tensor, "S P"], number: Int[Tensor, "S"], step: Int[Tensor, ""]) -> Tensor:
    """Products over twice as many blocks."""
    earlier = (torch.arange(number.shape[0], device=number.device) - step).clamp_min(0)
    return torch.where((number >= step)[:, None], product * product[earlier], product)


@fused
def one_earlier(product: Float[Tensor, "S P"], number: Int[Tensor, "S"]) -> Tensor:
    """What stands one block before, 1 before the first of a tile."""
    earlier = (torch.arange(number.shape[0], device=number.device) - 1).clamp_min(0)
    return torch.where((number >= 1)[:, None], product[earlier], 1.0)


@fused
def with_later(
    own: Float[Tensor, "S P"], passed: Float[Tensor, "S P"], left: Int[Tensor, "S"], step: Int[Tensor, ""]
) -> tuple[Tensor, Tensor]:
    """(pictures of twice as many blocks, the share of light that passes them)."""
    size = left.shape[0]
    later = (torch.arange(size, device=left.device) + step).clamp_max(size - 1)
    there = (left >= step)[:, None]
    return torch.where(there, own + passed * own[later], own), torch.where(there, passed * passed[later], passed)


@fused
def one_later(own: Float[Tensor, "S P"], left: Int[Tensor, "S"]) -> Tensor:
    """What stands one block behind, 0 behind the last of a tile."""
    size = left.shape[0]
    later = (torch.arange(size, device=left.device) + 1).clamp_max(size - 1)
    return torch.where((left >= 1)[:, None], own[later], 0.0)


def steps_of(segments: Segments) -> list[Int[Tensor, ""]]:
    """1, 2, 4, ..., as many as the scan doubles."""
    return list((2 ** torch.arange(segments.doublings, device=segments.number.device)).unbind())


def before_blocks(passed: Float[Tensor, "S P"], segments: Segments) -> Float[Tensor, "S P"]:
    """Transmittance in front of every block: the product of what the blocks before it let pass."""
    product = passed
    for step in steps_of(segments):
        product = with_earlier(product, segments.number, step)
    return one_earlier(product, segments.number)


def behind_blocks(passed: Float[Tensor, "S P"], own: Float[Tensor, "S P"], segments: Segments) -> Float[Tensor, "S P"]:
    """The picture behind every block as seen from there; `own` is each block's by itself.

    (own a, passed a) before (own b, passed b) is (own a + passed a own b, passed a passed b): associative.
    """
    for step in steps_of(segments):
        own, passed = with_later(own, passed, segments.left, step)
    return one_later(own, segments.left)


def parts(total: int, size: int) -> list[slice]:
    """Slices of about `size` that cover `total`; none has a single element unless there is only one."""
    edges = [*range(0, max(total - 1, 1), size), total]
    return [slice(a, b) for a, b in pairwise(edges)]


@dataclass(frozen=True, eq=False, kw_only=True)
class SegmentJob:
    """One picture to blend."""

    segments: Segments
    grid: TileGrid
    x: Float[Tensor, "P"]
    y: Float[Tensor, "P"]
    products: Float[Tensor, "3 P"]
    """x^2, x y, y^2."""
    loops: SegmentKernels
    rules: Rules
    precision: Precision
    batch: int
    """Blocks whose slopes are held at once."""


def segment_job(
    segments: Segments, grid: TileGrid, rules: Rules, precision: Precision, values: int, device: torch.device
) -> SegmentJob:
    """What the schedule needs beside its lists; `values`: alphas at once."""
    basis = basis_of(grid.tile, precision.exact, device)
    return SegmentJob(
        segments=segments,
        grid=grid,
        x=basis.x[:, 0],
        y=basis.y[:, 0],
        products=basis.products[..., 0],
        loops=segment_kernels(rules),
        rules=rules,
        precision=precision,
        batch=max(LEAST_BLOCKS, values // (rules.chunk * grid.tile**2)),
    )


@dataclass(frozen=True, eq=False)
class Kept:
    """What the way back needs of the way forward."""

    rows: Float[Tensor, "S K F"]
    passed: Float[Tensor, "S P"]
    before: Float[Tensor, "S P"]
    lights: list[Float[Tensor, "S P"]]


def blend_segments(job: SegmentJob, table: Float[Tensor, "M_1 F"]) -> tuple[Float[Tensor, "T P C_1"], Kept]:
    """Channels and coverage of every tile."""
    segments, loops, dtype = job.segments, job.loops, job.precision.accumulation
    centres = job.grid.centres(segments.tiles, table)[:, :, None]
    rows = loops.make_rows(table, segments.entries, centres)
    passed = loops.fade(rows, job.x, job.y).to(dtype)
    before = before_blocks(passed, segments)
    lights = loops.light(rows, before, job.x, job.y)
    return torch.stack([sum_by_tile(light, segments) for light in lights], 2), Kept(rows, passed, before, lights)


def sum_by_tile(values: Float[Tensor, "S P"], segments: Segments) -> Float[Tensor, "T P"]:
    """Sums over the blocks of each tile."""
    blocks = torch.arange(len(values), device=values.device)
    return bag_sums(values, blocks, segments.edges)


def segment_moments(job: SegmentJob, kept: Kept, gradient: Float[Tensor, "T C_1 P"]) -> Float[Tensor, "S K V"]:
    """Moments of every entry, `batch` blocks at a time."""
    segments, loops = job.segments, job.loops
    own = loops.own_picture(kept.lights, kept.before, segments.tiles, gradient)
    behind = behind_blocks(kept.passed, own, segments)
    found = []
    for part in parts(len(own), job.batch):
        rows, tiles = kept.rows[part], segments.tiles[part]
        slopes = loops.entry_slopes(rows, kept.before[part], behind[part], tiles, gradient, job.x, job.y)
        found.append(loops.entry_sums(rows, slopes, tiles, gradient, job.x, job.y, job.products))
    return torch.cat(found) if len(found) > 1 else found[0]


class SegmentComposite(torch.autograd.Function):
    """`table`: everything blending needs of each splat, and last a row that draws nothing."""

    @staticmethod
    def forward(ctx, table, absgrad, intersections, job):
        picture, kept = blend_segments(job, table.to(job.precision.exact))
        if any(ctx.needs_input_grad):
            ctx.kept = (job, intersections, len(table), kept, absgrad is not None)
        return job.grid.to_raster(picture).to(table.dtype)

    @staticmethod
    def backward(ctx, gradient):
        job, intersections, count, kept, absolute = ctx.kept
        seen = job.grid.to_tiles(gradient.to(job.precision.accumulation))
        moments = segment_moments(job, kept, seen)
        values = job.loops.entry_gradients(kept.rows, moments).flatten(0, 1)
        total = sum_by_splat(values, intersections, job.segments.places, count).to(gradient.dtype)
        width = TABLE + job.rules.channels
        return total[:, :width], total[:-1, width:] if absolute else None, None, None
