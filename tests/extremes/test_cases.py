"""Every case, forward and backward, on every path, in both precisions and under both culling rules."""

import itertools

import pytest
import torch

from extremes.cases import CASES, Case
from extremes.comparison import leaves, measure, paths, rules_of
from gsx.core.errors import InputError
from gsx.core.rasterizer import rasterize

RENDERED = [case for case in CASES if not case.refused]
REFUSED = [case for case in CASES if case.refused]
STEP = 0.01
"""What one decision at a threshold changes at most: a splat of alpha 1/255, or the 1e-4 / (1 - 0.99) of light left."""
FLOAT64 = {"image": 1e-11, "gradient": 1e-9}
ALWAYS = [
    ("eager", torch.float32, "published"),
    ("eager", torch.float64, "tight"),
    ("compiled", torch.float32, "tight"),
]
"""The other combinations are slow."""
TRIED = list(itertools.product(paths(), (torch.float32, torch.float64), ("published", "tight")))


@pytest.mark.parametrize(
    ("path", "dtype", "cull"),
    [
        pytest.param(*how, id=f"{how[0]}-{str(how[1])[6:]}-{how[2]}", marks=[] if how in ALWAYS else [pytest.mark.slow])
        for how in TRIED
    ],
)
@pytest.mark.parametrize("case", RENDERED, ids=lambda case: case.name)
def test_extreme(case: Case, path: str, dtype: torch.dtype, cull: str) -> None:
    found = measure(case, path, dtype, cull)
    rendering = found.rendering
    assert torch.isfinite(rendering.image).all()
    assert 0 <= float(rendering.alpha.detach().min()) <= float(rendering.alpha.detach().max()) <= 1
    assert (float(rendering.alpha.detach().max()) > 0) is case.drawn
    assert rendering.dropped == case.dropped_in(dtype)
    for name, gradient in found.gradients.items():
        assert torch.isfinite(gradient).all(), name
    bound = {"image": case.image, "gradient": case.gradient} if dtype == torch.float32 else FLOAT64
    assert found.image_error <= bound["image"]
    assert max(found.gradient_errors.values()) <= bound["gradient"], found.gradient_errors
    assert found.undecided <= case.undecided
    assert found.step <= bound["image"] + STEP


@pytest.mark.parametrize("path", paths())
@pytest.mark.parametrize("case", REFUSED, ids=lambda case: case.name)
def test_refused_by_name(case: Case, path: str) -> None:
    splats, camera = case.make()
    with pytest.raises(InputError, match=case.refused):
        rasterize(leaves(splats, torch.float32), camera, rules_of(case, "tight", path))
