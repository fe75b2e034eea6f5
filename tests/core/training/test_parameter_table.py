"""Rows and Adam moments through surgery, against Adam written out in float64 row by row."""

import math
from dataclasses import dataclass, field

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor, nn
from torch.nn import Parameter

from gsx.core.errors import CheckpointError, ConfigError
from gsx.core.training.parameter_table import (
    Networks,
    ParameterTable,
    append_rows,
    gradients,
    group_of,
    keep_rows,
    named_parameters,
    reset_column,
    restore_table,
    shared_colour,
    size_of,
    table_tensors,
    take_adam_step,
)

SHAPES = {"flat": (), "rows": (3,), "blocks": (2, 2)}
RATES = {"flat": 0.05, "rows": 0.001, "blocks": 0.02}


def values(name: str, identity: int, salt: int = 0) -> Tensor:
    """Numbers that belong to one row of one parameter and to no other."""
    seed = 1000 * identity + 10 * list(SHAPES).index(name) + salt
    return torch.randn(SHAPES[name], generator=torch.Generator().manual_seed(seed))


def rows_of(identities: list[int], salt: int = 0) -> dict[str, Tensor]:
    return {
        name: torch.stack([values(name, i, salt) for i in identities]) if identities else torch.empty(0, *shape)
        for name, shape in SHAPES.items()
    }


@dataclass
class Row:
    """One row of one parameter, and its moments, as Adam's paper has them."""

    value: Tensor
    first: Tensor = field(init=False)
    second: Tensor = field(init=False)

    def __post_init__(self) -> None:
        self.value = self.value.double()
        self.forget()

    def forget(self) -> None:
        self.first, self.second = torch.zeros_like(self.value), torch.zeros_like(self.value)

    def move(self, gradient: Tensor, rate: float, step: int) -> None:
        self.first = 0.9 * self.first + 0.1 * gradient.double()
        self.second = 0.999 * self.second + 0.001 * gradient.double().square()
        first, second = self.first / (1 - 0.9**step), self.second / (1 - 0.999**step)
        self.value = self.value - rate * first / (second.sqrt() + 1e-15)


class Ledger:
    """What the table should hold: a dictionary by identity instead of rows by position."""

    def __init__(self, identities: list[int]) -> None:
        self.identities = list(identities)
        self.rows = {name: {i: Row(values(name, i)) for i in identities} for name in SHAPES}
        self.steps = dict.fromkeys(SHAPES, 0)
        self.table = ParameterTable({name: Parameter(value) for name, value in rows_of(identities).items()})
        for name, rate in RATES.items():
            self.table.set_rate(name, rate)

    def append(self, identities: list[int]) -> None:
        append_rows(self.table, rows_of(identities))
        self.identities += identities
        for name in SHAPES:
            self.rows[name] |= {i: Row(values(name, i)) for i in identities}

    def keep(self, marks: list[bool]) -> None:
        kept = [mark for mark, _ in zip(marks * len(self.identities), self.identities, strict=False)]
        kept[0] = True  # an empty table is tested apart
        keep_rows(self.table, torch.tensor(kept))
        self.identities = [i for i, keep in zip(self.identities, kept, strict=True) if keep]

    def reset(self, name: str) -> None:
        new = rows_of(self.identities, salt=7)[name]
        reset_column(self.table, name, new)
        for i, value in zip(self.identities, new, strict=True):
            self.rows[name][i] = Row(value)

    def backward(self, salt: int) -> None:
        for name, gradient in rows_of(self.identities, salt).items():
            self.table[name].grad = gradient

    def step(self, salt: int) -> None:
        self.backward(salt)
        self.table.optimiser.step()
        self.table.optimiser.zero_grad()
        for name, rate in RATES.items():
            self.steps[name] += 1
            for i in self.identities:
                self.rows[name][i].move(values(name, i, salt), rate, self.steps[name])

    def check(self) -> None:
        assert len(self.table) == len(self.identities)
        for name in SHAPES:
            rows, parameter = self.rows[name], self.table[name]
            expected = torch.stack([rows[i].value for i in self.identities])
            torch.testing.assert_close(parameter.detach().double(), expected, atol=2e-5, rtol=2e-5)
            state = self.table.optimiser.state.get(parameter, {})
            if state:
                assert float(state["step"]) == self.steps[name]
                for key, moments in (
                    ("exp_avg", [rows[i].first for i in self.identities]),
                    ("exp_avg_sq", [rows[i].second for i in self.identities]),
                ):
                    torch.testing.assert_close(state[key].double(), torch.stack(moments), atol=1e-7, rtol=1e-5)
            else:
                assert self.steps[name] == 0


