"""One page over all runs below a folder: a table, what cannot be compared, and PSNR against its cost."""

import csv
import io
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from gsx import __version__
from gsx.core.charts import Dot, pareto_front, scatter
from gsx.core.control import control_rows
from gsx.core.errors import InputError
from gsx.core.files import replace_file
from gsx.core.page import fixed, template
from gsx.core.run_files import STATES, RunFiles, gain_of, is_number, part, read_run, runs_below, state_of

DIFFERENCES = 6
"""Configuration keys in which runs differ that an overview shows."""
UNTOLD = ("folder", "output", "device", "tracker")
"""Keys that say where a run ran and who was told, not what it is."""
LABEL = 32
"""Longest name beside a point."""
FIELDS = (
    "run", "state", "reason", "scene", "backbone", "differences", "iterations", "psnr", "ssim", "lpips", "primitives",
    "megabytes", "seconds", "render_fps", "peak_memory_mb", "zoom_gains", "protocol", "comparable",
)  # fmt: skip
"""Columns of report.csv."""


def write_overview(folder: Path, chosen: Sequence[Path] | None = None) -> Path:
    """Write report.html and report.csv into a folder, over the runs chosen, or over all runs below it.

    Raises:
        InputError: there is no run below it.
    """
    runs = [read_run(path) for path in (runs_below(folder) if chosen is None else chosen)]
    if not runs:
        raise InputError(f"there is no run below {folder} (no folder with a config.yaml): give the folder of some runs")
    rows, controls = overview_rows(folder, runs), control_rows(runs)
    replace_file(folder / "report.csv", csv_of(rows).encode())
    context = {
        "title": f"{len(rows)} runs {'below' if chosen is None else 'of'} {folder.name or folder}",
        "version": __version__,
        "rows": rows,
        "states": {state: n for state in STATES if (n := sum(row["state"] == state for row in rows))},
        "zooms": sorted({factor for row in rows for factor in row["gains"]}, key=float),
        "mixed": mixed_protocols(rows),
        "comparisons": comparisons(rows),
        "controls": controls,
        "control_zooms": sorted({factor for entry in controls for factor in entry["gains"]}, key=float),
        "any_lpips": any(is_number(row["lpips"]) for row in rows),
    }
    path = folder / "report.html"
    replace_file(path, template("overview.html").render(context).encode())
    return path


def overview_rows(folder: Path, runs: Sequence[RunFiles]) -> list[dict[str, Any]]:
    """One row for each run."""
    told = differences(runs)
    rows = [overview_row(folder, run, told[i]) for i, run in enumerate(runs)]
    mixed = mixed_protocols(rows)
    return [
        row | {"comparable": "" if not row["protocol"] else "no" if row["scene"] in mixed else "yes"} for row in rows
    ]


def overview_row(folder: Path, run: RunFiles, told: str) -> dict[str, Any]:
    """The figures of a run."""
    state, reason = state_of(run)
    e = run.evaluation
    zoom = {factor: gain_of(entry) for factor, entry in part(e, "zoom").items() if factor != "1"}
    gains = {factor: gain for factor, gain in zoom.items() if gain is not None}
    report = run.folder / "report.html"
    return {
        "run": place(run.folder, folder),
        "report": place(report, folder) if report.is_file() else "",
        "state": state,
        "reason": reason,
        "scene": run.scene,
        "backbone": run.backbone,
        "differences": told,
        "iterations": run.iterations,
        **{
            key: e.get(key)
            for key in ("psnr", "ssim", "lpips", "primitives", "megabytes", "render_fps", "peak_memory_mb")
        },
        "seconds": e.get("train_seconds"),
        "gains": gains,
        "zoom_gains": " ".join(f"x{factor}:{gain:+.3f}" for factor, gain in gains.items()),
        "protocol": run.protocol_hash,
    }


def place(path: Path, folder: Path) -> str:
    """A path as links in the folder have it."""
    return Path(os.path.relpath(path, folder)).as_posix()


