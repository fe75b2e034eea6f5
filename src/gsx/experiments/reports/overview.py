"""One page over many runs in any state: a table, what cannot be compared, curves, PSNR against its cost, pictures.

The page refers to pictures in the runs' folders.
"""

import os
from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from gsx import __version__
from gsx.core.errors import InputError
from gsx.core.files import csv_text, remove_partial, replace_text
from gsx.experiments.evaluation.remarks import NOT_MEASURED, measures_nothing
from gsx.experiments.reports.baselines import baseline_rows
from gsx.experiments.reports.comparison import Entry, compared_runs, groups_of
from gsx.experiments.reports.page import address, template
from gsx.experiments.reports.same_scene import number_namesakes
from gsx.experiments.reports.side_by_side import pictures_of
from gsx.experiments.run_folder.files import (
    STATES,
    RunFiles,
    detail_share,
    gain_of,
    over_upscaled,
    part,
    perceptual_figure,
    perceptual_names,
    read_run,
    runs_below,
    state_of,
)
from gsx.experiments.run_folder.run_key import comparable
from gsx.experiments.run_folder.shapes import is_number

DIFFERENCES = 6
"""Most configuration keys in which runs differ that an overview shows."""
FIELDS = (
    "run", "state", "reason", "scene", "backbone", "variant", "differences", "iterations", "psnr", "ssim", "lpips",
    "perceptual", "primitives", "megabytes", "seconds", "render_fps", "render_path", "peak_memory_mb", "zoom_gains",
    "zoom_upscaled_gains", "zoom_detail", "protocol", "comparable",
)  # fmt: skip
"""Columns of report.csv."""
FIGURES = ("psnr", "ssim", "lpips", "primitives", "megabytes", "render_fps", "render_path", "peak_memory_mb")
"""Columns that evaluation.json has under the same name."""


def write_overview(folder: Path, chosen: Sequence[Path] | None = None) -> Path:
    """Writes report.html and report.csv into a folder, over the runs chosen, or over all runs below it.

    Raises:
        InputError: there is no run below it.
    """
    runs = number_namesakes([read_run(path) for path in (runs_in([folder]) if chosen is None else chosen)])
    rows, baselines = overview_rows(folder, runs), baseline_rows(runs)
    groups = groups_of([Entry(run=run, row=row) for run, row in zip(runs, rows, strict=True)])
    remove_partial(folder, below=False)
    replace_text(folder / "report.csv", csv_text(FIELDS, rows))
    context = {
        "title": title_of(folder, runs),
        "version": __version__,
        "rows": rows,
        "states": {state: n for state in STATES if (n := sum(row["state"] == state for row in rows))},
        "zooms": sorted({factor for row in rows for factor in row["gains"]}, key=float),
        "upscaled_zooms": sorted({factor for row in rows for factor in row["upscaled_gains"]}, key=float),
        "mixed": mixed_protocols(rows),
        "groups": [compared_runs(group) | {"pictures": pictures_of(group, folder)} for group in groups],
        "baselines": baselines,
        "baseline_zooms": sorted({factor for entry in baselines for factor in entry["gains"]}, key=float),
        "any_lpips": any(is_number(row["lpips"]) for row in rows),
        "perceptual": list(dict.fromkeys(name for row in rows for name in row["perceptual_figures"])),
    }
    path = folder / "report.html"
    replace_text(path, template("reports/overview.html").render(context))
    return path


def title_of(folder: Path, runs: Sequence[RunFiles]) -> str:
    """Says how many runs there are, and where if that is one place."""
    count = f"{len(runs)} {'run' if len(runs) == 1 else 'runs'}"
    together = all(Path(os.path.abspath(run.folder)).is_relative_to(os.path.abspath(folder)) for run in runs)
    return f"{count} below {folder.resolve().name or folder}" if together else count


def runs_in(folders: Sequence[Path]) -> list[Path]:
    """Lists the runs that these folders are or hold, each once, however many ways lead to it.

    Raises:
        InputError: one of them is no folder, or neither is a run nor holds any.
    """
    found: dict[Path, Path] = {}
    for folder in folders:
        if not folder.is_dir():
            raise InputError(f"{folder} is no folder: give a run, or a folder with runs below it")
        runs = [folder] if (folder / "config.yaml").is_file() else list(runs_below(folder))
        if not runs:
            raise InputError(f"there is no run below {folder} (no folder with a config.yaml): give a folder of runs")
        for run in runs:
            found.setdefault(run.resolve(), run)
    return list(found.values())


def common_folder(folders: Sequence[Path]) -> Path:
    """Returns the closest folder above all of these that is no run itself.

    Raises:
        InputError: they have nothing but the root of the file system in common.
    """
    try:
        common = Path(os.path.commonpath([os.path.abspath(folder) for folder in folders]))
    except ValueError:  # on different drives
        common = Path(folders[0].anchor)
    while (common / "config.yaml").is_file():
        common = common.parent
    if common == common.parent:
        raise InputError(f"{folders[0]} and the others have no folder in common: say where with --to FOLDER")
    return common