action = st.one_of(
    st.tuples(st.just("append"), st.integers(0, 4)),
    st.tuples(st.just("keep"), st.lists(st.booleans(), min_size=1, max_size=7)),
    st.tuples(st.just("reset"), st.sampled_from(list(SHAPES))),
    st.tuples(st.just("step"), st.integers(1, 3)),
)


@settings(max_examples=60, deadline=None)
@given(actions=st.lists(action, max_size=8), count=st.integers(1, 5))
def test_rows_and_moments_stay_aligned_through_any_surgery(actions: list[tuple], count: int) -> None:
    ledger, fresh = Ledger(list(range(count))), count
    for kind, value in actions:
        if kind == "append":
            ledger.append(list(range(fresh, fresh + value)))
            fresh += value
        else:
            getattr(ledger, kind)(value)
        ledger.check()
    ledger.step(5)
    ledger.check()
    assert set(ledger.table.optimiser.state) == set(ledger.table.parameters.values())


def trained(count: int = 5) -> Ledger:
    ledger = Ledger(list(range(count)))
    for salt in (1, 2, 3):
        ledger.step(salt)
    return ledger


def moments(table: ParameterTable, name: str) -> tuple[Tensor, Tensor, float]:
    state = table.optimiser.state[table[name]]
    return state["exp_avg"].clone(), state["exp_avg_sq"].clone(), float(state["step"])


@pytest.mark.parametrize("name", SHAPES)
def test_survivors_are_unchanged_bit_for_bit_and_new_rows_start_at_zero(name: str) -> None:
    table = trained().table
    before, (first, second, steps) = table[name].detach().clone(), moments(table, name)
    append_rows(table, rows_of([10, 11]))
    assert torch.equal(table[name][:5], before)
    assert torch.equal(table[name][5:], rows_of([10, 11])[name])
    new_first, new_second, new_steps = moments(table, name)
    assert torch.equal(new_first[:5], first)
    assert torch.equal(new_second[:5], second)
    assert not new_first[5:].any()
    assert not new_second[5:].any()
    assert new_steps == steps == 3


@pytest.mark.parametrize("name", SHAPES)
def test_removed_rows_take_their_moments_along(name: str) -> None:
    table, kept = trained().table, torch.tensor([False, True, False, True, True])
    before, (first, second, steps) = table[name].detach().clone(), moments(table, name)
    keep_rows(table, kept)
    assert torch.equal(table[name], before[kept])
    new_first, new_second, new_steps = moments(table, name)
    assert torch.equal(new_first, first[kept])
    assert torch.equal(new_second, second[kept])
    assert new_steps == steps


def test_reset_zeroes_the_moments_of_one_parameter_alone() -> None:
    table = trained().table
    others = {name: moments(table, name) for name in ("rows", "blocks")}
    reset_column(table, "flat", torch.full((5,), -4.6))
    first, second, steps = moments(table, "flat")
    assert not first.any()
    assert not second.any()
    assert steps == 3
    assert torch.all(table["flat"] == -4.6)
    for name, (first, second, steps) in others.items():
        now = moments(table, name)
        assert torch.equal(now[0], first)
        assert torch.equal(now[1], second)
        assert now[2] == steps


def test_a_step_after_surgery_moves_only_what_was_left_alone() -> None:
    ledger = trained()
    ledger.backward(4)
    reset_column(ledger.table, "flat", torch.zeros(5))
    before = {name: ledger.table[name].detach().clone() for name in SHAPES}
    ledger.table.optimiser.step()
    assert torch.equal(ledger.table["flat"], before["flat"])
    assert moments(ledger.table, "flat")[2] == 3
    for name in ("rows", "blocks"):
        assert not torch.equal(ledger.table[name], before[name])
        assert moments(ledger.table, name)[2] == 4


@pytest.mark.parametrize("surgery", ["append", "keep"])
def test_surgery_on_all_rows_skips_the_whole_step(surgery: str) -> None:
    ledger = trained()
    ledger.backward(4)
    if surgery == "append":
        append_rows(ledger.table, rows_of([]))
    else:
        keep_rows(ledger.table, torch.ones(5, dtype=torch.bool))
    before = {name: ledger.table[name].detach().clone() for name in SHAPES}
    ledger.table.optimiser.step()
    for name in SHAPES:
        assert torch.equal(ledger.table[name], before[name])
        assert moments(ledger.table, name)[2] == 3


