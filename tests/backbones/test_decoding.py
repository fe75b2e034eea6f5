"""Anchors into Gaussians, against loops over anchors and offsets in float64 and finite differences."""

import math
from dataclasses import replace

import pytest
import torch
from test_heads import SMALL, heads_of
from torch import Tensor
from torch.nn import Parameter

from gsx.backbones.decoding import DrawnAnchors, Explicit, Neural, VisibleAnchors, baked
from gsx.backbones.heads import Heads
from gsx.core.data.camera import Camera, look_at
from gsx.core.gaussians.sh import colours_of
from gsx.core.gaussians.splats import Splats
from gsx.core.training.parameter_table import ParameterTable

CAMERA = look_at([0.3, -4, 1], [0, 0, 0], fov_x=0.9, width=24, height=16)
FIELDS = ("means", "scales", "quats", "log_opacities", "colours")


class Fixed(Heads):
    """Networks whose outputs are given; they remember what they were asked."""

    def __init__(self, opacities: Tensor, shapes: Tensor, colours: Tensor) -> None:
        super().__init__(SMALL, opacities.shape[1], 1, torch.Generator())
        self.outputs, self.asked = (opacities, shapes, colours), None

    def forward(self, feature, offset, level, view):
        self.asked = (feature, offset, level, view)
        return self.outputs


def table_of(count: int = 6, k: int = 3, dtype: torch.dtype = torch.float32, **columns: Tensor) -> ParameterTable:
    """Anchors with random values."""
    generator = torch.Generator().manual_seed(5)
    shapes = {"offsets": (count, k, 3), "features": (count, 8), "log_scales": (count, 6)}
    values = {name: torch.randn(*shape, generator=generator).to(dtype) for name, shape in shapes.items()}
    values["log_scales"] = values["log_scales"] / 2 - 1
    positions = torch.randn(count, 3, generator=generator).to(dtype)
    return ParameterTable({name: Parameter(value) for name, value in values.items()}, {"anchors": positions, **columns})


def explicit_table(count: int = 6, dtype: torch.dtype = torch.float32, degree: int = 3) -> ParameterTable:
    generator, bands = torch.Generator().manual_seed(6), (degree + 1) ** 2 - 1
    shapes = {
        "offsets": (count, 1, 3), "log_scales": (count, 6), "quats": (count, 4), "opacity_logits": (count,),
        "sh_dc": (count, 1, 3), "sh_rest": (count, bands, 3),
    }  # fmt: skip
    values = {name: torch.randn(*shape, generator=generator).to(dtype) / 2 for name, shape in shapes.items()}
    positions = torch.randn(count, 3, generator=generator).to(dtype)
    return ParameterTable({name: Parameter(value) for name, value in values.items()}, {"anchors": positions})


def draw(rows: list[int], weights: list[float] | None = None, camera: Camera = CAMERA, **more: int) -> VisibleAnchors:
    given = torch.tensor(weights or [1.0] * len(rows))
    return VisibleAnchors(
        rows=torch.tensor(rows, dtype=torch.long), weights=given, camera=camera, **({"view": -1, "sh_degree": 3} | more)
    )


def sigmoid(value: float) -> float:
    return 1 / (1 + math.exp(-value))


def fixed_outputs(opacities: list[list[float]]) -> Fixed:
    """The opacities given; every raw shape and colour a number of its own."""
    rows, k = len(opacities), len(opacities[0])
    shapes = torch.arange(rows * k * 7).reshape(rows, k, 7) / 100 - 0.5
    return Fixed(torch.tensor(opacities), shapes, torch.arange(rows * k * 3).reshape(rows, k, 3) / 100 + 0.01)


def check_against_loop(decoded: DrawnAnchors, table: ParameterTable, heads: Fixed, drawn: VisibleAnchors) -> None:
    """Which Gaussians there are, in which order, with which values: one anchor and offset after the other."""
    opacities, shapes, colours = (output.tolist() for output in heads.outputs)
    offsets, lengths = table["offsets"].tolist(), table["log_scales"].exp().tolist()
    number = 0
    for i, row in enumerate(drawn.rows.tolist()):
        for j in range(heads.offsets):
            opacity = opacities[i][j] * float(drawn.weights[i])
            assert float(decoded.opacities[i, j]) == pytest.approx(max(0.0, opacity))
            if not opacity > 0:
                continue
            raw, length = shapes[i][j], lengths[row]
            mean = [table["anchors"][row, axis] + offsets[row][j][axis] * length[axis] for axis in range(3)]
            splat = {name: getattr(decoded.splats, name)[number].tolist() for name in FIELDS}
            assert int(decoded.slots[number]) == row * heads.offsets + j
            assert splat["means"] == pytest.approx([float(value) for value in mean], abs=1e-6)
            assert splat["scales"] == pytest.approx([length[3 + a] * sigmoid(raw[a]) for a in range(3)])
            assert splat["quats"] == pytest.approx(raw[3:])
            assert math.exp(splat["log_opacities"]) == pytest.approx(opacity)
            assert splat["colours"] == pytest.approx(colours[i][j])
            number += 1
    assert len(decoded.splats) == len(decoded.slots) == number


