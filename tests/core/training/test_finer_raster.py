"""Training on finer renders, reduced as photographs were: against torch's own antialiased filter and by hand."""

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from module_contexts import build_module
from raster_scenes import SMOOTH, changed, front_camera, gradients, leaves, soft_splats
from small_scene import published_options, small_gs3d, small_scene, spread
from tiny import tiny_run, tiny_settings, trained
from torch import Tensor
from torch.nn.functional import avg_pool2d, interpolate

from gsx.backbones.density import densification_statistics
from gsx.backbones.mip import absorb
from gsx.builtin import plugins
from gsx.core.data.camera import Camera
from gsx.core.data.reduction import Reduction
from gsx.core.data.resize import display_from_linear, linear_from_display
from gsx.core.data.scene import Scene
from gsx.core.data.window import Window
from gsx.core.errors import ConfigError
from gsx.core.quality.losses import photometric
from gsx.core.rasterizer import RasterSettings, rasterize
from gsx.core.training.finer_raster import finer_raster, render_scale
from gsx.core.training.module import Modules
from gsx.core.training.render import render, render_for_training
from gsx.core.training.run import Run
from gsx.experiments.evaluation.evaluator import Evaluator
from gsx.experiments.runs.execute import execute
from gsx.experiments.runs.open import open_run, start
from gsx.modules.supersampling import Supersampling, SupersamplingOptions

BICUBIC = Reduction(filter="bicubic")


def enlarged_then_reduced(image: Tensor, factor: int) -> Tensor:
    """torch's filter: Keys with a = -0.5, widened, as photographs are reduced by default."""
    size = image.shape[1] // factor, image.shape[2] // factor
    return interpolate(image[None], size=size, mode="bicubic", antialias=True)[0]


@pytest.mark.parametrize(
    ("zoom", "supersample", "times"),
    [(1, 1, 1), (1, 2, 2), (2, 2, 1), (1.5, 2, 2), (4, 2, 1), (0.5, 2, 2), (2, 3, 2), (1, 4, 4)],
)
def test_what_is_finer_itself_needs_less(zoom: float, supersample: int, times: int) -> None:
    views = small_scene(spread(4)).train
    assert render_scale(views[0].camera.zoom(zoom), views, supersample) == times


def fresh(folder: Path, *more: str) -> Run:
    """A run at step 0 on photographs that are said to have been reduced by the bicubic filter."""
    run = start(tiny_settings(folder, "iterations=40", "rasterizer=eager", *more), plugins())
    run.views = replace(run.views, scene=replace(run.scene, reduction=BICUBIC))
    run.views = replace(run.views, scene=run.scene)
    return run


def test_what_is_compared_and_looked_at_is_the_reduced_picture(tmp_path: Path) -> None:
    run = fresh(tmp_path, "training.supersampling.factor=2")
    camera = run.scene.train[0].camera
    drawn, rendering, finer, _ = render_for_training(run, camera, 1, run.background)
    fine = rasterize(drawn.splats, camera.zoom(2), run.raster, background=run.background).image
    assert rendering.screen.size == (96, 72)
    assert finer[0].draws_as(camera.zoom(2))
    assert torch.equal(finer[1], fine)
    assert rendering.image.shape == (3, 36, 48)
    assert (rendering.image - enlarged_then_reduced(fine, 2)).abs().max() <= 1e-5
    shown = render(run, camera)
    assert (shown.image - rendering.image.detach().clamp(0, 1)).abs().max() <= 1e-6
    assert shown.alpha.shape == (36, 48)
    assert torch.equal(render(run, camera.zoom(2)).image, fine.detach().clamp(0, 1))
    finest = rasterize(drawn.splats, camera.zoom(4), run.raster, background=run.background).image.detach()
    assert (render(run, camera, supersample=4).image - enlarged_then_reduced(finest, 4).clamp(0, 1)).abs().max() <= 1e-5


