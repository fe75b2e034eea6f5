"""Sorting by whole numbers against Python's own."""

import pytest
import torch

from gsx.core.rasterizer.sorting import BY_DIGITS, WORTH_FILLING, sorted_stably


@pytest.mark.parametrize("dtype", [torch.int16, torch.int32, torch.int64])
@pytest.mark.parametrize("count", [0, 1, WORTH_FILLING - 1, WORTH_FILLING, BY_DIGITS - 1, BY_DIGITS])
def test_equal_numbers_stay_in_their_order_and_the_largest_there_are_belong_to_them(count: int, dtype) -> None:
    most = torch.iinfo(dtype).max
    some = torch.tensor([0, 3, most - 1, most, -2], dtype=dtype)
    keys = some[torch.randint(len(some), (count,), generator=torch.Generator().manual_seed(count))]
    listed = keys.tolist()
    ordered, places = sorted_stably(keys)
    assert places.tolist() == sorted(range(count), key=listed.__getitem__)
    assert ordered.tolist() == sorted(listed)
    assert ordered.dtype == dtype