# -- networks ----------------------------------------------------------------------------------------------------------


def test_anchors_decode_as_in_a_loop() -> None:
    table = table_of()
    opacities = [[0.5, -0.2, 0.9], [-0.1, -1.0, -0.3], [0.0, 1.0, 1e-30], [0.1, 0.2, 0.3]]
    heads, drawn = fixed_outputs(opacities), draw([1, 2, 4, 5])
    decoded = Neural(heads).decode(table, drawn)
    check_against_loop(decoded, table, heads, drawn)
    assert decoded.slots.tolist() == [3, 5, 13, 14, 15, 16, 17], "0 is not drawn, 1e-30 is"


def test_weights_of_a_level_fade_opacities_before_the_choice() -> None:
    table, opacities = table_of(), [[0.5, -0.2, 0.9], [0.4, 0.3, -0.3], [0.1, 0.2, 0.3]]
    heads, drawn = fixed_outputs(opacities), draw([0, 3, 4], [0.25, 0.0, 1.0])
    decoded = Neural(heads).decode(table, drawn)
    check_against_loop(decoded, table, heads, drawn)
    assert decoded.slots.tolist() == [0, 2, 12, 13, 14], "nothing is left of an anchor of weight 0"


def test_networks_are_asked_with_the_feature_and_from_the_camera_to_the_anchor() -> None:
    table = table_of(level=torch.tensor([0, 1, 2, 3, 4, 5], dtype=torch.int16))
    heads = fixed_outputs([[0.5] * 3] * 2)
    Neural(heads).decode(table, draw([4, 2], view=7))
    feature, offset, level, view = heads.asked
    assert torch.equal(feature, table["features"][[4, 2]])
    torch.testing.assert_close(offset, table["anchors"][[4, 2]] - torch.tensor([0.3, -4, 1]))
    assert level.tolist() == [[4.0], [2.0]]
    assert view == 7


def test_fresh_anchors_decode_to_their_place_at_about_half_their_length() -> None:
    """Unit check (a): zero features and offsets; exactly half where the networks say nothing."""
    neural = Neural(heads_of(offsets=3))
    rows = neural.rows(torch.tensor([0.0, 1.0, -2.0]), torch.full((3, 3), 0.5))
    assert not rows["features"].any()
    assert not rows["offsets"].any()
    table = ParameterTable({n: Parameter(v) for n, v in rows.items()}, {"anchors": torch.arange(9.0).view(3, 3)})
    decoded = neural.decode(table, draw([0, 1, 2]))
    owner = decoded.slots // 3
    assert torch.equal(decoded.splats.means, table["anchors"][owner])
    length = torch.tensor([0.0, 1.0, -2.0]).exp()[owner, None]
    assert ((decoded.splats.scales / length > 0.25) & (decoded.splats.scales / length < 0.75)).all()
    with torch.no_grad():
        neural.heads.covariance[2].weight.zero_()
        neural.heads.covariance[2].bias.zero_()
    scales = neural.decode(table, draw([0, 1, 2])).splats.scales
    torch.testing.assert_close(scales, (0.5 * length).expand(-1, 3))


def test_decoded_values_lie_where_they_may() -> None:
    splats = Neural(heads_of()).decode(table_of(count=40), draw(list(range(40)))).splats
    assert 0 < len(splats) < 120
    assert (splats.log_opacities < 0).all()
    assert ((splats.colours > 0) & (splats.colours < 1)).all()


def test_a_camera_at_an_anchor_decodes_finite_values() -> None:
    table = table_of()
    table.columns["anchors"][2] = CAMERA.centre.float()
    splats = Neural(heads_of(seed=2)).decode(table, draw([2])).splats
    assert all(torch.isfinite(getattr(splats, name)).all() for name in FIELDS)


def decoded_values(decoded: DrawnAnchors) -> tuple[Tensor, ...]:
    return tuple(getattr(decoded.splats, name) for name in FIELDS)


@pytest.mark.parametrize("filtered", [False, True])
def test_gradients_of_decoding_are_finite_differences(filtered: bool) -> None:
    options = replace(SMALL, bank=True, opacity_distance=True, colour_distance=True, appearance=2)
    neural, table = Neural(heads_of(options).double()), table_of(dtype=torch.float64)
    if filtered:
        table.columns["filter"] = torch.tensor([9.0, 0.1, 9, 9, 0.4, 9], dtype=torch.float64)
    drawn = replace(draw([1, 4]), weights=torch.tensor([0.5, 1.0], dtype=torch.float64))
    names = ("offsets", "features", "log_scales")

    def decode(*values: Tensor) -> tuple[Tensor, ...]:
        table.parameters = dict(zip(names, values, strict=True))
        return decoded_values(neural.decode(table, drawn))

    values = [table[name].detach().clone().requires_grad_() for name in names]
    assert len(decode(*values)[0]) > 0
    assert torch.autograd.gradcheck(decode, values)


