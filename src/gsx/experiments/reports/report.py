"""The report of one run as a single HTML file.

It is made from files only, copes with whatever is missing or damaged, and refers to nothing outside the page.
"""

import base64
import json
import math
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

from markupsafe import Markup

from gsx import __version__
from gsx.core.errors import InputError, command
from gsx.core.files import is_file, remove_partial, replace_text
from gsx.experiments.evaluation.perceptual import COMPARED
from gsx.experiments.evaluation.remarks import NOT_MEASURED, measures_nothing, remarks_of
from gsx.experiments.reports.charts import Mark, Series, line_chart, smoothed, style
from gsx.experiments.reports.overview import common_folder, runs_in, write_overview
from gsx.experiments.reports.page import template, time_unit
from gsx.experiments.reports.pictures import ERROR_COLOURS
from gsx.experiments.run_folder.files import (
    DETAIL_OF,
    RunFiles,
    detail_share,
    gain_of,
    newest_checkpoint,
    over_upscaled,
    part,
    perceptual_figure,
    perceptual_names,
    read_run,
    state_of,
    upscaler_of,
)
from gsx.experiments.run_folder.shapes import is_number

WORST = 10
"""Views in the table of the worst."""
SMOOTHING = 0.02
"""Curves are averaged over this fraction of their lines on either side."""
CURVES = (
    ("PSNR, dB", "psnr", "training view, smoothed"),
    ("Loss", "loss", "smoothed"),
    ("Primitives", "primitives", "primitives"),
    ("Time per step, ms", "step_ms", "smoothed"),
)
"""Titles, keys in metrics.jsonl and legends of the training curves."""
NAMES = {"psnr": "training", "step_ms": "ms"}
"""Names of these keys under the pointer."""
IMAGE_KINDS = {".png": "png", ".jpg": "jpeg", ".jpeg": "jpeg"}


def write_report(folder: Path) -> Path:
    """Writes report.html of a run folder, complete or not.

    Raises:
        InputError: the folder is no run.
    """
    if not (folder / "config.yaml").is_file():
        raise InputError(f"{folder} is no run folder (it has no config.yaml): give a folder that `gsx` made")
    path = folder / "report.html"
    remove_partial(folder)
    replace_text(path, template("reports/report.html").render(report_context(read_run(folder))))
    return path


def report_on(folders: Sequence[Path], to: Path | None = None) -> Path:
    """Writes the report of a single run without `to`, else an overview in `to` or the folder that the runs share.

    Raises:
        InputError: one of the folders holds no run, or there is no sensible place for the page.
    """
    chosen, requested = runs_in(folders), {folder.resolve() for folder in folders}
    if to is None and requested == {run.resolve() for run in chosen} and len(chosen) == 1:
        return write_report(folders[0])
    if to is not None and (to / "config.yaml").is_file():
        raise InputError(f"{to} is a run, whose report.html this would replace: choose another folder with --to FOLDER")
    place = to or (common_folder(folders) if len(folders) > 1 or folders == chosen else folders[0])
    try:
        place.mkdir(parents=True, exist_ok=True)
        return write_overview(place, chosen)
    except (PermissionError, NotADirectoryError) as error:
        raise InputError(f"{place} cannot be written ({error.strerror}): say where with --to FOLDER") from error