@pytest.mark.parametrize("filter_", ["area", "bicubic", "lanczos"])
def test_a_window_of_the_reduced_picture_is_that_of_its_window(filter_: str) -> None:
    """At corners, where the filter ends with the picture, and inside, where it takes from beyond the window."""
    splats, camera = soft_splats(count=8), front_camera(32, 24)
    reduction, rules = Reduction(filter=filter_), RasterSettings(cull="tight")

    def picture(camera: Camera) -> Tensor:
        raster = finer_raster(camera, reduction, 3)
        return raster.reduced(rasterize(splats, raster.camera, rules).image)

    whole = picture(camera)
    for window in (Window(0, 0, 10, 9), Window(11, 7, 12, 8), Window(20, 14, 12, 10), Window(1, 2, 5, 21)):
        assert (picture(window.of(camera)) - window.cut(whole)).abs().max() <= 1e-12


@pytest.mark.parametrize("window", [None, Window(5, 4, 9, 8)])
def test_gradients_of_the_loss_are_finite_differences(window: Window | None) -> None:
    splats, camera = soft_splats(count=3), front_camera(20, 16)
    camera = window.of(camera) if window else camera
    target = torch.rand(3, camera.height, camera.width, generator=torch.Generator().manual_seed(1)).double()

    def loss(of: Any) -> Tensor:
        raster = finer_raster(camera, BICUBIC, 2)
        return photometric(raster.reduced(rasterize(of, raster.camera, SMOOTH).image), target, 0.2)

    live = leaves(splats)
    loss(live).backward()
    for name, found in gradients(live).items():
        values, step = getattr(splats, name), 1e-6
        ahead, back = values.clone(), values.clone()
        ahead.view(-1)[0] += step
        back.view(-1)[0] -= step
        with torch.no_grad():
            slope = (loss(changed(splats, **{name: ahead})) - loss(changed(splats, **{name: back}))) / (2 * step)
        assert float(found.view(-1)[0]) == pytest.approx(float(slope), rel=2e-4, abs=1e-7), name


def test_light_is_averaged_as_light_and_what_is_too_bright_is_pulled_back() -> None:
    """A white and a black pixel make half of the light; losses have a gradient beyond [0, 1], photographs a clamp."""
    linear = Reduction(light="linear")
    pair = torch.tensor([[[1.0, 0.0], [1.0, 0.0]]]).repeat(3, 1, 1)
    assert float(linear.unclamped(pair, 2)[0]) == pytest.approx(1.055 * 0.5 ** (1 / 2.4) - 0.055, abs=1e-6)
    bright = torch.full((3, 2, 2), 1.2, requires_grad=True)
    low = linear.unclamped(bright, 2)
    assert float(low.detach().max()) == pytest.approx(1.2, abs=1e-5)
    low.sum().backward()
    assert float(bright.grad.min()) > 0.2
    assert float(linear.reduce(bright.detach(), 2).max()) == pytest.approx(1, abs=1e-6)
    grey = torch.linspace(-0.1, 1.3, 57)
    assert (display_from_linear(linear_from_display(grey), limited=False) - grey).abs().max() <= 1e-6
    assert torch.equal(linear_from_display(torch.tensor([-0.1])), torch.tensor([-0.1]) / 12.92)


def test_statistics_of_density_control_are_comparable() -> None:
    """Screen gradients in NDC of the same loss: within a fifth, where pixel by pixel they would be half or double."""
    splats, camera = soft_splats(count=8), front_camera(60, 44)
    target = torch.rand(3, 44, 60, generator=torch.Generator().manual_seed(2)).double()
    target = interpolate(avg_pool2d(target[None], 4), size=(44, 60), mode="bilinear")[0]
    found = []
    for times in (1, 2, 3):
        live = leaves(splats)
        raster = finer_raster(camera, BICUBIC, times)
        rendering = rasterize(live, raster.camera, SMOOTH)
        photometric(raster.reduced(rendering.image), target, 0.2).backward()
        found.append(densification_statistics(rendering.screen)["gradient"])
    for finer in found[1:]:
        assert (finer / found[0] - 1).abs().max() < 0.2


def supersampling(scene: Scene, factor: int, start: float, iterations: int = 1000) -> Modules:
    """Finer renders from a share of the steps on."""
    options = SupersamplingOptions(factor=factor, start=start)
    return {"supersampling": build_module(Supersampling, options, iterations=iterations, scene=scene)}


