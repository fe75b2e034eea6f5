"""The order in which rows go: what is worth little by itself, what is two of the same thing merged at no cost."""

from dataclasses import replace

import pytest
import torch
from small_scene import published_options, small_gs3d, small_scene, spread
from torch import Tensor
from torch.nn import Parameter
from torch.nn.functional import logsigmoid

from gsx.backbones.gs3d import GS3D
from gsx.backbones.merging import surfaces
from gsx.core.data.camera import Camera
from gsx.core.gaussians.sh import colour_of_constant
from gsx.core.quality.metrics import psnr
from gsx.core.rasterizer import rasterize
from gsx.core.training.parameter_table import ParameterTable, append_rows, detached_rows
from gsx.experiments.compact.reduction import Reduction, cheapest, pairs_of
from gsx.formats.smoothing import smoothed

STEP = 30000


def model_of(count: int) -> GS3D:
    """Gaussians of several colours before a camera."""
    colours = torch.randint(0, 255, (count, 3), generator=torch.Generator().manual_seed(1)).to(torch.uint8)
    model = small_gs3d(small_scene(spread(count), colours), options=replace(published_options(), sh_degree=1))
    with torch.no_grad():
        model.table["log_scales"].copy_(spread(count, 2) - 2.5)
        model.table["opacity_logits"].copy_(spread(count, 3)[:, 0])
    return model


def doubled(count: int) -> tuple[GS3D, Tensor]:
    """(a model in which each of `count` rows has become two at its place, that draw what it drew; its pictures)."""
    model = model_of(count)
    before = pictures(model)
    half = 1 - (1 - model.table["opacity_logits"].detach().sigmoid()) ** 0.5
    rows = detached_rows(model.table) | {"opacity_logits": torch.logit(half)}
    with torch.no_grad():
        model.table["opacity_logits"].copy_(rows["opacity_logits"])
    append_rows(model.table, rows)
    return model, before


def picture(model: GS3D, camera: Camera) -> Tensor:
    return rasterize(model.draw(camera, STEP).splats, camera, model.raster).image


def pictures(model: GS3D) -> Tensor:
    """Of all views, side by side."""
    with torch.no_grad():
        return torch.cat([picture(model, view.camera) for view in model.context.scene.train], 2)


def reduction_of(model: GS3D, worth: Tensor) -> Reduction:
    return Reduction(model.table, worth, colour_of_constant(model.table["sh_dc"].detach()[:, 0]))


def test_two_of_the_same_become_one() -> None:
    """A third of twelve rows goes, in two rounds: pictures are much nearer to what they were than where one of each two
    is merely removed."""
    found = {}
    for merging in (True, False):
        model, before = doubled(6)
        worth = torch.ones(12)
        reduction = reduction_of(model, worth) if merging else Reduction(model.table, worth, None)
        reduction.apply(model.table, 4 / 12)
        assert len(model.table) == 8
        assert [bool((one.into >= 0).all()) for one in reduction.rounds] == [merging, merging]
        found[merging] = psnr(pictures(model), before)
    assert found[True] > found[False] + 6
    assert found[True] > 40


def test_what_is_worth_nothing_goes_first() -> None:
    model = model_of(8)
    worth = torch.tensor([5.0, 0, 7, 6, 0, 8, 9, 4])
    before = model.table["means"].detach().clone()
    reduction_of(model, worth).apply(model.table, 2 / 8)
    assert torch.equal(model.table["means"].detach(), before[[0, 2, 3, 5, 6, 7]])


def test_no_round_takes_more_than_a_quarter_and_one_row_stays() -> None:
    model = model_of(20)
    reduction = reduction_of(model, torch.rand(20, generator=torch.Generator().manual_seed(3)))
    reduction.apply(model.table, 1.0)
    assert len(model.table) == 1
    left = 20
    for found in reduction.rounds:
        assert len(found.gone) <= left / 4 + 1
        touched = found.gone.tolist() + [row for row in found.into.tolist() if row >= 0]
        assert len(touched) == len(set(touched))
        left -= len(found.gone)


def test_a_larger_share_goes_on_where_a_smaller_one_ended() -> None:
    """The rows that are left of one are merged or gone in the other; worth adds up."""
    model = model_of(16)
    worth = torch.rand(16, generator=torch.Generator().manual_seed(3))
    reduction = reduction_of(model, worth)
    small, large = model_of(16), model_of(16)
    reduction.apply(small.table, 0.25)
    first = reduction.rounds[0]
    reduction.apply(large.table, 0.5)
    assert reduction.rounds[0] is first
    again = model_of(16)
    reduction.apply(again.table, 0.25)
    assert torch.equal(again.table["means"], small.table["means"])
    lost = sum(float(worth[row]) for row, into in zip(first.gone, first.into, strict=True) if into < 0)
    one_round = reduction_of(model_of(16), worth)
    one_round.add_round()
    assert float(one_round.importance.sum()) == pytest.approx(float(worth.sum()) - lost, rel=1e-5)


