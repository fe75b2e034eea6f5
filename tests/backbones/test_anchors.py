"""The anchor backbones as the trainer sees them, against the published rules."""

import json
import math
from dataclasses import replace
from functools import cache
from pathlib import Path

import pytest
import torch
from small_scene import small_scene, spread
from tiny import LIGHT, final_tensors, same_ending, stopped_at, tiny_run
from torch import Tensor

from gsx.backbones.anchor_grids import LevelGrids, automatic_voxel, voxel_nodes
from gsx.backbones.anchor_options import Decay
from gsx.backbones.anchors import Anchors
from gsx.backbones.decoding import DrawnAnchors
from gsx.builtin import plugins
from gsx.core.data.camera import Camera, look_at
from gsx.core.data.scene import Scene
from gsx.core.errors import InputError
from gsx.core.gaussians.splats import Splats
from gsx.core.quality.losses import photometric
from gsx.core.rasterizer import RasterSettings, Rendering, rasterize, touches
from gsx.core.training.backbone import Backbone, BackboneContext, remove_nonfinite
from gsx.core.training.parameter_table import gradients, size_of, table_tensors, zero_grad
from gsx.core.training.training_views import TrainingViews
from gsx.experiments.runs.compose import compose
from gsx.experiments.runs.settings import Settings

NAMES = ("scaffold", "octree_scaffold", "octree_gs3d")
NEURAL = ("scaffold", "octree_scaffold")
PARAMETERS = {
    "scaffold": ("offsets", "features", "log_scales"),
    "octree_scaffold": ("offsets", "features", "log_scales"),
    "octree_gs3d": ("offsets", "log_scales", "quats", "opacity_logits", "sh_dc", "sh_rest"),
}


@cache
def settings_of(name: str, *overrides: str) -> Settings:
    return compose([f"backbone={name}", *(f"backbone.{override}" for override in overrides)], plugins())


def small_anchors(
    name: str, *overrides: str, scene: Scene | None = None, iterations: int | None = None, seed: int = 0
) -> Anchors:
    """A backbone of conf/backbone at step 0 of its published run, with overrides below `backbone`."""
    chosen = settings_of(name, *overrides).backbone
    context = BackboneContext(
        scene=scene or small_scene(spread(60)),
        iterations=iterations or chosen.options.published_iterations,
        device=torch.device("cpu"),
        raster=RasterSettings(),
        generator=torch.Generator().manual_seed(seed),
        views=TrainingViews(scene=scene or small_scene(spread(60))),
    )
    return chosen.component.factory(chosen.options, context)


def stir(backbone: Anchors) -> None:
    """Other values than those of the beginning, so that Gaussians differ."""
    generator = torch.Generator().manual_seed(11)
    with torch.no_grad():
        for name, parameter in backbone.table.parameters.items():
            noise = torch.empty_like(parameter).normal_(generator=generator)
            parameter.copy_(noise * 0.3 - 2 if name == "log_scales" else parameter + 0.5 * noise)


def cameras_of(backbone: Anchors) -> list[Camera]:
    return [view.camera for view in backbone.context.scene.train]


def render(backbone: Anchors, camera: Camera, step: int) -> tuple[DrawnAnchors, Rendering]:
    """A picture that counts, with its backward pass."""
    drawn = backbone.draw(camera, step)
    rendering = rasterize(drawn.splats, camera, backbone.raster, background=torch.zeros(3))
    loss = photometric(rendering.image, torch.full_like(rendering.image, 0.5), 0.2)
    extra = backbone.regulariser(drawn)
    (loss if extra is None else loss + extra).backward()
    return drawn, rendering


# -- the beginning -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", NAMES)
def test_they_are_backbones_that_tell_their_size(name: str) -> None:
    backbone = small_anchors(name)
    assert isinstance(backbone, Backbone)
    assert tuple(backbone.table.parameters) == PARAMETERS[name]
    count, size = size_of(backbone.table)
    assert count == len(backbone.table) == len(backbone.table["anchors"])
    floats = {
        "scaffold": 3 + 30 + 32 + 6,
        "octree_scaffold": 3 + 30 + 32 + 6 + 1,
        "octree_gs3d": 3 + 3 + 6 + 4 + 49 + 1,
    }
    heads = 0 if name == "octree_gs3d" else 7086
    assert size == 4 * (count * floats[name] + heads) + (0 if name == "scaffold" else 2 * count)


