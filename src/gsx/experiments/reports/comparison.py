"""Runs of one scene and protocol against each other: held-out PSNR over training time, and quality against its cost."""

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from markupsafe import Markup

from gsx.experiments.evaluation.remarks import measures_nothing
from gsx.experiments.reports.charts import STYLES, Dot, Series, line_chart, pareto_front, scatter, style
from gsx.experiments.reports.page import duration, fixed, time_unit
from gsx.experiments.run_folder.files import RunFiles, part
from gsx.experiments.run_folder.shapes import is_number

COSTS = {"primitives": ("primitives", 0), "megabytes": ("MB", 1), "seconds": ("seconds of training", 1)}
"""Costs that quality is plotted against: column, its name on the axis, decimals."""
LABEL = 32
"""Most letters of a point's label."""


@dataclass(frozen=True, kw_only=True)
class Entry:
    """A run and its row of the table."""

    run: RunFiles
    row: dict[str, Any]

    @property
    def name(self) -> str:
        """Returns the run's name on this page."""
        return str(self.row["name"])


@dataclass(frozen=True, kw_only=True)
class Group:
    """Runs that can be compared; `protocol` is empty where none of them is evaluated."""

    scene: str
    protocol: str
    entries: list[Entry]

    @property
    def evaluated(self) -> list[Entry]:
        """Returns the runs with figures."""
        return [entry for entry in self.entries if entry.run.evaluation]

    @property
    def styles(self) -> dict[str, int]:
        """Returns the style of each run by its folder: one each, or one per variant where runs are too many."""
        single = len(self.entries) <= STYLES
        keys = [entry.row["run"] if single else entry.row["variant"] for entry in self.entries]
        numbers = {key: number for number, key in enumerate(dict.fromkeys(keys))}
        return {entry.row["run"]: numbers[key] for entry, key in zip(self.entries, keys, strict=True)}


@dataclass(frozen=True, kw_only=True)
class Quality:
    """A figure that is plotted against costs."""

    key: str
    label: str
    """Name on its button."""
    title: str
    values: dict[str, Any]
    """Figures by folder of the run; None: unknown."""
    unit: str = " dB"
    digits: int = 2
    sign: int = 1
    """1: higher is better; -1: lower is."""

    def words(self, run: str) -> str:
        """Formats the figure of a run."""
        return f"{fixed(self.values[run], self.digits)}{self.unit}"


def groups_of(entries: Sequence[Entry]) -> list[Group]:
    """Groups runs by scene and protocol; one without figures joins the first evaluated run of its scene settings."""
    members: dict[tuple[str, str], list[Entry]] = {}
    known: dict[str, str] = {}
    for entry in entries:
        if entry.row["protocol"]:
            known.setdefault(scene_settings(entry.run), entry.row["protocol"])
    for entry in entries:
        settings = scene_settings(entry.run)
        if settings:
            protocol = entry.row["protocol"] or known.get(settings, "")
            members.setdefault((entry.row["scene"], protocol), []).append(entry)
    return [Group(scene=scene, protocol=protocol, entries=found) for (scene, protocol), found in members.items()]


def scene_settings(run: RunFiles) -> str:
    """Returns the scene's settings as text; empty where config.yaml is damaged."""
    node = part(run.config, "scene")
    return json.dumps(node, sort_keys=True, default=str) if node else ""


def compared_runs(group: Group) -> dict[str, Any]:
    """Returns what the page shows of a group: legend, curves and plots."""
    styles = group.styles
    plots = [
        {"key": one.key, "label": one.label, "title": one.title, "costs": plots_of(group, one, styles)}
        for one in qualities_of(group)
    ]
    legend = []
    for entry in group.entries:
        points = held_out(entry.run)
        seconds, psnr = points[-1] if points else (None, None)
        facts = {"style": style(styles[entry.row["run"]]), "last_psnr": psnr, "last_seconds": seconds}
        legend.append(entry.row | facts)
    return {
        "scene": group.scene,
        "protocol": group.protocol,
        "legend": legend,
        "curves": curves_of(group, styles),
        "unmeasured": any(measures_nothing(entry.run.evaluation) for entry in group.entries),
        "plots": [plot for plot in plots if plot["costs"]],
    }