def overview_rows(folder: Path, runs: Sequence[RunFiles]) -> list[dict[str, Any]]:
    """Returns one row for each run."""
    rows = [
        overview_row(folder, run) | {"differences": varied} for run, varied in zip(runs, differences(runs), strict=True)
    ]
    mixed = mixed_protocols(rows)
    return [
        row | {"name": name, "comparable": "" if not row["protocol"] else "no" if row["scene"] in mixed else "yes"}
        for row, name in zip(rows, names_of(rows), strict=True)
    ]


def overview_row(folder: Path, run: RunFiles) -> dict[str, Any]:
    """Returns the figures of a run."""
    state, reason = state_of(run)
    evaluation, report = run.evaluation, run.folder / "report.html"
    zoom = {factor: entry for factor, entry in part(evaluation, "zoom").items() if factor != "1"}
    gains = {factor: gain for factor, entry in zoom.items() if (gain := gain_of(entry)) is not None}
    rivals = {factor: gain for factor, entry in zoom.items() if (gain := over_upscaled(entry)) is not None}
    shares = {factor: share for factor, entry in zoom.items() if (share := detail_share(entry)) is not None}
    perceptual = {name: perceptual_figure(evaluation, name) for name in perceptual_names(evaluation)}
    unmeasured = NOT_MEASURED if measures_nothing(evaluation) else ""
    return {
        "run": relative(run.folder, folder),
        "link": address(relative(report, folder)) if report.is_file() else "",
        "state": state,
        "reason": "; ".join(dict.fromkeys(word for word in (reason, *run.problems.values(), unmeasured) if word)),
        "scene": run.scene,
        "backbone": run.backbone,
        "variant": run.variant,
        "iterations": run.iterations,
        **{key: evaluation.get(key) for key in FIGURES},
        "perceptual": " ".join(f"{name}:{value:.4f}" for name, value in perceptual.items()),
        "perceptual_figures": perceptual,
        "perceptual_zoomed": {"1": perceptual}
        | {factor: zoom_figures(entry, perceptual) for factor, entry in zoom.items()},
        "seconds": evaluation.get("train_seconds"),
        "gains": gains,
        "upscaled_gains": rivals,
        "zoom_psnr": {factor: entry["psnr"] for factor, entry in zoom.items() if is_number(entry.get("psnr"))},
        "zoom_detail": by_zoom(shares),
        "zoom_gains": by_zoom(gains),
        "zoom_upscaled_gains": by_zoom(rivals),
        "protocol": run.protocol_hash,
    }


def zoom_figures(entry: dict[str, Any], names: Iterable[str]) -> dict[str, float | None]:
    """Returns the perceptual figures of a zoomed render by metric."""
    return {name: perceptual_figure(entry, name) for name in names}


def by_zoom(values: dict[str, float]) -> str:
    """Formats differences by zoom for report.csv."""
    return " ".join(f"x{factor}:{value:+.3f}" for factor, value in values.items())


def relative(path: Path, folder: Path) -> str:
    """Returns a path as links in the folder have it."""
    return Path(os.path.relpath(path, folder)).as_posix()


def differences(runs: Sequence[RunFiles]) -> list[str]:
    """Returns for each run its values of the configuration keys in which runs of its scene and variant differ."""
    groups: dict[tuple[str, str], list[int]] = {}
    for i, run in enumerate(runs):
        groups.setdefault((run.scene, run.variant), []).append(i)
    flat = [comparable(run.config) for run in runs]
    out = [""] * len(runs)
    for members in groups.values():
        varied = varied_keys([flat[i] for i in members])
        more = f", and {len(varied) - DIFFERENCES} more" if len(varied) > DIFFERENCES else ""
        for i in members:
            out[i] = ", ".join(f"{key}={flat[i].get(key, 'absent')}" for key in varied[:DIFFERENCES]) + more
    return out


def names_of(rows: Sequence[dict[str, Any]]) -> list[str]:
    """Names each run by its variant; where a scene has several of those, also by what differs, or its folder."""
    names = [row["variant"] for row in rows]
    short = [" ".join(word.split(".")[-1] for word in row["differences"].split(", ") if word) for row in rows]
    for more in (short, [Path(row["run"]).name for row in rows]):
        same = Counter((row["scene"], name) for row, name in zip(rows, names, strict=True))
        names = [
            f"{name} · {word}" if word and same[row["scene"], name] > 1 else name
            for row, name, word in zip(rows, names, more, strict=True)
        ]
    return names


def varied_keys(configs: Sequence[dict[str, Any]]) -> list[str]:
    """Lists keys whose values are not the same in all configurations, in their order."""
    keys = dict.fromkeys(key for config in configs for key in config)
    return [key for key in keys if len({repr(config.get(key)) for config in configs}) > 1]


def mixed_protocols(rows: Sequence[dict[str, Any]]) -> dict[str, dict[str, int]]:
    """Counts runs by protocol for scenes that were evaluated by several."""
    counts: dict[str, Counter[str]] = {}
    for row in rows:
        if row["protocol"]:
            counts.setdefault(row["scene"], Counter())[row["protocol"]] += 1
    return {scene: dict(by_hash) for scene, by_hash in counts.items() if len(by_hash) > 1}
