"""The table of docs/benchmarks/extremes.md lists the cases of the suite and keeps their bounds."""

from pathlib import Path

import pytest

from extremes.cases import CASES, Case
from extremes.table import BEGIN, COLUMNS, END, read, rewritten

PAGE = (Path(__file__).parents[2] / "docs" / "benchmarks" / "extremes.md").read_text()
ROWS = {cells[0]: dict(zip(COLUMNS, cells, strict=True)) for cells in read(PAGE)}


def test_the_table_lists_exactly_the_cases_in_their_order() -> None:
    assert list(ROWS) == [case.name for case in CASES]


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_a_row_says_what_happens_and_is_within_its_bounds(case: Case) -> None:
    row = ROWS[case.name]
    assert row["what happens"] == case.happens
    for path in ("eager", "compiled"):
        for kind, bound in (("image", case.image), ("gradient", case.gradient)):
            cell = row[f"{kind}, {path}"]
            assert not (cell and case.refused)
            assert not cell or float(cell) <= bound


def test_rewriting_a_page_keeps_what_is_around_the_table() -> None:
    table = [COLUMNS, ["---"] * len(COLUMNS), ["a case"] * len(COLUMNS)]
    page = rewritten(PAGE, table)
    assert read(page) == table[2:]
    assert page.split(BEGIN)[0] == PAGE.split(BEGIN)[0]
    assert page.split(END)[1] == PAGE.split(END)[1]