@pytest.mark.parametrize(("step", "factor"), [(1, 1.0), (600, 2.124), (30000, 3.162)])
def test_first_move_of_a_fresh_row_is_larger_late_in_the_run(step: int, factor: float) -> None:
    table = ParameterTable({"x": Parameter(torch.zeros(1))})
    table.set_rate("x", 0.01)
    if step > 1:
        table["x"].grad = torch.zeros(1)
        table.optimiser.step()
        table.optimiser.state[table["x"]]["step"].fill_(step - 1)
    append_rows(table, {"x": torch.zeros(1)})
    table["x"].grad = torch.full((len(table),), 1e-9)  # far above the epsilon of 1e-15, far below Adam's usual 1e-8
    table.optimiser.step()
    # 0.1 / (1 - 0.9^t) over the root of 0.001 / (1 - 0.999^t)
    exact = 0.1 / (1 - 0.9**step) / math.sqrt(0.001 / (1 - 0.999**step))
    assert exact == pytest.approx(factor, rel=1e-3)
    assert -float(table["x"].detach()[-1]) / 0.01 == pytest.approx(exact, rel=1e-4)


def test_all_rows_may_go() -> None:
    table = trained().table
    keep_rows(table, torch.zeros(5, dtype=torch.bool))
    assert len(table) == 0
    append_rows(table, rows_of([1, 2]))
    assert torch.equal(table["rows"], rows_of([1, 2])["rows"])


def test_a_column_the_run_did_not_have_is_named() -> None:
    table = ParameterTable({name: Parameter(value) for name, value in rows_of([1, 2]).items()})
    saved = table_tensors(table)
    table.columns["filter"] = torch.zeros(2)
    with pytest.raises(CheckpointError, match="holds no filter: it was trained with other options"):
        restore_table(table, saved)


def test_statistics_follow_their_rows_and_new_rows_begin_with_0() -> None:
    columns, statistics = {"level": torch.tensor([0, 1, 2])}, {"seen": torch.tensor([[1.0, 2], [3, 4], [5, 6]])}
    table = ParameterTable({"flat": Parameter(torch.tensor([1.0, 2, 3]))}, columns, statistics)
    append_rows(table, {"flat": torch.tensor([4.0]), "level": torch.tensor([3])})
    keep_rows(table, torch.tensor([True, False, True, True]))
    assert table["seen"].tolist() == [[1, 2], [5, 6], [0, 0]]
    assert table["level"].tolist() == [0, 2, 3]


def test_statistics_that_were_saved_as_columns_are_found() -> None:
    table = ParameterTable({"flat": Parameter(torch.ones(2))}, {}, {"visits": torch.tensor([3.0, 4])})
    saved = {name.replace("statistics.", "columns."): value for name, value in table_tensors(table).items()}
    empty = ParameterTable({"flat": Parameter(torch.ones(5))}, {}, {"visits": torch.zeros(5)})
    assert restore_table(empty, saved)["visits"].tolist() == [3, 4]


def test_learning_rates_that_are_set_once_outlive_a_restart() -> None:
    table = ParameterTable({"flat": Parameter(torch.ones(2))})
    table.set_rate("flat", 0.5)
    assert restore_table(table, table_tensors(table)).group("flat")["lr"] == 0.5


def small_networks() -> Networks:
    torch.manual_seed(0)
    modules = nn.ModuleDict({"opacity": nn.Linear(2, 1), "colour": nn.Linear(2, 3)})
    return Networks(modules, modules["colour"])


def test_networks_are_moved_saved_and_restored_with_the_rows() -> None:
    """Adam's first step moves every value with a gradient by its rate."""
    table, other = (ParameterTable({"flat": Parameter(torch.ones(2))}, {}, {}, small_networks()) for _ in range(2))
    table.set_rate("flat", 0.5)
    for group in table.networks.optimiser.param_groups:
        group["lr"] = 0.25
    before = {name: value.detach().clone() for name, value in named_parameters(table)}
    sum(value.sum() for _, value in named_parameters(table)).backward()
    assert set(gradients(table)) == set(before)
    take_adam_step(table)
    assert gradients(table) == {}
    for name, value in named_parameters(table):
        torch.testing.assert_close(
            before[name] - value.detach(), torch.full_like(value, 0.5 if name == "flat" else 0.25)
        )
    again = restore_table(other, table_tensors(table))
    assert {name: value.tolist() for name, value in table_tensors(again).items()} == {
        name: value.tolist() for name, value in table_tensors(table).items()
    }


