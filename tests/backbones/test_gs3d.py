"""gs3d against the published rules, on tables made by hand."""

import math
from dataclasses import replace

import pytest
import torch
from small_scene import published_options, small_gs3d, small_scene, spread
from torch import Tensor

from gsx.backbones.density import mean_gradient
from gsx.backbones.density_control import children
from gsx.backbones.gs3d import GS3D
from gsx.core.data.camera import Camera
from gsx.core.errors import InputError
from gsx.core.quality.losses import photometric
from gsx.core.rasterizer import RasterSettings, Rendering, ScreenStatistics, rasterize
from gsx.core.training.backbone import Backbone, DrawnSplats
from gsx.core.training.parameter_table import gradients, restore_table, size_of, table_tensors, zero_grad

NAMES = ("means", "sh_dc", "sh_rest", "opacity_logits", "log_scales", "quats")


def logit(opacity: float) -> float:
    return math.log(opacity / (1 - opacity))


def hand_made(
    gradients: list[float],
    scales: list[float],
    opacities: list[float] | None = None,
    *,
    background: float = 0.0,
    extent: float = 1.0,
    cap: int = 10**6,
) -> GS3D:
    """One primitive per entry, far apart, told apart by sh_dc = row number; statistics of two views each."""
    count = len(gradients)
    scene = small_scene(spread(count) * 100, extent=extent, background=background)
    backbone = small_gs3d(scene, options=replace(published_options(), max_primitives=cap))
    table = backbone.table
    with torch.no_grad():
        table["sh_dc"].copy_(torch.arange(count)[:, None, None].expand(-1, 1, 3))
        table["sh_rest"].normal_(generator=torch.Generator().manual_seed(1))
        table["quats"].normal_(generator=torch.Generator().manual_seed(2))
        table["log_scales"].copy_(torch.tensor(scales).log()[:, None] + torch.tensor([0.0, -0.5, -1.0]))
        table["opacity_logits"].copy_(torch.tensor([logit(o) for o in opacities or [0.5] * count]))
    seen = torch.full((count,), 2.0)
    table.statistics |= {"gradient": 2 * torch.tensor(gradients), "count": seen}
    return backbone


def snapshot(backbone: GS3D) -> dict[str, Tensor]:
    return {name: backbone.table[name].detach().clone() for name in NAMES}


def labels(backbone: GS3D) -> list[int]:
    """Original row of every primitive, in order."""
    return backbone.table["sh_dc"].detach()[:, 0, 0].int().tolist()


def learn(backbone: GS3D, gradient: float = 1e-6) -> None:
    """Give every value the same gradient."""
    for name in NAMES:
        backbone.table[name].grad = torch.full_like(backbone.table[name], gradient)


# -- initialisation ----------------------------------------------------------------------------------------------------


def test_initial_values_worked_by_hand() -> None:
    positions = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 2, 0], [0, 0, 3]])
    colours = torch.tensor([[255, 0, 127], [0, 255, 128], [51, 102, 204], [1, 2, 3]], dtype=torch.uint8)
    table = small_gs3d(small_scene(positions, colours)).table
    assert torch.equal(table["means"], positions)
    dc = torch.tensor([1.7724539, -1.7724539, (127 / 255 - 0.5) / 0.28209479])
    torch.testing.assert_close(table["sh_dc"][0, 0], dc)
    assert table["sh_rest"].shape == (4, 15, 3)
    assert not table["sh_rest"].any()
    torch.testing.assert_close(table["opacity_logits"].detach(), torch.full((4,), -2.1972246))  # opacity 0.1
    # the other three lie at squared distances 1, 4, 9 | 1, 5, 10 | 4, 5, 13 | 9, 10, 13
    mean_squares = torch.tensor([14.0, 16, 22, 32]) / 3
    torch.testing.assert_close(table["log_scales"].detach(), mean_squares.sqrt().log()[:, None].expand(4, 3))
    assert table["quats"].tolist() == [[1.0, 0, 0, 0]] * 4


def test_coincident_points_start_at_the_least_scale() -> None:
    table = small_gs3d(small_scene(torch.ones(6, 3))).table
    torch.testing.assert_close(table["log_scales"].exp(), torch.full((6, 3), 3.1622777e-4))


