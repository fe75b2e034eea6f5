"""Movements of cameras, told from pairs of pictures of which one was moved by a known one."""

import math

import pytest
import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d

from gsx.core.data.movement import motion_blurred
from gsx.core.quality.motion_blur import MOST, movement_between


def picture(seed: int = 0) -> Tensor:
    """Of coarse and fine detail, in [0, 1]."""
    generator = torch.Generator().manual_seed(seed)
    fine = avg_pool2d(torch.rand(3, 122, 162, generator=generator), 3, 1)
    coarse = torch.nn.functional.interpolate(torch.rand(1, 3, 8, 10, generator=generator), (120, 160), mode="bilinear")
    return (fine + coarse[0]) / 2


@pytest.mark.parametrize("movement", [(5.0, 2.0), (-3.0, 7.5), (2.0, 0.0), (0.0, 12.0)])
def test_a_known_movement_is_found(movement: tuple[float, float]) -> None:
    found = movement_between(picture(), motion_blurred(picture(), *movement))
    sign = math.copysign(1, found.across * movement[0] + found.down * movement[1])
    assert sign * found.across == pytest.approx(movement[0], abs=0.5)
    assert sign * found.down == pytest.approx(movement[1], abs=0.5)
    assert found.explained > 0.95


def test_none_is_found_where_the_photograph_is_as_sharp_or_sharper() -> None:
    """Noise and another brightness are no movement."""
    noise = 0.03 * torch.randn(3, 120, 160, generator=torch.Generator().manual_seed(1))
    for sharp, photograph in (
        (picture(), picture() + noise),
        (motion_blurred(picture(), 4, 0), picture()),
        (picture(),) * 2,
    ):
        found = movement_between(sharp, photograph)
        assert (found.length, found.explained) == (0, 0)


def test_what_does_not_count_says_nothing() -> None:
    sharp, photograph = picture(), motion_blurred(picture(), 6.0, 0.0)
    counted = torch.ones(120, 160, dtype=torch.bool)
    counted[:, 80:] = False
    photograph[:, :, 80:] = motion_blurred(picture(), 0.0, 10.0)[:, :, 80:]
    found = movement_between(sharp, photograph, counted)
    assert abs(found.across) == pytest.approx(6, abs=0.5)
    assert abs(found.down) < 0.5


def test_no_movement_is_longer_than_the_longest() -> None:
    found = movement_between(picture(), motion_blurred(picture(), 60.0, 0.0))
    assert 12 < abs(found.across) <= MOST
