"""Exact consistency with a low-resolution picture, against counting and brute force."""

import itertools

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from gsx.augmenters.redraw import BOX, blocks, consistent_pixels, exactly_consistent, repaired, unblocked
from gsx.core.data.reduction import box_average, projected


def random(*shape: int, seed: int = 0) -> Tensor:
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed))


def rounded_average(image: Tensor, factor: int) -> Tensor:
    """Half up, in exact integers."""
    sums = torch.stack([image[:, i::factor, j::factor].long() for i in range(factor) for j in range(factor)]).sum(0)
    return torch.div(2 * sums + factor**2, 2 * factor**2, rounding_mode="floor").to(torch.uint8)


@pytest.mark.parametrize("factor", [2, 3, 4, 8])
@given(seed=st.integers(0, 1000), spread=st.sampled_from([0.02, 0.3, 3.0]))
@settings(max_examples=15, deadline=None)
def test_no_pixel_of_the_low_resolution_is_missed(factor: int, seed: int, spread: float) -> None:
    low = (random(3, 5, 6, seed=seed) * 256).to(torch.uint8)
    guess = low.float().repeat_interleave(factor, 1).repeat_interleave(factor, 2) / 255
    image = guess + spread * (random(3, 5 * factor, 6 * factor, seed=seed + 1) - 0.5)
    result = exactly_consistent(image, low, factor, BOX)
    assert torch.equal(rounded_average(result, factor), low)
    assert bool(consistent_pixels(result, low, factor, BOX).all())


def test_black_and_white_are_kept() -> None:
    low = torch.tensor([0, 255, 254, 1], dtype=torch.uint8).view(1, 2, 2).repeat(3, 1, 1)
    result = exactly_consistent(random(3, 4, 4), low, 2, BOX)
    assert torch.equal(rounded_average(result, 2), low)
    assert int(result[:, :2, :2].long().sum((1, 2)).max()) < 2  # 1 in four rounds to 0
    assert int(result[:, :2, 2:].long().sum((1, 2)).min()) >= 4 * 255 - 2


def test_consistent_pictures_stay_as_they_are() -> None:
    image = (random(3, 8, 12) * 256).to(torch.uint8)
    low = rounded_average(image, 2)
    assert torch.equal(repaired(image.float() / 255, low, 2), image)


def test_the_projection_spreads_what_is_missing_evenly() -> None:
    image, low = 0.4 + 0.2 * random(3, 8, 8), 0.4 + 0.2 * random(3, 4, 4, seed=1)
    result = projected(image, low, 2, BOX)
    torch.testing.assert_close(box_average(result, 2), low)
    change = blocks(result - image, 2)
    torch.testing.assert_close(change, change.mean(1, keepdim=True).expand_as(change), rtol=0, atol=1e-6)


def test_repairs_cost_least() -> None:
    """Every 2 x 2 block within two levels, by trying all: the sum of squared distances is the smallest there is."""
    near = (100 + 2 * random(3, 2, 2, seed=5)) / 255
    low = torch.tensor([99, 101, 102], dtype=torch.uint8).view(3, 1, 1)
    result = repaired(near, low, 2)
    for channel in range(3):
        wanted, target = (near[channel] * 255).flatten().tolist(), int(low[channel])
        best = min(
            sum((value - goal) ** 2 for value, goal in zip(values, wanted, strict=True))
            for values in itertools.product(range(95, 107), repeat=4)
            if (2 * sum(values) + 4) // 8 == target
        )
        found = sum((v - g) ** 2 for v, g in zip(result[channel].flatten().tolist(), wanted, strict=True))
        assert found == pytest.approx(best, abs=1e-3)


def test_blocks_are_put_back() -> None:
    image = torch.arange(3 * 6 * 9).view(3, 6, 9)
    assert torch.equal(unblocked(blocks(image, 3), torch.Size([3, 2, 3]), 3), image)
    assert blocks(image, 3)[0].tolist() == [0, 1, 2, 9, 10, 11, 18, 19, 20]


def test_pixels_with_all_channels_right_are_counted() -> None:
    image = (random(3, 8, 8) * 200).to(torch.uint8)
    low = rounded_average(image, 2)
    low[1, 0, 0] += 1
    right = torch.ones(4, 4, dtype=torch.bool)
    right[0, 0] = False
    assert torch.equal(consistent_pixels(image, low, 2, BOX), right)