def test_anchors_are_the_nodes_nearest_to_the_points() -> None:
    """A loop: rounded to even, each node once, not the mean of its points."""
    points = torch.tensor(
        [[0.5, 0, 0], [0.49, 0.1, -0.2], [1.5, 0, 0], [2.5, 0, 0], [-3.4, 7.6, 0.5], [-3.3, 7.7, 0.4]]
    )
    nodes, owner = voxel_nodes(points, 1.0)
    by_hand = [tuple(float(round(value)) for value in point) for point in points.tolist()]
    assert by_hand[0] == by_hand[1] == (0.0, 0.0, 0.0)
    assert [tuple(nodes[i].tolist()) for i in owner.tolist()] == by_hand
    assert len(nodes) == len(set(by_hand))
    assert torch.equal(voxel_nodes(points / 8, 0.125)[0], nodes / 8)


def test_initial_lengths_come_from_the_neighbours_of_the_anchors() -> None:
    """Three others at squared distances 1, 4, 9 | 1, 5, 10 | 4, 5, 13 | 9, 10, 13: root of the mean, six times."""
    points = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 2, 0], [0, 0, 3]])
    table = small_anchors("scaffold", "voxel=1", scene=small_scene(torch.cat([points, points + 0.3]))).table
    squares = {(0, 0, 0): 14 / 3, (1, 0, 0): 16 / 3, (0, 2, 0): 22 / 3, (0, 0, 3): 32 / 3}
    assert len(table) == 4
    for place, lengths in zip(table["anchors"].tolist(), table["log_scales"].tolist(), strict=True):
        assert lengths == pytest.approx([0.5 * math.log(squares[tuple(place)])] * 6)


def test_one_anchor_has_a_length() -> None:
    backbone = small_anchors("scaffold", scene=small_scene(torch.zeros(1, 3)))
    torch.testing.assert_close(backbone.table["log_scales"].exp(), torch.full((1, 6), 1e-7**0.5))


def test_the_automatic_voxel_is_the_literal_median_of_mean_squares() -> None:
    """kthvalue with k = int(0.5 n): of an even number the lower of the two in the middle."""
    points = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 2, 0], [0, 0, 3]])
    assert automatic_voxel(points, squared=True) == pytest.approx(16 / 3)
    assert automatic_voxel(points, squared=False) == pytest.approx(math.sqrt(16 / 3))
    five = torch.cat([points, torch.tensor([[10.0, 0, 0]])])
    means = sorted(sum(sorted(float((p - q).square().sum()) for q in five)[1:4]) / 3 for p in five)
    assert automatic_voxel(five, squared=True) == pytest.approx(means[1], rel=1e-5)
    assert small_anchors("scaffold", "voxel=0", scene=small_scene(points)).grid.voxel == pytest.approx(16 / 3)
    sane = small_anchors("scaffold", "voxel=0", "fidelity=sane", scene=small_scene(points))
    assert sane.grid.voxel == pytest.approx(math.sqrt(16 / 3))
    assert automatic_voxel(torch.zeros(5, 3), squared=True) > 0


def test_a_cell_begins_with_its_largest_colours() -> None:
    points = torch.tensor([[0.0, 0, 0], [0.01, 0, 0], [3, 3, 3]])
    colours = torch.tensor([[255, 0, 51], [0, 102, 0], [0, 0, 255]], dtype=torch.uint8)
    scene = small_scene(points, colours)
    backbone = small_anchors("octree_gs3d", "levels.count=1", "levels.base_layer=3", scene=scene)
    anchors, constants = backbone.table["anchors"], backbone.table["sh_dc"].detach()[:, 0]
    assert len(anchors) == 2
    shown = (0.5 + 0.28209479 * constants)[anchors.norm(dim=1).argsort()]
    torch.testing.assert_close(shown, torch.tensor([[1.0, 0.4, 0.2], [0.0, 0.0, 1.0]]))