@pytest.mark.parametrize(("count", "scale"), [(1, 3.1622777e-4), (2, 2.0), (3, math.sqrt((4 + 4) / 2))])
def test_fewer_than_four_points(count: int, scale: float) -> None:
    corners = torch.tensor([[0.0, 0, 0], [2, 0, 0], [0, 2, 0]])[:count]
    table = small_gs3d(small_scene(corners)).table
    torch.testing.assert_close(table["log_scales"][0].exp(), torch.full((3,), scale))


def test_no_points_is_an_error_that_names_the_scene() -> None:
    with pytest.raises(InputError, match=r"scene 'small' has no points .*scene\.points=random"):
        small_gs3d(small_scene(torch.empty(0, 3)))


def test_it_is_a_backbone_of_59_floats_a_primitive() -> None:
    backbone = small_gs3d(small_scene(spread(7)))
    assert isinstance(backbone, Backbone)
    assert size_of(backbone.table) == (7, 7 * 59 * 4)


# -- rates, degrees, regulariser ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(("step", "means_rate"), [(1, 1.6e-4), (15000, 1.6e-5), (30000, 1.6e-6)])
def test_first_adam_step_moves_every_parameter_by_its_published_rate(step: int, means_rate: float) -> None:
    backbone = small_gs3d(small_scene(spread(4), extent=3.0))
    before = snapshot(backbone)
    learn(backbone, gradient=1e-12)
    backbone.update(step)
    rates = {"means": 3 * means_rate, "sh_dc": 0.0025, "sh_rest": 1.25e-4}
    rates |= {"opacity_logits": 0.05, "log_scales": 0.005, "quats": 0.001}
    for name, rate in rates.items():
        moved = before[name] - backbone.table[name].detach()
        torch.testing.assert_close(moved, torch.full_like(moved, rate), rtol=2e-3, atol=1.2e-7, msg=name)
    assert gradients(backbone.table) == {}


def test_sh_degree_rises_every_thousand_steps() -> None:
    backbone = small_gs3d(small_scene(spread(4)))
    steps = (1, 999, 1000, 1999, 2000, 2999, 3000, 30000)
    assert [backbone.active_degree(step) for step in steps] == [0, 0, 1, 1, 2, 2, 3, 3]


def camera() -> Camera:
    return small_scene(spread(4)).train[0].camera


@pytest.mark.parametrize(("step", "bands"), [(999, 0), (1000, 3), (2500, 8), (3000, 15)])
def test_only_active_bands_colour_the_splats(step: int, bands: int) -> None:
    backbone = hand_made([0.0] * 5, [0.1] * 5)
    shown = backbone.draw(camera(), step).splats.colours
    with torch.no_grad():
        backbone.table["sh_rest"][:, bands:] = 5.0
    assert torch.equal(backbone.draw(camera(), step).splats.colours, shown)
    if bands:
        with torch.no_grad():
            backbone.table["sh_rest"][:, bands - 1] += 5.0
        assert not torch.equal(backbone.draw(camera(), step).splats.colours, shown)


def test_splats_are_the_activated_parameters() -> None:
    backbone = hand_made([0.0] * 3, [0.1, 0.2, 0.4], [0.2, 0.5, 0.9])
    drawn = backbone.draw(camera(), 1)
    splats = drawn.splats
    torch.testing.assert_close(splats.scales[:, 0], torch.tensor([0.1, 0.2, 0.4]))
    torch.testing.assert_close(splats.log_opacities.exp(), torch.tensor([0.2, 0.5, 0.9]))
    assert torch.equal(splats.means, backbone.table["means"])
    assert backbone.regulariser(drawn) is None


def test_explicit_holds_raw_values_and_unit_quaternions() -> None:
    backbone = hand_made([0.0] * 3, [0.1, 0.2, 0.4])
    explicit = backbone.explicit(None, 1)
    for name in ("means", "log_scales", "opacity_logits", "sh_rest"):
        assert torch.equal(getattr(explicit, name), backbone.table[name])
    assert torch.equal(explicit.sh_dc, backbone.table["sh_dc"][:, 0])
    torch.testing.assert_close(explicit.quats.norm(dim=1), torch.ones(3))
    assert not any(value.requires_grad for value in vars(explicit).values())


