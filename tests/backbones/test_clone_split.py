"""Octree-GS on free Gaussians: clone and split across levels, by hand and against loops."""

import json
import math
from dataclasses import replace
from functools import cache
from pathlib import Path

import pytest
import torch
from small_scene import small_scene, spread
from tiny import LIGHT, same_ending, stopped_at, tiny_run
from torch import Tensor

from gsx.backbones.clone_split import (
    LevelDensityOptions,
    VisibleByLevel,
    clones,
    densify_masks,
    relative_sizes,
    small_children,
    starting_points,
)
from gsx.backbones.density import within_room
from gsx.backbones.gs3d import GS3D
from gsx.backbones.levels import Levels, initial_nodes, kept
from gsx.backbones.octree_gs3d import OctreeGS3DOptions, free_gaussians, free_options
from gsx.backbones.visibility import everything, extents
from gsx.builtin import plugins
from gsx.core.data.camera import Camera, look_at
from gsx.core.data.scene import Scene
from gsx.core.errors import ConfigError
from gsx.core.gaussians.splats import splats_of
from gsx.core.rasterizer import RasterSettings, Rendering, rasterize
from gsx.core.training.backbone import Backbone, BackboneContext, DrawnSplats
from gsx.core.training.parameter_table import size_of
from gsx.core.training.training_views import TrainingViews
from gsx.experiments.runs.compose import compose
from gsx.experiments.runs.saved_settings import read_config, write_config
from gsx.formats.ply import read_ply
from gsx.formats.splat_files import write_columns

WORDS = ("backbone=octree_gs3d", "backbone.densification=clone_split")
CONTROL = LevelDensityOptions(update_ratio=0.2, bias_gradient=1.5, bias_step=0.01, shrink=0.6, volume_weight=0.01)


@cache
def options_of(*overrides: str) -> OctreeGS3DOptions:
    return compose([*WORDS, *(f"backbone.{override}" for override in overrides)], plugins()).backbone.options


def seen_from(distance: float) -> Camera:
    return look_at([0.0, -distance, 0.0], [0.0, 0.0, 0.0], fov_x=0.9, width=24, height=16)


def deep_scene(colours: Tensor | None = None, background: float = 0.0) -> Scene:
    """Cameras 8, 4, 2 and 1 units away, so that there is something to see on three levels."""
    scene = small_scene(spread(60), colours, background=background)
    views = [replace(view, camera=seen_from(8.0 / 2**n)) for n, view in enumerate(scene.train)]
    return replace(scene, train=views)


def small_octree(*overrides: str, scene: Scene | None = None, iterations: int = 40000) -> GS3D:
    """Three levels of free Gaussians at step 0 of the published run; D is 8."""
    options = options_of("levels.count=3", "levels.base_layer=3", "levels.visible_threshold=0", *overrides)
    context = BackboneContext(
        scene=scene or deep_scene(),
        iterations=iterations,
        device=torch.device("cpu"),
        raster=RasterSettings(),
        generator=torch.Generator().manual_seed(0),
        views=TrainingViews(scene=scene or deep_scene()),
    )
    backbone = free_gaussians(options, context)
    visibility = visibility_of(backbone)
    visibility.levels = replace(visibility.levels, farthest=8.0)
    return backbone


def visibility_of(backbone: GS3D) -> VisibleByLevel:
    assert isinstance(backbone.visibility, VisibleByLevel)
    return backbone.visibility


def levels_of(backbone: GS3D) -> Levels:
    return visibility_of(backbone).levels


def render(backbone: GS3D, camera: Camera, step: int) -> tuple[DrawnSplats, Rendering]:
    """A picture with its backward pass."""
    drawn = backbone.draw(camera, step)
    rendering = rasterize(drawn.splats, camera, backbone.raster, background=torch.zeros(3))
    rendering.image.square().sum().backward()
    return drawn, rendering


