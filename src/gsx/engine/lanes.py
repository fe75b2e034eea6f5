"""Tile lists laid out for compiled loops: 16 lists of similar length side by side, one in each lane of a register.

A group is L lists; a block is K entries of every list of a group. Blocks lie chunk after chunk: first the first
K entries of all groups, then the next K of those groups that have more, and so on. Groups are sorted by list length,
so each chunk is a contiguous slice that begins at the first group. A pixel of a group is a vector of L values, and
sums over a tile's pixels need no shuffling between lanes.

Each chunk is a call, which costs as much as a dozen groups: where a few tiles have much longer lists than all others,
those are cut into pieces, which fill lanes as the lists of other tiles do.
"""

from dataclasses import dataclass, replace
from typing import TypeAlias

import torch
from torch import Tensor
from torch.nn.functional import pad

from gsx.core.device import upload
from gsx.core.rasterizer.grid import TileGrid
from gsx.core.rasterizer.intersections import TileIntersections
from gsx.core.shapes import Float, Int

LANES = 16
"""Lists of a group: a 512-bit register of float32."""
LONG = 8
"""One in this many lists may be longer than the cut."""
WORTH_CUTTING = 1.5
"""Long lists are cut if the longest has more than this many times the chunks of a piece: light is computed twice in all
pieces but the last."""
MOST_PIECES = 8
"""Most pieces of a list: each costs an operation that hands light on to the next."""

Groups: TypeAlias = Int[Tensor, "G L"]
"""List of each lane."""
Places: TypeAlias = tuple[Int[Tensor, "_"], Int[Tensor, "_"]]
"""Groups and lanes of some lists."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Lanes:
    """G groups of L lists and their S blocks."""

    tiles: Int[Tensor, "G L"]
    """Tile of each lane's list; T, one past the last, for empty lanes of the last group."""
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
    follows: list[tuple[Places, Places]]
    """(places of second pieces of tiles, of the first ones), then of third pieces and the second ones, and so on;
    nothing where no list was cut."""

    def without_entries(self) -> "Lanes":
        """Returns the lanes without pairs and entries, which a backward pass does not need."""
        pairs, entries = (table.new_empty(0, *table.shape[1:]) for table in (self.pairs, self.entries))
        return replace(self, pairs=pairs, entries=entries)


@dataclass(frozen=True, eq=False, kw_only=True)
class Lists:
    """N lists of pairs, in the order of their tiles: one of each tile that has any, or pieces of it."""

    tiles: Int[Tensor, "N"]
    number: Int[Tensor, "N"]
    """Number of each piece within its tile's list, from 0."""
    begin: Int[Tensor, "N"]
    """Its first pair."""
    end: Int[Tensor, "N"]
    """One past its last."""


def lists_of(starts: Int[Tensor, "T_1"], chunk: int, cut_long: bool) -> Lists:
    """Returns the lists of all tiles; `cut_long` cuts long ones at whole chunks."""
    lengths = starts.diff()
    size = chunks_at_most(lengths, chunk) * chunk if cut_long else int(lengths.max())
    pieces = torch.div(lengths + (size - 1), size, rounding_mode="floor")
    tiles = torch.repeat_interleave(pieces)
    number = torch.arange(len(tiles), device=tiles.device) - (pieces.cumsum(0) - pieces)[tiles]
    begin = starts[tiles] + number * size
    return Lists(tiles=tiles, number=number, begin=begin, end=torch.minimum(begin + size, starts[tiles + 1]))


