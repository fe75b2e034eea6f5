"""trade.json and trade.html: every figure of a sweep, and a page of it that refers to nothing outside itself."""

from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from gsx import __version__
from gsx.core.files import replace_text, write_json
from gsx.experiments.reports.charts import Dot, scatter
from gsx.experiments.reports.page import NONE, fixed, template
from gsx.experiments.run_folder.files import is_number
from gsx.experiments.trade.machine import machine
from gsx.experiments.trade.rasterizer.advice import advice, advice_lines, front_of, shown
from gsx.experiments.trade.rasterizer.bench import EXACT, UNBOUNDED
from gsx.experiments.trade.rasterizer.knobs import COSTS, KNOBS, OUTLIERS, Row, overrides
from gsx.experiments.trade.rasterizer.measure import Trade

ERRORS = {"max_error": "max error", "most_error": f"error of all but {OUTLIERS:.2%} of the pixels"}
"""Errors that are drawn against time."""
LEAST_ERROR = 1e-17
"""Smaller ones, zero too, are drawn here: a logarithmic axis has no zero."""
COLOURS = {"base": 1, "combination": 2}
"""Colour numbers of dots; single knobs have 0."""


def write_trade(trade: Trade, folder: Path, budget: float) -> Path:
    """Write trade.json and trade.html into an existing folder; returns the page."""
    write_json(folder / "trade.json", content(trade, budget))
    page = folder / "trade.html"
    replace_text(page, template("trade/rasterizer/trade.html").render(context(trade, budget)))
    return page


def content(trade: Trade, budget: float) -> dict[str, Any]:
    """What trade.json holds."""
    subject = trade.subject
    return {
        "gsx": __version__,
        "machine": machine(trade.subject.device),
        "model": subject.name,
        "notes": [*subject.notes, *trade.notes],
        "views": [{"name": s.name, "size": list(s.camera.size), "splats": len(s.splats)} for s in subject.shots],
        "base": asdict(trade.base),
        "truth": asdict(replace(trade.base, **EXACT)),
        "check": asdict(trade.check),
        "ideal": {"rules": UNBOUNDED, "truth_against_it": trade.ideal},
        "repeats": trade.repeats,
        "outliers": OUTLIERS,
        "max_error": budget,
        "recommendation": [
            {key: value for key, value in entry.items() if key != "row"}
            | {"overrides": overrides(entry["row"].changes) if entry["row"] else None}
            for entry in advice(trade.rows, budget)
        ],
        "rows": [asdict(row) | {"front": i in front_of(trade.rows)} for i, row in enumerate(trade.rows)],
    }


def context(trade: Trade, budget: float) -> dict[str, Any]:
    """What the page's template needs."""
    subject, rows = trade.subject, trade.rows
    width, height = subject.shots[0].camera.size
    told = machine(trade.subject.device)
    return {
        "title": "Rasterizer: time against accuracy",
        "version": __version__,
        "facts": [
            ("model", subject.name),
            ("splats", f"{len(subject.shots[0].splats):,}"),
            ("views", f"{len(subject.shots)} of {width} × {height} px"),
            ("device", f"{told['device']}, {told['threads']} threads, torch {told['torch']}"),
            ("rounds", str(trade.repeats)),
        ],
        "notes": [*subject.notes, *trade.notes],
        "budget": budget,
        "outliers": OUTLIERS,
        "advice": advice_lines(rows, budget),
        "cards": cards(rows, budget),
        "rows": rows,
        "front": front_of(rows),
        "knobs": by_knob(rows),
        "plots": [{"error": error, "title": ERRORS[error], "figures": plots(rows, error)} for error in ERRORS],
        "check": str(trade.check),
        "ideal": trade.ideal,
        "base": overrides(asdict(trade.base)).split(),
        "exact": overrides(EXACT).split(),
        "unbounded": overrides(UNBOUNDED).split(),
        "exponent": exponent,
    }


def exponent(value: Any) -> str:
    """A small number as 1.2e-06, or n/a."""
    return f"{value:.1e}" if is_number(value) else NONE


def cards(rows: Sequence[Row], budget: float) -> list[dict[str, str]]:
    """The recommended settings as figures: for training and for rendering, for every pixel or else for most."""
    told = {(entry["purpose"], entry["error"]): entry for entry in advice(rows, budget)}
    chosen = []
    for purpose in ("training", "rendering"):
        entry = told[purpose, "max_error"]
        entry = entry if entry["row"] else told[purpose, "most_error"]
        if entry["row"]:
            chosen.append(card(entry, budget))
    return chosen


def card(entry: dict[str, Any], budget: float) -> dict[str, str]:
    """One recommendation: its speed, and what it promises."""
    row = entry["row"]
    pixels = "every pixel" if entry["error"] == "max_error" else f"all but {OUTLIERS:.2%} of the pixels"
    return {
        "label": f"for {entry['purpose']}, {COSTS[entry['cost']]}",
        "value": fixed(getattr(row, entry["cost"]), 1),
        "remark": f"{entry['gain']:.2f} x as fast as the base settings; {pixels} within {budget:g}",
        "command": overrides(row.changes),
    }


def by_knob(rows: Sequence[Row]) -> list[tuple[str, list[Row]]]:
    """Single changes, knob by knob, in the order of the sweep."""
    return [(knob, found) for knob in KNOBS if (found := [row for row in rows if row.knob == knob])]


def plots(rows: Sequence[Row], error: str) -> list[dict[str, Any]]:
    """An error against each time."""
    return [
        {"title": words, "svg": scatter(dots(rows, cost, error), x_label=f"ms a picture, {words}", falling=True)}
        for cost, words in COSTS.items()
    ]


def dots(rows: Sequence[Row], cost: str, error: str) -> list[Dot]:
    """The rows as points; those of the front are labelled with their number in the table."""
    return [
        Dot(
            x=getattr(row, cost),
            y=max(shown(getattr(row, error)), LEAST_ERROR),
            text=f"{number}: {row.settings}\n{getattr(row, cost):.1f} ms, {ERRORS[error]} {getattr(row, error):.2g}",
            label=str(number),
            colour=COLOURS.get(row.knob, 0),
        )
        for number, row in enumerate(rows, 1)
        if not row.failure
    ]
