"""Grid cells against loops over rows in plain Python."""

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from gsx.backbones.cells import cell_keys, new_cells, pooled_max

FAR = 2**40
"""Cells so far apart that the product of ranges fits no integer of 64 bits."""
near_rows = st.lists(st.tuples(*[st.integers(-2, 2)] * 3), max_size=12)
far_rows = st.lists(st.tuples(*[st.sampled_from([-FAR, -1, 0, 1, FAR])] * 3), max_size=12)


def tensor_of(rows: list[tuple[int, int, int]]) -> Tensor:
    return torch.tensor(rows, dtype=torch.int64).reshape(-1, 3)


def brute_force(candidates: list, taken: list) -> tuple[list, list]:
    """New cells one after the other, and the number of each candidate's."""
    new = sorted({cell for cell in candidates if all(cell != other for other in taken)})
    return new, [new.index(cell) if cell in new else -1 for cell in candidates]


@given(near_rows, near_rows)
def test_new_cells_are_those_a_loop_finds(candidates, taken):
    cells, group = new_cells(tensor_of(candidates), tensor_of(taken))
    assert ([tuple(cell) for cell in cells.tolist()], group.tolist()) == brute_force(candidates, taken)


@given(far_rows, far_rows)
def test_cells_however_far_apart_are_told_apart(candidates, taken):
    cells, group = new_cells(tensor_of(candidates), tensor_of(taken))
    assert ([tuple(cell) for cell in cells.tolist()], group.tolist()) == brute_force(candidates, taken)


def test_order_of_rows_does_not_change_the_cells():
    generator = torch.Generator().manual_seed(0)
    candidates = torch.randint(-5, 5, (400, 3), generator=generator)
    taken, shuffle = candidates[:50] + 1, torch.randperm(400, generator=generator)
    cells, group = new_cells(candidates, taken)
    again, group_again = new_cells(candidates[shuffle], taken.flip(0))
    assert torch.equal(cells, again)
    assert torch.equal(group[shuffle], group_again)
    assert torch.equal(cells[group[group >= 0]], candidates[group >= 0])


@pytest.mark.parametrize("ranges", [(18, 18, 18), (2, 3, 90), (90, 2, 3), (3, 90, 2)])
@pytest.mark.parametrize("start", [0, -9, 2**61])
def test_keys_order_cells_by_rows(ranges, start):
    generator = torch.Generator().manual_seed(1)
    cells = torch.stack([torch.randint(length, (300,), generator=generator) for length in ranges], dim=1) + start
    by_rows = sorted(range(300), key=lambda i: cells[i].tolist())
    assert cell_keys(cells).argsort(stable=True).tolist() == by_rows
    assert len(cell_keys(cells).unique()) == len(cells.unique(dim=0))


def test_keys_of_cells_too_far_apart_for_a_product_are_ranks():
    far = 2**21
    assert cell_keys(torch.tensor([[far, far, far], [0, 0, 0], [0, 0, 0], [0, 2 * far, 1]])).tolist() == [2, 0, 0, 1]


@pytest.mark.parametrize("shape", [(), (4,), (2, 3)])
def test_pooled_maximum_is_that_of_a_loop(shape):
    generator = torch.Generator().manual_seed(2)
    values, group = torch.randn(60, *shape, generator=generator), torch.randint(-1, 7, (60,), generator=generator)
    group[group == 5] = 4
    pooled = pooled_max(values, group, 8)
    for number in range(8):
        rows = [values[i] for i in range(60) if group[i] == number]
        wanted = torch.stack(rows).amax(0) if rows else torch.full(shape, -math.inf)
        assert torch.equal(pooled[number], wanted)


def test_maximum_of_negative_values_is_negative():
    assert pooled_max(torch.tensor([[-3.0], [-2.0]]), torch.tensor([0, 0]), 1).tolist() == [[-2.0]]


def test_nothing_is_pooled_from_nothing():
    assert pooled_max(torch.empty(0, 3), torch.empty(0, dtype=torch.int64), 2).tolist() == [[-math.inf] * 3] * 2
