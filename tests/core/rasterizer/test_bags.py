"""Sums over the entries of lists, and rows that are taken several times."""

import pytest
import torch

from gsx.core.rasterizer import repeat_rows
from gsx.core.rasterizer.bags import bag_sums, sum_runs


def test_each_row_is_the_sum_of_its_bag() -> None:
    values, places = torch.arange(1.0, 13.0)[:, None], torch.arange(12).flip(0)[:5]
    assert bag_sums(values, places, torch.tensor([0, 2, 2, 5])).tolist() == [[12.0 + 11], [0.0], [10.0 + 9 + 8]]


def test_rows_that_are_taken_several_times_add_their_gradients() -> None:
    ids = torch.tensor([0, 0, 2, 2, 2, 3])
    values = torch.rand(5, 2, 3, dtype=torch.float64, requires_grad=True)
    assert torch.equal(repeat_rows(values, ids), values[ids])
    assert torch.autograd.gradcheck(lambda values: repeat_rows(values, ids), values)


@pytest.mark.parametrize("ids", [[0, 0, 2, 2, 2, 3], [1, 4], []])
def test_runs_are_added_row_by_row(ids: list[int]) -> None:
    """As a GPU does it: in the order of the list, and without being asked how many there are of each."""
    values, rows = torch.rand(len(ids), 3), torch.tensor(ids, dtype=torch.int64)
    assert torch.equal(sum_runs(values, rows, 5), torch.zeros(5, 3).index_add_(0, rows, values))
