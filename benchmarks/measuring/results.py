"""Results as a table on the terminal, JSON, Markdown and a plot."""

import html
import math
import statistics
from collections.abc import Sequence
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import Any

from gsx.core.errors import InputError, first_line
from gsx.core.files import read_json, replace_file, write_json
from gsx.experiments.reports.charts import Axis, Plot, Series, axis_of, drawing
from measuring.machine import commit

Section = dict[str, Any]
"""title, columns ([key, heading] each), rows, notes; and when, how, of what and, in a file, on what it was measured."""
PARTS = {"title", "columns", "rows", "notes", "date", "commit", "load", "command", "machine"}
"""Of a section in a file."""
PICTURES = {"splats": "Time against pairs", "reached": "PSNR over seconds"}
"""Titles of pictures by a section that comes with one."""
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


def ratios_told(before: Sequence[float], now: Sequence[float]) -> str:
    """The median of ratios that each hold within a round, and between which they lie."""
    ratios = [old / new for old, new in zip(before, now, strict=True)]
    return f"{statistics.median(ratios):.2f} ({min(ratios):.2f} to {max(ratios):.2f})"


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


def read_sections(path: Path) -> dict[str, Section]:
    """The sections of a file of results, by name; none where there is no file.

    Raises:
        InputError: the file cannot be read, or is of another form.
    """
    if not path.exists():
        return {}
    try:
        found = read_json(path)
    except (OSError, ValueError) as error:
        raise kept_as_it_is(path, f"cannot be read ({first_line(error)})") from error
    if not isinstance(found, dict) or found.keys() != {"sections"} or not isinstance(found["sections"], dict):
        raise kept_as_it_is(path, "is no file of sections")
    for name, section in found["sections"].items():
        lacking = PARTS - section.keys() if isinstance(section, dict) else PARTS
        if lacking:
            raise kept_as_it_is(path, f"has a section '{name}' without {', '.join(sorted(lacking))}")
    return found["sections"]


def kept_as_it_is(path: Path, reason: str) -> InputError:
    """Why nothing is written."""
    return InputError(f"{path} {reason} and is left as it is: move it away, or choose another folder with --to")


def write_results(
    folder: Path, name: str, machine: dict[str, Any], sections: dict[str, Section], picture: str = ""
) -> list[Path]:
    """Write `name`.json, .md and, with a `picture` or a scaling section, .svg; returns what was written.

    Each section keeps the machine that it was measured on; those of earlier runs stay, but for the ones given now.

    Raises:
        InputError: the file that is there cannot be read, or is of another form; it stays as it is.
    """
    folder.mkdir(parents=True, exist_ok=True)
    new = {key: section | {"machine": machine} for key, section in sections.items()}
    merged = read_sections(folder / f"{name}.json") | new
    write_json(folder / f"{name}.json", {"sections": merged})
    return [folder / f"{name}.json", *write_pages(folder, name, merged, picture)]


def write_pages(folder: Path, name: str, sections: dict[str, Section], picture: str = "") -> list[Path]:
    """Write `name`.md and, with a `picture` or a scaling section, .svg."""
    drawing = picture or scaling_plot(sections.get("splats", {"rows": []})["rows"])
    if drawing:
        replace_file(folder / f"{name}.svg", drawing.encode())
    replace_file(folder / f"{name}.md", markdown(name, sections, bool(drawing)).encode())
    return [folder / f"{name}{suffix}" for suffix in (".md", *([".svg"] if drawing else []))]


def markdown(name: str, sections: dict[str, Section], drawn: bool) -> str:
    """The page: what all sections have been measured on at the top, the rest of it with each section."""
    machines = [section["machine"] for section in sections.values()]
    common = {key: value for key, value in machines[0].items() if all(m.get(key) == value for m in machines)}
    facts = "\n".join(f"* {key}: {value}" for key, value in common.items())
    title = next((title for section, title in PICTURES.items() if section in sections), "")
    picture = [f"![{title}]({name}.svg)"] if drawn else []
    tables = [markdown_table(section) + own_facts(section["machine"], common) for section in sections.values()]
    return "\n\n".join([f"# {name.replace('_', ' ')}", facts, *picture, *tables]) + "\n"


def own_facts(machine: dict[str, Any], common: dict[str, Any]) -> str:
    """What a section was measured on, as far as others were not."""
    own = [f"{key} {value}" for key, value in machine.items() if key not in common]
    return f"\n\nMachine of this section: {', '.join(own)}." if own else ""


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
    body = (
        str(drawing().frame(plot, "splat-tile pairs"))
        + f'<text x="{plot.LEFT}" y="{plot.TOP}">forward + backward, ms</text>'
    )
    for number, ((path, raster), group) in enumerate(sorted(curves.items())):
        series = Series(name=path, x=[x for x, _ in group], y=[y for _, y in group], dots=True)
        line = str(drawing().curve(plot, series)) + legend(len(curves) - number, f"{path}, {raster}")
        body += f"<g {pen(path, rasters.index(raster))}>{line}</g>"
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {plot.WIDTH} {plot.HEIGHT}" width="{2 * plot.WIDTH}">'
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
    x, y = Plot.right - 150, Plot.bottom - 14 * number + 4
    line = f'<line class="curve" x1="{x}" x2="{x + 22}" y1="{y - 4}" y2="{y - 4}"/>'
    return line + f'<text x="{x + 28}" y="{y}" stroke="none">{html.escape(text)}</text>'
