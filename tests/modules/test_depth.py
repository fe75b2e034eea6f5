"""Depth supervision: losses by hand and by finite differences, masks, what counts as measured, whole runs."""

import json
import math
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from module_contexts import build_module
from raster_scenes import SMOOTH, front_camera, leaves, soft_splats
from refusals import refused
from small_scene import Grey, small_gs3d, small_scene, spread
from tiny import LIGHT, final_tensors, same_ending, stopped_at, tiny_run, tiny_settings
from torch import Tensor

from gsx.builtin import plugins
from gsx.core.data.camera import Camera
from gsx.core.data.scene import Depths, Scene
from gsx.core.errors import ConfigError, InputError
from gsx.core.gaussians.splats import Splats
from gsx.core.rasterizer import RasterSettings, rasterize
from gsx.core.training.parameter_table import zero_grad
from gsx.core.training.render import render_for_training
from gsx.core.training.run import Run
from gsx.core.training.trainer import backward
from gsx.experiments.runs.open import start
from gsx.modules.depth import Depth, DepthOptions, add_depth_points, mean_errors, spread_errors

RUN = SimpleNamespace(device=torch.device("cpu"), step=0, backbone=small_gs3d(small_scene(spread(5))))
"""A run without a sky."""


def half_and_quarter() -> tuple[Tensor, Tensor, Tensor]:
    """A ray with half of its weight at 1 and a quarter at 2: its coverage, values and squares."""
    return torch.tensor([0.75]), torch.tensor([0.5 + 0.5]), torch.tensor([0.5 + 1.0])


def test_errors_of_a_ray_by_hand() -> None:
    coverage, first, second = half_and_quarter()
    target = torch.tensor([1.0])
    torch.testing.assert_close(spread_errors(first, second, target), torch.tensor([math.sqrt(0.25 * 1 + 0.25 * 1)]))
    torch.testing.assert_close(mean_errors(coverage, first, target), torch.tensor([1 / 0.75 - 1]))
    assert float(mean_errors(torch.zeros(1), torch.zeros(1), target)) == 1


def supervised(options: DepthOptions, depths: Depths, camera: Camera) -> Depth:
    """The module with depths of a view."""
    scene = small_scene(spread(5))
    module = build_module(Depth, options, scene=replace(scene, train=[replace(scene.train[0], camera=camera)]))
    module.measured = {scene.train[0].name: depths}
    return module


def loss_of(module: Depth, splats: Splats, camera: Camera, rules: RasterSettings, step: int = 1) -> Tensor:
    """The loss of a render of splats by a view's camera, at another raster."""
    view = module.context.scene.train[0]
    channels = module.channels(RUN, splats, camera, step)
    assert channels is not None
    blended = rasterize(replace(splats, colours=channels), camera, rules).image
    value = module.loss(RUN, view, step, camera, blended, view.counted())
    assert value is not None
    return value


def at_centre(z: float, weight: float = 1.0) -> Depths:
    """A depth at the middle of a picture of 24 x 16."""
    return Depths(pixels=torch.tensor([[12.0, 8.0]]), z=torch.tensor([z]), weights=torch.tensor([weight]))


@pytest.mark.parametrize(("domain", "rays"), [("disparity", "whole"), ("depth", "whole"), ("depth", "mean")])
def test_the_loss_of_a_wide_splat_is_that_worked_by_hand(domain: str, rays: str) -> None:
    """Half opaque at depth 2, measured 4: errors of 1 / z relative to 1 / 4, of z relative to 4. Weights go by step."""
    camera = front_camera(24, 16)
    wall = Splats(
        means=(camera.centre + 2 * camera.rotation[2]).float()[None],
        scales=torch.full((1, 3), 1e5),
        quats=torch.tensor([[1.0, 0, 0, 0]]),
        log_opacities=torch.full((1,), math.log(0.5)),
        colours=torch.zeros(1, 3),
    )
    module = supervised(DepthOptions(domain=domain, rays=rays, weight=0.8, weight_final=0.2), at_centre(4.0), camera)
    squares = {"disparity": 0.5 * (1 / 2 - 1 / 4) ** 2 + 0.5 / 16, "depth": 0.5 * (2 - 4) ** 2 + 0.5 * 16}
    error = 2 / 4 if rays == "mean" else math.sqrt(squares[domain]) * (4 if domain == "disparity" else 1 / 4)
    for step, weight in ((0, 0.8), (500, 0.4), (1000, 0.2)):
        for raster in (camera, camera.zoom(2)):
            assert float(loss_of(module, wall, raster, RasterSettings(), step)) == pytest.approx(
                weight * error, rel=1e-4
            )