def stir(backbone: GS3D) -> None:
    """Other values than those of the beginning, so that Gaussians differ; biases too."""
    generator = torch.Generator().manual_seed(11)
    with torch.no_grad():
        for name, parameter in backbone.table.parameters.items():
            noise = torch.empty_like(parameter).normal_(generator=generator)
            parameter.copy_(noise * 0.3 - 2 if name == "log_scales" else parameter + 0.5 * noise)
    backbone.table["bias"].uniform_(0, 0.4, generator=generator)


# -- the beginning -----------------------------------------------------------------------------------------------------


def test_gaussians_start_half_a_cell_beyond_the_nodes_with_the_largest_colours_of_their_cells() -> None:
    colours = torch.randint(0, 256, (60, 3), generator=torch.Generator().manual_seed(1), dtype=torch.uint8)
    scene = deep_scene(colours)
    levels = levels_of(small_octree(scene=scene))
    cloud, columns = starting_points(scene.points, levels)
    nodes, of, group = initial_nodes(scene.points.positions, levels)
    assert torch.equal(columns["level"], of)
    assert not columns["bias"].any()
    half = torch.tensor([levels.size(level) / 2 for level in of.tolist()])
    torch.testing.assert_close(cloud.positions, nodes + half[:, None])
    for row in range(len(nodes)):
        owners = (group[of[row]] == row).nonzero()[:, 0]
        assert torch.equal(cloud.colours[row], colours[owners].amax(0)), row


def test_they_are_backbones_that_tell_their_size() -> None:
    backbone = small_octree()
    assert isinstance(backbone, Backbone)
    count, size = size_of(backbone.table)
    assert count == len(backbone.table)
    assert size == count * (4 * (59 + 1) + 2)  # 59 floats of 3D-GS, a bias, and 16 bits of level


# -- the verdict -------------------------------------------------------------------------------------------------------


def test_sizes_are_relative_to_level_0() -> None:
    scales = torch.tensor([[1.0, 2, 3], [3, 4, 5], [1, 1, 1], [0.5, 0.5, 0.5]])
    of = torch.tensor([0, 0, 1, 3], dtype=torch.int16)
    torch.testing.assert_close(relative_sizes(scales, of, 4), torch.tensor([1, 1 / 3, 1, 0.5 / 3]))  # level 2 is empty


def test_without_level_0_every_level_counts_as_it_is() -> None:
    of = torch.tensor([1, 2], dtype=torch.int16)
    assert relative_sizes(torch.ones(2, 3), of, 3).tolist() == [1, 1, 1]


@pytest.mark.parametrize(("level", "gradient", "scale", "wanted"), [
    (0, 2.0e-4, 0.009, "cloned"),
    (0, 1.99e-4, 0.009, ""),
    (0, 2.0e-4, 0.011, "split"),
    (0, 3.0e-4, 0.011, "split biased"),
    (0, 3.0e-4, 0.009, "cloned biased"),
    (1, 2.29e-4, 0.004, ""),             # 2e-4 x 2^0.2 = 2.2974e-4
    (1, 2.30e-4, 0.004, "cloned"),
    (1, 2.30e-4, 0.006, "split"),        # level 1 is half as large: so is what counts as large
    (1, 3.45e-4, 0.004, "cloned biased"),
    (0, 0.0, 0.02, ""),
])  # fmt: skip
def test_verdicts_by_hand(level: int, gradient: float, scale: float, wanted: str) -> None:
    """The first Gaussian is judged; the others make level 0 of mean scale 1, level 1 of mean scale 1/2."""
    levels = levels_of(small_octree())
    of = torch.tensor([level, *[0] * 200, *[1] * 200], dtype=torch.int16)
    scales = torch.cat([torch.full((1, 3), 1e-3), torch.ones(200, 3), torch.full((200, 3), 0.5)])
    scales[0, 1] = scale
    gradients = torch.zeros(401)
    gradients[0] = gradient
    found = densify_masks(gradients, scales, of, levels, CONTROL, threshold=2e-4, large=0.01, splitting=True)
    assert [name for name in ("cloned", "split", "biased") if getattr(found, name)[0]] == wanted.split()
    assert not any(bool(getattr(found, name)[1:].any()) for name in ("cloned", "split", "biased"))


