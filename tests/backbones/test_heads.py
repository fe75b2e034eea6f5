"""The networks of Scaffold-GS against the table of their sizes and against sums written out."""

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor, nn

from gsx.backbones.heads import HeadOptions, Heads, linear, tiled
from gsx.core.errors import InputError

PLAIN = HeadOptions(
    features=32,
    bank=False,
    bank_distance=True,
    opacity_distance=False,
    covariance_distance=False,
    colour_distance=False,
    level=False,
    appearance=0,
    appearance_code=-1,
)
SMALL = replace(PLAIN, features=8)


def heads_of(options: HeadOptions = SMALL, offsets: int = 3, views: int = 4, seed: int = 0) -> Heads:
    return Heads(options, offsets, views, torch.Generator().manual_seed(seed))


def inputs(count: int = 5, width: int = 8) -> tuple[Tensor, Tensor, Tensor]:
    """(features, anchor minus camera, levels)."""
    generator = torch.Generator().manual_seed(3)
    feature, offset = (torch.randn(count, size, generator=generator) for size in (width, 3))
    return feature, 2 * offset, torch.arange(count)[:, None].float()


def count_of(module: nn.Module) -> int:
    return sum(parameter.numel() for parameter in module.parameters())


def network_by_hand(part: nn.Sequential, x: list[float]) -> list[float]:
    """One hidden layer with ReLU, in float64 sums; without the last activation."""

    def layer(which: nn.Linear, values: list[float]) -> list[float]:
        rows, biases = which.weight.tolist(), which.bias.tolist()
        return [sum(w * v for w, v in zip(row, values, strict=True)) + b for row, b in zip(rows, biases, strict=True)]

    return layer(part[2], [max(0.0, value) for value in layer(part[0], x)])


def direction_by_hand(offset: list[float]) -> tuple[list[float], float]:
    distance = math.sqrt(sum(value * value for value in offset))
    return [value / distance for value in offset], distance


def close(found: Tensor, wanted: list[float]) -> None:
    torch.testing.assert_close(found.double(), torch.tensor(wanted, dtype=torch.float64), rtol=0, atol=2e-6)


# -- sizes and beginnings ----------------------------------------------------------------------------------------------


def test_parameters_are_those_of_the_published_table() -> None:
    heads = heads_of(replace(PLAIN, bank=True), offsets=10)
    assert [count_of(part) for part in (heads.opacity, heads.covariance, heads.colour)] == [1482, 3462, 2142]
    assert count_of(heads.bank) == 259
    assert count_of(heads_of(PLAIN, offsets=10)) == 7086


@pytest.mark.parametrize(
    ("change", "widths"),
    [
        ({}, (35, 35, 35)),
        ({"opacity_distance": True}, (36, 35, 35)),
        ({"covariance_distance": True}, (35, 36, 35)),
        ({"colour_distance": True}, (35, 35, 36)),
        ({"level": True}, (36, 36, 36)),
        ({"appearance": 16}, (35, 35, 51)),
    ],
)
def test_each_toggle_widens_its_own_inputs(change: dict, widths: tuple[int, ...]) -> None:
    heads = heads_of(replace(PLAIN, **change))
    assert tuple(part[0].in_features for part in (heads.opacity, heads.covariance, heads.colour)) == widths


@pytest.mark.parametrize(("distance", "level", "width"), [(True, False, 4), (False, False, 3), (True, True, 5)])
def test_the_bank_sees_direction_and_what_it_is_told_to(distance: bool, level: bool, width: int) -> None:
    assert heads_of(replace(PLAIN, bank=True, bank_distance=distance, level=level)).bank[0].in_features == width


@pytest.mark.parametrize(("fan_in", "fan_out"), [(35, 400), (4, 900)])
def test_layers_begin_as_torch_begins_them(fan_in: int, fan_out: int) -> None:
    ours, theirs, bound = linear(fan_in, fan_out, torch.Generator().manual_seed(0)), nn.Linear(fan_in, fan_out), 0.0
    for name in ("weight", "bias"):
        values, default = getattr(ours, name).detach(), getattr(theirs, name).detach()
        bound = 1 / math.sqrt(fan_in)
        assert values.abs().max() <= bound
        assert default.abs().max() <= bound, "torch's own bound"
        assert values.abs().max() > 0.95 * bound
        assert abs(float(values.mean())) < 4 * bound / math.sqrt(3 * values.numel())
        assert float(values.std()) == pytest.approx(bound / math.sqrt(3), rel=0.1)


def test_codes_begin_standard_normal() -> None:
    codes = heads_of(replace(SMALL, appearance=32), views=300).appearance.weight.detach()
    assert abs(float(codes.mean())) < 0.05
    assert float(codes.std()) == pytest.approx(1, rel=0.05)


def test_the_generator_alone_decides() -> None:
    options = replace(SMALL, bank=True, appearance=4)
    before = torch.get_rng_state()
    first, again, other = heads_of(options), heads_of(options), heads_of(options, seed=1)
    assert torch.equal(before, torch.get_rng_state())
    for name, value in first.state_dict().items():
        assert torch.equal(value, again.state_dict()[name]), name
        assert not torch.equal(value, other.state_dict()[name]), name


# -- what goes in and comes out ----------------------------------------------------------------------------------------


