"""trade.json and trade.html of the settings tried on a scene."""

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from gsx import __version__
from gsx.core.files import replace_text, write_json
from gsx.experiments.reports.charts import Dot, scatter
from gsx.experiments.reports.page import template
from gsx.experiments.trade.training.measure import COSTS, Row, known
from gsx.experiments.trade.training.wishes import Wish, advice, command, figures, front, told

COLOURS = {0: 1, 1: 0}
"""Colour numbers of dots by how many changes they are; several have 2."""


def write_trade(rows: Sequence[Row], wish: Wish, words: Sequence[str], machine: dict[str, Any], folder: Path) -> Path:
    """Write both into an existing folder; returns the page. `words`: the composition as given."""
    write_json(folder / "trade.json", content(rows, wish, words, machine))
    page = folder / "trade.html"
    replace_text(page, template("trade/training/trade.html").render(context(rows, wish, words, machine)))
    return page


def content(rows: Sequence[Row], wish: Wish, words: Sequence[str], machine: dict[str, Any]) -> dict[str, Any]:
    """What trade.json holds."""
    given, *_ = known(rows)
    fronts = {cost: {zoom: front(rows, cost, zoom) for zoom in given.zooms()} for cost in COSTS}
    return {
        "gsx": __version__,
        "machine": machine,
        "given": list(words),
        "wish": asdict(wish),
        "advice": advised(rows, wish, words),
        "rows": [
            asdict(row) | {"front": {c: [z for z, best in by.items() if row in best] for c, by in fronts.items()}}
            for row in rows
        ],
    }


def advised(rows: Sequence[Row], wish: Wish, words: Sequence[str]) -> list[dict[str, str]]:
    """What to do for the wish: `purpose`, `told`, and a `command` where there is something to advise."""
    given, *_ = known(rows)
    found = advice(rows, wish, given.zooms()[-1])
    return [{"purpose": one.purpose, "told": told(one, given), "command": command(one, words)} for one in found]


def context(rows: Sequence[Row], wish: Wish, words: Sequence[str], machine: dict[str, Any]) -> dict[str, Any]:
    """What the page's template needs."""
    given, *_ = trained = known(rows)
    zooms = given.zooms()
    return {
        "title": "Training: what it costs, what it brings",
        "version": __version__,
        "facts": [
            ("as given", " ".join(["gsx", *words])),
            ("seeds", str(len(given.outcomes))),
            ("machine", f"{machine['device']}, {machine['threads']} threads, torch {machine['torch']}"),
        ],
        "advice": advised(rows, wish, words),
        "given": given,
        "rows": trained,
        "failed": [row for row in rows if row.failure],
        "zooms": zooms,
        "costs": COSTS,
        "fronts": {cost: front(rows, cost, zooms[-1]) for cost in COSTS},
        "plots": [
            {
                "zoom": zoom,
                "figures": [
                    {"title": unit, "svg": scatter(dots(trained, cost, zoom), x_label=unit)}
                    for cost, unit in COSTS.items()
                ],
            }
            for zoom in zooms
        ],
    }


def dots(rows: Sequence[Row], cost: str, zoom: str) -> list[Dot]:
    """The rows as points; those of the front carry their number in the table."""
    return [
        Dot(
            x=row.cost(cost),
            y=row.quality(zoom),
            text=f"{number}: {row.setting.name}\n{figures(row, rows[0])}",
            label=str(number),
            colour=COLOURS.get(len(row.setting.trades), 2),
        )
        for number, row in enumerate(rows, 1)
    ]
