"""Gaussians behind the scene: where they come from, what density control leaves alone, what a run keeps of them."""

import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from small_scene import published_options, small_gs3d, small_scene, spread
from tiny import LIGHT, same_ending, tiny_run
from torch import Tensor

from gsx.backbones import sky
from gsx.backbones.gs3d import GS3D
from gsx.backbones.sky import Sky, not_sky, sky_behind
from gsx.builtin import plugins
from gsx.core.data.scene import PointCloud, Scene
from gsx.core.errors import ConfigError
from gsx.core.gaussians.splats import Splats
from gsx.core.training.importance import Probe
from gsx.core.training.parameter_table import append_rows, detached_rows, keep_rows
from gsx.core.training.render import render, splats_for
from gsx.experiments.evaluation.evaluated_renders import depth_and_coverage
from gsx.experiments.runs.compose import compose
from gsx.experiments.runs.execute import execute
from gsx.experiments.runs.open import open_run

FAR = 200.0
LIGHT_WITH_SKY = (*LIGHT, "scene.train_views=4", "scene.points=300")
"""Of fewer views no two have sky in the same direction; a scene of fewer points is less wide than its sky."""


@pytest.fixture
def two_behind(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every scene has two points of sky in 3 % of its pixels."""

    def found(scene: Scene) -> Sky:
        positions = torch.tensor([[0.0, FAR, 10.0], [10.0, FAR, 0.0]])
        points = PointCloud(positions, torch.tensor([[200, 210, 220]] * 2, dtype=torch.uint8))
        return Sky(points=points, spacing=8.0, share=0.03)

    monkeypatch.setattr(sky, "sky_of", found)


def with_sky(count: int = 3, capacity: str = "published") -> GS3D:
    """So many Gaussians, all of them to be cloned or split at an event, and two far away."""
    options = replace(published_options(), sky="auto", capacity=capacity)
    backbone = small_gs3d(small_scene(spread(count)), options=options)
    table, rows = backbone.table, len(backbone.table)
    table.statistics |= {"gradient": torch.ones(rows), "count": torch.ones(rows)}
    if "absolute" in table.statistics:
        table.statistics["absolute"] = torch.ones(rows)
    return backbone


def far(backbone: GS3D) -> Tensor:
    return backbone.table["means"].detach()[:, 1] == FAR


@pytest.mark.usefixtures("two_behind")
def test_they_follow_the_scene_and_hide_what_is_behind_them_from_the_start() -> None:
    backbone = with_sky()
    assert backbone.table["sky"].tolist() == [0, 0, 0, 1, 1]
    assert torch.equal(~not_sky(backbone.table), far(backbone))
    opacities = backbone.table["opacity_logits"].detach().sigmoid()
    torch.testing.assert_close(opacities, torch.tensor([0.1, 0.1, 0.1, 0.98, 0.98]))
    colours = 0.5 + backbone.table["sh_dc"].detach()[3:, 0] * 0.28209479177387814
    torch.testing.assert_close(colours, torch.tensor([[200.0, 210, 220]] * 2) / 255)
    assert backbone.plan()["sky"] == {"gaussians": 2}


@pytest.mark.parametrize(("spacing", "size"), [(20.0, 20.0), (12.0, 200**0.5), (8.0, 12.0)])
def test_sizes_are_distances_to_neighbours_between_one_spacing_and_one_and_a_half(
    spacing: float, size: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two directions whose points are 14.1 apart."""
    points = PointCloud(torch.tensor([[0.0, FAR, 10.0], [10.0, FAR, 0.0]]), torch.zeros(2, 3, dtype=torch.uint8))
    monkeypatch.setattr(sky, "sky_of", lambda scene: Sky(points=points, spacing=spacing, share=0.03))
    table = with_sky().table
    torch.testing.assert_close(table["log_scales"].detach()[3:].exp(), torch.full((2, 3), size))


@pytest.mark.usefixtures("two_behind")
def test_density_control_grows_prunes_and_resets_the_scene_alone() -> None:
    backbone = with_sky()
    done = backbone.densify_and_prune(3000)
    assert (done["cloned"] + done["split"], done["opacity_resets"]) == (3, 1)
    assert int(far(backbone).sum()) == 2
    assert torch.equal(~not_sky(backbone.table), far(backbone))
    opacities = backbone.table["opacity_logits"].detach().sigmoid()
    torch.testing.assert_close(opacities[far(backbone)], torch.full((2,), 0.98))
    assert float(opacities[~far(backbone)].max()) <= 0.01 + 1e-6
    with torch.no_grad():
        backbone.table["log_scales"].fill_(math.log(5.0))  # larger than a tenth of the extent
    backbone.densify_and_prune(3100)
    assert far(backbone).all()


@pytest.mark.usefixtures("two_behind")
def test_adaptive_growth_leaves_the_sky_alone_though_it_draws_the_largest_errors(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(Probe, "row_errors", lambda probe, views: 1.0 + torch.arange(len(probe.model.table)))
    backbone = with_sky(capacity="adaptive")
    done = backbone.control.add(backbone, 600)
    assert done["split"] == 1
    assert int(far(backbone).sum()) == 2


@pytest.mark.usefixtures("two_behind")
def test_the_sky_is_no_empty_space(monkeypatch: pytest.MonkeyPatch) -> None:
    everywhere = torch.tensor([True, False, False, True, True])
    monkeypatch.setattr("gsx.backbones.adaptive.in_empty_space", lambda *_: everywhere)
    backbone = with_sky(capacity="adaptive")
    assert backbone.densify_and_prune(1) == {"cleared": 1}
    assert far(backbone).tolist() == [False, False, True, True]


@pytest.mark.usefixtures("two_behind")
def test_auto_asks_for_a_hundredth_of_the_pixels(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = small_scene(spread(3))
    assert [len(sky_behind(scene, when).points) for when in ("auto", "always")] == [2, 2]
    monkeypatch.setattr(sky, "OPEN", 0.04)
    assert [len(sky_behind(scene, when).points) for when in ("auto", "always")] == [0, 2]


def test_rows_of_the_scene_are_all_where_there_is_no_sky() -> None:
    backbone = small_gs3d(small_scene(spread(3)))
    assert "sky" not in backbone.table.columns
    assert not_sky(backbone.table).tolist() == [True] * 3


@pytest.mark.usefixtures("two_behind")
def test_rows_keep_what_they_are_when_others_come_and_go() -> None:
    backbone = with_sky()
    append_rows(backbone.table, {name: value[:1] for name, value in detached_rows(backbone.table).items()})
    keep_rows(backbone.table, torch.tensor([False, True, True, True, True, True]))
    assert torch.equal(~not_sky(backbone.table), far(backbone))


def test_what_cannot_have_a_sky_is_told_so() -> None:
    with pytest.raises(ConfigError, match=r"backbone\.sky is 'yes'; choose from never, auto, always"):
        compose(["backbone.sky=yes"], plugins())
    levels = ["backbone=octree_gs3d", "backbone.densification=clone_split", "backbone.sky=always"]
    with pytest.raises(ConfigError, match=r"backbone\.sky"):
        compose(levels, plugins())


@pytest.mark.usefixtures("two_behind")
def test_what_lies_far_away_in_a_splat_file_is_sky_again() -> None:
    gaussians = with_sky().explicit(None, 1)
    backbone = small_gs3d(small_scene(spread(5)), options=replace(published_options(), sky="auto"))
    backbone.start_from(gaussians)
    assert not_sky(backbone.table).tolist() == [True, True, True, False, False]
    plain = small_gs3d(small_scene(spread(5)))
    plain.start_from(gaussians)
    assert "sky" not in plain.table.columns


def test_without_need_training_is_bit_for_bit_that_without_a_sky(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sky, "OPEN", 1.0)
    words = [*LIGHT_WITH_SKY, "iterations=14"]
    plain = tiny_run(tmp_path / "plain", words, stop_after=5)
    asked = tiny_run(tmp_path / "asked", [*words, "backbone.sky=auto"], stop_after=5)
    assert not_sky(asked.backbone.table).all()
    assert len(sky.sky_of(asked.scene).points)
    for name, value in plain.backbone.table.parameters.items():
        assert torch.equal(value, asked.backbone.table[name]), name


def test_a_run_with_a_sky_resumes_as_if_never_stopped(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    words = [*LIGHT_WITH_SKY, "backbone.sky=always", "iterations=18", "backbone.rates.shortened=0.4"]
    whole = tiny_run(tmp_path / "whole", words, evaluated=False)
    tiny_run(tmp_path / "stopped", words, stop_after=5)
    with monkeypatch.context() as looking:
        looking.setattr(sky, "sky_of", lambda scene: pytest.fail("a checkpoint tells what is sky"))
        run, settings = open_run(tmp_path / "stopped", plugins(), training=True)
    execute(run, settings, plugins())
    same_ending(tmp_path / "whole", tmp_path / "stopped")
    above = ~not_sky(whole.backbone.table)
    assert 0 < int(above.sum()) < len(above)
    distances = whole.backbone.table["means"].detach().norm(dim=1)
    assert float(distances[above].min()) > 100 * whole.scene.extent
    assert float(distances[~above].max()) < 100 * whole.scene.extent


def test_depth_is_that_of_the_scene_alone(tmp_path: Path) -> None:
    """What is behind everything changes no weight before it: depth and alpha are those of a picture without it."""
    run = tiny_run(tmp_path, [*LIGHT_WITH_SKY, "backbone.sky=always", "iterations=12"], stop_after=1)
    camera = run.scene.test[0].camera
    splats, near = splats_for(run, camera), not_sky(run.backbone.table)
    assert not near.all()
    shown = render(run, camera, depth=True, supersample=1)
    alone = render(
        run, camera, splats=Splats(**{name: value[near] for name, value in vars(splats).items()}), depth=True
    )
    assert float(alone.alpha.max()) > 0.5
    torch.testing.assert_close(shown.alpha, alone.alpha, atol=1e-5, rtol=0)
    torch.testing.assert_close(shown.depth, alone.depth, atol=1e-4, rtol=1e-4)
    torch.testing.assert_close(shown.image, render(run, camera, supersample=1).image, atol=1e-5, rtol=0)
    summed, coverage = depth_and_coverage(run, camera, 1 << 20)
    torch.testing.assert_close(summed, alone.depth, atol=1e-4, rtol=1e-4)
    torch.testing.assert_close(coverage, alone.alpha, atol=1e-5, rtol=0)
