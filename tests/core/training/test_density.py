"""Rows and Adam moments through surgery, against Adam written out in float64 row by row."""

import math
from dataclasses import dataclass, field

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor
from torch.nn import Parameter

from gsx.core.errors import CheckpointError
from gsx.core.rasterizer import ScreenStatistics
from gsx.core.training.density import (
    ParameterTable,
    Statistics,
    append_rows,
    densification_statistics,
    keep_rows,
    reset_column,
    restored_table,
    table_tensors,
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


def screen(ids: list[int], radii: list[int], gradient: list[list[float]], size: tuple[int, int]) -> ScreenStatistics:
    shift = torch.zeros(len(ids), 2, requires_grad=True)
    shift.grad = torch.tensor(gradient)
    return ScreenStatistics(
        ids=torch.tensor(ids),
        radii=torch.tensor(radii),
        means2d_offset=shift,
        absgrad=None,
        max_weights=None,
        size=size,
    )


def test_statistics_are_means_of_norms_in_ndc_over_the_views_that_saw_the_row() -> None:
    statistics = Statistics.zeros(4, "cpu")
    # 20 x 8 px: NDC gradients are (10, 4) times those in pixels
    one = screen([3, 0, 1], [5, 0, 2], [[0.3, 1.0], [9.0, 9.0], [0.0, 0.5]], (20, 8))  # norms 5, -, 2
    other = screen([1, 3], [1, 1], [[-0.6, 2.0], [-0.3, -1.0]], (20, 8))  # 10 and 5: opposite to the first view
    for picture in (one, other):
        statistics.add(densification_statistics(picture))
    assert statistics.count.tolist() == [0, 2, 0, 2]
    torch.testing.assert_close(statistics.mean_gradient(), torch.tensor([0.0, 6.0, 0.0, 5.0]))


def test_sightings_count_by_their_weight() -> None:
    """Gradients carry the weight already: 4 at weight 1 and 2 of 8 at weight 1/4 have the mean 6 / 1.25."""
    statistics = Statistics.zeros(2, "cpu")
    statistics.add(densification_statistics(screen([0], [1], [[0.4, 0.0]], (20, 8))))
    statistics.add(densification_statistics(screen([0, 1], [1, 1], [[0.2, 0.0], [0.0, 0.25]], (20, 8)), weight=0.25))
    assert statistics.count.tolist() == [1.25, 0.25]
    torch.testing.assert_close(statistics.mean_gradient(), torch.tensor([6 / 1.25, 4.0]))


def test_a_view_without_gradient_still_counts() -> None:
    statistics = Statistics.zeros(2, "cpu")
    unused = ScreenStatistics(
        ids=torch.tensor([1]),
        radii=torch.tensor([3]),
        means2d_offset=torch.zeros(1, 2),
        absgrad=None,
        max_weights=None,
        size=(4, 4),
    )
    statistics.add(densification_statistics(unused))
    assert statistics.count.tolist() == [0, 1]
    assert statistics.mean_gradient().tolist() == [0.0, 0.0]


def test_a_column_the_run_did_not_have_is_named() -> None:
    table = ParameterTable({name: Parameter(value) for name, value in rows_of([1, 2]).items()})
    saved = table_tensors(table)
    table.columns["filter"] = torch.zeros(2)
    with pytest.raises(CheckpointError, match="holds no filter: it was trained with other options"):
        restored_table(table, saved, torch.device("cpu"))