def test_outputs_are_those_of_sums_written_out() -> None:
    """Every toggle on: feature, direction, distance, level, and for colour alone the code, last."""
    options = replace(
        SMALL, opacity_distance=True, covariance_distance=True, colour_distance=True, level=True, appearance=2
    )
    heads, (feature, offset, level) = heads_of(options), inputs()
    opacity, shape, colour = heads(feature, offset, level, 2)
    assert (opacity.shape, shape.shape, colour.shape) == ((5, 3), (5, 3, 7), (5, 3, 3))
    for row in range(5):
        direction, distance = direction_by_hand(offset[row].tolist())
        x = [*feature[row].tolist(), *direction, distance, float(row)]
        close(opacity[row], [math.tanh(value) for value in network_by_hand(heads.opacity, x)])
        close(shape[row].flatten(), network_by_hand(heads.covariance, x))
        seen = network_by_hand(heads.colour, [*x, *heads.appearance.weight[2].tolist()])
        close(colour[row].flatten(), [1 / (1 + math.exp(-value)) for value in seen])


def test_without_toggles_only_feature_and_direction_count() -> None:
    heads, (feature, offset, level) = heads_of(), inputs()
    opacity, *rest = heads(feature, offset, level, -1)
    direction, _ = direction_by_hand(offset[0].tolist())
    close(opacity[0], [math.tanh(v) for v in network_by_hand(heads.opacity, [*feature[0].tolist(), *direction])])
    moved = heads(feature, 3 * offset, level + 1, 2)
    for found, wanted in zip(moved, (opacity, *rest), strict=True):
        torch.testing.assert_close(found, wanted)


def test_tiling_repeats_the_whole_vector() -> None:
    feature = torch.arange(8.0)[None]
    assert tiled(feature, 4).tolist() == [[0, 4, 0, 4, 0, 4, 0, 4]]
    assert tiled(feature, 2).tolist() == [[0, 2, 4, 6, 0, 2, 4, 6]]


@pytest.mark.parametrize(("distance", "level"), [(True, False), (False, True)])
def test_the_bank_mixes_tiled_features_by_softmax(distance: bool, level: bool) -> None:
    heads = heads_of(replace(SMALL, bank=True, bank_distance=distance, level=level))
    plain = heads_of(replace(SMALL, level=level))
    plain.load_state_dict({k: v for k, v in heads.state_dict().items() if not k.startswith("bank")})
    feature, offset, levels = inputs()
    mixed = torch.empty_like(feature)
    for row in range(5):
        direction, far = direction_by_hand(offset[row].tolist())
        x = [*direction, *([far] if distance else []), *([float(row)] if level else [])]
        powers = [math.exp(value) for value in network_by_hand(heads.bank, x)]
        coarse, middle, fine = (power / sum(powers) for power in powers)
        f = feature[row].tolist()
        mixed[row] = torch.tensor([coarse * f[4 * (c % 2)] + middle * f[2 * (c % 4)] + fine * f[c] for c in range(8)])
    for found, wanted in zip(heads(feature, offset, levels, -1), plain(mixed, offset, levels, -1), strict=True):
        torch.testing.assert_close(found, wanted, rtol=0, atol=2e-6)


@pytest.mark.parametrize(("chosen", "view", "rows"), [(-1, 1, [1]), (-1, -1, [0, 1, 2, 3]), (2, -1, [2]), (2, 0, [0])])
def test_training_views_have_their_own_code_and_others_the_configured_one(
    chosen: int, view: int, rows: list[int]
) -> None:
    heads = heads_of(replace(SMALL, appearance=5, appearance_code=chosen))
    wanted = torch.stack([heads.appearance.weight[row] for row in rows]).mean(0)
    torch.testing.assert_close(heads.code(view), wanted)
    opacity, shape, colour = heads(*inputs(), view)
    (opacity.sum() + shape.sum()).backward(retain_graph=True)
    assert heads.appearance.weight.grad is None, "codes reach colours alone"
    colour.sum().backward()
    assert heads.appearance.weight.grad.abs().sum(1).nonzero()[:, 0].tolist() == rows


def test_a_camera_at_an_anchor_sees_something_finite() -> None:
    options = replace(SMALL, bank=True, opacity_distance=True, covariance_distance=True, colour_distance=True)
    heads, (feature, offset, level) = heads_of(options), inputs()
    feature.requires_grad_()
    outputs = heads(feature, torch.zeros_like(offset), level, -1)
    sum(output.sum() for output in outputs).backward()
    for value in (*outputs, feature.grad, *(p.grad for p in heads.parameters())):
        assert torch.isfinite(value).all()


def test_no_anchors_give_no_outputs() -> None:
    feature, offset, level = inputs()
    outputs = heads_of(replace(SMALL, bank=True, appearance=2))(feature[:0], offset[:0], level[:0], 0)
    assert [tuple(output.shape) for output in outputs] == [(0, 3), (0, 3, 7), (0, 3, 3)]


def test_impossible_options_are_refused_by_name() -> None:
    with pytest.raises(ValueError, match=r"backbone\.heads\.features is 6; give a multiple of 4"):
        replace(SMALL, features=6)


def test_a_code_of_no_view_is_refused() -> None:
    with pytest.raises(InputError, match="appearance_code is 4; training views have numbers 0 to 3"):
        heads_of(replace(SMALL, appearance=2, appearance_code=4))