# -- statistics --------------------------------------------------------------------------------------------------------


def seen_as(
    backbone: GS3D, ids: list[int], radii: list[int], gradients: list[list[float]]
) -> tuple[DrawnSplats, Rendering]:
    """What is drawn, and a rendering on 24 x 16 px with screen gradients made by hand."""
    shift = torch.zeros(len(ids), 2, requires_grad=True)
    shift.grad = torch.tensor(gradients)
    screen = ScreenStatistics(
        ids=torch.tensor(ids),
        radii=torch.tensor(radii),
        means2d_offset=shift,
        absgrad=None,
        max_weights=None,
        size=(24, 16),
    )
    drawn = backbone.draw(camera(), 1)
    return drawn, replace(rasterize(drawn.splats, camera(), RasterSettings()), screen=screen)


def test_statistics_are_the_mean_of_norms_over_views_that_saw_the_primitive() -> None:
    backbone = small_gs3d(small_scene(spread(3)))
    # half the raster is (12, 8) px: the norms are 60, 15 (unseen: radius 0) and then 20 with the opposite sign
    backbone.accumulate(backbone.observe(*seen_as(backbone, [0, 1], [4, 0], [[3.0, 6.0], [1.25, 0.0]]), 1))
    backbone.accumulate(backbone.observe(*seen_as(backbone, [0, 2], [4, 1], [[-1.0, -2.0], [0.0, 0.5]]), 2))
    assert backbone.table.statistics["count"].tolist() == [2, 0, 1]
    expected = torch.tensor([(math.hypot(36, 48) + math.hypot(12, 16)) / 2, 0.0, 4.0])
    torch.testing.assert_close(mean_gradient(backbone.table), expected)


def test_statistics_end_with_density_control() -> None:
    backbone = small_gs3d(small_scene(spread(3)))
    backbone.accumulate(backbone.observe(*seen_as(backbone, [0], [4], [[1.0, 0.0]]), 14999))
    backbone.accumulate(backbone.observe(*seen_as(backbone, [0], [4], [[1.0, 0.0]]), 15000))
    assert backbone.table.statistics["count"].tolist() == [1, 0, 0]


# -- clone, split, prune -----------------------------------------------------------------------------------------------


def test_rows_are_survivors_clones_first_children_second_children() -> None:
    # quiet, clone (exactly at the threshold), split, clone, split, unseen
    backbone = hand_made([0.00019, 0.0002, 0.001, 0.1, 0.0003, 0.0], [0.02, 0.009, 0.02, 0.001, 0.05, 0.02])
    before = snapshot(backbone)
    done = backbone.densify_and_prune(600)
    assert done == {"cloned": 2, "split": 2, "pruned": 0}
    assert labels(backbone) == [0, 1, 3, 5, 1, 3, 2, 4, 2, 4]
    after = snapshot(backbone)
    for name in NAMES:  # survivors and clones: every parameter exactly, position included
        assert torch.equal(after[name][:6], before[name][[0, 1, 3, 5, 1, 3]])
    for name in ("sh_dc", "sh_rest", "opacity_logits", "quats"):
        assert torch.equal(after[name][6:], before[name][[2, 4, 2, 4]])
    torch.testing.assert_close(after["log_scales"][6:].exp(), before["log_scales"][[2, 4, 2, 4]].exp() / 1.6)
    assert not torch.isclose(after["means"][6:], before["means"][[2, 4, 2, 4]]).all(1).any()
    assert not torch.isclose(after["means"][6:8], after["means"][8:]).all(1).any()


@pytest.mark.parametrize("extent", [1.0, 20.0])
def test_what_is_large_depends_on_the_extent(extent: float) -> None:
    sizes = [extent * 0.0099, extent * 0.0101]
    assert hand_made([1.0, 1.0], sizes, extent=extent).densify_and_prune(600) == {"cloned": 1, "split": 1, "pruned": 0}


def test_nothing_happens_between_events() -> None:
    backbone = hand_made([1.0, 1.0], [0.001, 0.05], [0.5, 0.001])
    table = dict(backbone.table.parameters)
    for step in (1, 500, 599, 601, 15000, 15100, 30000):
        assert backbone.densify_and_prune(step) == {}
    assert all(backbone.table[name] is table[name] for name in NAMES)


