"""Lists whose sizes are given: whose each entry is, and whether there was room."""

from dataclasses import replace

import pytest
import torch

from gsx.core.rasterizer import FixedLists, Needed
from gsx.core.rasterizer.fixed_lists import owners

ROOM = FixedLists(lens=torch.zeros(16), rows=10, pairs=20, blocks=6, longest=3)
ENOUGH = Needed(dropped=0, rows=10, pairs=20, blocks=5, longest=3)


def test_owners_of_a_list() -> None:
    counts = torch.tensor([2, 0, 3, 1])
    assert owners(counts, 6, fixed=False).tolist() == [0, 0, 2, 2, 2, 3]
    assert owners(counts, 8, fixed=True).tolist() == [0, 0, 2, 2, 2, 3, 3, 3]
    assert owners(counts, 4, fixed=True).tolist() == [0, 0, 2, 2]


def test_what_just_fits() -> None:
    assert ROOM.hold(ENOUGH)
    assert ROOM.hold(ENOUGH._replace(dropped=7))


@pytest.mark.parametrize("short", ["rows", "pairs", "blocks", "longest"])
def test_one_too_many_of_anything(short: str) -> None:
    assert not ROOM.hold(ENOUGH._replace(**{short: getattr(ENOUGH, short) + 1}))
    assert replace(ROOM, **{short: getattr(ROOM, short) + 1}).hold(
        ENOUGH._replace(**{short: getattr(ENOUGH, short) + 1})
    )
