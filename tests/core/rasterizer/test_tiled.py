"""Pictures in pieces: the same bits as the whole, at any zoom, in memory that does not grow with the raster."""

from typing import Any

import pytest
import torch
from raster_scenes import any_path, changed, front_camera, leaves, random_splats, run_script
from reference_rasterizer import render_reference

from gsx.core.data.camera import Camera
from gsx.core.data.window import Window
from gsx.core.errors import InputError
from gsx.core.gaussians.splats import Splats
from gsx.core.rasterizer import Rendering, rasterize, rasterize_tiled
from gsx.core.rasterizer.render import covering
from gsx.engine.compiled import available


@pytest.mark.parametrize("cull", ["published", "tight"])
@pytest.mark.parametrize("pixels", [1, 500, 2000, 10**6])
def test_pieces_are_the_whole_bit_for_bit(pixels: int, cull: str) -> None:
    splats, rules, colour = random_splats(), any_path(cull=cull), torch.tensor([0.2, 0.5, 0.9])
    whole = rasterize(splats, front_camera(), rules, background=colour, depth=True)
    tiled = rasterize_tiled(splats, front_camera(), rules, background=colour, depth=True, pixels=pixels)
    assert torch.equal(tiled.image, whole.image)
    assert torch.equal(tiled.alpha, whole.alpha)
    assert torch.equal(tiled.depth, whole.depth)
    assert torch.equal(tiled.visible.nonzero()[:, 0], whole.screen.ids[whole.screen.visible].sort().values)
    assert (tiled.windows > 1) is (pixels < 70 * 52)


@pytest.mark.skipif(not available(), reason="no working compiler on this machine")
def test_pieces_of_the_compiled_path_are_the_whole_without_gradients() -> None:
    rules = any_path(path="compiled", unrolled=2)
    with torch.no_grad():
        whole = rasterize(random_splats(), front_camera(), rules).image
    tiled = rasterize_tiled(random_splats(), front_camera(), rules, pixels=500)
    assert tiled.windows > 1
    assert torch.equal(tiled.image, whole)


def test_pieces_of_a_crop_and_of_large_tiles_are_the_whole_too() -> None:
    camera, rules = front_camera(200, 150).crop(-13, 21, 180, 140), any_path(cull="tight", tile_size=24)
    whole = rasterize(random_splats(), camera, rules).image
    assert torch.equal(rasterize_tiled(random_splats(), camera, rules, pixels=4000).image, whole)


def test_pieces_with_too_many_pairs_are_halved_until_they_fit() -> None:
    splats = random_splats()
    whole = rasterize(splats, front_camera(), any_path())
    rules = any_path(max_pairs=whole.intersections // 4)
    with pytest.raises(InputError, match="max_pairs"):
        rasterize(splats, front_camera(), rules)
    tiled = rasterize_tiled(splats, front_camera(), rules)
    assert tiled.windows >= 4
    assert torch.equal(tiled.image, whole.image)


def test_pieces_that_a_gpu_cannot_hold_are_halved_until_it_can(monkeypatch: pytest.MonkeyPatch) -> None:
    def holds_little(splats: Splats, camera: Camera, *given: Any, **named: Any) -> Rendering:
        sizes.append(camera.width * camera.height)
        if sizes[-1] > 1000:
            raise torch.OutOfMemoryError("CUDA out of memory")
        return rasterize(splats, camera, *given, **named)

    sizes = list[int]()
    whole = rasterize(random_splats(), front_camera(), any_path()).image
    monkeypatch.setattr("gsx.core.rasterizer.render.rasterize", holds_little)
    assert torch.equal(rasterize_tiled(random_splats(), front_camera(), any_path()).image, whole)
    assert sizes[0] == 70 * 52


def test_a_tile_with_too_many_pairs_is_refused() -> None:
    with pytest.raises(InputError, match=r"16x16 px needs \d+ splat-tile pairs, more than rasterizer.max_pairs=3"):
        rasterize_tiled(random_splats(), front_camera(), any_path(max_pairs=3))
    with pytest.raises(InputError, match="windows of 0 px"):
        rasterize_tiled(random_splats(), front_camera(), any_path(), pixels=0)


def test_non_finite_splats_are_counted_once_and_nothing_learns() -> None:
    splats = leaves(random_splats())
    with torch.no_grad():
        splats.means[3] = torch.nan
    tiled = rasterize_tiled(splats, front_camera(), any_path(), pixels=500)
    assert tiled.dropped == 1
    assert not tiled.image.requires_grad


@pytest.mark.parametrize(("width", "height", "pixels", "unit"), [(70, 52, 500, 16), (16, 16, 1, 16), (100, 7, 900, 8)])
def test_windows_cover_the_raster_once(width: int, height: int, pixels: int, unit: int) -> None:
    count = torch.zeros(height, width)
    for window in covering(width, height, pixels, unit):
        assert window.width * window.height <= max(pixels, unit * unit)
        assert window.left % unit == window.top % unit == 0
        count[window.pixels] += 1
    assert bool((count == 1).all())


@pytest.mark.parametrize(("width", "height"), [(33, 16), (17, 40), (48, 48), (16, 100)])
def test_halves_are_cut_at_whole_tiles(width: int, height: int) -> None:
    count = torch.zeros(height + 32, width + 32)
    window = Window(left=32, top=16, width=width, height=height)
    for half in window.halves(16):
        assert half.left % 16 == half.top % 16 == 0
        assert min(half.width, half.height) > 0
        count[half.pixels] += 1
    assert torch.equal(count[window.pixels], torch.ones(height, width))
    assert float(count.sum()) == width * height


def test_a_window_of_a_64_fold_zoom_is_that_of_the_zoomed_render_and_of_the_truth() -> None:
    splats, rules = random_splats(80), any_path(cull="tight")
    zoomed = front_camera(20, 15).zoom(64)  # 1280 x 960
    window = (610, 400, 64, 48)
    part = rasterize_tiled(splats, zoomed.crop(*window), rules, pixels=1000)
    whole = rasterize_tiled(splats, zoomed, rules, pixels=1 << 18)
    assert torch.equal(part.image, whole.image[:, 400:448, 610:674])
    truth = render_reference(changed(splats, dtype=torch.float64), zoomed.crop(*window), rules)[0]
    assert truth.std() > 0.05
    assert (part.image - truth).abs().max() <= 1e-5


LARGE = """
import json, resource, sys, torch
from raster_scenes import front_camera, random_splats
from gsx.core.rasterizer import RasterSettings, rasterize_tiled
peak = lambda: resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024) / 1e6
splats, before = random_splats(300, size=0.02), peak()
tiled = rasterize_tiled(splats, front_camera(7680, 4320), any_path(), pixels=1 << 19)
finite = all(bool(torch.isfinite(row).all()) for row in tiled.image.flatten(0, 1).split(1000))
print(json.dumps({"before": before, "peak": peak(), "size": list(tiled.image.shape), "finite": finite,
    "covered": float(tiled.alpha.mean()), "pieces": tiled.windows}))
"""


@pytest.mark.slow
def test_an_8k_picture_needs_little_more_memory_than_itself() -> None:
    found = run_script(LARGE)
    result = 4 * 4 * 7680 * 4320 / 1e6  # image and coverage, MB
    assert found["size"] == [3, 4320, 7680]
    assert found["finite"]
    assert found["covered"] > 0.05
    assert found["peak"] - found["before"] < result + 150  # 71 measured
