"""Lists whose sizes are given: whose each entry is, and whether there was room."""

from dataclasses import replace

import pytest
import torch

from gsx.core.rasterizer import ListSizes, Needed, repeat_rows
from gsx.core.rasterizer.bags import SPARE, bag_sums, runs_added
from gsx.core.rasterizer.fixed_lists import owners

ROOM = ListSizes(rows=10, pairs=20, blocks=6, longest=3)
ENOUGH = Needed(dropped=0, rows=10, pairs=20, blocks=5, longest=3)


def test_owners_of_a_list() -> None:
    counts = torch.tensor([2, 0, 3, 1])
    assert owners(counts, 6, fixed=False).tolist() == [0, 0, 2, 2, 2, 3]
    assert owners(counts, 8, fixed=True).tolist() == [0, 0, 2, 2, 2, 3, 3, 3]
    assert owners(counts, 4, fixed=True).tolist() == [0, 0, 2, 2]


def test_sums_of_bags_leave_out_what_is_spare() -> None:
    values, places = torch.arange(1.0, 13.0)[:, None], torch.arange(12).flip(0)
    edges = torch.tensor([0, 2, 2, 5])
    expected = [[12.0 + 11], [0.0], [10.0 + 9 + 8]]
    assert bag_sums(values, places, edges, spare=True).tolist() == expected
    many = torch.cat([places, places.new_zeros(3 * SPARE)])
    assert bag_sums(values, many, edges, spare=True).tolist() == expected
    assert bag_sums(values, places[:5], edges, spare=False).tolist() == expected
    beyond = torch.tensor([0, 2, 2, 99])  # too little room: nothing is read behind the last place
    assert bag_sums(values, places, beyond, spare=True)[:2].tolist() == expected[:2]


def test_rows_that_are_taken_several_times_add_their_gradients() -> None:
    ids = torch.tensor([0, 0, 2, 2, 2, 3])
    values = torch.rand(5, 2, 3, dtype=torch.float64, requires_grad=True)
    assert torch.equal(repeat_rows(values, ids), values[ids])
    assert torch.autograd.gradcheck(lambda values: repeat_rows(values, ids), values)


@pytest.mark.parametrize("ids", [[0, 0, 2, 2, 2, 3], [1, 4], []])
def test_runs_are_added_row_by_row(ids: list[int]) -> None:
    """As a GPU does it: in the order of the list, and without being asked how many there are of each."""
    values, rows = torch.rand(len(ids), 3), torch.tensor(ids, dtype=torch.int64)
    assert torch.equal(runs_added(values, rows, 5), torch.zeros(5, 3).index_add_(0, rows, values))


def test_what_just_fits() -> None:
    assert ROOM.hold(ENOUGH)
    assert ROOM.hold(ENOUGH._replace(dropped=7))


@pytest.mark.parametrize("short", ["rows", "pairs", "blocks", "longest"])
def test_one_too_many_of_anything(short: str) -> None:
    assert not ROOM.hold(ENOUGH._replace(**{short: getattr(ENOUGH, short) + 1}))
    assert replace(ROOM, **{short: getattr(ROOM, short) + 1}).hold(
        ENOUGH._replace(**{short: getattr(ENOUGH, short) + 1})
    )