@pytest.mark.parametrize("domain", ["disparity", "depth"])
@pytest.mark.parametrize("rays", ["whole", "mean"])
def test_gradients_are_finite_differences(domain: str, rays: str) -> None:
    camera, splats = front_camera(20, 16), soft_splats(count=3)
    pixels = torch.tensor([[9.5, 8.5], [4.2, 6.7], [13.0, 10.0]])
    depths = Depths(pixels=pixels, z=torch.tensor([3.0, 3.6, 5.1]).double(), weights=torch.tensor([1.0, 0.5, 0.7]))
    module = supervised(DepthOptions(domain=domain, rays=rays), depths, camera)
    module.measured = {"view0": replace(depths, pixels=pixels.double(), weights=depths.weights.double())}
    live = leaves(splats)
    loss_of(module, live, camera, SMOOTH).backward()
    for name in ("means", "log_opacities", "scales"):
        values, found, step = getattr(splats, name), getattr(live, name).grad, 1e-6
        for place in range(values.numel()):
            ends = []
            for sign in (1, -1):
                moved = values.clone()
                moved.view(-1)[place] += sign * step
                ends.append(float(loss_of(module, replace(splats, **{name: moved}), camera, SMOOTH)))
            assert float(found.view(-1)[place]) == pytest.approx((ends[0] - ends[1]) / (2 * step), rel=1e-4, abs=1e-8)