# -- new Gaussians -----------------------------------------------------------------------------------------------------


def raw_of(backbone: GS3D) -> dict[str, Tensor]:
    return {name: value.detach().clone() for name, value in everything(backbone.table).values.items()}


def test_clones_are_copies_on_their_level_without_bias() -> None:
    backbone = small_octree()
    stir(backbone)
    raw = raw_of(backbone)
    cloned = torch.arange(3, len(backbone.table), 7)
    new = clones(raw, cloned)
    for name, value in new.items():
        assert torch.equal(value, torch.zeros_like(value) if name == "bias" else raw[name][cloned]), name


def test_a_child_is_smaller_a_level_finer_and_drawn_from_its_parent() -> None:
    """Parents stretched along their first axis, which their rotation turns to y: children lie on that line."""
    backbone = small_octree()
    raw = raw_of(backbone)
    raw["log_scales"][:] = torch.tensor([math.log(0.1), -30.0, -30.0])
    raw["quats"][:] = torch.tensor([math.cos(math.pi / 4), 0, 0, math.sin(math.pi / 4)])
    everyone = torch.arange(len(backbone.table))
    new = small_children(raw, everyone, levels_of(backbone), 0.6, torch.Generator().manual_seed(0))
    offsets = new["means"] - raw["means"]
    assert offsets[:, [0, 2]].abs().max() < 1e-6
    assert 0.07 < float(offsets[:, 1].std()) < 0.13
    torch.testing.assert_close(new["log_scales"], raw["log_scales"] + math.log(0.6))
    assert torch.equal(new["level"], (raw["level"] + 1).clamp(max=2))
    for name in ("sh_dc", "sh_rest", "opacity_logits", "quats"):
        assert torch.equal(new[name], raw[name]), name


def test_what_too_few_cameras_would_draw_is_not_made() -> None:
    """Half of the cameras stand at D/2 and farther, so hardly anything of level 2 is drawn by more than half."""
    backbone = small_octree()
    levels, raw = replace(levels_of(backbone), threshold=0.5), raw_of(backbone)
    everyone = torch.arange(len(backbone.table))
    generator = torch.Generator().manual_seed(0)
    for new in (clones(raw, everyone), small_children(raw, everyone, levels, 0.6, generator)):
        keep = kept(levels, new["means"], new["level"])
        for row in range(len(everyone)):
            place, level = new["means"][row].tolist(), int(new["level"][row])
            reach = [math.log2(8 / math.dist(place, (0.0, -8.0 / 2**n, 0.0))) for n in range(4)]
            drawn = sum(level <= min(2, max(0, round(value))) for value in reach)
            assert bool(keep[row]) == (drawn > 2)
        assert 0 < int(keep.sum()) < len(everyone)


@pytest.mark.parametrize("place", [math.nan, math.inf, -math.inf])
def test_a_child_without_a_place_is_not_made(place: float) -> None:
    backbone = small_octree()
    raw = raw_of(backbone)
    seen = kept(levels_of(backbone), raw["means"], raw["level"])
    raw["means"][5, 1] = place
    seen[5] = False
    assert torch.equal(kept(levels_of(backbone), raw["means"], raw["level"]), seen)


def test_room_goes_to_the_largest_gradients_of_those_that_are_seen() -> None:
    backbone = small_octree()
    levels, raw = replace(levels_of(backbone), threshold=0.5), raw_of(backbone)
    everyone = torch.arange(len(backbone.table))
    gradient = torch.rand(len(everyone), generator=torch.Generator().manual_seed(2))
    seen = kept(levels, raw["means"], raw["level"])
    keep = within_room(seen, gradient, 3)
    best = sorted(gradient[seen].tolist())[-3:]
    assert sorted(gradient[keep].tolist()) == best
    assert int(within_room(seen, gradient, 0).sum()) == 0


