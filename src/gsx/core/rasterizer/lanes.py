"""Tile lists laid out for compiled loops: 16 tiles of similar length side by side, one in each lane of a register.

A group is L tiles; a block is K list entries of every tile of a group. Blocks lie chunk after chunk: first the first
K entries of all groups, then the next K of those groups that have more, and so on. Groups are sorted by list length,
so each chunk is a contiguous slice that begins at the first group. A pixel of a group is a vector of L values, and
sums over a tile's pixels need no shuffling between lanes.
"""

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import pad

from gsx.core.compiling import fused
from gsx.core.device import uploaded
from gsx.core.rasterizer.grid import TileGrid
from gsx.core.rasterizer.intersections import TileIntersections
from gsx.core.shapes import Float, Int

LANES = 16
"""Tiles of a group: a 512-bit register of float32."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Lanes:
    """G groups of L tiles and their S blocks."""

    tiles: Int[Tensor, "G L"]
    """Tile of each lane; T, one past the last, fills the last group up."""
    entries: Int[Tensor, "S K L"]
    """Row of the screen splat; M, one past the last, is padding."""
    groups: Int[Tensor, "S"]
    """Group of each block."""
    active: list[int]
    """Groups that have each chunk."""
    bases: list[int]
    """First block of each chunk."""
    places: Int[Tensor, "P"]
    """Entry of each pair, pairs sorted by splat."""


def lay_out(intersections: TileIntersections, splats: int, chunk: int, batch: int) -> Lanes:
    """Lay the lists of all tiles that have one out in lanes; `splats` is the number M of screen splats.

    The first two groups of every `batch` groups get equally many chunks (torch specialises on sizes of one).
    """
    ranks, tiles, longest = rank_tiles(intersections.starts.diff())
    counts = (longest.cpu() + (chunk - 1)) // chunk  # of each group: those of its first, longest list
    counts = counts[: max(2, int((counts > 0).sum()))]
    counts[1::batch] = counts[::batch][: len(counts[1::batch])]
    active = (len(counts) - counts.bincount().cumsum(0))[:-1]
    bases, blocks = active.cumsum(0) - active, int(active.sum())
    table = uploaded(torch.stack([active, bases]), ranks.device)
    places = entry_places(intersections.tiles, intersections.starts, ranks, table[1], chunk)
    entries = places.new_full((blocks * chunk * LANES,), splats)
    entries.scatter_(0, places.long(), intersections.splats.int())
    chunks = torch.repeat_interleave(table[0], output_size=blocks)
    return Lanes(
        tiles=tiles[: len(counts)],
        entries=entries.view(blocks, chunk, LANES),
        groups=torch.arange(blocks, device=chunks.device) - table[1][chunks],
        active=active.tolist(),
        bases=bases.tolist(),
        places=torch.empty_like(places).scatter_(0, intersections.slots, places),
    )


def rank_tiles(lengths: Int[Tensor, "T"]) -> tuple[Int[Tensor, "T"], Int[Tensor, "G L"], Int[Tensor, "G"]]:
    """Rank of every tile by list length, longest first; the tiles by rank in groups, T where lists are empty; and the
    longest list of each group. At least two groups."""
    lengths, order = torch.sort(lengths, descending=True, stable=True)
    ranks = torch.empty_like(order).index_copy_(0, order, torch.arange(len(order), device=order.device))
    count = max(2, -(-len(order) // LANES)) * LANES
    tiles = pad(torch.where(lengths > 0, order, len(order)), (0, count - len(order)), value=len(order))
    return ranks, tiles.view(-1, LANES), pad(lengths, (0, count - len(order)))[::LANES].long()


@fused
def entry_places(
    tiles: Int[Tensor, "P"], starts: Int[Tensor, "T_1"], ranks: Int[Tensor, "T"], bases: Int[Tensor, "N"], chunk: int
) -> Int[Tensor, "P"]:
    """Place of every pair (sorted by tile) in the flat [S K L] entries; fewer than 2^31, as max_pairs sees to.

    `tiles`, `starts`: those of `TileIntersections`.
    """
    # per tile: place of a list's first entry but for its chunk, and where the list begins
    lane = (ranks // LANES * chunk * LANES + ranks % LANES).int()
    lane, begin = torch.stack([lane, starts[:-1].int()], 1).index_select(0, tiles).unbind(1)
    number = torch.arange(len(lane), device=lane.device, dtype=torch.int32) - begin
    step = torch.div(number, chunk, rounding_mode="floor")
    return lane + (number - step * chunk) * LANES + (bases * (chunk * LANES)).int().index_select(0, step)


def centres(lanes: Lanes, grid: TileGrid, like: Tensor) -> Float[Tensor, "S 2 1 L"]:
    """Middle of the tile of every block's lanes on the frame, px."""
    positions = grid.centres(lanes.tiles.view(-1), like).view(*lanes.tiles.shape, 2)
    return positions[lanes.groups].permute(0, 2, 1)[:, :, None].contiguous()


def to_lanes(tiles: Float[Tensor, "T C P"], lanes: Lanes) -> list[Float[Tensor, "G P L"]]:
    """Each channel of a picture cut into tiles, in lanes."""
    padded = torch.cat([tiles, tiles.new_zeros(1, *tiles.shape[1:])])
    return list(padded[lanes.tiles].permute(2, 0, 3, 1).contiguous().unbind(0))


def from_lanes(channels: list[Float[Tensor, "G P L"]], lanes: Lanes, count: int) -> Float[Tensor, "T P C"]:
    """Tiles of a picture from channels in lanes; tiles without a list are zero."""
    values = torch.stack(channels, 3).permute(0, 2, 1, 3)
    picture = values.new_zeros(count + 1, values.shape[2], values.shape[3])
    return picture.index_copy_(0, lanes.tiles.view(-1), values.flatten(0, 1))[:count]
