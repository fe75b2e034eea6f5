"""Compositors as plugins: the example of the docs draws, and names that nobody registered are refused."""

import re
from pathlib import Path
from types import ModuleType

import pytest
import torch
from raster_scenes import front_camera, leaves, random_splats

from gsx import builtin
from gsx.core.errors import ConfigError
from gsx.core.plugins import Plugins, load_plugins
from gsx.core.rasterizer import rasterize
from gsx.experiments.runs.compose import compose

PAGE = Path(__file__).parents[3] / "docs" / "how-to" / "write-a-plugin.md"


@pytest.fixture(scope="module")
def loaded() -> Plugins:
    """The built-in components and the compositor of the page."""
    section = PAGE.read_text().split("## A compositor")[1].split("\n## ")[0]
    code = re.search(r"```python\n(.*?)```", section, flags=re.S)[1]
    assert len(code.splitlines()) <= 30
    plugin = ModuleType("order_independent")
    exec(code, vars(plugin))
    return load_plugins([("gsx", builtin), ("example", plugin)], points=[])


def test_the_example_draws_and_learns(loaded: Plugins) -> None:
    rules = compose(["scene=demo", "rasterizer.path=order_independent"], loaded).raster
    splats = leaves(random_splats(30))
    rendering = rasterize(splats, front_camera(20, 15), rules, max_weight=True)
    rendering.image.square().mean().backward()
    assert rules.path_on("cpu") == "order_independent"
    assert 0 < float(rendering.alpha.detach().mean()) < 1
    assert float(rendering.screen.max_weights.detach().max()) > 0
    assert float(rendering.screen.means2d_offset.grad.norm()) > 0
    assert all(torch.isfinite(value.grad).all() for value in vars(splats).values())


def test_one_splat_is_drawn_as_by_the_eager_compositor(loaded: Plugins) -> None:
    words = ["scene=demo", "rasterizer.cull=tight", "rasterizer.alpha_min=1e-6"]
    drawn = [
        rasterize(random_splats(1), front_camera(20, 15), compose([*words, *path], loaded).raster).image
        for path in ((), ("rasterizer.path=order_independent",))
    ]
    torch.testing.assert_close(drawn[1], drawn[0], rtol=0, atol=2e-6)


def test_a_name_that_nobody_registered_is_refused(loaded: Plugins) -> None:
    with pytest.raises(ConfigError, match=r"rasterizer\.path is 'fast'; choose auto, eager, .*order_independent"):
        compose(["scene=demo", "rasterizer.path=fast"], loaded)