def test_statistics_start_anew_after_an_event() -> None:
    backbone = hand_made([1.0, 0.0, 1.0], [0.001, 0.001, 0.05])
    backbone.densify_and_prune(600)
    assert backbone.table.statistics["count"].tolist() == [0] * 5
    assert backbone.table.statistics["gradient"].tolist() == [0.0] * 5


def test_children_are_drawn_from_their_parent() -> None:
    # 90 degrees about z, of any length: the longest axis x of the Gaussian lies along y of the world
    half = math.sqrt(0.5)
    deviations, count = torch.tensor([0.8, 0.2, 0.05]), 40000
    parent = {
        "means": torch.tensor([5.0, -3.0, 1.0]).repeat(count, 1),
        "quats": 3 * torch.tensor([half, 0.0, 0.0, half]).repeat(count, 1),
        "log_scales": deviations.log().repeat(count, 1),
        "opacity_logits": torch.zeros(count),
    }
    born = children(parent, 1.6, torch.Generator().manual_seed(0))
    offsets = (born["means"] - parent["means"]).double()
    along = torch.tensor([0.2, 0.8, 0.05]).double()
    normalised = offsets / along
    # sampling error of a mean is 1 / 200, of a covariance 1.4 / 200
    assert normalised.mean(0).abs().max() < 0.02
    assert (normalised.T @ normalised / count - torch.eye(3)).abs().max() < 0.03
    torch.testing.assert_close(born["log_scales"].exp(), (deviations / 1.6).repeat(count, 1))


def test_children_of_a_tilted_parent_have_its_covariance() -> None:
    angle, axis = 0.7, torch.tensor([2.0, -1.0, 2.0]).double() / 3
    cross = torch.tensor([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]]).double()
    rotation = torch.linalg.matrix_exp(angle * cross)
    deviations, count = torch.tensor([0.9, 0.3, 0.1]), 40000
    quat = torch.cat([torch.tensor([math.cos(angle / 2)]), math.sin(angle / 2) * axis.float()])
    rows = {"means": torch.zeros(3), "quats": quat, "log_scales": deviations.log()}
    born = children({k: v.repeat(count, 1) for k, v in rows.items()}, 1.6, torch.Generator().manual_seed(1))
    samples = born["means"].double() @ rotation / deviations  # back in the parent's own axes
    assert (samples.T @ samples / count - torch.eye(3)).abs().max() < 0.03


def test_splitting_a_zero_quaternion_stays_finite() -> None:
    backbone = hand_made([1.0, 0.0], [0.05, 0.05])
    with torch.no_grad():
        backbone.table["quats"][0] = 0
    backbone.densify_and_prune(600)
    assert all(torch.isfinite(value).all() for value in snapshot(backbone).values())


def test_faint_primitives_go_and_huge_ones_after_the_first_reset() -> None:
    def event(step: int) -> tuple[dict[str, int], list[int]]:
        backbone = hand_made([0.0] * 5, [0.01, 0.01, 0.099, 0.11, 5.0], [0.0051, 0.0049, 0.5, 0.5, 0.5])
        return backbone.densify_and_prune(step), labels(backbone)

    assert event(600) == ({"cloned": 0, "split": 0, "pruned": 1}, [0, 2, 3, 4])
    assert event(3000)[1] == [0, 2, 3, 4]
    assert event(3100) == ({"cloned": 0, "split": 0, "pruned": 3}, [0, 2])


def test_new_children_are_pruned_at_once_where_they_are_faint_or_huge() -> None:
    backbone = hand_made([1.0, 1.0, 1.0, 0.0], [0.159, 0.161, 0.05, 0.01], [0.5, 0.5, 0.004, 0.5])
    assert backbone.densify_and_prune(3100) == {"cloned": 0, "split": 3, "pruned": 4}
    assert labels(backbone) == [3, 0, 0]  # 0.159 / 1.6 is below 0.1, 0.161 / 1.6 above


