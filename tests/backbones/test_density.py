"""What renders tell of each primitive, against sums worked out by hand."""

import torch
from torch.nn import Parameter

from gsx.backbones.density import (
    add_statistics,
    densification_statistics,
    gradient_statistics,
    mean_gradient,
    zero_statistics,
)
from gsx.core.rasterizer import ScreenStatistics
from gsx.core.training.parameter_table import ParameterTable


def counted(count: int) -> ParameterTable:
    """A table of so many rows with fresh statistics."""
    return ParameterTable({"means": Parameter(torch.zeros(count, 3))}, {}, gradient_statistics(count, "cpu"))


def screen(ids: list[int], radii: list[int], gradient: list[list[float]], size: tuple[int, int]) -> ScreenStatistics:
    shift = torch.zeros(len(ids), 2, requires_grad=True)
    shift.grad = torch.tensor(gradient)
    return ScreenStatistics(
        ids=torch.tensor(ids),
        radii=torch.tensor(radii),
        means2d_offset=shift,
        absgrad=None,
        max_weights=None,
        size=size,
    )


def test_statistics_are_means_of_norms_in_ndc_over_the_views_that_saw_the_row() -> None:
    table = counted(4)
    # 20 x 8 px: NDC gradients are (10, 4) times those in pixels
    one = screen([3, 0, 1], [5, 0, 2], [[0.3, 1.0], [9.0, 9.0], [0.0, 0.5]], (20, 8))  # norms 5, -, 2
    other = screen([1, 3], [1, 1], [[-0.6, 2.0], [-0.3, -1.0]], (20, 8))  # 10 and 5: opposite to the first view
    for picture in (one, other):
        add_statistics(table, densification_statistics(picture))
    assert table["count"].tolist() == [0, 2, 0, 2]
    torch.testing.assert_close(mean_gradient(table), torch.tensor([0.0, 6.0, 0.0, 5.0]))


def test_sightings_count_by_their_weight() -> None:
    """Gradients carry the weight already: 4 at weight 1 and 2 of 8 at weight 1/4 have the mean 6 / 1.25."""
    table = counted(2)
    add_statistics(table, densification_statistics(screen([0], [1], [[0.4, 0.0]], (20, 8))))
    add_statistics(
        table, densification_statistics(screen([0, 1], [1, 1], [[0.2, 0.0], [0.0, 0.25]], (20, 8)), weight=0.25)
    )
    assert table["count"].tolist() == [1.25, 0.25]
    torch.testing.assert_close(mean_gradient(table), torch.tensor([6 / 1.25, 4.0]))


def test_a_view_without_gradient_still_counts() -> None:
    table = counted(2)
    unused = ScreenStatistics(
        ids=torch.tensor([1]),
        radii=torch.tensor([3]),
        means2d_offset=torch.zeros(1, 2),
        absgrad=None,
        max_weights=None,
        size=(4, 4),
    )
    add_statistics(table, densification_statistics(unused))
    assert table["count"].tolist() == [0, 1]
    assert mean_gradient(table).tolist() == [0.0, 0.0]


def test_counting_begins_anew() -> None:
    table = counted(2)
    add_statistics(table, densification_statistics(screen([0], [1], [[0.4, 0.0]], (20, 8))))
    zero_statistics(table)
    assert {name: sums.tolist() for name, sums in table.statistics.items()} == {"gradient": [0, 0], "count": [0, 0]}