def test_levels_are_not_merged() -> None:
    rows = detached_rows(model_of(12).table) | {"level": (torch.arange(12) % 2).to(torch.int16)}
    first, second = pairs_of(rows)
    assert len(first) > 0
    assert torch.equal(first % 2, second % 2)


def test_rows_that_are_no_gaussians_go_by_themselves() -> None:
    table = ParameterTable({"anchors": Parameter(torch.arange(8.0)[:, None])})
    reduction = Reduction(table, torch.arange(8.0).flip(0), None)
    reduction.apply(table, 0.5)
    assert table["anchors"].flatten().tolist() == [0, 1, 2, 3]


def test_rows_are_merged_as_a_filter_draws_them() -> None:
    """Two discs 0.2 thick, half a filter's size from their middle: drawn they are sqrt(1.04) thick and 0.049 opaque,
    not 0.5; 0.25 comes to the variance across. Merged without the filter they would become twice as opaque."""
    model = model_of(2)
    with torch.no_grad():
        model.table["means"].copy_(torch.tensor([[0.0, 0, -0.5], [0, 0, 0.5]]))
        model.table["log_scales"].copy_(torch.tensor([1.0, 1, 0.2]).log().expand(2, 3))
        model.table["quats"].copy_(torch.tensor([1.0, 0, 0, 0]).expand(2, 4))
        model.table["opacity_logits"].zero_()
    model.table.columns["filter"] = torch.ones(2)
    Reduction(model.table, torch.ones(2), torch.ones(2, 3)).apply(model.table, 0.5)
    assert len(model.table) == 1
    scales, log_opacities = smoothed(
        model.table["log_scales"].detach().exp(), logsigmoid(model.table["opacity_logits"].detach()), torch.ones(1)
    )
    wide, thin, thick = 2**0.5, 1.04**0.5, 1.29**0.5
    assert sorted(scales[0].tolist()) == pytest.approx([thick, wide, wide], rel=1e-5)
    before, after = surfaces(torch.tensor([[wide, wide, thin], [wide, wide, thick]])).tolist()
    assert log_opacities.exp().tolist() == pytest.approx([2 * 0.5 * 0.5 * 0.2 / thin * before / after], rel=1e-4)


def test_the_order_is_that_of_the_beginning() -> None:
    """Though the model has learnt on since."""
    model = model_of(12)
    still, moving = (reduction_of(model, spread(12, 5)[:, 0].abs()) for _ in range(2))
    still.add_round()
    with torch.no_grad():
        model.table["means"].add_(spread(12, 6))
    moving.add_round()
    assert torch.equal(still.rounds[0].gone, moving.rounds[0].gone)
    assert torch.equal(still.rounds[0].into, moving.rounds[0].into)
    assert all(torch.equal(value, moving.rows[name]) for name, value in still.rows.items())


def test_merged_rows_begin_with_the_moments_of_both() -> None:
    """Second moments of both; along axes of their own in the mean over these. First moments are 0."""
    model, _ = doubled(6)
    picture(model, model.context.scene.train[0].camera).square().sum().backward()
    model.update(STEP)
    states = {name: model.table.optimiser.state[parameter] for name, parameter in model.table.parameters.items()}
    before = {name: state["exp_avg_sq"].clone() for name, state in states.items()}
    reduction = reduction_of(model, torch.ones(12))
    reduction.apply(model.table, 1 / 12)
    one, other = int(reduction.rounds[0].gone[0]), int(reduction.rounds[0].into[0])
    for name, parameter in model.table.parameters.items():
        state, both = model.table.optimiser.state[parameter], before[name][one] + before[name][other]
        expected = both.mean().expand_as(both) if name in ("quats", "log_scales") else both
        torch.testing.assert_close(state["exp_avg_sq"][-1], expected)
        assert not state["exp_avg"][-1].any()
    assert float(before["opacity_logits"].min()) > 0


def test_the_cheapest_ways_with_each_row_once() -> None:
    """Rows 0..3 cost 5, 1, 9, 9; merging 0 with 1 costs 2, 2 with 3 costs 3, 0 with 2 costs 4."""
    costs = torch.tensor([5.0, 1, 9, 9, 2, 3, 4])
    first, second = torch.tensor([0, 2, 0]), torch.tensor([1, 3, 2])
    assert cheapest(costs, first, second, 4, 2) == ([1, 2], [-1, 3])
    assert cheapest(costs, first, second, 4, 4) == ([1, 2, 0], [-1, 3, -1])