# -- density events ----------------------------------------------------------------------------------------------------


def due(*overrides: str, step: int = 1600, scene: Scene | None = None) -> GS3D:
    """A backbone at a density event: 0, 1 are to be cloned, 2, 3 split, of 3 the gradient is large."""
    backbone = small_octree(*overrides, scene=scene)
    with torch.no_grad():
        backbone.table["log_scales"].fill_(math.log(1e-3))
        backbone.table["log_scales"][4:] = math.log(0.1)
        backbone.table["log_scales"][2:4] = math.log(0.02)
    render(backbone, seen_from(1.0), step)
    backbone.update(step)
    backbone.table.statistics["gradient"].zero_()
    backbone.table.statistics["count"].fill_(2)
    backbone.table.statistics["gradient"][:4] = torch.tensor([4.4e-4, 4.4e-4, 4.4e-4, 6.4e-4])
    return backbone


def test_an_event_by_hand() -> None:
    """What is large on level 0 is above 0.01 x the extent, which is 1: Gaussians 2 and 3."""
    backbone = due()
    before = raw_of(backbone)
    assert before["level"][:4].tolist() == [0, 0, 0, 0]
    done = backbone.densify_and_prune(1600)
    assert done == {"cloned": 2, "split": 2, "pruned": 0}
    after, count = raw_of(backbone), len(before["means"])
    for name, value in before.items():
        if name != "bias":
            assert torch.equal(after[name][:count], value), name
            if name not in ("means", "log_scales", "level"):
                assert torch.equal(after[name][count:], value[[0, 1, 2, 3]]), name
    torch.testing.assert_close(after["bias"], torch.tensor([0.01 * (row == 3) for row in range(count + 4)]))
    assert after["level"][count:].tolist() == [0, 0, 1, 1]
    assert torch.equal(after["means"][count : count + 2], before["means"][:2])
    assert len(backbone.table.statistics["gradient"]) == count + 4
    assert not backbone.table.statistics["gradient"].any()
    for parameter in backbone.table.parameters.values():
        moment = backbone.table.optimiser.state[parameter]["exp_avg"]
        assert moment[:count].any()
        assert not moment[count:].any()


@pytest.mark.parametrize(("step", "happens"), [(1500, False), (1600, True), (24900, True), (25000, False)])
def test_events_come_every_hundred_steps_of_their_window(step: int, happens: bool) -> None:
    assert bool(due(step=step).densify_and_prune(step)) == happens


@pytest.mark.parametrize(("word", "step", "split"), [
    ("fidelity=reference", 1600, 2), ("quirks.gate=open", 1600, 2),
    ("quirks.gate=closed", 1600, 0), ("quirks.gate=closed", 10000, 0), ("quirks.gate=closed", 10100, 2),
    ("fidelity=sane", 1600, 0), ("fidelity=sane", 10100, 2),
])  # fmt: skip
def test_the_gate_keeps_splits_until_all_levels_train(word: str, step: int, split: int) -> None:
    backbone = due(word, step=step)
    done = backbone.densify_and_prune(step)
    assert (done["cloned"], done["split"]) == (2, split)
    assert bool(backbone.table["bias"][3] > 0) == (split > 0)


def test_splits_that_wait_take_no_room() -> None:
    count = len(small_octree().table)
    done = due("quirks.gate=closed", f"max_primitives={count + 1}").densify_and_prune(1600)
    assert (done["cloned"], done["split"]) == (1, 0)


def test_the_cap_is_never_passed() -> None:
    count = len(small_octree().table)
    done = due(f"max_primitives={count + 1}").densify_and_prune(1600)
    free = due("max_primitives=0").densify_and_prune(1600)
    assert "withheld" not in free
    more = free["cloned"] + free["split"] - 1
    assert done == {"cloned": 0, "split": 1, "pruned": 0, "withheld": more}  # the largest gradient comes first