def report_context(run: RunFiles) -> dict[str, Any]:
    """Returns what the template of a run's report needs."""
    state, reason = state_of(run, reporting=True)
    evaluation, zoom = run.evaluation, zoom_rows(run.evaluation)
    views = evaluation.get("views", [])

    def psnr(view: dict[str, Any]) -> float:
        return view["psnr"] if is_number(view.get("psnr")) else -math.inf

    def embed(folder: str, name: Any) -> str | None:
        return embedded(run.folder / folder / Path(str(name)).name)

    return {
        "title": f"{run.scene} · {run.backbone}",
        "version": __version__,
        "run": run,
        "state": state,
        "reason": reason,
        "evaluation": evaluation,
        "protocol": part(evaluation, "protocol"),
        "groups": part(evaluation, "groups"),
        **coverage_context(evaluation),
        "zoom_groups": zoom_groups(zoom),
        "scene": part(run.environment, "scene"),
        "plan": part(run.environment, "plan"),
        "minutes": minutes_of(run),
        "remarks": remarks_of(evaluation),
        "unmeasured": f"{NOT_MEASURED[0].upper()}{NOT_MEASURED[1:]}." if measures_nothing(evaluation) else "",
        "zoom": zoom,
        "upscaler": upscaler_of(evaluation),
        "upscaled": any(row["upscaled_gain"] is not None for row in zoom),
        "agreement": consistency_rows(zoom),
        "zoom_chart": zoom_chart(zoom),
        "perceptual": part(evaluation, "perceptual"),
        "perceptual_figure": perceptual_figure,
        "perceptual_names": perceptual_names,
        "measured": perceptual_names(evaluation),
        "growth_chart": growth_chart(run.lines),
        "curves": curves(run.lines),
        "held_out": any("test_psnr" in line for line in run.lines),
        "embed": embed,
        "views": views,
        "worst": sorted(views, key=psnr)[:WORST],
        "newest": newest_checkpoint(run.folder),
        "pages": sorted(path.name for path in run.folder.glob("*.html") if path.name != "report.html"),
        "percent": lambda step: round(100 * min(max(float(step), 0), run.iterations) / run.iterations, 2),
        "ramp": ", ".join(f"rgb{colour} {place:.0%}" for place, colour in ERROR_COLOURS),
        "environment_text": json.dumps(run.environment, indent=2, ensure_ascii=False) if run.environment else "",
    }


def coverage_context(evaluation: dict[str, Any]) -> dict[str, Any]:
    """Returns the coverage of views, its classes of test views and of training views; empty where unknown."""
    coverage = part(evaluation, "coverage")
    classes, training = part(coverage, "classes"), part(coverage, "training")
    return {
        "coverage": coverage,
        "classes": classes if any(one["views"] for one in classes.values()) else {},
        "training": training,
        "training_classes": part(training, "classes"),
    }


def minutes_of(run: RunFiles) -> dict[str, Any]:
    """Returns the plan by wall time of a run with the command that repeats it; empty: there is no readable one."""
    plan = part(run.environment, "minutes")
    words, numbers = plan.get("repeat"), [plan.get(key) for key in ("limit_s", "steps", "training_s")]
    if not (isinstance(words, list) and all(isinstance(word, str) for word in words) and all(map(is_number, numbers))):
        return {}
    late = run.evaluation.get("late")
    if isinstance(late, list) and late and all(map(is_number, late)):
        words = [*words, f"training.deadline.skip=[{','.join(f'{step:.0f}' for step in late)}]"]
    return plan | {"command": command(*words)} if plan["steps"] == run.iterations else {}


def embedded(path: Path) -> str | None:
    """Reads a picture as a data URI; None where it is missing."""
    kind = IMAGE_KINDS.get(path.suffix.lower())
    if kind is None or not is_file(path):
        return None
    return f"data:image/{kind};base64,{base64.b64encode(path.read_bytes()).decode()}"


def zoom_rows(evaluation: dict[str, Any]) -> list[dict[str, Any]]:
    """Returns figures and gains of each zoom, in order."""
    return [
        {
            "factor": factor,
            "entry": entry,
            "gain": None if factor == "1" else gain_of(entry),
            "upscaled_gain": over_upscaled(entry),
            "ssim_gain": None if factor == "1" else gain_of(entry, "ssim"),
            "detail": {kind: detail_share(entry, kind) for kind in DETAIL_OF},
            "perceptual": {
                name: {kind: perceptual_figure(entry, name, kind) for kind in COMPARED}
                for name in perceptual_names(evaluation)
            },
        }
        for factor, entry in sorted(part(evaluation, "zoom").items(), key=lambda item: float(item[0]))
    ]


