"""Two Gaussians made one: moments worked by hand, and changes against sums over a fine grid."""

import math

import pytest
import torch
from torch import Tensor

from gsx.backbones.merging import (
    LARGEST_OPACITY,
    changes,
    covariances,
    densities,
    merged,
    principal_axes,
    products,
    surfaces,
)
from gsx.core.gaussians.quaternions import rotation_matrices

FIRST, SECOND = torch.tensor([0]), torch.tensor([1])


def rows_of(means: list[list[float]], scales: list[list[float]], opacities: list[float], **more: Tensor) -> dict:
    """Raw parameters, float64, axes along those of the world."""
    return {
        "means": torch.tensor(means, dtype=torch.float64),
        "log_scales": torch.tensor(scales, dtype=torch.float64).log(),
        "quats": torch.tensor([[1.0, 0, 0, 0]] * len(means), dtype=torch.float64),
        "opacity_logits": torch.logit(torch.tensor(opacities, dtype=torch.float64)),
        **more,
    }


def turned_rows() -> dict[str, Tensor]:
    """Two of unlike shapes, turned, that overlap."""
    rows = rows_of([[0.1, 0, 0], [-0.3, 0.2, 0.1]], [[0.3, 0.5, 0.4], [0.6, 0.3, 0.35]], [0.6, 0.4])
    return rows | {"quats": torch.tensor([[0.9, 0.1, 0.3, -0.2], [0.5, -0.4, 0.3, 0.7]]).double()}


def test_two_spheres_side_by_side_by_hand() -> None:
    """At -1 and 1, of radius 1 and opacity 0.5: variances 2, 1, 1; the ink of both on the larger surface."""
    rows = rows_of([[-1, 0, 0], [1, 0, 0]], [[1, 1, 1]] * 2, [0.5, 0.5])
    one = merged(rows, FIRST, SECOND)
    torch.testing.assert_close(one["means"], torch.zeros(1, 3).double())
    torch.testing.assert_close(covariances(one)[0], torch.diag(torch.tensor([2.0, 1, 1])).double())
    assert float(one["opacity_logits"].sigmoid()) == pytest.approx(0.778, abs=5e-4)


def test_what_weighs_nothing_leaves_the_other_as_it_is() -> None:
    """Even where its numbers are infinite."""
    rows = rows_of([[0, 0, 0], [4, 0, 0]], [[3, 3, 3], [1, 1, 1]], [0.2, 0.0], size=torch.tensor([2.0, math.inf]))
    one, other = merged(rows, FIRST, SECOND), merged(rows, SECOND, FIRST)
    assert [float(both["size"]) for both in (one, other)] == [2, 2]
    torch.testing.assert_close(one["means"], torch.zeros(1, 3).double())


def test_the_heavier_one_counts_more() -> None:
    """Surfaces 4 pi 9 and 4 pi, opacities 0.2 and 0.6: weights 1.8 and 0.6."""
    numbers = {"sh_dc": torch.tensor([[[1.0, 0, 0]], [[5.0, 0, 4]]]), "level": torch.tensor([2, 2], dtype=torch.int16)}
    rows = rows_of([[0, 0, 0], [4, 0, 0]], [[3, 3, 3], [1, 1, 1]], [0.2, 0.6], **numbers)
    one = merged(rows, FIRST, SECOND)
    torch.testing.assert_close(one["means"], torch.tensor([[1.0, 0, 0]]).double())
    torch.testing.assert_close(one["sh_dc"], torch.tensor([[[2.0, 0, 1]]]))
    torch.testing.assert_close(covariances(one)[0], torch.diag(torch.tensor([7.0 + 3, 7, 7])).double())
    assert one["level"].tolist() == [2]
    assert one["level"].dtype == torch.int16


def test_coincident_ones_add_their_opacities() -> None:
    rows = rows_of([[1, 2, 3]] * 4, [[0.1, 0.2, 0.3]] * 4, [0.2, 0.3, 0.7, 0.8])
    pairs = merged(rows, torch.tensor([0, 2]), torch.tensor([1, 3]))
    torch.testing.assert_close(pairs["opacity_logits"].sigmoid(), torch.tensor([0.5, LARGEST_OPACITY]).double())
    torch.testing.assert_close(covariances(pairs), covariances(rows)[:2])


def test_axes_and_variances_make_the_covariance_again() -> None:
    before = covariances(turned_rows())
    variances, quats = principal_axes(before)
    turn = rotation_matrices(quats)
    torch.testing.assert_close(torch.linalg.det(turn), torch.ones(2).double())
    torch.testing.assert_close(turn @ torch.diag_embed(variances) @ turn.mT, before)


@pytest.mark.parametrize("long", [1.0, 2.0, 5.0])
def test_surfaces_of_stretched_spheres(long: float) -> None:
    """Radius 1, half length `long`: 2 pi (1 + long / e asin e), e the eccentricity."""
    e = math.sqrt(1 - 1 / long**2)
    exact = 2 * math.pi * (1 + (long / e * math.asin(e) if e else 1.0))
    assert float(surfaces(torch.tensor([[1.0, 1.0, long]]))) == pytest.approx(exact, rel=0.0107)


# -- changes, against a grid -------------------------------------------------------------------------------------------

STEP = 0.05


def field(rows: dict[str, Tensor], colours: Tensor, row: int) -> Tensor:
    """Opacity times (colour, 1) times the Gaussian at the points of a grid."""
    line = torch.arange(-2.5, 2.5, STEP, dtype=torch.float64)
    points = torch.cartesian_prod(line, line, line) - rows["means"][row]
    inverse = covariances(rows)[row].inverse()
    values = rows["opacity_logits"][row].sigmoid() * torch.exp(-0.5 * (points @ inverse * points).sum(1))
    return values[:, None] * torch.cat([colours[row], torch.ones(1).double()])


def test_changes_are_those_of_the_field() -> None:
    rows, colours = turned_rows(), torch.tensor([[0.9, 0.2, 0.1], [0.3, 0.4, 0.8]]).double()
    one = merged(rows | {"colours": colours}, FIRST, SECOND)
    a, b, whole = field(rows, colours, 0), field(rows, colours, 1), field(one, one["colours"], 0)
    both, single = densities(rows, colours), densities(one, one["colours"])
    integral = float(products(both.at(FIRST), both.at(SECOND)))
    assert integral == pytest.approx(float((a * b).sum()) * STEP**3, rel=1e-6)
    expected = float((a + b - whole).square().sum() / (a + b).square().sum())
    assert 0.01 < expected < 1
    assert float(changes(both.at(FIRST), both.at(SECOND), single)) == pytest.approx(expected, rel=1e-5)


def test_nothing_changes_where_one_is_two() -> None:
    rows = rows_of([[1, 2, 3]] * 2, [[0.1, 0.2, 0.3]] * 2, [0.2, 0.3])
    colours = torch.full((2, 3), 0.4)
    one, both = merged(rows, FIRST, SECOND), densities(rows, colours)
    assert float(changes(both.at(FIRST), both.at(SECOND), densities(one, colours[:1]))) < 1e-12


def test_the_dark_and_the_flat_count_too() -> None:
    """Black ones far from each other, without any extent along an axis: all of them changes."""
    rows = rows_of([[0, 0, 0], [1, 0, 0]], [[0.1, 0.1, 1e-30]] * 2, [0.5, 0.5])
    black = torch.zeros(2, 3)
    one, both = merged(rows, FIRST, SECOND), densities(rows, black)
    assert float(changes(both.at(FIRST), both.at(SECOND), densities(one, black[:1]))) > 0.5
