"""The order of training views: all before any comes again, known ahead, the same for the same seed."""

from gsx.core.training.run import Sampler


def test_every_view_once_before_any_comes_again() -> None:
    sampler = Sampler(7, 3)
    drawn = [sampler.next() for _ in range(28)]
    for start in range(0, 28, 7):
        assert sorted(drawn[start : start + 7]) == list(range(7))
    assert len({tuple(drawn[start : start + 7]) for start in range(0, 28, 7)}) == 4


def test_views_to_come_are_known_without_drawing_them() -> None:
    """Across the end of an order too."""
    sampler, other = Sampler(5, 0), Sampler(5, 0)
    for _ in range(3):
        assert sampler.next() == other.next()
    assert sampler.coming(4) == {other.next() for _ in range(4)}
    again = Sampler(5, 0)
    assert [sampler.next() for _ in range(9)] == [again.next() for _ in range(12)][3:]
    assert sampler.coming(0) == set()


def test_seeds_give_other_orders() -> None:
    orders = [[sampler.next() for _ in range(20)] for sampler in (Sampler(20, 1), Sampler(20, 1), Sampler(20, 2))]
    assert orders[0] == orders[1] != orders[2]