def test_every_network_learns() -> None:
    neural = Neural(heads_of(replace(SMALL, bank=True, appearance=2)))
    sum(value.square().sum() for value in decoded_values(neural.decode(table_of(), draw([0, 1, 2])))).backward()
    for name, parameter in neural.heads.named_parameters():
        assert parameter.grad is not None, name
        assert parameter.grad.abs().sum() > 0, name


@pytest.mark.parametrize("rows", [[], [0, 3]])
def test_nothing_to_draw_is_no_error(rows: list[int]) -> None:
    table, heads = table_of(), fixed_outputs([[-0.5, 0.0, -1.0]] * 2)
    heads.outputs = tuple(output[: len(rows)] for output in heads.outputs)
    decoded = Neural(heads).decode(table, draw(rows))
    assert len(decoded.splats) == 0
    assert tuple(decoded.opacities.shape) == (len(rows), 3)
    assert not decoded.opacities.any()


def test_long_lengths_stay_finite() -> None:
    table = table_of()
    with torch.no_grad():
        table["log_scales"].fill_(1000.0)
    splats = Neural(fixed_outputs([[0.5] * 3])).decode(table, draw([0])).splats
    assert torch.isfinite(splats.scales.square()).all()
    assert torch.isfinite(splats.means).all()


# -- explicit Gaussians ------------------------------------------------------------------------------------------------


def test_explicit_anchors_decode_as_in_a_loop() -> None:
    table, drawn = explicit_table(), draw([5, 0, 3], [1.0, 0.25, 0.5], sh_degree=2)
    decoded = Explicit(3, 0.0).decode(table, drawn)
    assert decoded.slots.tolist() == [5, 0, 3]
    for i, row in enumerate([5, 0, 3]):
        length = table["log_scales"][row].exp()
        mean = table["anchors"][row] + table["offsets"][row, 0] * length[:3]
        opacity = sigmoid(table["opacity_logits"][row].item()) * float(drawn.weights[i])
        torch.testing.assert_close(decoded.splats.means[i], mean)
        torch.testing.assert_close(decoded.splats.scales[i], length[3:])
        assert torch.equal(decoded.splats.quats[i], table["quats"][row])
        assert math.exp(decoded.splats.log_opacities[i].item()) == pytest.approx(opacity, rel=1e-5)
        assert float(decoded.opacities[i, 0]) == pytest.approx(opacity, rel=1e-5)
        view = (mean - CAMERA.centre.float())[None]
        colour = colours_of(table["sh_dc"][row][None], table["sh_rest"][row, :8][None], view, 2)[0]
        torch.testing.assert_close(decoded.splats.colours[i], colour)


def test_gradients_of_explicit_decoding_are_finite_differences() -> None:
    table, names = explicit_table(dtype=torch.float64), tuple(explicit_table().parameters)
    drawn = replace(draw([1, 4]), weights=torch.tensor([0.5, 1.0], dtype=torch.float64))

    def decode(*values: Tensor) -> tuple[Tensor, ...]:
        table.parameters = dict(zip(names, values, strict=True))
        return decoded_values(Explicit(3, 0.0).decode(table, drawn))

    assert torch.autograd.gradcheck(decode, [table[name].detach().clone().requires_grad_() for name in names])


def test_new_explicit_anchors_show_the_colour_given() -> None:
    rows = Explicit(1, -2.0).rows(torch.tensor([0.5]), torch.tensor([[0.2, 0.5, 0.9]]))
    assert {name: tuple(value.shape) for name, value in rows.items()} == {
        "offsets": (1, 1, 3), "log_scales": (1, 6), "quats": (1, 4), "opacity_logits": (1,),
        "sh_dc": (1, 1, 3), "sh_rest": (1, 3, 3),
    }  # fmt: skip
    shown = colours_of(rows["sh_dc"], rows["sh_rest"], torch.ones(1, 3), 1)
    torch.testing.assert_close(shown, torch.tensor([[0.2, 0.5, 0.9]]))
    assert rows["quats"].tolist() == [[1, 0, 0, 0]]
    assert rows["opacity_logits"].tolist() == [-2.0]


def test_values_that_underflow_can_be_written() -> None:
    splats = Splats(
        means=torch.zeros(1, 3),
        scales=torch.zeros(1, 3),
        quats=torch.zeros(1, 4),
        log_opacities=torch.zeros(1),
        colours=torch.zeros(1, 3),
    )
    values = vars(baked(splats, torch.zeros(1, 3), torch.zeros(1, 0, 3)))
    assert all(torch.isfinite(value).all() for value in values.values())
    faded = Explicit(3, 0.0).decode(explicit_table(), draw([1], [0.0]))
    assert torch.isfinite(faded.splats.log_opacities).all()
    assert float(faded.opacities) < 1e-30
