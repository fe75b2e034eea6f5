"""Stable sorting of integers."""

import torch
from torch import Tensor

from gsx.core.shapes import Int

GRAIN = 1 << 15
"""Least count at which torch uses another thread (ATen, at::internal::GRAIN_SIZE)."""
BY_DIGITS = GRAIN
"""Least count at which torch uses radix sort on a CPU, five times as fast (ATen, native/cpu/SortingKernel.cpp)."""
WORTH_FILLING = BY_DIGITS // 5
"""Least count at which padding up to `BY_DIGITS` is faster."""


def sorted_stably(keys: Int[Tensor, "N"]) -> tuple[Int[Tensor, "N"], Int[Tensor, "N"]]:
    """Returns the keys in ascending order and their old positions; equal keys keep their order."""
    count = len(keys)
    if keys.device.type == "cpu" and WORTH_FILLING <= count < BY_DIGITS:
        keys = torch.cat([keys, keys.new_full((BY_DIGITS - count,), torch.iinfo(keys.dtype).max)])
    ordered, places = torch.sort(keys, stable=True)
    return ordered[:count], places[:count]