@pytest.mark.parametrize(("word", "bias"), [
    ("fidelity=reference", 1.005), ("fidelity=sane", 1.0), ("quirks.bias=own", 1.0), ("quirks.bias=level", 1.005),
])  # fmt: skip
def test_bias_has_a_limit_where_the_reference_has_none(word: str, bias: float) -> None:
    backbone = due(word, "quirks.gate=open")
    backbone.table["bias"][3] = 0.995
    backbone.densify_and_prune(1600)
    assert float(backbone.table["bias"][3]) == pytest.approx(bias)


def test_fidelity_reaches_every_switch_of_the_second_form() -> None:
    """Those of the reference, and what levels leave open; what means nothing here is refused."""
    found = {}
    for fidelity in ("reference", "sane"):
        options = options_of(f"fidelity={fidelity}", "levels.half_cell=null")
        quirks, levels = options.switches(), free_options(options)[1]
        found[fidelity] = (quirks.gate, quirks.bias, levels.extend_rule, levels.half_cell)
    assert found == {"reference": ("open", "level", "reference", True), "sane": ("closed", "own", "sane", False)}
    with pytest.raises(
        ConfigError, match=r"quirks\.promoted is 'max', which has no effect on densification=clone_split"
    ):
        options_of("quirks.promoted=max")


@pytest.mark.parametrize(("step", "pruned"), [(3000, 1), (3100, 3)])
def test_faint_gaussians_go_at_once_and_huge_ones_after_step_3000(step: int, pruned: int) -> None:
    backbone = due(step=step)
    backbone.table.statistics["gradient"].zero_()
    with torch.no_grad():
        backbone.table["opacity_logits"][10] = -6.0
        backbone.table["log_scales"][11:13, 1] = math.log(0.11)
    assert backbone.densify_and_prune(step) == {"cloned": 0, "split": 0, "pruned": pruned}


def test_opacities_are_never_reset() -> None:
    white = small_octree(scene=deep_scene(background=1.0))
    assert not any(white.control.reset_due(step) for step in range(1, 40001))
    assert "opacity_reset" not in white.plan()


# -- pictures ----------------------------------------------------------------------------------------------------------


def test_levels_join_as_the_camera_comes_near() -> None:
    """D = 8, plain distance: round(log2(8 / d)) for each Gaussian, at the end of training."""
    backbone = small_octree()
    for distance in (30.0, 8.0, 4.0, 1.6):
        camera = seen_from(distance)
        means, of = backbone.table["means"].detach(), backbone.table["level"].tolist()
        reach = [math.log2(8 / math.dist(mean, (0.0, -distance, 0.0))) for mean in means.tolist()]
        wanted = [row for row, level in enumerate(of) if level <= min(2, max(0, round(reach[row])))]
        splats = backbone.draw(camera, 40000).splats
        assert torch.equal(splats.means, means[wanted])
        assert len(splats.scales) == len(splats.colours) == len(splats.log_opacities) == len(wanted)


def test_bias_lets_a_gaussian_be_drawn_from_farther() -> None:
    """At 3 units from D = 8 the level asked for is log2(8/3) = 1.4: finer ones join with a bias of a few tenths."""
    backbone = small_octree()
    camera = seen_from(3.0)
    means, of = backbone.table["means"].detach(), backbone.table["level"]
    reach = (8 / (means - camera.centre.float()).norm(dim=1)).log2()
    close = ((of == 2) & (reach < 1.5) & (reach > 1.0)).nonzero()[:, 0]
    assert len(close) > 0
    row = int(close[0])
    assert row not in backbone.visibility.visible(backbone.table, camera, 40000).rows.tolist()  # type: ignore[union-attr]
    backbone.table["bias"][row] = 0.6
    assert row in backbone.visibility.visible(backbone.table, camera, 40000).rows.tolist()  # type: ignore[union-attr]


def test_levels_that_wait_are_not_drawn() -> None:
    backbone = small_octree()
    shown = backbone.visibility.visible(backbone.table, seen_from(1.0), 1)
    assert shown.rows is not None
    assert int(backbone.table["level"][shown.rows].max()) == levels_of(backbone).first < 2


