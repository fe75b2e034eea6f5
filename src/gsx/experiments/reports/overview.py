"""One page over many runs in any state: a table, what cannot be compared, curves, PSNR against its cost, pictures.

The page refers to pictures in the runs' folders.
"""

import os
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from gsx import __version__
from gsx.core.data.images import read_image
from gsx.core.errors import GsxError, InputError
from gsx.core.files import csv_text, remove_partial, replace_text
from gsx.experiments.evaluation.remarks import NOT_MEASURED, measures_nothing
from gsx.experiments.reports.baselines import baseline_rows
from gsx.experiments.reports.comparison import Entry, compared_runs, groups_of
from gsx.experiments.reports.page import address, counted, template
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
    count = counted(len(runs), "run")
    together = all(Path(os.path.abspath(run.folder)).is_relative_to(os.path.abspath(folder)) for run in runs)
    remove_partial(folder, below=False)
    replace_text(folder / "report.csv", csv_text(FIELDS, rows))
    context = {
        "title": f"{count} below {folder.resolve().name or folder}" if together else count,
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
        | {factor: {name: perceptual_figure(entry, name) for name in perceptual} for factor, entry in zoom.items()},
        "seconds": evaluation.get("train_seconds"),
        "gains": gains,
        "upscaled_gains": rivals,
        "zoom_psnr": {factor: entry["psnr"] for factor, entry in zoom.items() if is_number(entry.get("psnr"))},
        "zoom_detail": by_zoom(shares),
        "zoom_gains": by_zoom(gains),
        "zoom_upscaled_gains": by_zoom(rivals),
        "protocol": run.protocol_hash,
    }


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
        keys = dict.fromkeys(key for i in members for key in flat[i])
        varied = [key for key in keys if len({repr(flat[i].get(key)) for i in members}) > 1]
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


def mixed_protocols(rows: Sequence[dict[str, Any]]) -> dict[str, dict[str, int]]:
    """Counts runs by protocol for scenes that were evaluated by several."""
    counts: dict[str, Counter[str]] = {}
    for row in rows:
        if row["protocol"]:
            counts.setdefault(row["scene"], Counter())[row["protocol"]] += 1
    return {scene: dict(by_hash) for scene, by_hash in counts.items() if len(by_hash) > 1}


def number_namesakes(runs: Sequence[RunFiles]) -> list[RunFiles]:
    """Numbers the scenes of one name that differ (`RunFiles.namesake`)."""
    first: dict[str, list[RunFiles]] = {}
    out = []
    for run in runs:
        known = first.setdefault(run.scene, [])
        number = next((n for n, other in enumerate(known) if not differ(run, other)), len(known))
        if number == len(known):
            known.append(run)
        out.append(replace(run, namesake=number))
    return out


def differ(run: RunFiles, other: RunFiles) -> bool:
    """Returns whether scenes in different folders have other pixels in a test photo of one name and size."""
    if part(run.config, "scene").get("path") == part(other.config, "scene").get("path"):
        return False
    truths, others = truths_of(run), truths_of(other)
    return any(unlike(truths[key], others[key]) for key in truths.keys() & others.keys())


def truths_of(run: RunFiles) -> dict[tuple[str, str], Path]:
    """Returns the photos of drawn test views by name and size."""
    return {
        (str(view.get("name")), str(view["size"])): run.folder / "renders" / Path(view["files"]["truth"]).name
        for view in run.pictures.get("views", [])
        if part(view, "files").get("truth")
    }


def unlike(one: Path, other: Path) -> bool:
    """Returns whether two picture files have other pixels; False where one cannot be read."""
    try:
        return one.read_bytes() != other.read_bytes() and not torch.equal(read_image(one), read_image(other))
    except (OSError, GsxError):
        return False
