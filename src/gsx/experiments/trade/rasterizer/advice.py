"""Which settings are worth it: the front, what is recommended within an error, the table."""

import math
from collections.abc import Sequence
from typing import Any

from gsx.experiments.reports.charts import pareto_front
from gsx.experiments.trade.rasterizer.knobs import NOISE, OUTLIERS, SPREADS, Row, overrides


def shown(error: float) -> float:
    """An error as the tables show it: the digits beyond are chance."""
    return float(f"{error:.1e}")


def front_of(rows: Sequence[Row], cost: str = "step_ms", error: str = "max_error") -> list[int]:
    """Indices, fastest first, of rows that no other beats: no slower, no less exact (as shown), and better in one."""
    known = [i for i, row in enumerate(rows) if not row.failure]
    costs = [getattr(rows[i], cost) for i in known]
    return [known[i] for i in pareto_front(costs, [-shown(getattr(rows[i], error)) for i in known])]


def recommended(rows: Sequence[Row], budget: float, cost: str = "step_ms", error: str = "max_error") -> Row | None:
    """The fastest row within the budget; None: there is none.

    Of rows as fast as it, but for noise and for what its own time varied from round to round, the one that changes
    least.
    """
    within = [row for row in rows if not row.failure and getattr(row, error) <= budget]
    if not within:
        return None
    fastest = min(within, key=lambda row: getattr(row, cost))
    slowest = getattr(fastest, cost) * (1 + max(NOISE, getattr(fastest, SPREADS[cost])))
    return min(
        (row for row in within if getattr(row, cost) <= slowest), key=lambda row: (len(row.changes), getattr(row, cost))
    )


def most_exact(rows: Sequence[Row]) -> Row:
    """The row of the smallest error as shown; among equals the one that changes least, then the fastest."""
    known = (row for row in rows if not row.failure)
    return min(known, key=lambda row: (shown(row.max_error), len(row.changes), row.step_ms))


def advice(rows: Sequence[Row], budget: float) -> list[dict[str, Any]]:
    """For training and for rendering: the row to use, once for every pixel, once for all but a few."""
    base = next(row for row in rows if row.knob == "base")
    return [
        {
            "purpose": purpose,
            "cost": cost,
            "error": error,
            "row": row,
            "gain": getattr(base, cost) / getattr(row, cost) if row else math.nan,
        }
        for purpose, cost in (("training", "step_ms"), ("rendering", "forward_ms"))
        for error in ("max_error", "most_error")
        for row in [recommended(rows, budget, cost, error)]
    ]


def advice_lines(rows: Sequence[Row], budget: float) -> list[str]:
    """The recommendation in words."""
    told = advice(rows, budget)
    every, most = ([entry for entry in told if entry["error"] == error] for error in ("max_error", "most_error"))
    lines = advised(every, f"every pixel within {budget:g}")
    if any(entry["row"] is None for entry in every):
        exact = most_exact(rows)
        lines = [
            f"no settings keep every pixel within {budget:g}: the most exact are {exact.settings} "
            f"(max error {exact.max_error:.2g}); allow more with --max-error {rounded_up(exact.max_error)}"
        ]
        if all(entry["row"] is not None for entry in most):
            lines += advised(most, f"all but {OUTLIERS:.2%} of the pixels within {budget:g}")
    return lines


def advised(entries: Sequence[dict[str, Any]], promise: str) -> list[str]:
    """One line for each purpose, or one for both where they agree."""
    rows = [entry["row"] for entry in entries]
    if any(row is None for row in rows):
        return []
    if all(row is rows[0] for row in rows):
        entries = [entries[0] | {"purpose": "training and rendering"}]
    return [
        f"{entry['purpose']}, {promise}: {overrides(entry['row'].changes) or 'keep the settings as they are'}"
        + (f" ({entry['gain']:.2f} x as fast)" if entry["row"].changes else "")
        for entry in entries
    ]


def rounded_up(value: float) -> str:
    """A round number that is no smaller, two digits."""
    power = 10.0 ** (math.floor(math.log10(value)) - 1) if value > 0 else 1.0
    return f"{math.ceil(value / power * (1 - 1e-12)) * power:.2g}"


NONE = "n/a"
HEADINGS = (
    "", "#", "f+b ms", "x base", "+-", "fwd ms", "max error", "99.99 %", "PSNR", "gradient", "ideal", "pairs", "MB",
)  # fmt: skip
"""Of the table in the terminal; the settings follow."""


def table(rows: Sequence[Row]) -> list[str]:
    """The rows, already in order, as aligned lines; a star marks the Pareto front of time and max error."""
    front = set(front_of(rows))
    known = [(i, row) for i, row in enumerate(rows) if not row.failure]
    cells = [list(HEADINGS)] + [row_cells(row, i, i in front) for i, row in known]
    columns = [column for column in zip(*cells, strict=True) if any(cell != NONE for cell in column[1:])]
    widths = [max(map(len, column)) for column in columns]
    figures = ["  ".join(map(str.rjust, line, widths)) for line in zip(*columns, strict=True)]
    told = ["settings"] + [row.settings for _, row in known]
    aligned = [f"{line}  {words}" for line, words in zip(figures, told, strict=True)]
    return aligned + [f"failed: {row.settings}: {row.failure}" for row in rows if row.failure]


def row_cells(row: Row, index: int, on_front: bool) -> list[str]:
    """The figures of a row as text."""
    return [
        "*" if on_front else "",
        str(index + 1),
        f"{row.step_ms:.1f}",
        f"{row.ratio:.2f}",
        f"{row.step_spread:.0%}",
        f"{row.forward_ms:.1f}",
        f"{row.max_error:.1e}",
        f"{row.most_error:.1e}",
        f"{row.psnr:.1f}",
        f"{row.gradient_error:.1e}",
        NONE if math.isnan(row.ideal_psnr) else f"{row.ideal_psnr:.1f}",
        f"{row.pairs:,.0f}",
        NONE if row.memory_mb is None else f"{row.memory_mb:,.0f}",
    ]
