"""Pictures in bands are the whole picture, with its gradients."""

from typing import Any

import pytest
import torch
from raster_scenes import any_path, front_camera, leaves, loss_of, random_splats, truth_of
from torch import Tensor

from gsx.core.rasterizer import RasterSettings, Rendering, rasterize
from gsx.engine.bands import SHARE, InBands
from gsx.engine.compiled import available
from gsx.engine.compositors import COMPOSITORS

SPLATS, CAMERA = random_splats(400), front_camera(200, 150).crop(-13, 21, 180, 139)
"""A raster that cuts tiles on all sides."""


class Counting:
    """The compositor of a path that notes the height of each picture."""

    def __init__(self, path: str) -> None:
        self.composite, self.heights = COMPOSITORS[path].composite, list[int]()

    def __call__(self, *arguments: Any) -> Any:
        self.heights.append(arguments[3].height)
        return self.composite(*arguments)


def learned(rules: RasterSettings) -> tuple[Rendering, dict[str, Tensor]]:
    """A render with depth, and all its gradients."""
    live = leaves(SPLATS)
    rendering = rasterize(live, CAMERA, rules, depth=True, absolute_gradient=True)
    loss_of(rendering.image, rendering.depth).backward()
    screen = {"offset": rendering.screen.means2d_offset, "absolute": rendering.screen.absgrad}
    return rendering, {name: value.grad for name, value in (vars(live) | screen).items()}


@pytest.mark.parametrize("path", ["eager", *(["compiled"] if available() else [])])
def test_bands_are_the_whole_picture(path: str) -> None:
    counting, options = Counting(path), {"path": path, "unrolled": 2, "cull": "tight"}
    whole, gradients = learned(any_path(**options))
    bands = InBands(counting, COMPOSITORS[path].backend, pairs=whole.intersections - 1)
    part, found = learned(RasterSettings(**options, compositors={path: bands}))
    assert sum(counting.heights) == 2 * CAMERA.height  # forward, and again backward
    assert len(counting.heights) >= 2 * SHARE
    torch.testing.assert_close(part.image, whole.image, rtol=0, atol=0 if path == "eager" else 1e-6)
    assert part.intersections == whole.intersections
    for name, gradient in gradients.items():
        assert float((found[name] - gradient).norm() / gradient.norm()) < 1e-5, name
    for name, true in truth_of(SPLATS, CAMERA, any_path(**options)).gradients.items():
        assert float((found[name] - true).norm() / true.norm()) < 1e-4, name


def test_renders_without_gradients_are_not_cut() -> None:
    counting = Counting("eager")
    rasterize(SPLATS, CAMERA, RasterSettings(compositors={"eager": InBands(counting, pairs=1)}))
    assert counting.heights == [CAMERA.height]


def test_a_row_of_tiles_may_hold_more_pairs_than_a_band() -> None:
    counting = Counting("eager")
    whole, gradients = learned(RasterSettings())
    part, found = learned(RasterSettings(compositors={"eager": InBands(counting, pairs=1)}))
    assert max(counting.heights) <= 8 * len(counting.heights)
    assert torch.equal(part.image, whole.image)
    assert all(torch.allclose(found[name], gradient, rtol=1e-3, atol=1e-6) for name, gradient in gradients.items())
