"""gsplat's compositor against a stand-in of its function in plain torch."""

import sys
from itertools import pairwise
from types import SimpleNamespace

import pytest
import torch
from raster_scenes import front_camera, leaves, random_splats
from torch import Tensor

from gsx.core.errors import ConfigError
from gsx.core.rasterizer import RasterSettings, Rendering, rasterize
from gsx.engine.gsplat import RULES, GsplatCompositor

CPU = torch.device("cpu")


def rasterize_to_pixels(
    means2d: Tensor,
    conics: Tensor,
    colors: Tensor,
    opacities: Tensor,
    image_width: int,
    image_height: int,
    tile_size: int,
    isect_offsets: Tensor,
    flatten_ids: Tensor,
    backgrounds: Tensor | None = None,
    masks: Tensor | None = None,
    packed: bool = False,
    absgrad: bool = False,
) -> tuple[Tensor, Tensor]:
    """What gsplat documents for one camera, tile by tile and splat by splat."""
    rows = []
    ends = [*isect_offsets.flatten().tolist(), len(flatten_ids)]
    columns = image_width // tile_size
    y, x = torch.meshgrid(torch.arange(tile_size) + 0.5, torch.arange(tile_size) + 0.5, indexing="ij")
    for tile, (begin, end) in enumerate(pairwise(ends)):
        corner = torch.tensor([tile % columns, tile // columns]) * tile_size
        light, going = torch.ones(tile_size, tile_size), torch.ones(tile_size, tile_size, dtype=torch.bool)
        picture = torch.zeros(tile_size, tile_size, colors.shape[2] + 1)
        for splat in flatten_ids[begin:end].tolist():
            dx, dy = x + corner[0] - means2d[0, splat, 0], y + corner[1] - means2d[0, splat, 1]
            a, b, c = conics[0, splat]
            alpha = opacities[0, splat] * torch.exp(-(a * dx * dx + c * dy * dy) / 2 - b * dx * dy)
            alpha = alpha + (alpha.clamp(max=0.999) - alpha).detach()
            alpha = torch.where(alpha >= 1 / 255, alpha, 0.0)
            going = going & (light * (1 - alpha) > 1e-4)
            weight = torch.where(going, alpha * light, 0.0)
            picture = picture + weight[..., None] * torch.cat([colors[0, splat], torch.ones(1)])
            light = light - weight
        rows.append(picture)
    whole = torch.stack(rows).view(image_height // tile_size, columns, tile_size, tile_size, -1)
    whole = whole.permute(0, 2, 1, 3, 4).reshape(1, image_height, image_width, -1)
    return whole[..., :-1], whole[..., -1:]


@pytest.fixture
def stand_in(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "gsplat", SimpleNamespace(rasterize_to_pixels=rasterize_to_pixels))


def drawn(path: str, size: tuple[int, int]) -> tuple[Rendering, list[Tensor]]:
    compositors = {"gsplat": GsplatCompositor(devices=("cpu",))}
    rules = RasterSettings(path=path, tile_size=16, compositors=compositors, cull="tight", **RULES)
    splats = leaves(random_splats(40))
    camera = front_camera(50, 40).crop(7, 5, *size)
    rendering = rasterize(splats, camera, rules, background=torch.tensor([0.1, 0.2, 0.3]))
    rendering.image.square().mean().backward()
    return rendering, [value.grad for value in vars(splats).values()]


@pytest.mark.usefixtures("stand_in")
@pytest.mark.parametrize("size", [(32, 20), (43, 35)])
def test_picture_and_gradients_are_the_eager_ones(size: tuple[int, int]) -> None:
    (ours, gradients), (theirs, others) = drawn("gsplat", size), drawn("eager", size)
    torch.testing.assert_close(ours.image, theirs.image, rtol=0, atol=1e-5)
    torch.testing.assert_close(ours.alpha, theirs.alpha, rtol=0, atol=1e-5)
    for gradient, other in zip(gradients, others, strict=True):
        assert (gradient - other).norm() <= 1e-4 * other.norm()


@pytest.mark.usefixtures("stand_in")
def test_it_is_refused_with_a_remedy() -> None:
    with pytest.raises(ConfigError, match="draws on a CUDA device, not on cpu: set device=cuda"):
        GsplatCompositor().refuse(RasterSettings(**RULES), CPU)
    with pytest.raises(ConfigError, match=r"alpha_max is 0\.99, but gsplat has 0\.999"):
        GsplatCompositor(devices=("cpu",)).refuse(RasterSettings(), CPU)


def test_without_the_package_it_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "gsplat", None)
    with pytest.raises(ConfigError, match=r"pip install 'gsx.gsplat.', or set rasterizer=auto"):
        GsplatCompositor().refuse(RasterSettings(**RULES), CPU)