def test_the_3d_filter_is_that_of_finer_cameras_and_the_zoomed_rule_that_of_photographs() -> None:
    scene = small_scene(spread(30))
    for name in ("mip", "resampled"):
        options = replace(published_options(), filter=name)
        one = small_gs3d(scene, options=options)
        two = small_gs3d(scene, options=options, modules=supersampling(scene, 2, 0.0))
        assert one.raster == two.raster
        if name == "mip":
            assert torch.allclose(2 * two.table["filter"], one.table["filter"])


def test_pictures_go_on_as_they_were_where_renders_become_finer() -> None:
    """Hand-worked: s 0.01 and a filter of 0.02 that becomes 0.01 make s 0.02 and an eighth of the opacity; and a model
    halfway through draws the same Gaussians before and after."""
    table = small_gs3d(small_scene(spread(3)), options=replace(published_options(), filter="mip")).table
    with torch.no_grad():
        table["log_scales"].fill_(math.log(0.01))
        table["opacity_logits"].fill_(math.log(0.4 / 0.6))
    absorb(table, torch.full((3,), 0.02), torch.full((3,), 0.01))
    assert torch.allclose(table["log_scales"].exp(), torch.tensor(0.02))
    assert torch.allclose(table["opacity_logits"].sigmoid(), torch.tensor(0.05), rtol=1e-4)
    scene, options = small_scene(spread(40)), replace(published_options(), filter="mip")
    model = small_gs3d(scene, options=options, iterations=100, modules=supersampling(scene, 2, 0.6, iterations=100))
    camera = scene.train[0].camera
    before, sizes = model.draw(camera, 60).splats, model.table["filter"].clone()
    model.densify_and_prune(60)
    after = model.draw(camera, 61).splats
    assert torch.allclose(2 * model.table["filter"], sizes)
    assert torch.allclose(after.scales, before.scales, rtol=1e-5)
    assert torch.allclose(after.log_opacities, before.log_opacities, atol=1e-4)


def test_one_is_the_published_loop_bit_for_bit_and_two_is_another_run(tmp_path: Path) -> None:
    words = ("iterations=30", "rasterizer=eager", "backbone=mip_splatting")
    runs = {k: trained(tmp_path, 30, *words, f"training.supersampling.factor={k}") for k in (1, 2)}
    plain = trained(tmp_path, 30, *words)
    assert torch.equal(runs[1].backbone.table["means"], plain.backbone.table["means"])
    assert not torch.equal(runs[2].backbone.table["means"], plain.backbone.table["means"])


def test_it_is_evaluated_as_it_was_trained_unless_told(tmp_path: Path) -> None:
    """And resumed as if it had never stopped."""
    words = ("iterations=24", "rasterizer=eager", "backbone=mip_splatting", "training.supersampling.factor=2")
    whole = tiny_run(tmp_path / "whole", words)
    tiny_run(tmp_path / "cut", words, stop_after=11)
    again, settings = open_run(tmp_path / "cut", plugins(), training=True)
    execute(again, settings, plugins())
    assert torch.equal(again.backbone.table["means"], whole.backbone.table["means"])
    view = whole.scene.test[0]
    for asked, times in ((0, 2), (1, 1), (4, 4)):
        run, settings = open_run(tmp_path / "whole", plugins(), [f"eval.supersample={asked}"])
        picture = Evaluator(run, settings.evaluation).renders.render(view).image
        drawn = run.backbone.draw(view.camera, run.model_step).splats
        fine = rasterize(drawn, view.camera.zoom(times), run.raster, background=run.background).image.detach()
        assert (picture - avg_pool2d(fine, times).clamp(0, 1)).abs().max() <= 1e-5


def test_values_that_mean_nothing_are_refused(tmp_path: Path) -> None:
    for word, message in (
        ("training.supersampling.factor=0", "training.supersampling.factor is 0"),
        ("eval.supersample=-1", "-1"),
    ):
        with pytest.raises(ConfigError, match=message):
            tiny_settings(tmp_path, word)
