"""Results as a table on the terminal, JSON, Markdown and a plot."""

import html
import math
from collections.abc import Sequence
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import Any

from gsx.core.charts import BOTTOM, HEIGHT, LEFT, RIGHT, TOP, WIDTH, Axis, Plot, Series, axis_of, curve
from gsx.core.files import read_json, replace_file, write_json
from measuring.machine import commit

Section = dict[str, Any]
"""title, columns ([key, heading] each), rows, notes; and when, how and of what it was measured."""
COLOURS = {"eager": "#3366aa", "compiled": "#d2601a", "naive": "#888888", "gsplat": "#2a8a4a"}
STYLE = (
    "svg{font:11px system-ui,sans-serif;background:#fff}.grid{stroke:#ddd}.axis{stroke:#666}"
    ".curve{fill:none;stroke-width:2}circle{stroke:none}text{fill:#333}"
)


def stamped(
    title: str, columns: list[list[str]], rows: list[dict[str, Any]], notes: list[str], load: float, command: str
) -> Section:
    """A finished table with when, at what load, of which revision and by which command it was measured."""
    when = datetime.now().strftime("%Y-%m-%d %H:%M")
    table = {"title": title, "columns": columns, "rows": rows, "notes": notes}
    return table | {"date": when, "commit": commit(), "load": load, "command": command}


def cell(value: Any) -> str:
    """A value in a table: three significant digits, thousands grouped."""
    if value is None:
        return ""
    if isinstance(value, int):
        return f"{value:,}"
    if not isinstance(value, float):
        return str(value)
    if value == 0 or abs(value) >= 100 or not math.isfinite(value):
        return f"{value:,.0f}"
    return f"{value:.3g}" if abs(value) < 1e-3 else f"{value:.{2 - math.floor(math.log10(abs(value)))}f}"


def cells(section: Section) -> list[list[str]]:
    """Headings, then rows, of the columns that hold anything."""
    used = [(key, head) for key, head in section["columns"] if any(row.get(key) is not None for row in section["rows"])]
    return [[head for _, head in used], *[[cell(row.get(key)) for key, _ in used] for row in section["rows"]]]


def text_table(section: Section) -> str:
    """The section for a terminal."""
    lines = cells(section)
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    table = ["  ".join(word.rjust(width) for word, width in zip(line, widths, strict=True)) for line in lines]
    return "\n".join([section["title"], *table, *section["notes"], ""])


def markdown_table(section: Section) -> str:
    """The section for a page."""
    head, *rows = cells(section)
    rules = ["---" if index == 0 else "---:" for index in range(len(head))]
    table = "\n".join(f"| {' | '.join(line)} |" for line in (head, rules, *rows))
    facts = f"{section['date']}, revision {section['commit']}, load {section['load']}: `{section['command']}`"
    return "\n\n".join([f"## {section['title']}", table, *section["notes"], facts])


def merged(path: Path, machine: dict[str, Any], sections: dict[str, Section]) -> dict[str, Any]:
    """The new sections, and those that an earlier run on the very same machine has left in the file."""
    old = read_json(path) if path.is_file() else {}
    kept = old.get("sections", {}) if old.get("machine") == machine else {}
    return {"machine": machine, "sections": {**kept, **sections}}


def write_results(folder: Path, name: str, machine: dict[str, Any], sections: dict[str, Section]) -> list[Path]:
    """Write `name`.json, .md and, with a scaling section, .svg; returns what was written."""
    folder.mkdir(parents=True, exist_ok=True)
    results = merged(folder / f"{name}.json", machine, sections)
    write_json(folder / f"{name}.json", results)
    drawing = scaling_plot(results["sections"].get("splats", {"rows": []})["rows"])
    if drawing:
        replace_file(folder / f"{name}.svg", drawing.encode())
    page = markdown(name, results, bool(drawing))
    replace_file(folder / f"{name}.md", page.encode())
    return [folder / f"{name}{suffix}" for suffix in (".json", ".md", *([".svg"] if drawing else []))]


def markdown(name: str, results: dict[str, Any], drawn: bool) -> str:
    """The page."""
    facts = "\n".join(f"* {key}: {value}" for key, value in results["machine"].items())
    picture = [f"![Time against pairs]({name}.svg)"] if drawn else []
    tables = [markdown_table(section) for section in results["sections"].values()]
    return "\n\n".join([f"# {name.replace('_', ' ')}", facts, *picture, *tables]) + "\n"


# -- plot ----------------------------------------------------------------------------------------------------------


def scaling_plot(rows: Sequence[dict[str, Any]]) -> str:
    """Forward + backward against pairs, both logarithmic, a curve for each path and raster; empty without curves."""
    groups: dict[tuple[str, str], list[tuple[float, float]]] = {}
    for row in rows:
        groups.setdefault((row["path"], row["raster"]), []).append((row["pairs"], row["total_ms"]))
    curves = {key: sorted(points) for key, points in groups.items()}
    if not any(len(points) > 1 for points in curves.values()):
        return ""
    points = [point for group in curves.values() for point in group]
    plot = Plot(decades(axis_of((x for x, _ in points), log=True)), decades(axis_of((y for _, y in points), log=True)))
    rasters = sorted({raster for _, raster in curves}, key=lambda raster: [len(raster), raster])
    body = plot.frame("splat-tile pairs") + f'<text x="{LEFT}" y="{TOP}">forward + backward, ms</text>'
    for number, ((path, raster), group) in enumerate(sorted(curves.items())):
        series = Series(name=path, x=[x for x, _ in group], y=[y for _, y in group], dots=True)
        line = curve(plot, series) + legend(len(curves) - number, f"{path}, {raster}")
        body += f"<g {pen(path, rasters.index(raster))}>{line}</g>"
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {HEIGHT}" width="{2 * WIDTH}">'
        f"<style>{STYLE}</style>{body}</svg>\n"
    )


def decades(axis: Axis) -> Axis:
    """The axis with ticks at powers of ten, if there are at least two of them."""
    powers = range(math.ceil(math.log10(axis.low)), math.floor(math.log10(axis.high)) + 1)
    return replace(axis, chosen=tuple(10.0**power for power in powers)) if len(powers) > 1 else axis


def pen(path: str, number: int) -> str:
    """A path's colour; curves of further rasters are dashed."""
    dashes = f' stroke-dasharray="{max(1, 6 - 2 * number)} 3"' if number else ""
    return f'stroke="{COLOURS[path]}" fill="{COLOURS[path]}"{dashes}'


def legend(number: int, text: str) -> str:
    """A line of the legend, counted from below: large pictures take long, so the lower right is free."""
    x, y = WIDTH - RIGHT - 150, HEIGHT - BOTTOM - 14 * number + 4
    line = f'<line class="curve" x1="{x}" x2="{x + 22}" y1="{y - 4}" y2="{y - 4}"/>'
    return line + f'<text x="{x + 28}" y="{y}" stroke="none">{html.escape(text)}</text>'