def test_a_cloud_about_to_vanish_stays() -> None:
    backbone = hand_made([0.0, 0.0], [0.01, 0.01], [0.001, 0.002])
    assert backbone.densify_and_prune(600)["pruned"] == 0
    assert labels(backbone) == [0, 1]


@pytest.mark.parametrize(
    ("cap", "expected"),
    [
        (8, [0, 1, 3, 1, 3, 2, 2]),
        (7, [0, 1, 3, 1, 3, 2, 2]),
        (6, [0, 1, 3, 3, 2, 2]),
        (5, [0, 1, 3, 2, 2]),
        (4, [0, 1, 2, 3]),
        (1, [0, 1, 2, 3]),
        (0, [0, 1, 3, 1, 3, 2, 2]),  # none
    ],
)
def test_no_primitive_is_added_beyond_the_cap_and_strong_gradients_come_first(cap: int, expected: list[int]) -> None:
    backbone = hand_made([0.0, 0.0003, 0.5, 0.2], [0.001, 0.001, 0.05, 0.001], cap=cap)
    done = backbone.densify_and_prune(600)
    assert labels(backbone) == expected
    assert done["cloned"] + done["split"] == len(expected) - 4
    assert done.get("withheld", 0) == 7 - len(expected)


# -- opacity reset -----------------------------------------------------------------------------------------------------


def test_reset_caps_opacities_and_forgets_their_moments_alone() -> None:
    backbone = hand_made([0.0] * 4, [0.01] * 4, [0.9, 0.011, 0.009, 0.006])
    learn(backbone)
    backbone.update(1)
    faint = backbone.table["opacity_logits"].detach()[2:].clone()
    others = {name: backbone.table[name] for name in NAMES if name != "opacity_logits"}
    backbone.control.reset_opacities(backbone.table)
    logits = backbone.table["opacity_logits"].detach()
    torch.testing.assert_close(logits[:2], torch.full((2,), -4.5951199))  # logit(0.01)
    torch.testing.assert_close(logits[2:], faint)
    state = backbone.table.optimiser.state
    moments = state[backbone.table["opacity_logits"]]
    assert not moments["exp_avg"].any()
    assert not moments["exp_avg_sq"].any()
    assert float(moments["step"]) == 1
    for name, parameter in others.items():
        assert backbone.table[name] is parameter
        assert state[parameter]["exp_avg"].all()


def test_reset_leaves_invisible_primitives_finite() -> None:
    backbone = hand_made([0.0] * 3, [0.01] * 3)
    with torch.no_grad():
        backbone.table["opacity_logits"].copy_(torch.tensor([-200.0, 200.0, 0.0]))
    backbone.control.reset_opacities(backbone.table)
    expected = torch.tensor([-200.0, -4.5951199, -4.5951199])
    torch.testing.assert_close(backbone.table["opacity_logits"].detach(), expected)


@pytest.mark.parametrize(
    ("background", "step", "resets"), [(0.0, 500, False), (1.0, 500, True), (0.0, 3000, True), (1.0, 15000, False)]
)
def test_resets_come_when_due(background: float, step: int, resets: bool) -> None:
    backbone = hand_made([0.0] * 2, [0.01] * 2, background=background)
    assert backbone.densify_and_prune(step).get("opacity_resets", 0) == int(resets)
    expected = 0.01 if resets else 0.5
    torch.testing.assert_close(backbone.table["opacity_logits"].detach().sigmoid(), torch.full((2,), expected))


def test_reset_comes_after_the_event_of_the_same_step() -> None:
    backbone = hand_made([0.0, 1.0, 0.0], [0.01, 0.001, 0.01], [0.9, 0.9, 0.0049])
    backbone.control.options = published_options(reset_opacity=0.004).density  # below what is pruned: the order shows
    assert backbone.densify_and_prune(3000) == {"cloned": 1, "split": 0, "pruned": 1, "opacity_resets": 1}
    torch.testing.assert_close(backbone.table["opacity_logits"].detach().sigmoid(), torch.full((3,), 0.004))


# -- density control and Adam ------------------------------------------------------------------------------------------


