"""Which setting is worth it: fronts of cost and quality, and the answer to a wish."""

from collections.abc import Sequence
from dataclasses import dataclass

from gsx.core import errors
from gsx.experiments.reports.charts import pareto_front
from gsx.experiments.trade.training.measure import COSTS, Row, known


@dataclass(frozen=True, kw_only=True)
class Wish:
    """Bounds that hold for every seed; None: none."""

    budget_mb: float | None = None
    """Of the splat file."""
    max_drop_db: float | None = None
    """At any zoom, beside the composition as given."""
    target_seconds: float | None = None
    """Of training."""

    def granted(self, row: Row, given: Row) -> bool:
        """Whether all of its seeds keep the bounds."""
        fits = [
            self.budget_mb is None or row.worst_cost("megabytes") <= self.budget_mb,
            self.target_seconds is None or row.worst_cost("seconds") <= self.target_seconds,
            self.max_drop_db is None or row.drop(given) <= self.max_drop_db,
        ]
        return all(fits)

    def told(self) -> str:
        """In words."""
        parts = [
            f"at most {self.budget_mb:g} MB" if self.budget_mb is not None else "",
            f"at most {self.target_seconds:g} s of training" if self.target_seconds is not None else "",
            f"at most {self.max_drop_db:g} dB lost at any zoom" if self.max_drop_db is not None else "",
        ]
        return ", ".join(filter(None, parts))


def front(rows: Sequence[Row], cost: str, zoom: str) -> list[Row]:
    """Cheapest first, the rows that no other beats in both."""
    rows = known(rows)
    costs, gains = [row.cost(cost) for row in rows], [row.quality(zoom) for row in rows]
    return [rows[i] for i in pareto_front(costs, gains)]


@dataclass(frozen=True, kw_only=True)
class Advice:
    """What to do for a wish."""

    purpose: str
    row: Row | None
    """None: nothing that was tried grants it."""
    nearest: Row
    """What comes nearest to it."""


def advice(rows: Sequence[Row], wish: Wish, zoom: str) -> list[Advice]:
    """What grants a wish: the best picture at a zoom where size or time are bounded, else the smallest file and the
    shortest training."""
    given, *_ = rows = known(rows)
    unbounded = wish.budget_mb is None and wish.target_seconds is None
    wish = Wish(max_drop_db=wish.max_drop_db or 0.0) if unbounded else wish
    granted = [row for row in rows if wish.granted(row, given)]
    if unbounded:
        least = {unit: cheapest(granted, cost) for cost, unit in COSTS.items()}
        return [Advice(purpose=f"least {unit}, {wish.told()}", row=row, nearest=row) for unit, row in least.items()]
    best = max(granted, key=lambda row: row.quality(zoom)) if granted else None
    bound = "megabytes" if wish.budget_mb is not None else "seconds"
    return [Advice(purpose=f"best at x{zoom}, {wish.told()}", row=best, nearest=best or cheapest(rows, bound))]


def cheapest(rows: Sequence[Row], cost: str) -> Row:
    """By the seed that costs the most."""
    return min(rows, key=lambda row: row.worst_cost(cost))


def advice_lines(found: Sequence[Advice], given: Row, words: Sequence[str]) -> list[str]:
    """Two lines for each: what it is and gave here, and the command; `words`: the composition as given."""
    return [line for one in found for line in (f"{one.purpose}: {told(one, given)}", command(one, words)) if line]


def told(one: Advice, given: Row) -> str:
    """The setting advised, and what it gave here."""
    if one.row is None:
        return f"nothing that was tried; nearest is '{one.nearest.setting.name}', {figures(one.nearest, given)}"
    return f"{one.row.setting.name}, {figures(one.row, given)}"


def command(one: Advice, words: Sequence[str]) -> str:
    """What trains it; empty: there is nothing to advise."""
    return errors.command(*words, *one.row.overrides) if one.row else ""


def figures(row: Row, given: Row) -> str:
    """What it gave, beside the composition as given."""
    quality = ", ".join(
        f"x{zoom} {row.quality(zoom):.2f} dB ({row.quality(zoom) - given.quality(zoom):+.2f})" for zoom in row.zooms()
    )
    return f"{quality}, {row.cost('megabytes'):.3g} MB, {row.cost('seconds'):.3g} s"


def table(rows: Sequence[Row]) -> list[str]:
    """Aligned lines; a star marks what no other setting beats at the finest zoom."""
    given, *_ = trained = known(rows)
    zooms = given.zooms()
    stars = {cost: front(rows, cost, zooms[-1]) for cost in COSTS}
    heading = [
        *(f"x{zoom} dB" for zoom in zooms),
        "primitives",
        *(word for unit in COSTS.values() for word in (unit, "")),
    ]
    cells = [heading] + [row_cells(row, zooms, stars) for row in trained]
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    lines = ["  ".join(map(str.rjust, line, widths)) for line in cells]
    names = ["setting"] + [row.setting.name for row in trained]
    told = [f"{line}  {name}" for line, name in zip(lines, names, strict=True)]
    return told + [f"does not go here: {row.setting.name}: {row.failure}" for row in rows if row.failure]


def row_cells(row: Row, zooms: Sequence[str], stars: dict[str, list[Row]]) -> list[str]:
    """The figures of a row as text."""
    cells = [*(f"{row.quality(zoom):.2f}" for zoom in zooms), f"{row.cost('primitives'):,.0f}"]
    for cost, best in stars.items():
        cells += [f"{row.cost(cost):.3g}", "*" if row in best else " "]
    return cells
