"""Every case by Gaussian Blending, forward and backward: finite, and as its own double precision has it."""

from dataclasses import replace

import pytest
import torch

from extremes.cases import CASES, Case
from extremes.comparison import leaves, rules_of
from gsx.core.rasterizer import Rendering, rasterize

MOST = 1000
"""Splats of a case: a pixel takes them one by one."""
CHOSEN = [case for case in CASES if not case.refused and len(case.make()[0]) <= MOST]
SMALL = [case for case in CHOSEN if case.name.startswith(("scales", "needles", "discs", "points", "opacity"))]
"""Those in which it matters how much a splat is dilated and what that does to its opacity."""


def drawn(case: Case, dtype: torch.dtype, mip: bool) -> tuple[Rendering, dict[str, torch.Tensor]]:
    splats, camera = case.make()
    live = leaves(splats, dtype)
    rules = replace(rules_of(case, "tight", "eager"), pixel="window")
    rules = replace(rules, dilation=0.1, compensate=True) if mip else rules
    rendering = rasterize(live, camera, rules)
    rendering.image.sum().backward()
    return rendering, {name: value.grad for name, value in vars(live).items() if value.grad is not None}


@pytest.mark.parametrize(
    ("case", "mip"),
    [
        *(pytest.param(case, True, id=f"{case.name}-mip") for case in CHOSEN),
        *(
            pytest.param(case, False, id=f"{case.name}-plain", marks=[] if case in SMALL else [pytest.mark.slow])
            for case in CHOSEN
        ),
    ],
)
def test_extreme_windows(case: Case, mip: bool) -> None:
    single, gradients = drawn(case, torch.float32, mip)
    double, _ = drawn(case, torch.float64, mip)
    for image in (single.image.detach(), double.image.detach()):
        assert torch.isfinite(image).all()
    assert 0 <= float(single.alpha.detach().min()) <= float(single.alpha.detach().max()) <= 1 + 1e-6
    for name, gradient in gradients.items():
        assert torch.isfinite(gradient).all(), name
    if single.dropped == double.dropped:
        assert (single.image.detach() - double.image.detach()).abs().mean() < 2e-3