def test_an_event_costs_the_step_and_new_rows_start_without_moments() -> None:
    backbone = hand_made([0.0, 1.0, 1.0], [0.01, 0.001, 0.05])
    learn(backbone)
    backbone.update(599)
    learn(backbone)
    backbone.densify_and_prune(600)
    before = snapshot(backbone)
    backbone.update(600)
    for name in NAMES:
        assert torch.equal(backbone.table[name], before[name])
        state = backbone.table.optimiser.state[backbone.table[name]]
        assert float(state["step"]) == 1
        assert state["exp_avg"][:2].all()  # rows 0 and 1 keep theirs
        assert not state["exp_avg"][2:].any()
        assert not state["exp_avg_sq"][2:].any()


def test_an_event_without_candidates_costs_the_step_too() -> None:
    backbone = hand_made([0.0] * 2, [0.01] * 2)
    learn(backbone)
    backbone.densify_and_prune(600)
    before = snapshot(backbone)
    backbone.update(600)
    assert all(torch.equal(backbone.table[name], before[name]) for name in NAMES)


def adam_steps(backbone: GS3D) -> dict[str, float]:
    """Adam's count of steps of each parameter, which its bias corrections use."""
    table = backbone.table
    return {name: float(table.optimiser.state[table[name]].get("step", 0)) for name in NAMES}


def test_a_reset_outside_an_event_costs_only_opacity_its_step() -> None:
    backbone = hand_made([0.0] * 2, [0.01] * 2, background=1.0)
    learn(backbone)
    backbone.densify_and_prune(500)
    before, taken = snapshot(backbone), adam_steps(backbone)
    backbone.update(500)
    moved = [name for name in NAMES if not torch.equal(backbone.table[name], before[name])]
    assert moved == [name for name in NAMES if name != "opacity_logits"]
    assert [name for name in NAMES if adam_steps(backbone)[name] > taken[name]] == moved


def test_discard_forgets_gradients_without_moving() -> None:
    backbone = hand_made([0.0] * 2, [0.01] * 2)
    learn(backbone)
    assert sorted(name for name in gradients(backbone.table)) == sorted(NAMES)
    before = snapshot(backbone)
    zero_grad(backbone.table)
    assert gradients(backbone.table) == {}
    assert all(torch.equal(backbone.table[name], before[name]) for name in NAMES)


# -- going on exactly --------------------------------------------------------------------------------------------------


def step_on(backbone: GS3D, step: int) -> dict[str, int]:
    """One training step against a striped picture."""
    target = torch.zeros(3, 16, 24)
    target[:, :, ::3] = 0.9
    seen = small_scene(spread(4)).train[step % 4].camera
    drawn = backbone.draw(seen, step)
    picture = rasterize(drawn.splats, seen, RasterSettings())
    photometric(picture.image, target, 0.2).backward()
    backbone.accumulate(backbone.observe(drawn, picture, step))
    done = backbone.densify_and_prune(step)
    backbone.update(step)
    return done


def test_restored_backbone_goes_on_bit_for_bit() -> None:
    first = small_gs3d(small_scene(spread(30), views=2), iterations=300)  # events at 6, 8, ...; a reset at 30
    grown = [step_on(first, step) for step in range(1, 12)]
    assert any(done.get("split", 0) or done.get("cloned", 0) for done in grown)
    saved = {name: value.clone() for name, value in table_tensors(first.table).items()}
    second = small_gs3d(small_scene(spread(3), views=2), iterations=300, seed=5)  # another cloud, another size
    second.table = restore_table(second.table, {name: value.clone() for name, value in saved.items()})
    assert table_tensors(second.table).keys() == saved.keys()
    assert all(torch.equal(value, saved[name]) for name, value in table_tensors(second.table).items())
    second.control.generator.set_state(first.control.generator.get_state())
    for step in (*range(12, 18), 30):
        assert step_on(first, step) == step_on(second, step)
    left, right = table_tensors(first.table), table_tensors(second.table)
    assert left.keys() == right.keys()
    assert len(first.table) > 30
    assert all(torch.equal(left[name], right[name]) for name in left)


def test_untrained_backbone_can_be_restored() -> None:
    first, second = small_gs3d(small_scene(spread(5))), small_gs3d(small_scene(spread(9)), seed=1)
    second.table = restore_table(second.table, table_tensors(first.table))
    assert torch.equal(second.table["means"], first.table["means"])
    assert second.table.optimiser.state == {}
