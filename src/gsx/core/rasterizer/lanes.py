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
    pairs: Int[Tensor, "S K L"]
    """Pair of each entry, pairs sorted by tile; P, one past the last, behind the end of a list."""
    entries: Int[Tensor, "S K L"]
    """Row of each entry's screen splat; M, one past the last, is padding."""
    groups: Int[Tensor, "S"]
    """Group of each block."""
    active: list[int]
    """Groups that have each chunk."""
    bases: list[int]
    """First block of each chunk."""


def lay_out(intersections: TileIntersections, splats: int, chunk: int, batch: int) -> Lanes:
    """Lay the lists of all tiles that have one out in lanes; `splats` is the number M of screen splats.

    The first two groups of every `batch` groups get equally many chunks, and no batch has a single group: torch
    specialises on sizes of one.
    """
    tiles, longest = by_length(intersections.starts.diff())
    counts = (longest.cpu() + (chunk - 1)) // chunk  # of each group: those of its first, longest list
    counts = counts[: max(2, int((counts > 0).sum()))]
    counts[1::batch] = counts[::batch][: len(counts[1::batch])]
    active = (len(counts) - counts.bincount().cumsum(0))[:-1]
    bases, blocks = active.cumsum(0) - active, int(active.sum())
    tiles, table = tiles[: len(counts)], uploaded(torch.stack([active, bases]), tiles.device)
    chunks = torch.repeat_interleave(table[0], output_size=blocks)
    groups = torch.arange(blocks, device=chunks.device) - table[1][chunks]
    pairs = pairs_in_blocks(intersections, tiles, groups, chunks, chunk)
    rows = pad(intersections.splats, (0, 1), value=splats)
    return Lanes(
        tiles=tiles,
        pairs=pairs,
        entries=rows.index_select(0, pairs.view(-1)).view(pairs.shape),
        groups=groups,
        active=active.tolist(),
        bases=bases.tolist(),
    )


def by_length(lengths: Int[Tensor, "T"]) -> tuple[Int[Tensor, "G L"], Int[Tensor, "G"]]:
    """Tiles in groups, longest lists first, T where a list is empty; and the longest list of each group. At least two
    groups."""
    lengths, order = torch.sort(lengths, descending=True, stable=True)
    count = max(2, -(-len(order) // LANES)) * LANES
    tiles = pad(torch.where(lengths > 0, order, len(order)), (0, count - len(order)), value=len(order))
    return tiles.view(-1, LANES), pad(lengths, (0, count - len(order)))[::LANES]


def pairs_in_blocks(
    intersections: TileIntersections,
    tiles: Int[Tensor, "G L"],
    groups: Int[Tensor, "S"],
    chunks: Int[Tensor, "S"],
    chunk: int,
) -> Int[Tensor, "S K L"]:
    """Pair of every entry: those of a list follow each other. With what fills blocks up they stay below 2^31, since
    max_pairs is at most 2^30."""
    count = len(intersections.splats)
    edges = pad(intersections.starts.int(), (0, 1), value=count)
    begin, end = (edges[number].index_select(0, groups) for number in (tiles, tiles + 1))
    first = begin + (chunks * chunk).int()[:, None]
    pairs = first[:, None] + torch.arange(chunk, device=first.device, dtype=torch.int32)[:, None]
    return torch.where(pairs < end[:, None], pairs, count)


def places_of(lanes: Lanes, intersections: TileIntersections) -> Int[Tensor, "P"]:
    """Entry of each pair, pairs sorted by splat."""
    pairs, count = lanes.pairs.view(-1), len(intersections.slots)
    slots = pad(intersections.slots, (0, 1), value=count).index_select(0, pairs)
    places = torch.arange(len(pairs), device=pairs.device, dtype=torch.int32)
    return pairs.new_empty(count + 1).index_copy_(0, slots, places)[:count]


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
    picture = channels[0].new_zeros(len(channels), count + 1, channels[0].shape[1])
    for plane, channel in zip(picture, channels, strict=True):
        plane.index_copy_(0, lanes.tiles.view(-1), channel.mT.flatten(0, 1))
    return picture[:, :count].permute(1, 2, 0)