@dataclass
class Masked(Grey):
    """The right half of the photo does not count."""

    def counted(self, camera: Camera) -> Tensor:
        return (torch.arange(camera.width) < camera.width // 2).expand(camera.height, camera.width)


def test_masked_places_do_not_count() -> None:
    camera, splats = front_camera(24, 16), soft_splats(count=3)
    left, right = torch.tensor([[5.0, 8.0]]), torch.tensor([[18.0, 8.0]])

    def loss(pixels: Tensor) -> Tensor:
        count = len(pixels)
        depths = Depths(
            pixels=pixels.double(), z=torch.full((count,), 4.0).double(), weights=torch.ones(count).double()
        )
        module = supervised(DepthOptions(), depths, camera)
        scene = module.context.scene
        masked = replace(scene, train=[replace(scene.train[0], source=Masked())])
        module.context = replace(module.context, scene=masked)
        return loss_of(module, splats, camera, SMOOTH)

    assert float(loss(right)) == 0
    assert float(loss(torch.cat([left, right]))) == pytest.approx(float(loss(left)), rel=1e-9)


def half_known() -> Tensor:
    """A map of depth 3 in the upper half, unknown below."""
    return torch.tensor([3.0, 0.0]).repeat_interleave(8)[:, None].repeat(1, 24)


def mapped_scene() -> Scene:
    """View 0 has a map, view 1 observes points, view 2 both, view 3 nothing, and view 4 a map that does not fit."""
    scene = small_scene(spread(20), views=5)
    camera = front_camera(24, 16)
    sparse = Depths(pixels=torch.rand(7, 2), z=torch.ones(7), weights=torch.ones(7))
    maps = {0: half_known, 2: half_known, 4: lambda: None}
    views = [
        replace(view, camera=camera, sparse=sparse if i in (1, 2) else None, depth_map=maps.get(i))
        for i, view in enumerate(scene.train)
    ]
    return replace(scene, train=views)


@pytest.mark.parametrize(
    ("source", "places"), [("both", {0: 192, 1: 7, 2: 192}), ("maps", {0: 192, 2: 192}), ("points", {1: 7, 2: 7})]
)
def test_maps_come_before_points_and_unknown_pixels_have_no_place(source: str, places: dict[int, int]) -> None:
    module = build_module(Depth, DepthOptions(when="always", source=source), scene=mapped_scene())
    metrics = module.before_step(RUN)
    assert module.measured is not None
    assert {name: len(one.z) for name, one in module.measured.items()} == {f"view{i}": n for i, n in places.items()}
    assert metrics["depth_places"] == sum(places.values())
    assert module.before_step(RUN) == {}
    if source != "points":
        first = module.measured["view0"]
        assert float(first.pixels[:, 1].max()) == 7.5
        assert set(first.z.tolist()) == {3.0}


def test_starting_points_lie_at_the_depths_of_maps() -> None:
    scene, generator = mapped_scene(), torch.Generator().manual_seed(0)
    more = add_depth_points(scene, 50, generator)
    added = more.points.positions[20:]
    assert len(added) == 20  # a tenth for each of five views, of which two have usable maps
    pixels, z = scene.train[0].camera.project(added)
    torch.testing.assert_close(z, torch.full((20,), 3.0))
    assert float(pixels[:, 1].max()) < 8
    assert torch.equal(more.points.positions[:20], scene.points.positions)
    assert "20 points from depth maps of 2 of 5 training views are added to 20" in more.notes[-1]
    assert add_depth_points(scene, 0, generator) is scene
    unusable = replace(scene, train=[scene.train[4]])
    refused("none of the 1 depth maps of 'small' fits .*scene.depth_values", add_depth_points, unusable, 5, generator)


def test_without_depths_always_is_an_error_and_auto_is_off() -> None:
    plain = small_scene(spread(5))
    with pytest.raises(InputError, match=r"training\.depth\.when=always, but no training view of 'small'"):
        DepthOptions(when="always").prepare_scene(plain, torch.Generator())
    assert DepthOptions(when="auto").prepare_scene(plain, torch.Generator()) is plain
    module = build_module(Depth, DepthOptions(when="auto"), scene=plain)
    module.before_step(RUN)
    assert module.channels(RUN, soft_splats(), front_camera(), 1) is None
    with pytest.raises(ValueError, match=r"training.depth.domain is 'z'; choose from disparity, depth"):
        DepthOptions(domain="z")


WORDS = (*LIGHT, "iterations=12", "scene.depth_maps=true", "training.log_every=1", "rasterizer=eager")
ON = (*WORDS, "training.depth.when=always", "training.depth.weight=1", "training.depth.weight_final=0.5")


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> tuple[Run, Path]:
    folder = tmp_path_factory.mktemp("whole")
    return tiny_run(folder, ON), folder


def test_a_run_learns_depth_and_says_so(whole: tuple[Run, Path], tmp_path: Path) -> None:
    plain = tiny_run(tmp_path, WORDS)
    assert plain.complete
    errors = [
        json.loads((folder / "evaluation.json").read_text())["depth"]["relative"] for folder in (whole[1], tmp_path)
    ]
    assert errors[0] < 0.95 * errors[1]
    lines = [json.loads(line) for line in (whole[1] / "metrics.jsonl").read_text().splitlines()]
    assert lines[0]["depth_maps"] == 3
    assert all(line["loss"] == pytest.approx(sum(line["terms"].values()), rel=1e-5) for line in lines)
    assert all(line["terms"]["depth"] > 0 for line in lines)
    measured = json.loads((whole[1] / "evaluation.json").read_text())["measured_depth"]
    assert measured == {"maps": 3, "points": 0, "places": lines[0]["depth_places"]}


def test_resuming_equals_never_having_stopped(whole: tuple[Run, Path], tmp_path: Path) -> None:
    stopped_at(tmp_path, ON, 5)
    same_ending(whole[1], tmp_path)


def test_without_measured_depths_everything_is_bit_for_bit_as_without_the_module(tmp_path: Path) -> None:
    """`auto` without maps, and maps without the module."""
    plain = ("iterations=6", *WORDS[:-3], *WORDS[-2:])
    runs = {"off": plain, "auto": (*plain, "training.depth.when=auto"), "maps": (*plain, "scene.depth_maps=true")}
    for name, more in runs.items():
        tiny_run(tmp_path / name, more)
    expected, *others = (final_tensors(tmp_path / name) for name in runs)
    assert all(torch.equal(expected[name], found[name]) for found in others for name in expected)
    lines = [(tmp_path / name / "metrics.jsonl").read_text() for name in ("off", "maps")]
    assert "terms" not in lines[0]
    assert "depth" not in lines[1]


def test_views_with_and_without_depth_share_a_step(tmp_path: Path) -> None:
    """A batch's gradient is the mean of its views', of which one has no map."""
    settings = tiny_settings(tmp_path, *ON, "training.batch=2")
    run = start(settings, plugins())
    module = run.modules["depth"]
    module.before_step(run)
    assert isinstance(module, Depth)
    known = dict(module.measured or {})
    first, second = run.sampler.take()
    run.sampler.put_back()
    gradients = list[Tensor]()
    for left in ({first, second}, {first}, {second}):
        module.measured = {name: one for index, (name, one) in enumerate(known.items()) if index in left}
        result = backward(run)
        run.sampler.put_back()
        gradients.append(run.backbone.table["means"].grad.clone())
        zero_grad(run.backbone.table)
        assert result.terms["depth"] > 0
    module.measured = {}
    backward(run)
    without = run.backbone.table["means"].grad
    torch.testing.assert_close(gradients[0] - without, gradients[1] + gradients[2] - 2 * without, rtol=1e-4, atol=1e-9)


def test_modules_get_their_own_channels_blended_and_the_picture_stays(tmp_path: Path) -> None:
    """With supersampling: channels come at the raster of the render."""
    settings = tiny_settings(tmp_path, *ON, "training.supersampling.factor=2")
    run = start(settings, plugins())
    module, camera = run.modules["depth"], run.scene.train[0].camera
    module.before_step(run)
    plain, with_them = (render_for_training(run, camera, 1, run.background, channels=on) for on in (False, True))
    torch.testing.assert_close(with_them[1].image, plain[1].image, rtol=0, atol=1e-6)
    assert plain[3] == {}
    drawn, _, (finer, _), blended = with_them
    values = module.channels(run, drawn.splats, finer, 1)
    alone = rasterize(replace(drawn.splats, colours=values), finer, run.raster).image
    torch.testing.assert_close(blended["depth"], alone, rtol=0, atol=1e-6)
    assert blended["depth"].shape == (2, 72, 96)


def test_options_are_refused_with_their_key(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"training\.depth\.when is 'on'"):
        tiny_settings(tmp_path, "training.depth.when=on")