def test_gradients_count_for_the_rows_that_were_drawn() -> None:
    """From afar level 0 alone is drawn; its rows lie anywhere in the table once levels are mixed."""
    backbone = small_octree()
    backbone.table["level"].copy_(torch.arange(len(backbone.table)) % 3)
    backbone.accumulate(backbone.observe(*render(backbone, seen_from(30.0), 1), 1))
    coarse = backbone.table["level"] == 0
    assert backbone.table.statistics["count"][coarse].sum() > 10
    assert not backbone.table.statistics["count"][~coarse].any()
    assert not backbone.table.statistics["gradient"][~coarse].any()
    grad = backbone.table["means"].grad
    assert grad is not None
    assert not grad[~coarse].any()
    assert grad[coarse].any()


def test_fading_levels_are_fainter() -> None:
    backbone = small_octree("levels.mode=progressive")
    camera = seen_from(3.0)
    shown = backbone.visibility.visible(backbone.table, camera, 40000)
    assert shown.rows is not None
    assert shown.weights is not None
    assert 0 < float(shown.weights.min()) < 0.9
    opacities = backbone.draw(camera, 40000).splats.log_opacities.detach().exp()
    torch.testing.assert_close(
        opacities, shown.weights * backbone.table["opacity_logits"].detach()[shown.rows].sigmoid()
    )


def test_the_volume_of_what_is_drawn_is_held_small() -> None:
    backbone = small_octree()
    drawn = backbone.draw(seen_from(30.0), 40000)
    extra = backbone.regulariser(drawn)
    assert extra is not None
    assert extra.item() == pytest.approx(0.01 * float(drawn.splats.scales.detach().prod(1).mean()))
    extra.backward()
    grad = backbone.table["log_scales"].grad
    assert grad is not None
    assert bool((grad[backbone.table["level"] == 0] > 0).all())
    assert not grad[backbone.table["level"] > 0].any()


# -- files -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("words", [(), ("filter=mip",)])
def test_files_have_the_published_columns(words: tuple[str, ...], tmp_path: Path) -> None:
    backbone = small_octree(*words)
    stir(backbone)
    write_columns(tmp_path / "levels.ply", backbone.file_columns(), backbone.file_notes())
    data = (tmp_path / "levels.ply").read_bytes()
    assert len(data) - data.index(b"end_header\n") - len(b"end_header\n") == 248 * len(backbone.table)
    columns = {name: torch.from_numpy(column) for name, column in read_ply(tmp_path / "levels.ply").items()}
    assert list(columns)[:6] == ["x", "y", "z", "level", "extra_level", "info"]
    assert list(columns)[6:9] == ["f_dc_0", "f_dc_1", "f_dc_2"]
    assert list(columns)[-8:] == ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
    assert torch.equal(columns["level"], backbone.table["level"].float())
    assert torch.equal(columns["extra_level"], backbone.table["bias"])
    assert columns["info"].tolist() == [8.0] + [0.0] * (len(backbone.table) - 1)
    assert "standard_dist 8.0" in backbone.file_notes()[1]
    scales, log_opacities = extents(backbone.table, everything(backbone.table))
    torch.testing.assert_close(columns["scale_1"].exp(), scales[:, 1].detach())
    torch.testing.assert_close(columns["opacity"].sigmoid(), log_opacities.detach().exp())


@pytest.mark.parametrize("mode", ["round", "progressive"])
def test_a_view_as_a_standard_file_draws_the_same_picture(mode: str) -> None:
    backbone = small_octree(f"levels.mode={mode}")
    stir(backbone)
    camera = seen_from(6.0)
    gaussians = backbone.explicit(camera, 40000)
    assert len(gaussians.means) < len(backbone.table)
    with torch.no_grad():
        ours = rasterize(backbone.draw(camera, 40000).splats, camera, backbone.raster).image
        theirs = rasterize(splats_of(gaussians, camera.centre.float()), camera, backbone.raster).image
    assert float((ours - theirs).abs().max()) < 2e-6
    assert len(backbone.explicit(None, 40000).means) == len(backbone.table)