def zoom_groups(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Returns PSNR of each group by zoom, without x1 and zooms that have none."""
    return [
        {"factor": row["factor"], "psnr": {name: part(groups, name).get("psnr") for name in groups}}
        for row in rows
        if row["factor"] != "1" and (groups := part(row["entry"], "groups"))
    ]


def consistency_rows(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Returns the consistency of neighbouring views at the zooms where it was measured."""
    found = {row["factor"]: part(row["entry"], "consistency") for row in rows}
    known = {factor: levels for factor, levels in found.items() if is_number(levels.get("render"))}
    return [{"factor": factor, **levels, "detail": part(levels, "detail")} for factor, levels in known.items()]


def zoom_chart(rows: Sequence[dict[str, Any]]) -> Markup:
    """Draws PSNR of zoomed and resized renders over the zoom; empty with fewer than two zooms."""
    known = [(float(row["factor"]), row["entry"]) for row in rows if is_number(row["entry"].get("psnr"))]
    zooms = [factor for factor, _ in known]
    render = [entry["psnr"] for _, entry in known]
    enlarged = [entry.get("enlarged_psnr") if factor != 1 else entry["psnr"] for factor, entry in known]
    if len(known) < 2 or not all(is_number(value) for value in enlarged):
        return Markup()
    series = [
        Series(name="zoomed render", x=zooms, y=render, dots=True),
        Series(name="resized ×1 render", x=zooms, y=enlarged, kind="test", dots=True),
    ]
    upscaled = {float(row["factor"]): row["entry"].get("upscaled_psnr") for row in rows}
    if known_upscaled := {factor: value for factor, value in upscaled.items() if is_number(value)}:
        places, values = list(known_upscaled), list(known_upscaled.values())
        series.append(Series(name="upscaled ×1 render", x=places, y=values, kind=style(3), dots=True))
    return line_chart(series, x_label="zoom, times the training resolution", x_ticks=zooms)


def growth_chart(lines: Sequence[dict[str, Any]]) -> Markup:
    """Draws the gain of each event of growth, and its price, over the primitives; empty where none was measured."""
    measured = [line for line in lines if all(is_number(line.get(name)) for name in ("judged", "gain", "price"))]
    count = [line["judged"] for line in measured]
    gain = Series(name="gain", x=count, y=[line["gain"] for line in measured], dots=True)
    price = Series(name="price", x=count, y=[line["price"] for line in measured], kind="test")
    return line_chart([gain, price], x_label="primitives")


def curves(lines: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Draws the training curves over steps and over time; empty without at least two lines."""
    if len(lines) < 2:
        return []
    unit, seconds = time_unit(max(line["seconds"] if is_number(line.get("seconds")) else 0 for line in lines))
    labels = {"step": "training step", "time": f"{unit} of training"}
    timed = with_times(lines, seconds)
    return [
        {
            "title": title,
            "key": key,
            "legend": legend,
            "svg": {
                x: line_chart(series_of(timed, key, x), x_label=label, log=key == "loss", marks=marks_of(timed, x))
                for x, label in labels.items()
            },
        }
        for title, key, legend in CURVES
    ]


def with_times(lines: Sequence[dict[str, Any]], unit: int) -> list[dict[str, Any]]:
    """Adds `time` in units of so many seconds, and `step_ms`, the mean time of the steps since the line before."""
    out = []
    for before, line in pairwise([{}, *lines]):
        times = {"time": line["seconds"] / unit} if is_number(line.get("seconds")) else {}
        if times and is_number(before.get("seconds")) and line["step"] > before["step"]:
            times["step_ms"] = 1000 * (line["seconds"] - before["seconds"]) / (line["step"] - before["step"])
        out.append(line | times)
    return out


def series_of(lines: Sequence[dict[str, Any]], key: str, x: str) -> list[Series]:
    """Returns raw values faintly, their smoothed curve, and held-out points for PSNR, over steps or time."""
    places, values = columns(lines, key, x)
    smooth = smoothed(values, 0 if key == "primitives" else math.ceil(SMOOTHING * len(values)))
    out = [Series(name=NAMES.get(key, key), x=places, y=smooth)]
    if key in ("psnr", "step_ms"):
        out.insert(0, Series(name=f"{key} of one line", x=places, y=values, kind="faint"))
    if key == "psnr":
        test_places, test_values = columns(lines, "test_psnr", x)
        out.append(Series(name="held-out", x=test_places, y=test_values, kind="test", dots=True))
    return out


def columns(lines: Sequence[dict[str, Any]], key: str, x: str) -> tuple[list[float], list[float]]:
    """Returns positions and values where both are known."""
    known = [line for line in lines if is_number(line.get(key)) and is_number(line.get(x))]
    return [line[x] for line in known], [line[key] for line in known]


def marks_of(lines: Sequence[dict[str, Any]], x: str) -> list[Mark]:
    """Marks opacity resets and skipped steps."""
    out = []
    for line in lines:
        if x in line and line.get("opacity_resets"):
            out.append(Mark(x=line[x], text=f"opacity reset at step {line['step']}", kind="reset"))
        if x in line and line.get("skipped"):
            out.append(Mark(x=line[x], text=f"step {line['step']} skipped: {line['skipped']}", kind="skipped"))
    return out