def differences(runs: Sequence[RunFiles]) -> list[str]:
    """For each run its values of the configuration keys in which runs of its scene and backbone differ."""
    groups: dict[tuple[str, str], list[int]] = {}
    for i, run in enumerate(runs):
        groups.setdefault((run.scene, run.backbone), []).append(i)
    flat = [flattened(run.config) for run in runs]
    out = [""] * len(runs)
    for members in groups.values():
        varied = varied_keys([flat[i] for i in members])
        more = f", and {len(varied) - DIFFERENCES} more" if len(varied) > DIFFERENCES else ""
        for i in members:
            out[i] = ", ".join(f"{key}={flat[i].get(key, 'absent')}" for key in varied[:DIFFERENCES]) + more
    return out


def varied_keys(configs: Sequence[dict[str, Any]]) -> list[str]:
    """Keys whose values are not the same in all configurations, in their order."""
    keys = dict.fromkeys(key for config in configs for key in config)
    return [key for key in keys if len({repr(config.get(key)) for config in configs}) > 1]


def flattened(node: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """Dotted keys and values, without UNTOLD."""
    out: dict[str, Any] = {}
    for key, value in node.items():
        if f"{prefix}{key}" in UNTOLD:
            continue
        if isinstance(value, dict):
            out |= flattened(value, f"{prefix}{key}.")
        else:
            out[f"{prefix}{key}"] = value
    return out


def mixed_protocols(rows: Sequence[dict[str, Any]]) -> dict[str, dict[str, int]]:
    """Scenes evaluated by several protocols: how many runs by each hash."""
    counts: dict[str, dict[str, int]] = {}
    for row in rows:
        if row["protocol"]:
            by_hash = counts.setdefault(row["scene"], {})
            by_hash[row["protocol"]] = by_hash.get(row["protocol"], 0) + 1
    return {scene: by_hash for scene, by_hash in counts.items() if len(by_hash) > 1}


def csv_of(rows: Sequence[dict[str, Any]]) -> str:
    """report.csv: missing figures are empty."""
    stream = io.StringIO()
    writer = csv.DictWriter(stream, FIELDS, extrasaction="ignore", lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return stream.getvalue()


def comparisons(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Scatter plots of each scene and protocol with at least two evaluated runs."""
    groups: dict[tuple[str, str], list[dict[str, Any]]] = {}
    for row in rows:
        if all(is_number(row[key]) for key in ("psnr", "primitives", "seconds")):
            groups.setdefault((row["scene"], row["protocol"]), []).append(row)
    colours = {name: i for i, name in enumerate(dict.fromkeys(row["backbone"] for row in rows))}
    return [comparison(*key, members, colours) for key, members in groups.items() if len(members) > 1]


def comparison(scene: str, protocol: str, rows: Sequence[dict[str, Any]], colours: dict[str, int]) -> dict[str, Any]:
    """PSNR against primitives and against training time, with both Pareto fronts."""

    def plot(key: str, x_label: str) -> dict[str, Any]:
        dots = [
            Dot(
                x=row[key],
                y=row["psnr"],
                text=f"{row['run']}: {fixed(row['psnr'])} dB, {fixed(row[key], 0)} {x_label}",
                label=short_name(row),
                colour=colours[row["backbone"]] % 6,
            )
            for row in rows
        ]
        front = pareto_front([dot.x for dot in dots], [dot.y for dot in dots])
        return {"svg": scatter(dots, x_label=x_label), "front": [rows[i]["run"] for i in front], "label": x_label}

    return {
        "scene": scene,
        "protocol": protocol,
        "plots": [plot("primitives", "primitives"), plot("seconds", "seconds of training")],
        "legend": {name: colours[name] % 6 for name in dict.fromkeys(row["backbone"] for row in rows)},
    }


def short_name(row: dict[str, Any]) -> str:
    """What tells a run from its like, or else its folder, cut to what fits beside a point."""
    words = [word.split(".")[-1] for word in row["differences"].split(", ") if word]
    name = " ".join(words) or Path(row["run"]).name
    return name if len(name) <= LABEL else name[: LABEL - 1] + "…"