def test_no_points_is_an_error_that_names_the_scene() -> None:
    with pytest.raises(InputError, match=r"scene 'small' has no points .*scene\.points=random"):
        small_anchors("scaffold", scene=small_scene(torch.empty(0, 3)))


# -- rates -------------------------------------------------------------------------------------------------------------

NEURAL_RATES = {
    "offsets": (0.01, 1e-4), "features": (0.0075, 0.0075), "log_scales": (0.007, 0.007), "opacity": (0.002, 2e-5),
    "covariance": (0.004, 0.004), "colour": (0.008, 5e-5), "bank": (0.01, 1e-5), "appearance": (0.05, 5e-4),
}  # fmt: skip
RATES = {
    "scaffold": NEURAL_RATES,
    "octree_scaffold": NEURAL_RATES,
    "octree_gs3d": {
        "offsets": (0.01, 1e-4), "log_scales": (0.005, 0.005), "quats": (0.001, 0.001), "opacity_logits": (0.05, 0.05),
        "sh_dc": (0.0025, 0.0025), "sh_rest": (0.0025 / 20, 0.0025 / 20),
    },
}  # fmt: skip


@pytest.mark.parametrize("name", NAMES)
def test_learning_rates_at_the_first_middle_and_last_step(name: str) -> None:
    options = ("heads.bank=true", "heads.appearance=4") if name in NEURAL else ()
    backbone = small_anchors(name, *options, scene=small_scene(spread(60), extent=3.0))
    steps = 30000 if name == "scaffold" else 40000
    for step in (1, steps // 2, steps, steps + 7):
        backbone.set_rates(step)
        groups = [*backbone.table.optimiser.param_groups]
        groups += backbone.table.networks.optimiser.param_groups if backbone.table.networks else []
        u = min(1.0, step / steps)
        for group in groups:
            first, last = RATES[name][group["name"]]
            unit = 3.0 if group["name"] == "offsets" else 1.0
            assert group["lr"] == pytest.approx(unit * first ** (1 - u) * last**u), (group["name"], step)
            assert group["eps"] == 1e-15
            assert group["betas"] == (0.9, 0.999)
        assert {group["name"] for group in groups} == set(RATES[name])


def test_impossible_rates_are_refused() -> None:
    assert Decay(first=0.0, last=0.0).at(3, 10) == 0
    with pytest.raises(ValueError, match="a learning rate goes from"):
        Decay(first=0.1, last=0.0)


def test_harmonics_join_every_thousand_steps() -> None:
    backbone, camera = small_anchors("octree_gs3d"), small_scene(spread(4)).train[0].camera
    for step, degree in ((1, 0), (999, 0), (1000, 1), (2999, 2), (3000, 3), (40000, 3)):
        assert backbone.visible(camera, step).sh_degree == degree


def test_unused_harmonics_count_their_steps() -> None:
    backbone = small_anchors("octree_gs3d")
    render(backbone, cameras_of(backbone)[0], 1)
    backbone.update(1)
    assert float(backbone.table.optimiser.state[backbone.table["sh_rest"]]["step"]) == 1
    assert not backbone.table["sh_rest"].any()


# -- what a camera draws -----------------------------------------------------------------------------------------------


def published_box(place: list[float], lengths: list[float], camera: Camera) -> bool:
    """Whether an upright ellipsoid is before the camera and its 3-sigma square touches a 16 px tile."""
    rotation, shift = camera.rotation.tolist(), camera.translation.tolist()
    x, y, z = (sum(r * p for r, p in zip(row, place, strict=True)) + t for row, t in zip(rotation, shift, strict=True))
    if not z > 0.2:
        return False
    lim_x, lim_y = 1.3 * camera.width / (2 * camera.fx), 1.3 * camera.height / (2 * camera.fy)
    tx, ty = min(lim_x, max(-lim_x, x / z)), min(lim_y, max(-lim_y, y / z))
    across = [(camera.fx * rotation[0][i] - camera.fx * tx * rotation[2][i]) / z * lengths[i] for i in range(3)]
    down = [(camera.fy * rotation[1][i] - camera.fy * ty * rotation[2][i]) / z * lengths[i] for i in range(3)]
    a, c = sum(v * v for v in across) + 0.3, sum(v * v for v in down) + 0.3
    b = sum(v * w for v, w in zip(across, down, strict=True))
    middle = (a + c) / 2
    radius = math.ceil(3 * math.sqrt(middle + math.sqrt(max(0.1, middle * middle - (a * c - b * b)))))
    column, row = camera.fx * x / z + camera.cx - 0.5, camera.fy * y / z + camera.cy - 0.5
    for centre, size in ((column, camera.width), (row, camera.height)):
        tiles = math.ceil(size / 16)
        first = min(tiles, max(0, int((centre - radius) / 16)))
        last = min(tiles, max(0, int((centre + radius + 15) / 16)))
        if last <= first:
            return False
    return True


def wide_cloud(count: int = 300) -> tuple[Tensor, Tensor]:
    """Positions all around a camera and lengths of very different size."""
    generator = torch.Generator().manual_seed(2)
    positions = torch.randn(count, 3, generator=generator) * torch.tensor([6.0, 5, 5])
    return positions, (torch.randn(count, 3, generator=generator) - 2).exp()


CAMERA = look_at([0.3, -4, 1], [0, 0, 0], fov_x=0.9, width=40, height=24)


def test_the_pre_filter_follows_the_published_rules() -> None:
    positions, lengths = wide_cloud()
    quats = torch.tensor([1.0, 0, 0, 0]).repeat(len(positions), 1)
    seen = touches(positions, lengths, quats, CAMERA, RasterSettings())
    wanted = [published_box(p, s, CAMERA) for p, s in zip(positions.tolist(), lengths.tolist(), strict=True)]
    assert seen.tolist() == wanted
    assert 20 < sum(wanted) < len(wanted) - 20


def test_the_pre_filter_agrees_with_radii_of_the_rasterizer() -> None:
    positions, lengths = wide_cloud()
    quats = torch.randn(len(positions), 4, generator=torch.Generator().manual_seed(3))
    splats = Splats(
        means=positions,
        scales=lengths,
        quats=quats,
        log_opacities=torch.zeros(len(positions)),
        colours=torch.zeros(len(positions), 3),
    )
    for settings in (RasterSettings(), RasterSettings(dilation=0.1, compensate=True, cull="tight")):
        screen = rasterize(splats, CAMERA, settings).screen
        radii = torch.zeros(len(positions), dtype=screen.radii.dtype).index_copy_(0, screen.ids, screen.radii)
        assert torch.equal(touches(positions, lengths, quats, CAMERA, settings), radii > 0)


@pytest.mark.parametrize("name", NAMES)
def test_anchors_in_view_are_judged_by_their_reach(name: str) -> None:
    """The first three lengths; the last three, huge, make no anchor visible."""
    backbone = small_anchors(name, "levels=null" if name == "scaffold" else "levels.count=1")
    positions, lengths = wide_cloud(len(backbone.table))
    backbone.table.columns["anchors"] = positions
    with torch.no_grad():
        backbone.table["log_scales"].copy_(torch.cat([lengths.log(), torch.full_like(lengths, 5.0)], 1))
    wanted = [i for i in range(len(positions)) if published_box(positions[i].tolist(), lengths[i].tolist(), CAMERA)]
    assert 0 < len(wanted) < len(positions)
    assert backbone.visible(CAMERA, 1).rows.tolist() == wanted


@pytest.mark.parametrize("name", ["octree_scaffold", "octree_gs3d"])
def test_coarse_levels_are_drawn_and_finer_ones_added(name: str) -> None:
    """D / d of 1, 2, 4 draw levels up to 0, 1, 2; levels that do not train yet stay away."""
    backbone = small_anchors(name, "levels.count=4", "levels.first=1", "levels.half_cell=false")
    levels, table = backbone.grid.levels, backbone.table
    rows = torch.arange(len(table))
    table.columns["anchors"] = torch.zeros(len(table), 3)
    table.columns["level"] = (rows % 4).to(torch.int16)
    for step, most in ((1, 1), (40000, 3)):
        for power, wanted in ((0, 0), (1, 1), (2, 2), (3, 3), (6, 3)):
            eye = [0.0, -levels.farthest / 2**power, 0.0]
            camera = replace(look_at(eye, [0, 0, 0], fov_x=0.9, width=24, height=16), near=1e-6)
            camera = replace(camera, fx=levels.views.focal, fy=levels.views.focal)
            found = sorted(set(table["level"][backbone.visible(camera, step).rows].tolist()))
            assert found == list(range(min(wanted, most) + 1)), (step, power)


def test_training_views_are_known_by_their_camera() -> None:
    backbone = small_anchors("scaffold", "heads.appearance=4")
    assert [backbone.visible(camera, 1).view for camera in cameras_of(backbone)] == [0, 1, 2, 3]
    assert backbone.visible(cameras_of(backbone)[2].zoom(2), 1).view == -1
    assert backbone.visible(CAMERA, 1).view == -1


@pytest.mark.parametrize("name", NAMES)
def test_an_empty_picture_is_a_picture(name: str) -> None:
    """No anchor in view, and for networks none with positive opacity: a finite loss with a backward pass."""
    away = look_at([0, -40, 0], [0, -80, 0], fov_x=0.9, width=24, height=16)
    backbone = small_anchors(name)
    cases = [(backbone, away)]
    if name in NEURAL:
        shut = small_anchors(name)
        with torch.no_grad():
            shut.table.networks.modules.opacity[2].bias.fill_(-10.0)
        cases.append((shut, cameras_of(shut)[0]))
    for model, camera in cases:
        drawn, rendering = render(model, camera, 1000)
        assert len(drawn.splats) == 0
        regulariser = model.regulariser(drawn)
        assert regulariser is None or float(regulariser.detach()) == 0
        assert all(not gradient.any() for gradient in gradients(model.table).values())
        model.accumulate(model.observe(drawn, rendering, 1000))
        assert model.table["visits"].sum() == len(drawn.anchors)
        assert model.densify_and_prune(1000) == {}
        model.update(1000)
        assert all(torch.isfinite(value).all() for value in table_tensors(model.table).values())


def test_the_volume_term_is_the_mean_over_what_is_drawn() -> None:
    backbone = small_anchors("scaffold")
    drawn = backbone.draw(cameras_of(backbone)[0], 1)
    scales = drawn.splats.scales.tolist()
    assert 0 < len(scales) < 10 * len(backbone.table)
    wanted = 0.01 * sum(a * b * c for a, b, c in scales) / len(scales)
    assert backbone.regulariser(drawn).item() == pytest.approx(wanted, rel=1e-5)
    explicit = small_anchors("octree_gs3d")
    assert explicit.regulariser(explicit.draw(cameras_of(explicit)[0], 1)) is None


# -- statistics --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", NAMES)
def test_statistics_are_nested_as_in_a_loop(name: str) -> None:
    """Visits of anchors in view; opacities summed over offsets; gradients, NDC, of Gaussians drawn and on screen."""
    scene = small_scene(spread(60) * 8)
    backbone, camera = small_anchors(name, scene=scene), scene.train[0].camera
    stir(backbone)
    k, count = backbone.representation.offsets, len(backbone.table)
    names = ("visits", "opacity_sum", "gradient_sum", "gradient_count")
    wanted = [[0.0] * count, [0.0] * count, [0.0] * count * k, [0.0] * count * k]
    for camera in cameras_of(backbone)[:2]:
        drawn, rendering = render(backbone, camera, 1000)
        opacity_of = dict(zip(drawn.slots.tolist(), drawn.splats.log_opacities.exp().tolist(), strict=True))
        for row in drawn.anchors.tolist():
            wanted[0][row] += 1
            wanted[1][row] += sum(opacity_of.get(row * k + j, 0.0) for j in range(k))
        screen = rendering.screen
        for place, splat in enumerate(screen.ids.tolist()):
            if int(screen.radii[place]) > 0:
                x, y = screen.means2d_offset.grad[place].tolist()
                slot = int(drawn.slots[splat])
                wanted[2][slot] += math.hypot(x * camera.width / 2, y * camera.height / 2)
                wanted[3][slot] += 1
        backbone.accumulate(backbone.observe(drawn, rendering, 1000))
        zero_grad(backbone.table)
    for column, values in zip(names, wanted, strict=True):
        torch.testing.assert_close(backbone.table[column].flatten(), torch.tensor(values))
    assert 0 < sum(visits > 0 for visits in wanted[0]) < count
    assert 0 < sum(seen > 0 for seen in wanted[3]) < sum(visits > 0 for visits in wanted[0]) * k + 1
    assert max(wanted[2]) > 0


@pytest.mark.parametrize(("step", "counts"), [(500, False), (501, True), (14999, True), (15000, False)])
def test_statistics_are_gathered_while_anchors_are_judged(step: int, counts: bool) -> None:
    backbone = small_anchors("scaffold")
    backbone.accumulate(backbone.observe(*render(backbone, cameras_of(backbone)[0], step), step))
    assert bool(backbone.table["visits"].any()) == counts


def test_growth_comes_134_times_in_the_published_run_and_234_with_levels() -> None:
    for name, calls, last in (("scaffold", 134, 14900), ("octree_scaffold", 234, 24900)):
        growing = small_anchors(name).events
        due = [step for step in range(1, 40001) if growing.due(step)]
        assert (len(due), due[0], due[-1]) == (calls, 1600, last)


# -- growing, pruning, optimising --------------------------------------------------------------------------------------


def judged(name: str, *overrides: str) -> Anchors:
    """After a step at 1600, with statistics that make some anchors grow and the first five go."""
    backbone = small_anchors(name, *overrides)
    stir(backbone)
    render(backbone, cameras_of(backbone)[0], 1600)
    table = backbone.table
    table["gradient_count"][:20] = 50.0
    table["gradient_sum"][:20] = 50.0 * 2.1e-4 if name != "scaffold" else 50.0
    table["visits"][:10] = 100.0
    table["opacity_sum"][5:10] = 100.0
    return backbone


@pytest.mark.parametrize("name", NAMES)
def test_a_growth_step_moves_only_the_networks(name: str) -> None:
    """Parameters made anew have no gradient; new rows have no moments; networks are untouched by the surgery."""
    backbone = judged(name)
    backbone.update(1600)
    render(backbone, cameras_of(backbone)[0], 1600)
    table, heads = backbone.table, dict(backbone.table.networks.named() if backbone.table.networks else ())
    moments = {n: table.optimiser.state[table[n]]["exp_avg"].clone() for n in table.parameters}
    held = {n: p.detach().clone() for n, p in heads.items()}
    before = len(table)
    done = backbone.densify_and_prune(1600)
    assert done["grown"] > 0
    assert done["pruned"] == 5
    assert len(table) == before + done["grown"] - 5
    values = {n: p.detach().clone() for n, p in table.parameters.items()}
    assert all(torch.equal(p.detach(), held[n]) for n, p in heads.items())
    backbone.update(1600)
    for n, parameter in table.parameters.items():
        assert torch.equal(parameter.detach(), values[n]), n
        state = table.optimiser.state[parameter]
        assert float(state["step"]) == 1
        assert torch.equal(state["exp_avg"][: before - 5], moments[n][5:])
        assert not state["exp_avg"][before - 5 :].any()
    for n, parameter in heads.items():
        assert float(backbone.table.networks.optimiser.state[parameter]["step"]) == 2
        assert not torch.equal(parameter.detach(), held[n]), n


@pytest.mark.parametrize("name", NAMES)
def test_eligible_offsets_and_ready_anchors_are_reset_and_nothing_else(name: str) -> None:
    backbone = judged(name)
    table = backbone.table
    table["gradient_count"][20:] = 40.0
    table["gradient_sum"][20:] = 3.0
    table["visits"][10:] = 80.0
    table["opacity_sum"][10:] = 7.0
    before = len(table)
    backbone.densify_and_prune(1600)
    old = before - 5
    assert not table["gradient_count"][:15].any()
    assert not table["gradient_sum"][:15].any()
    assert (table["gradient_count"][15:old] == 40).all()
    assert (table["gradient_sum"][15:old] == 3).all()
    assert not table["visits"][:5].any()
    assert (table["visits"][5:old] == 80).all()
    assert (table["opacity_sum"][5:old] == 7).all()
    for column in ("gradient_count", "gradient_sum", "visits", "opacity_sum"):
        assert not table[column][old:].any()


@pytest.mark.parametrize(("quirk", "unit"), [("world", 1.0), ("extent", 3.0)])
def test_lengths_are_clamped_in_units_of_the_world_or_the_extent(quirk: str, unit: float) -> None:
    scene = small_scene(spread(60), extent=3.0)
    backbone = small_anchors("scaffold", f"quirks.clamp={quirk}", scene=scene)
    with torch.no_grad():
        backbone.table["log_scales"].fill_(4.0)
    backbone.densify_and_prune(1600)
    lengths = backbone.table["log_scales"].exp()
    torch.testing.assert_close(lengths[:, 3:], torch.full_like(lengths[:, 3:], unit * math.exp(0.05)))
    torch.testing.assert_close(lengths[:, :3], torch.full_like(lengths[:, :3], math.exp(4)))


def test_one_camera_has_no_extent_to_clamp_by() -> None:
    scene = small_scene(spread(60), extent=0.0, views=1)
    backbone = small_anchors("scaffold", "fidelity=sane", scene=scene)
    assert backbone.densify_and_prune(1600) == {"grown": 0, "pruned": 0}


@pytest.mark.parametrize("name", NAMES)
def test_the_cap_is_never_passed(name: str) -> None:
    count = len(small_anchors(name).table)
    backbone = judged(name, f"max_primitives={count + 2}")
    free = judged(name, "max_primitives=0").densify_and_prune(1600)
    assert "withheld" not in free
    cap_tiles = backbone.densify_and_prune(1600)
    assert (cap_tiles["grown"], cap_tiles["pruned"]) == (2, 5)
    assert cap_tiles["withheld"] >= free["grown"] - 2  # what found no room takes no finer anchor's cell either
    full = judged(name, f"max_primitives={count - 7}").densify_and_prune(1600)
    assert (full["grown"], full["pruned"]) == (0, 5)
    assert full["withheld"] > 0


@pytest.mark.parametrize(("quirk", "step", "opens"), [
    ("open", 1600, True), ("closed", 1600, False), ("closed", 10000, False), ("closed", 10100, True),
])  # fmt: skip
def test_the_gate_opens_when_all_levels_train(quirk: str, step: int, opens: bool) -> None:
    backbone = judged("octree_scaffold", f"quirks.gate={quirk}", "levels.count=4")
    backbone.densify_and_prune(step)
    assert bool(backbone.table["bias"].any()) == opens


@pytest.mark.parametrize(("name", "bias", "half_cell"), [
    ("octree_scaffold", "all", True), ("octree_gs3d", "level", False),
])  # fmt: skip
def test_fidelity_reaches_the_switches_of_levels_and_of_each_reference(name: str, bias: str, half_cell: bool) -> None:
    """Octree-AnyGS keeps bias at the level at hand and has no half cell; sane is the same for both."""
    for word, wanted in (
        ("fidelity=reference", (bias, half_cell)),
        ("fidelity=sane", ("own", False)),
        ("quirks.bias=all", ("all", half_cell)),
    ):
        backbone = small_anchors(name, word)
        assert isinstance(backbone.grid, LevelGrids)
        assert (backbone.options.switches().bias, backbone.grid.levels.half_cell) == wanted
    points = torch.tensor([[3.0, 3, 3], [4.0, 4, 4], [3.5, 3.2, 3.9]]).repeat(10, 1) + spread(30) / 8
    origins = {
        word: small_anchors(name, word, scene=small_scene(points)).grid.levels.origin
        for word in ("fidelity=reference", "fidelity=sane", "levels.extend_rule=sane")
    }
    low, high = float(points.min()), float(points.max())
    assert origins["fidelity=reference"] == pytest.approx(1.1 * low)
    assert origins["fidelity=sane"] == origins["levels.extend_rule=sane"] == pytest.approx(low - 0.05 * (high - low))


def test_rows_that_are_not_finite_are_removed_with_all_that_is_theirs() -> None:
    backbone = small_anchors("octree_scaffold")
    with torch.no_grad():
        backbone.table["features"][3, 2] = torch.nan
        backbone.table["offsets"][7, 1, 0] = torch.inf
    before = backbone.table["anchors"].clone()
    kept = [row for row in range(len(before)) if row not in (3, 7)]
    assert remove_nonfinite(backbone, [], 1) == 2
    assert torch.equal(backbone.table["anchors"], before[kept])
    assert {len(column) for column in backbone.table.columns.values()} == {len(kept)}


# -- whole runs --------------------------------------------------------------------------------------------------------

RUN = (*LIGHT, "iterations=14", "backbone.growth.every=400", "backbone.growth.gradient=1e-6")
MORE = {
    "scaffold": (
        "backbone.heads.bank=true",
        "backbone.heads.appearance=4",
        "backbone.quirks.early_stop=no",
    ),
    "octree_scaffold": (
        "backbone.heads.level=true",
        "backbone.levels.mode=progressive",
        "backbone.filter=mip",
    ),
    "octree_gs3d": ("backbone.levels.count=3",),
}


def run_words(name: str) -> tuple[str, ...]:
    return (f"backbone={name}", *RUN, *MORE[name])


@pytest.fixture(scope="module", params=NAMES)
def finished(request, tmp_path_factory) -> tuple[str, Path]:
    folder = tmp_path_factory.mktemp("runs") / request.param
    tiny_run(folder, run_words(request.param))
    return request.param, folder


def test_runs_grow_and_keep_everything(finished: tuple[str, Path]) -> None:
    name, folder = finished
    lines = [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]
    assert sum(line.get("grown", 0) for line in lines) > 0, "the test needs growth"
    tensors = final_tensors(folder)
    wanted = {f"parameters.{n}" for n in PARAMETERS[name]} | {f"adam.{n}.exp_avg" for n in PARAMETERS[name]}
    wanted |= {"columns.anchors"} | {
        f"statistics.{n}" for n in ("visits", "opacity_sum", "gradient_sum", "gradient_count")
    }
    if name != "scaffold":
        wanted |= {"columns.level", "columns.bias"}
        assert tensors["columns.level"].dtype == torch.int16
    if name in NEURAL:
        wanted |= {"heads.opacity.0.weight", "adam.heads.colour.2.bias.exp_avg_sq", "adam.heads.covariance.0.bias.step"}
    if name == "scaffold":
        wanted |= {"heads.bank.0.weight", "adam.heads.appearance.weight.exp_avg"}
    assert wanted <= tensors.keys()


def test_other_seeds_begin_with_other_networks() -> None:
    first, other = (dict(small_anchors("scaffold", seed=seed).table.networks.named()) for seed in (0, 1))
    assert not any(torch.equal(first[name], other[name]) for name in first)


def test_resume_equals_never_having_stopped(finished: tuple[str, Path], tmp_path: Path) -> None:
    """Stopped between two growths: with anchors that grew, moments, and statistics on the way."""
    name, folder = finished
    stopped_at(tmp_path / "run", run_words(name), 4)
    same_ending(folder, tmp_path / "run")