def held_out(run: RunFiles) -> list[tuple[float, float]]:
    """Returns seconds of training and held-out PSNR in dB, where both were logged."""
    pairs = [(line.get("seconds"), line.get("test_psnr")) for line in run.lines]
    return [(seconds, psnr) for seconds, psnr in pairs if is_number(seconds) and is_number(psnr)]


def curves_of(group: Group, styles: dict[str, int]) -> Markup:
    """Draws held-out PSNR over training time, a line for each run; empty where no run has two points."""
    curves = {entry.row["run"]: held_out(entry.run) for entry in group.entries}
    unit, length = time_unit(max((seconds for points in curves.values() for seconds, _ in points), default=0))
    series = [
        Series(
            name=entry.name,
            x=[seconds / length for seconds, _ in curves[entry.row["run"]]],
            y=[psnr for _, psnr in curves[entry.row["run"]]],
            kind=style(styles[entry.row["run"]]),
            dots=True,
        )
        for entry in group.entries
    ]
    return line_chart(series, x_label=f"{unit} of training")


def qualities_of(group: Group) -> Iterator[Quality]:
    """Yields PSNR at each zoom, then the perceptual metrics at each zoom."""
    rows = [entry.row for entry in group.evaluated]
    zooms = sorted({factor for row in rows for factor in row["zoom_psnr"] if float(factor) > 1}, key=float)
    yield Quality(key="1", label="PSNR", title="PSNR, dB", values={row["run"]: row["psnr"] for row in rows})
    for factor in zooms:
        values = {row["run"]: row["zoom_psnr"].get(factor) for row in rows}
        title = f"PSNR zoomed in ×{factor}, dB"
        yield Quality(key=factor, label=f"zoom ×{factor}", title=title, values=values)
    for name in dict.fromkeys(name for row in rows for name in row["perceptual_figures"]):
        for factor in ("1", *zooms):
            yield perceptual_quality(rows, name, factor)


def perceptual_quality(rows: Sequence[dict[str, Any]], name: str, factor: str) -> Quality:
    """Returns a perceptual metric at a zoom."""
    label = name if factor == "1" else f"{name} ×{factor}"
    values = {row["run"]: row["perceptual_zoomed"].get(factor, {}).get(name) for row in rows}
    title = f"{label}, lower is better"
    return Quality(key=f"{name}-{factor}", label=label, title=title, values=values, unit="", digits=4, sign=-1)


def plots_of(group: Group, quality: Quality, styles: dict[str, int]) -> list[dict[str, Any]]:
    """Plots a figure against every cost that at least two runs have."""
    return [plot for cost in COSTS if (plot := plot_of(group, quality, cost, styles))]


def plot_of(group: Group, quality: Quality, cost: str, styles: dict[str, int]) -> dict[str, Any]:
    """Plots points with their Pareto front; empty with fewer than two."""
    values, (axis, decimals) = quality.values, COSTS[cost]

    def price(row: dict[str, Any]) -> str:
        return f"{duration(row[cost])} of training" if cost == "seconds" else f"{fixed(row[cost], decimals)} {axis}"

    rows = [e.row for e in group.evaluated if is_number(e.row[cost]) and is_number(values[e.row["run"]])]
    if len(rows) < 2:
        return {}
    dots = [
        Dot(
            x=row[cost],
            y=values[row["run"]],
            text=f"{row['name']} ({row['run']}): {quality.words(row['run'])}, {price(row)}",
            label=row["name"] if len(row["name"]) <= LABEL else row["name"][: LABEL - 1] + "…",
            colour=styles[row["run"]],
            link=row["link"],
        )
        for row in rows
    ]
    front = pareto_front([dot.x for dot in dots], [quality.sign * dot.y for dot in dots])
    return {"svg": scatter(dots, x_label=axis, sign=quality.sign), "front": [rows[i] for i in front], "label": axis}