def test_what_networks_keep_beside_parameters_is_saved_and_restored() -> None:
    def made() -> ParameterTable:
        modules = nn.ModuleDict({"colour": nn.Sequential(nn.BatchNorm1d(2), nn.Linear(2, 3))})
        return ParameterTable({"flat": Parameter(torch.ones(2))}, {}, {}, Networks(modules, modules["colour"]))

    table, other = made(), made()
    table.networks.modules["colour"](torch.tensor([[1.0, 5], [3, 9]]))
    assert table.networks.modules["colour"][0].running_mean.tolist() == pytest.approx([0.2, 0.7])
    found = table_tensors(restore_table(other, table_tensors(table)))
    assert found["buffers.colour.0.running_mean"].tolist() == pytest.approx([0.2, 0.7])
    assert found["buffers.colour.0.num_batches_tracked"] == 1
    saved = {name: value for name, value in table_tensors(table).items() if not name.startswith("buffers.")}
    with pytest.raises(CheckpointError, match="holds no buffers"):
        restore_table(made(), saved)


def test_networks_that_share_weights_keep_them_as_parameters() -> None:
    def made() -> ParameterTable:
        modules = nn.ModuleDict({"colour": nn.Sequential(nn.Linear(2, 2), nn.Linear(2, 2))})
        modules["colour"][1].weight = modules["colour"][0].weight
        return ParameterTable({"flat": Parameter(torch.ones(2))}, {}, {}, Networks(modules, modules["colour"]))

    table = made()
    assert list(table.networks.buffers()) == []
    found = table_tensors(restore_table(made(), table_tensors(table)))
    assert torch.equal(found["heads.colour.0.weight"], table_tensors(table)["heads.colour.0.weight"])


def test_a_parameter_that_no_rate_would_move_is_refused() -> None:
    modules = nn.Module()
    modules.colour, modules.tint = nn.Linear(2, 3), Parameter(torch.zeros(3))
    for alone, told in ((modules, "^tint of"), (nn.Linear(2, 3), "^weight and bias of")):
        with pytest.raises(ConfigError, match=f"{told} a backbone's networks would never learn"):
            Networks(alone, alone)


def test_what_is_recorded_later_comes_back() -> None:
    def made() -> ParameterTable:
        return ParameterTable(
            {"flat": Parameter(torch.ones(2))}, record={"first": torch.tensor(2.0), "new": torch.ones(1)}
        )

    table = made()
    table.record |= {"first": torch.tensor(3.0), "budget": torch.tensor([4, 5])}
    del table.record["new"]  # of a later version, as far as the file knows
    found = restore_table(made(), table_tensors(table)).record
    assert {name: value.tolist() for name, value in found.items()} == {"first": 3, "budget": [4, 5], "new": [1]}


def test_steps_are_shorter_by_the_pace_and_rates_stay() -> None:
    """Adam's steps are proportional to its rates."""
    moved = {}
    for pace in (1.0, 0.25):
        table = ParameterTable({"flat": Parameter(torch.ones(2))}, {}, {}, small_networks())
        table.set_rate("flat", 0.5)
        table.networks.set_rate("opacity", 0.5)
        table.pace = pace
        before = {name: value.detach().clone() for name, value in named_parameters(table)}
        for _ in range(2):
            sum(value.sum() for _, value in named_parameters(table)).backward()
            take_adam_step(table)
        moved[pace] = {name: before[name] - value.detach() for name, value in named_parameters(table)}
        assert table.group("flat")["lr"] == group_of(table.networks.optimiser, "opacity")["lr"] == 0.5
    for name, value in moved[1.0].items():
        torch.testing.assert_close(moved[0.25][name], 0.25 * value)
    torch.testing.assert_close(moved[1.0]["flat"], torch.ones(2))


def test_shared_colour_is_that_of_the_colour_network_alone() -> None:
    table = ParameterTable({"flat": Parameter(torch.ones(2))}, {}, {}, small_networks())
    assert [value.shape for value in shared_colour(table)] == [(3, 2), (3,)]
    assert shared_colour(ParameterTable({"flat": Parameter(torch.ones(2))})) == []


def test_size_counts_what_a_render_needs() -> None:
    """2 rows of one float and one int16, 3 + 9 floats of networks; statistics are not drawn with."""
    columns, statistics = {"level": torch.zeros(2, dtype=torch.int16)}, {"visits": torch.zeros(2)}
    table = ParameterTable({"flat": Parameter(torch.ones(2))}, columns, statistics, small_networks())
    assert size_of(table) == (2, 2 * (4 + 2) + 4 * (3 + 9))
