"""Neighbour distances against a float64 search through all pairs."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from gsx.backbones import neighbours
from gsx.backbones.neighbours import mean_square_distance, nearest


def brute_force(points: Tensor, count: int = 3) -> Tensor:
    p = points.double().numpy()
    squares = ((p[:, None] - p[None]) ** 2).sum(2)
    np.fill_diagonal(squares, np.inf)
    return torch.from_numpy(np.sort(squares, 1)[:, : min(count, len(p) - 1)].mean(1)).float()


def cloud(count: int, seed: int = 0) -> Tensor:
    return torch.randn(count, 3, generator=torch.Generator().manual_seed(seed))


def test_points_on_a_line_worked_by_hand() -> None:
    points = torch.tensor([[0.0, 0, 0], [1, 0, 0], [3, 0, 0], [7, 0, 0], [20, 0, 0]])
    sums = torch.tensor([1.0 + 9 + 49, 1 + 4 + 36, 4 + 9 + 16, 16 + 36 + 49, 169 + 289 + 361])
    torch.testing.assert_close(mean_square_distance(points), sums / 3)


@pytest.mark.parametrize("count", [4, 9, 10, 300])
def test_random_points(count: int) -> None:
    points = cloud(count)
    torch.testing.assert_close(mean_square_distance(points), brute_force(points), rtol=1e-5, atol=0)


@pytest.mark.parametrize("count", [9, 5000])
def test_which_points_are_nearest(count: int) -> None:
    points = cloud(count)
    squares, which = nearest(points, 4)
    distances = torch.cdist(points.double(), points.double()).fill_diagonal_(torch.inf)
    assert torch.equal(which, distances.topk(4, largest=False).indices)
    torch.testing.assert_close(squares.double(), distances.gather(1, which).square(), rtol=1e-4, atol=1e-9)


def test_work_in_chunks_changes_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    points = cloud(100)
    whole = mean_square_distance(points)
    monkeypatch.setattr(neighbours, "CHUNK_VALUES", 700)
    torch.testing.assert_close(mean_square_distance(points), whole, rtol=1e-6, atol=0)


def test_duplicates_have_distance_zero() -> None:
    points = torch.cat([cloud(20)] * 4 + [cloud(5, seed=1)])
    got = mean_square_distance(points)
    assert torch.all(got[:80] == 0)
    torch.testing.assert_close(got[80:], brute_force(points)[80:], rtol=1e-5, atol=0)


def test_some_duplicates_count_as_neighbours_each() -> None:
    points = torch.tensor([[0.0, 0, 0], [0, 0, 0], [0, 3, 0], [6, 0, 0], [50, 0, 0]])
    torch.testing.assert_close(mean_square_distance(points)[:3], torch.tensor([15.0, 15.0, (9 + 9 + 45) / 3]))


@pytest.mark.parametrize(
    ("rows", "expected"),
    [
        ([[5.0, 6.0, 7.0]], [0.0]),
        ([[0.0, 0.0, 0.0], [3.0, 4.0, 0.0]], [25.0, 25.0]),
        ([[0.0, 0.0, 0.0], [2.0, 0.0, 0.0], [0.0, 0.0, 4.0]], [10.0, 12.0, 18.0]),
    ],
)
def test_few_points_average_over_those_there_are(rows: list[list[float]], expected: list[float]) -> None:
    torch.testing.assert_close(mean_square_distance(torch.tensor(rows)), torch.tensor(expected))


@pytest.mark.parametrize("unit", [1e-6, 1e6])
def test_distances_scale_with_the_square_of_the_unit(unit: float) -> None:
    points = cloud(40)
    expected = mean_square_distance(points) * unit**2
    torch.testing.assert_close(mean_square_distance(points * unit), expected, rtol=1e-5, atol=0)


@pytest.mark.parametrize("distance", [1e3, 1e5])
def test_far_from_the_origin(distance: float) -> None:
    points = cloud(200) + distance  # what float32 keeps of the positions is the truth here
    torch.testing.assert_close(mean_square_distance(points), brute_force(points), rtol=1e-5, atol=0)


def test_one_outlier_leaves_the_others_exact() -> None:
    points = torch.cat([cloud(500), torch.tensor([[1e6, 0.0, 0.0]])])
    torch.testing.assert_close(mean_square_distance(points), brute_force(points), rtol=1e-5, atol=0)


coordinate = st.integers(-4, 4).map(float)  # a coarse grid: many ties and duplicates


@settings(max_examples=100, deadline=None)
@given(rows=st.lists(st.tuples(coordinate, coordinate, coordinate), min_size=1, max_size=30))
def test_any_small_cloud(rows: list[tuple[float, float, float]]) -> None:
    points = torch.tensor(rows)
    expected = brute_force(points) if len(points) > 1 else torch.zeros(1)
    torch.testing.assert_close(mean_square_distance(points), expected, rtol=1e-5, atol=1e-5)