def chunks_at_most(lengths: Int[Tensor, "T"], chunk: int) -> int:
    """Returns the chunks of a piece: those of the longest list if cutting is not worth it. One list is not empty."""
    ranked = lengths[lengths > 0].sort(descending=True).values
    longest, usual = (-(-ranked[[0, len(ranked) // LONG]] // chunk)).tolist()
    usual = max(usual, -(-longest // MOST_PIECES))
    return usual if longest > WORTH_CUTTING * usual else longest


def lay_out(intersections: TileIntersections, splats: int, chunk: int, batch: int, *, cut_long: bool) -> Lanes:
    """Lays the lists of all tiles that have one out in lanes; `splats` is the number M of screen splats.

    Sums over pieces of a list round differently from those over the whole, and the cuts depend on all lists of a
    picture: no lists are cut where a crop must have the bits of the whole. The first two groups of every `batch` groups
    get equally many chunks, and no batch has a single group: torch specialises on sizes of one.
    """
    lists, last = lists_of(intersections.starts, chunk, cut_long), len(intersections.starts) - 1
    lanes, longest = by_length(lists.end - lists.begin)
    counts = (longest.cpu() + (chunk - 1)) // chunk  # of each group: those of its first, longest list
    counts[1::batch] = counts[::batch][: len(counts[1::batch])]
    active = (len(counts) - counts.bincount().cumsum(0))[:-1]
    bases, blocks = active.cumsum(0) - active, int(active.sum())
    table = upload(torch.stack([active, bases]), lanes.device)
    chunks = torch.repeat_interleave(table[0], output_size=blocks)
    groups = torch.arange(blocks, device=chunks.device) - table[1][chunks]
    pairs = pairs_in_blocks(lists, len(intersections.splats), lanes, groups, chunks, chunk)
    rows = pad(intersections.splats, (0, 1), value=splats)
    return Lanes(
        tiles=pad(lists.tiles, (0, 1), value=last)[lanes],
        pairs=pairs,
        entries=rows.index_select(0, pairs.view(-1)).view(pairs.shape),
        groups=groups,
        active=active.tolist(),
        bases=bases.tolist(),
        follows=pieces_of(lists, lanes),
    )


def by_length(lengths: Int[Tensor, "N"]) -> tuple[Groups, Int[Tensor, "G"]]:
    """Returns (lists in groups, longest first, N for none; longest list of each group). At least two groups."""
    lengths, order = torch.sort(lengths, descending=True, stable=True)
    count = max(2, -(-len(order) // LANES)) * LANES
    lanes = pad(order, (0, count - len(order)), value=len(order))
    return lanes.view(-1, LANES), pad(lengths, (0, count - len(order)))[::LANES]


def pieces_of(lists: Lists, lanes: Groups) -> list[tuple[Places, Places]]:
    """Returns `Lanes.follows`."""
    rank = torch.empty_like(lists.tiles)
    rank[lanes.view(-1)[: len(rank)]] = torch.arange(len(rank), device=rank.device)

    def places(numbers: Int[Tensor, "M"]) -> Places:
        return rank[numbers] // LANES, rank[numbers] % LANES

    numbered = [(lists.number == number).nonzero()[:, 0] for number in range(1, int(lists.number.max()) + 1)]
    return [(places(later), places(later - 1)) for later in numbered]


def pairs_in_blocks(
    lists: Lists, count: int, lanes: Groups, groups: Int[Tensor, "S"], chunks: Int[Tensor, "S"], chunk: int
) -> Int[Tensor, "S K L"]:
    """Returns the pair of every entry: consecutive in a list; `count`, one past the last, behind its end.

    With padding they stay below 2^31, since max_pairs is at most 2^30.
    """
    edges = (pad(side.int(), (0, 1), value=count) for side in (lists.begin, lists.end))
    begin, end = (side[lanes].index_select(0, groups) for side in edges)
    first = begin + (chunks * chunk).int()[:, None]
    pairs = first[:, None] + torch.arange(chunk, device=first.device, dtype=torch.int32)[:, None]
    return torch.where(pairs < end[:, None], pairs, count)


def places_of(lanes: Lanes, intersections: TileIntersections) -> Int[Tensor, "P"]:
    """Returns the entry of each pair, pairs sorted by splat."""
    pairs, count = lanes.pairs.view(-1), len(intersections.slots)
    slots = pad(intersections.slots, (0, 1), value=count).index_select(0, pairs)
    places = torch.arange(len(pairs), device=pairs.device, dtype=torch.int32)
    return pairs.new_empty(count + 1).index_copy_(0, slots, places)[:count]


def centres(lanes: Lanes, grid: TileGrid, like: Tensor) -> Float[Tensor, "S 2 1 L"]:
    """Returns the middle of the tile of every block's lanes on the frame, px."""
    positions = grid.centres(lanes.tiles.view(-1), like).view(*lanes.tiles.shape, 2)
    return positions[lanes.groups].permute(0, 2, 1)[:, :, None].contiguous()


def to_lanes(tiles: Float[Tensor, "T C P"], lanes: Lanes) -> list[Float[Tensor, "G P L"]]:
    """Returns each channel of a picture cut into tiles, in lanes."""
    padded = torch.cat([tiles, tiles.new_zeros(1, *tiles.shape[1:])])
    return list(padded[lanes.tiles].permute(2, 0, 3, 1).contiguous().unbind(0))


def from_lanes(channels: list[Float[Tensor, "G P L"]], lanes: Lanes, count: int) -> Float[Tensor, "T P C"]:
    """Returns tiles of a picture from channels in lanes, pieces of a list added up; tiles without a list are zero."""
    picture = channels[0].new_zeros(len(channels), count + 1, channels[0].shape[1])
    tiles = lanes.tiles.clone() if lanes.follows else lanes.tiles
    for later, _ in lanes.follows:
        tiles[later] = count
    for plane, channel in zip(picture, channels, strict=True):
        lists = channel.mT.clone(memory_format=torch.contiguous_format)
        for later, earlier in reversed(lanes.follows):
            lists[earlier] += lists[later]
        plane.index_copy_(0, tiles.view(-1), lists.flatten(0, 1))
    return picture[:, :count].permute(1, 2, 0)
