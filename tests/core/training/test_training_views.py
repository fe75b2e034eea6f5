"""Coarse to fine: what training sees of its views at each step."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from module_contexts import build_module, coarse_modules
from small_scene import Grey, published_options, small_context, small_gs3d, small_scene, spread
from tiny import same_ending, tiny_run, tiny_settings, trained
from torch import Tensor

from gsx.backbones.adaptive import Adaptive, AdaptiveOptions
from gsx.backbones.capacity import EventSteps
from gsx.builtin import plugins
from gsx.core.data.camera import Camera, look_at
from gsx.core.data.reduction import Reduction
from gsx.core.data.scene import View
from gsx.core.errors import ConfigError
from gsx.core.plugins import hookimpl
from gsx.core.training.run import Run, StepResult
from gsx.core.training.training_views import TrainingViews
from gsx.experiments.runs.execute import execute
from gsx.experiments.runs.open import open_run, start
from gsx.modules.coarse_to_fine import CoarseToFine, CoarseToFineOptions
from gsx.modules.derived_views import reduce_view


class Noise:
    """Other pixels everywhere; those of the left column do not count."""

    def image(self, camera: Camera) -> Tensor:
        generator = torch.Generator().manual_seed(3)
        return torch.randint(0, 256, (3, camera.height, camera.width), generator=generator).to(torch.uint8)

    def max_zoom(self, camera: Camera) -> float:
        return 1.0

    def counted(self, camera: Camera) -> Tensor:
        counted = torch.ones(camera.height, camera.width, dtype=torch.bool)
        counted[:, 0] = False
        return counted


def noisy(width: int = 131, height: int = 99) -> View:
    camera = look_at([1.0, -4, 1], [0, 0, 0], fov_x=0.9, width=width, height=height)
    return View("noise", replace(camera, cx=40.3, cy=51.9), Noise())


def test_halved_in_equal_times() -> None:
    scene = small_scene(spread(1))
    module = build_module(CoarseToFine, CoarseToFineOptions(factor=4, until=0.04), scene=scene)
    assert [module.factor_at(step) for step in (0, 1, 20, 21, 40, 41, 1000)] == [4, 4, 4, 2, 2, 1, 1]
    steps = TrainingViews(scene=scene, modules={"coarse_to_fine": module})
    assert [step for step in range(60) if steps.changes_after(step)] == [20, 40]
    plain = build_module(CoarseToFine, CoarseToFineOptions(until=0.04), scene=scene)
    assert [plain.factor_at(step) for step in (1, 5)] == [1, 1]


def test_a_coarser_view_shows_the_same_with_every_pixel_a_mean_of_a_block() -> None:
    view = noisy()
    half = reduce_view(view, Reduction(), 2)
    assert half.camera.size == (65, 49)
    fine = view.image().double()[:, :98, :130]
    blocks = (fine[:, ::2, ::2] + fine[:, 1::2, ::2] + fine[:, ::2, 1::2] + fine[:, 1::2, 1::2]) / 4
    assert (half.image() - blocks).abs().max() <= 0.501 / 255
    points = spread(20)
    assert torch.allclose(half.camera.project(points)[0], view.camera.project(points)[0] / 2, atol=1e-4)
    assert torch.equal(half.camera.project(points)[1], view.camera.project(points)[1])
    counted = half.counted()
    assert counted is not None
    assert not counted[:, 0].any()
    assert counted[:, 1:].all()


def test_views_that_would_become_too_small_stay_as_they_are() -> None:
    view = noisy(width=131, height=63)
    assert reduce_view(view, Reduction(), 2) is view
    assert reduce_view(noisy(height=64), Reduction(), 2) is not None


def test_windows_that_are_judged_by_lie_at_the_same_place_of_coarser_views() -> None:
    cameras = [look_at([0.1 * i, -4, 1], [0, 0, 0], fov_x=0.9, width=128, height=96) for i in range(4)]
    scene = replace(small_scene(spread(1)), train=[View(f"v{i}", c, Grey()) for i, c in enumerate(cameras)])
    found = []
    for coarse in (1, 2):
        context = small_context(scene, modules=coarse_modules(scene, coarse, 50 if coarse > 1 else 0))
        judge = Adaptive(AdaptiveOptions(views=3), context, EventSteps(0, 100, 10), 0)
        found.append({view.name: window for view, window in judge.windows(20).items()})
    assert found[0].keys() == found[1].keys()
    for name, window in found[0].items():
        half = found[1][name]
        assert (half.width, half.height) == (window.width // 2, window.height // 2)
        assert abs(half.left - window.left / 2) <= 1
        assert abs(half.top - window.top / 2) <= 1


def test_the_3d_filter_is_that_of_what_is_seen_and_the_picture_goes_on_as_it_was() -> None:
    scene = small_scene(spread(40))
    wide = [View(view.name, view.camera.zoom(8), Grey()) for view in scene.train]
    scene = replace(scene, train=wide)
    options = replace(published_options(), filter="mip")
    one = small_gs3d(scene, options=options)
    two = small_gs3d(scene, options=options, iterations=100, modules=coarse_modules(scene, 2, 60))
    assert torch.allclose(two.table["filter"], 2 * one.table["filter"])
    camera = scene.train[0].camera
    before, sizes = two.draw(camera, 60).splats, two.table["filter"].clone()
    two.densify_and_prune(60)
    after = two.draw(camera, 61).splats
    assert torch.allclose(2 * two.table["filter"], sizes)
    assert torch.allclose(after.scales, before.scales, rtol=1e-5)


class Sizes:
    """Sizes of what the steps compare."""

    def __init__(self) -> None:
        self.seen: list[tuple[int, ...]] = []

    @hookimpl
    def gsx_step_finished(self, run: Run, step: StepResult) -> None:
        assert step.target.shape == step.rendering.image.shape
        self.seen.append(tuple(step.target.shape[1:]))


WORDS = [
    "scene.width=128",
    "scene.height=96",
    "iterations=24",
    "training.coarse_to_fine.factor=2",
    "training.coarse_to_fine.until=0.5",
]


def test_a_run_sees_coarse_pictures_first_and_goes_on_bit_for_bit(tmp_path: Path) -> None:
    adaptive = [*WORDS, "backbone.capacity=adaptive", "backbone.density.start=100", "backbone.density.every=2500"]
    sizes, loaded = Sizes(), plugins()
    settings = tiny_settings(tmp_path / "whole", *adaptive)
    run = start(settings, loaded)
    with loaded.listening([sizes]):
        execute(run, settings, loaded)
    assert sizes.seen == [(48, 64)] * 12 + [(96, 128)] * 12
    tiny_run(tmp_path / "parts", adaptive, stop_after=7)
    parts, parts_settings = open_run(tmp_path / "parts", loaded, training=True)
    execute(parts, parts_settings, loaded)
    same_ending(tmp_path / "whole", tmp_path / "parts")


def test_of_1_nothing_changes(tmp_path: Path) -> None:
    factor = ("training.coarse_to_fine.factor=1", "training.coarse_to_fine.until=0.5")
    plain, one = (trained(tmp_path, 8, "iterations=8", *more) for more in ((), factor))
    assert torch.equal(plain.backbone.table["means"], one.backbone.table["means"])


def test_what_is_no_power_of_two_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"training.coarse_to_fine.factor is 3; set a power of two, for example 2"):
        tiny_settings(tmp_path, "training.coarse_to_fine.factor=3")
