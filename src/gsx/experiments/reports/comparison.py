"""Runs of one scene and protocol against each other: held-out PSNR over training time, and quality against its cost."""

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from markupsafe import Markup

from gsx.experiments.evaluation.remarks import measures_nothing
from gsx.experiments.reports.charts import STYLES, Dot, Series, line_chart, pareto_front, scatter, style
from gsx.experiments.reports.page import duration, fixed, time_unit
from gsx.experiments.run_folder.files import RunFiles, part
from gsx.experiments.run_folder.shapes import is_number

COSTS = (("primitives", "primitives", 0), ("megabytes", "MB", 1), ("seconds", "seconds of training", 1))
"""What quality is plotted against: column, its name on the axis, decimals."""
LABEL = 32
"""Longest name beside a point."""


@dataclass(frozen=True, kw_only=True)
class Entry:
    """A run and its row of the table."""

    run: RunFiles
    row: dict[str, Any]

    @property
    def name(self) -> str:
        """What the run is called on this page."""
        return str(self.row["name"])


@dataclass(frozen=True, kw_only=True)
class Group:
    """Runs that can be compared; `protocol` is empty where none of them is evaluated."""

    scene: str
    protocol: str
    entries: list[Entry]

    @property
    def evaluated(self) -> list[Entry]:
        """Those with figures."""
        return [entry for entry in self.entries if entry.run.evaluation]

    @property
    def styles(self) -> dict[str, int]:
        """Number of the style of each run by its folder: one each, or one per variant where runs are too many."""
        single = len(self.entries) <= STYLES
        keys = [entry.row["run"] if single else entry.row["variant"] for entry in self.entries]
        numbers = {key: number for number, key in enumerate(dict.fromkeys(keys))}
        return {entry.row["run"]: numbers[key] for entry, key in zip(self.entries, keys, strict=True)}


def groups_of(entries: Sequence[Entry]) -> list[Group]:
    """Runs by scene and protocol; one without figures joins the first evaluated run with the same scene settings."""
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
    """The scene's settings as text; empty where config.yaml is damaged."""
    node = part(run.config, "scene")
    return json.dumps(node, sort_keys=True, default=str) if node else ""


def compared_runs(group: Group) -> dict[str, Any]:
    """What the page shows of a group: legend, curves and plots."""
    styles = group.styles
    plots = [plot for quality in qualities(group) if (plot := plots_of(group, quality, styles))["costs"]]
    return {
        "scene": group.scene,
        "protocol": group.protocol,
        "legend": [legend_row(entry, styles) for entry in group.entries],
        "curves": curves_of(group, styles),
        "unmeasured": any(measures_nothing(entry.run.evaluation) for entry in group.entries),
        "plots": plots,
    }


def legend_row(entry: Entry, styles: dict[str, int]) -> dict[str, Any]:
    """Style, name, state, and the last held-out PSNR with its time."""
    points = held_out(entry.run)
    seconds, psnr = points[-1] if points else (None, None)
    return entry.row | {"style": style(styles[entry.row["run"]]), "last_psnr": psnr, "last_seconds": seconds}


# -- over time -----------------------------------------------------------------------------------------------------


def held_out(run: RunFiles) -> list[tuple[float, float]]:
    """Seconds of training and held-out PSNR in dB, where both were written down."""
    pairs = [(line.get("seconds"), line.get("test_psnr")) for line in run.lines]
    return [(seconds, psnr) for seconds, psnr in pairs if is_number(seconds) and is_number(psnr)]


def curves_of(group: Group, styles: dict[str, int]) -> Markup:
    """Held-out PSNR over training time, a line for each run; empty where no run has two points."""
    courses = [(entry, held_out(entry.run)) for entry in group.entries]
    unit, length = time_unit(max((seconds for _, points in courses for seconds, _ in points), default=0))
    series = [
        Series(
            name=entry.name,
            x=[seconds / length for seconds, _ in points],
            y=[psnr for _, psnr in points],
            kind=style(styles[entry.row["run"]]),
            dots=True,
        )
        for entry, points in courses
    ]
    return line_chart(series, x_label=f"{unit} of training")


# -- against cost --------------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class Quality:
    """What is plotted upwards: PSNR in dB at a zoom."""

    key: str
    title: str
    of: Callable[[dict[str, Any]], Any]


def qualities(group: Group) -> list[Quality]:
    """PSNR at the training resolution, and at every zoom above 1 that a run was evaluated at."""
    zooms = {factor for entry in group.evaluated for factor in entry.row["zoom_psnr"] if float(factor) > 1}
    plain = Quality(key="1", title="PSNR, dB", of=lambda row: row["psnr"])
    return [plain, *(zoom_quality(factor) for factor in sorted(zooms, key=float))]


def zoom_quality(factor: str) -> Quality:
    """PSNR of renders zoomed in `factor` times."""
    return Quality(key=factor, title=f"PSNR zoomed in ×{factor}, dB", of=lambda row: row["zoom_psnr"].get(factor))


def plots_of(group: Group, quality: Quality, styles: dict[str, int]) -> dict[str, Any]:
    """One quality against every cost that at least two runs know."""
    plots = [plot_of(group, quality, cost, styles) for cost in COSTS]
    return {"key": quality.key, "title": quality.title, "costs": [plot for plot in plots if plot is not None]}


def plot_of(
    group: Group, quality: Quality, cost: tuple[str, str, int], styles: dict[str, int]
) -> dict[str, Any] | None:
    """Points with their Pareto front; None with fewer than two."""
    key, axis, decimals = cost
    rows = [e.row for e in group.evaluated if is_number(e.row[key]) and is_number(quality.of(e.row))]
    if len(rows) < 2:
        return None

    def dot(row: dict[str, Any]) -> Dot:
        price = f"{duration(row[key])} of training" if key == "seconds" else f"{fixed(row[key], decimals)} {axis}"
        return Dot(
            x=row[key],
            y=quality.of(row),
            text=f"{row['name']} ({row['run']}): {fixed(quality.of(row))} dB, {price}",
            label=row["name"] if len(row["name"]) <= LABEL else row["name"][: LABEL - 1] + "…",
            colour=styles[row["run"]],
            link=row["link"],
        )

    dots = [dot(row) for row in rows]
    front = pareto_front([dot.x for dot in dots], [dot.y for dot in dots])
    return {"svg": scatter(dots, x_label=axis), "front": [rows[i] for i in front], "label": axis}