# -- options and runs --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("words", "complaint"), [
    (("densification=split",), "choose anchors or clone_split"),
    (("levels=null",), "without levels: backbone=gs3d"),
    (("clone_split=null",), "clone_split is null"),
    (("clone_split.level_density.shrink=0",), "give 0 < shrink <= 1"),
    (("clone_split.level_density.bias_step=-1",), "give a number from 0"),
    (("clone_split.density.absolute=true",), "levels do not support it"),
    (("levels.coarse_until=40000",), "would never train"),
])  # fmt: skip
def test_options_are_checked(words: tuple[str, ...], complaint: str) -> None:
    with pytest.raises(ConfigError, match=complaint):
        options_of(*words)


def test_shared_options_reach_the_second_form() -> None:
    words = ("filter=mip", "max_primitives=77", "levels.count=5", "published_iterations=50000")
    given, levels, _ = free_options(options_of(*words))
    assert (given.filter, given.max_primitives, given.published_iterations) == ("mip", 77, 50000)
    assert levels.count == 5


def test_overrides_of_a_saved_run_reach_the_second_form(tmp_path: Path) -> None:
    settings = compose(list(WORDS), plugins())
    write_config(tmp_path / "config.yaml", settings.resolved)
    again = read_config(tmp_path / "config.yaml", plugins(), ["backbone.levels.mode=progressive"])
    levels = free_options(again.backbone.options)[1]
    assert levels.mode == "progressive"


def test_runs_older_than_the_second_form_are_opened_in_the_first(tmp_path: Path) -> None:
    resolved = dict(compose(["backbone=octree_gs3d"], plugins()).resolved)
    backbone = {
        key: value for key, value in resolved["backbone"].items() if key not in ("densification", "clone_split")
    }
    write_config(tmp_path / "config.yaml", resolved | {"backbone": backbone})
    assert read_config(tmp_path / "config.yaml", plugins()).backbone.options.densification == "anchors"


def test_the_anchors_form_is_free_of_the_second_forms_demands() -> None:
    words = ["backbone=octree_gs3d", "backbone.levels=null"]
    assert compose(words, plugins()).backbone.options.levels is None


def test_the_filter_follows_the_gaussians_to_the_end() -> None:
    backbone = small_octree("filter=mip")
    assert backbone.filter.due(39800)
    assert not backbone.filter.due(39900)


RUN = (
    *WORDS,
    *LIGHT,
    "scene.points=300",
    "iterations=14",
    "backbone.levels.count=3",
    "backbone.levels.base_layer=4",
    "backbone.clone_split.density.every=400",
    "backbone.clone_split.density.gradient=1e-6",
    "backbone.clone_split.density.split_extent=0.5",
)


@pytest.mark.parametrize("more", [(), ("backbone.filter=mip",)], ids=["plain", "mip"])
def test_runs_grow_and_resume_bit_for_bit(more: tuple[str, ...], tmp_path: Path) -> None:
    """Stopped before the switch to the finest level, before the growth, and after it."""
    tiny_run(tmp_path / "whole", (*RUN, *more))
    lines = [json.loads(line) for line in (tmp_path / "whole" / "metrics.jsonl").read_text().splitlines()]
    grown = [line["step"] for line in lines if line.get("cloned") and line.get("split")]
    assert len(grown) > 1, "the test needs growth of both kinds"
    stopped_at(tmp_path / "parts", (*RUN, *more), 1, grown[0] - 1, grown[0])
    whole = same_ending(tmp_path / "whole", tmp_path / "parts")
    assert {"columns.level", "columns.bias", "statistics.gradient"} <= whole.keys()
    assert len(read_ply(tmp_path / "whole" / "point_cloud.ply")["level"]) == len(whole["columns.level"])
