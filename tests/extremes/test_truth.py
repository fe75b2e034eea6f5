"""The reference itself where float64 is put to the test: needles against exact rational arithmetic, crops."""

from fractions import Fraction

import pytest
import torch
from reference_rasterizer import render_reference, squared_distances
from torch import Tensor

from extremes.cases import ball, view
from gsx.core.rasterizer import RasterSettings


def exact_squared_distance(root: Tensor, offset: Tensor) -> Fraction:
    """d^T (A^T A)^-1 d in rational numbers, from the very float64 numbers."""
    rows = [[Fraction(value) for value in row] for row in root.tolist()]
    xx, xy, yy = (sum(row[i] * row[j] for row in rows) for i, j in ((0, 0), (0, 1), (1, 1)))
    x, y = (Fraction(value) for value in offset.tolist())
    return (yy * x * x - 2 * xy * x * y + xx * y * y) / (xx * yy - xy * xy)


@pytest.mark.parametrize("length", [1.0, 1e3, 1e5, 1e7])
def test_distances_from_needles_are_those_of_exact_arithmetic(length: float) -> None:
    g = torch.Generator().manual_seed(0)
    turn = 6 * torch.rand(20, 1, generator=g, dtype=torch.float64)
    along = torch.cat([turn.cos(), turn.sin()], 1)
    dilation = 0.3**0.5 * torch.eye(2, dtype=torch.float64).expand(20, 2, 2)
    axes = torch.stack([length * along, 1e-6 * length * along.flip(1), torch.zeros_like(along)], 1)
    roots = torch.cat([axes, dilation], 1)
    offsets = 3 * torch.randn(20, 2, generator=g, dtype=torch.float64)
    found = squared_distances(roots, offsets[:, None, None])[:, 0, 0]
    exact = [float(exact_squared_distance(root, offset)) for root, offset in zip(roots, offsets, strict=True)]
    assert torch.allclose(found, torch.tensor(exact, dtype=torch.float64), rtol=1e-15 * max(1e2, length), atol=0)


def test_the_reference_of_a_crop_is_the_crop_of_the_reference() -> None:
    splats, rules = ball(), RasterSettings(cull="published")
    splats.means[:, 0] *= 3  # some beyond the frame, where slopes are clamped
    whole = render_reference(splats, view(), rules)[0]
    part = render_reference(splats, view().crop(37, 11, 40, 50), rules)[0]
    assert torch.allclose(part, whole[:, 11:61, 37:77], rtol=0, atol=1e-14)
