"""The report of one run as a single HTML file.

It is made from files only, copes with whatever is missing or damaged, and refers to nothing outside the page.
"""

import base64
import json
import math
from collections.abc import Callable, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

from gsx import __version__
from gsx.core.errors import InputError
from gsx.core.files import is_file, remove_partial, replace_text
from gsx.experiments.evaluation.remarks import NOT_MEASURED, measures_nothing, remarks_of
from gsx.experiments.reports.charts import Mark, Series, line_chart, smoothed
from gsx.experiments.reports.overview import common_folder, runs_in, write_overview
from gsx.experiments.reports.page import NONE, duration, fixed, template, time_unit
from gsx.experiments.reports.pictures import ERROR_COLOURS
from gsx.experiments.run_folder.files import (
    DETAIL_OF,
    RunFiles,
    detail_share,
    gain_of,
    part,
    read_run,
    state_of,
)
from gsx.experiments.run_folder.heads import newest_checkpoint
from gsx.experiments.run_folder.shapes import is_number

__all__ = ["report_on", "write_overview", "write_report"]

WORST = 10
"""Views in the table of the worst."""
SMOOTHING = 0.02
"""Curves are averaged over this fraction of their lines to either side."""
HARDLY = 0.1
"""Gains below this, in dB, cannot be seen: they are neither called detail nor artefacts."""
NAMES = {"psnr": "training", "step_ms": "ms"}
"""Figures of metrics.jsonl as they are called under the pointer."""
IMAGE_KINDS = {".png": "png", ".jpg": "jpeg", ".jpeg": "jpeg"}


def write_report(folder: Path) -> Path:
    """Write report.html of a run folder, complete or not.

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
    """The report of a run if one run is given and no `to`, else an overview in `to` or the folder they share.

    Raises:
        InputError: one of the folders holds no run, or there is no sensible place for the page.
    """
    chosen, given = runs_in(folders), {folder.resolve() for folder in folders}
    if to is None and given == {run.resolve() for run in chosen} and len(chosen) == 1:
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
    """What the template of a run's report needs."""
    state, reason = state_of(run, reporting=True)
    evaluation, environment = run.evaluation, run.environment
    drawn = run.pictures.get("views", [])
    return {
        "title": f"{run.scene} · {run.backbone}",
        "version": __version__,
        "run": run,
        "state": state,
        "reason": reason,
        "notes": part(environment, "scene").get("notes", []),
        "remarks": remarks_of(evaluation),
        "unmeasured": f"{NOT_MEASURED[0].upper()}{NOT_MEASURED[1:]}." if measures_nothing(evaluation) else "",
        "facts": facts(run),
        "headline": headline(evaluation),
        "zoom": zoom_rows(evaluation),
        "zoom_chart": zoom_chart(evaluation),
        "growth_chart": growth_chart(run.lines),
        "cleared": next((line["cleared"] for line in run.lines if is_number(line.get("cleared"))), 0),
        "removals": [line for line in run.lines if is_number(line.get("removed"))],
        "curves": curves(run),
        "resets": any(line.get("opacity_resets") for line in run.lines),
        "skipped": any(line.get("skipped") for line in run.lines),
        "views": [with_images(run, entry) for entry in drawn],
        "anchors": {str(entry.get("name")): f"view-{number}" for number, entry in enumerate(drawn, 1)},
        "crops": crops_by_factor(run),
        "flight": flight_of(run),
        "pages": pages_of(run.folder),
        "pseudo": [with_pseudo_images(run, entry) for entry in run.pseudo.get("views", [])],
        "photographs": photographs_of(run),
        "error_full": run.pictures.get("error_full"),
        "ramp": ", ".join(f"rgb{colour} {place:.0%}" for place, colour in ERROR_COLOURS),
        "bars": bars(evaluation.get("views", [])),
        "worst": sorted(evaluation.get("views", []), key=quality)[:WORST],
        "groups": part(evaluation, "groups"),
        "plan": plan_rows(part(environment, "plan"), run.iterations),
        "protocol": part(evaluation, "protocol"),
        "environment_text": json.dumps(environment, indent=2, ensure_ascii=False) if environment else "",
    }


def steps_of(run: RunFiles) -> str:
    """How many of the steps were taken, and how many a plateau has left out of them."""
    left_out = sum(int(line["steps_left_out"]) for line in run.lines if is_number(line.get("steps_left_out")))
    told = f", {left_out:,} of them left out (training.plateau)" if left_out else ""
    return f"{run.step:,} of {run.iterations:,}{told}"


def facts(run: RunFiles) -> list[tuple[str, str]]:
    """What was trained, on what, in name and value."""
    scene, environment = part(run.environment, "scene"), run.environment
    size = part(run.evaluation, "protocol").get("size")
    rows = [
        ("steps", steps_of(run)),
        ("training views", fixed(scene.get("train_views"), 0)),
        ("test views", fixed(scene.get("test_views"), 0)),
        ("size", f"{size[0]} × {size[1]} px" if size else NONE),
        ("initial points", fixed(scene.get("points"), 0)),
        ("seed", str(run.config.get("seed", NONE))),
        ("device", str(environment.get("device", NONE))),
        ("gsx", str(environment.get("gsx", NONE))),
    ]
    return [row for row in rows if row[1] != NONE]


def headline(evaluation: dict[str, Any]) -> list[dict[str, str]]:
    """Return the figures on top: label, value, unit and a remark; without test views those that are known."""
    e, protocol = evaluation, part(evaluation, "protocol")
    if not e:
        return []
    views = len(e.get("views", []))
    lpips = fixed(e.get("lpips"), 4)
    visible = e.get("visible_primitives")
    paths = [f"{e['render_path']} path"] if e.get("render_path") else []

    def card(label: str, value: str, unit: str = "", remark: str = "") -> dict[str, str]:
        return {"label": label, "value": value, "unit": unit, "remark": remark}

    cards = [
        card("PSNR", fixed(e.get("psnr")), "dB", f"{views} held-out views" if views else ""),
        card("SSIM", fixed(e.get("ssim"), 4), "", str(protocol.get("ssim", ""))),
        card("LPIPS", lpips, "", "no weights" if lpips == NONE else str(protocol.get("lpips", ""))),
        card("Primitives", fixed(e.get("primitives"), 0), "", f"{fixed(visible, 0)} in a view" if visible else ""),
        card("Size", fixed(e.get("megabytes"), 1), "MB", "needed to render"),
        card("Rendering", fixed(e.get("render_fps"), 1), "fps", ", ".join(["at training size", *paths])),
        card("Training", duration(e.get("train_seconds")), "", "steps alone"),
        card("Evaluation", duration(e.get("evaluate_seconds")), "", "all zooms and pictures"),
        card("Peak memory", fixed(e.get("peak_memory_mb"), 0), "MB", ""),
    ]
    return [one for one in cards if one["value"] != NONE] if measures_nothing(e) else cards


# -- zoom ----------------------------------------------------------------------------------------------------------


def zoom_rows(evaluation: dict[str, Any]) -> list[dict[str, Any]]:
    """Figures and verdict of each zoom."""
    rows = []
    for factor, entry in sorted(part(evaluation, "zoom").items(), key=lambda item: float(item[0])):
        gain = None if factor == "1" else gain_of(entry)
        rows.append(
            {
                "factor": factor,
                "entry": entry,
                "gain": gain,
                "detail": {kind: detail_share(entry, kind) for kind in DETAIL_OF},
                "ssim_gain": None if factor == "1" else gain_of(entry, "ssim"),
                "verdict": "" if gain is None else ("win" if gain > 0 else "loss"),
                "sentence": zoom_sentence(factor, entry),
            }
        )
    return rows


def zoom_sentence(factor: str, entry: dict[str, Any]) -> str:
    """What a zoom's figures mean, in words."""
    if "unavailable" in entry:
        return str(entry["unavailable"])
    gain, ssim_gain = gain_of(entry), gain_of(entry, "ssim")
    if factor == "1":
        return "The training resolution: what the other rows fall from."
    if gain is None:
        return "The figures are incomplete."
    resizing = "enlarging" if float(factor) > 1 else "reducing"
    if abs(gain) < HARDLY:
        side = "closer to" if gain > 0 else "further from"
        text = f"Hardly a difference: {abs(gain):.2f} dB {side} the truth than {resizing} the ×1 render."
    elif gain > 0:
        what = "Real detail" if float(factor) > 1 else "True from afar"
        text = f"{what}: {gain:.2f} dB closer to the truth than {resizing} the ×1 render."
    else:
        what = "Artefacts, not detail" if float(factor) > 1 else "Wrong from afar"
        text = f"{what}: {-gain:.2f} dB further from the truth than simply {resizing} the ×1 render."
    if ssim_gain is not None and (ssim_gain > 0) != (gain > 0):
        text += " SSIM says the opposite: look at the crops."
    return text


def zoom_chart(evaluation: dict[str, Any]) -> str:
    """PSNR of zoomed and resized renders over the zoom; empty with fewer than two zooms."""
    known = [
        (float(row["factor"]), row["entry"]) for row in zoom_rows(evaluation) if is_number(row["entry"].get("psnr"))
    ]
    render = [entry["psnr"] for _, entry in known]
    enlarged = [entry.get("enlarged_psnr") if factor != 1 else entry["psnr"] for factor, entry in known]
    if len(known) < 2 or not all(is_number(value) for value in enlarged):
        return ""
    zooms = [factor for factor, _ in known]
    both = [
        Series(name="zoomed render", x=zooms, y=render, dots=True),
        Series(name="resized ×1 render", x=zooms, y=enlarged, kind="test", dots=True),
    ]
    return line_chart(both, x_label="zoom, times the training resolution", x_ticks=zooms)


def growth_chart(lines: Sequence[dict[str, Any]]) -> str:
    """What each event of growth gained, and the price, over the primitives; empty where nothing was judged."""
    judged = [line for line in lines if all(is_number(line.get(name)) for name in ("judged", "gain", "price"))]
    count = [line["judged"] for line in judged]
    gain = Series(name="gain", x=count, y=[line["gain"] for line in judged], dots=True)
    price = Series(name="price", x=count, y=[line["price"] for line in judged], kind="test")
    return line_chart([gain, price], x_label="primitives")


# -- curves --------------------------------------------------------------------------------------------------------


def curves(run: RunFiles) -> list[dict[str, Any]]:
    """Charts over steps and over time; empty without at least two lines."""
    lines = run.lines
    if len(lines) < 2:
        return []
    unit, seconds = time_unit(max(value if is_number(value := line.get("seconds")) else 0 for line in lines))
    scales: dict[str, tuple[str, Callable[[dict[str, Any]], float | None]]] = {
        "step": ("training step", lambda line: line.get("step")),
        "time": (
            f"{unit} of training",
            lambda line: line["seconds"] / seconds if is_number(line.get("seconds")) else None,
        ),
    }
    held_out = (("test", "held-out"),) if any("test_psnr" in line for line in lines) else ()
    charts = [
        ("PSNR, dB", "psnr", False, (("main", "training view, smoothed"), *held_out)),
        ("Loss", "loss", True, (("main", "smoothed"),)),
        ("Primitives", "primitives", False, (("main", "primitives"),)),
        ("Time per step, ms", "step_ms", False, (("main", "smoothed"),)),
    ]
    timed = with_step_times(lines)
    return [
        {
            "title": title,
            "legend": legend,
            "svg": {
                key: line_chart(series_of(timed, name, at), x_label=label, log=log, marks=marks_of(timed, at))
                for key, (label, at) in scales.items()
            },
        }
        for title, name, log, legend in charts
    ]


def with_step_times(lines: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Lines with `step_ms`, the mean time of the steps since the line before."""
    out = [dict(lines[0])]
    for before, line in pairwise(lines):
        steps = line["step"] - before["step"]
        known = steps > 0 and is_number(line.get("seconds")) and is_number(before.get("seconds"))
        out.append(line | ({"step_ms": 1000 * (line["seconds"] - before["seconds"]) / steps} if known else {}))
    return out


def series_of(lines: Sequence[dict[str, Any]], name: str, at: Callable[[dict[str, Any]], float | None]) -> list[Series]:
    """The raw values faintly, their smoothed course, and held-out points for PSNR."""
    x, y = column(lines, name, at)
    smooth = smoothed(y, 0 if name == "primitives" else math.ceil(SMOOTHING * len(y)))
    out = [Series(name=NAMES.get(name, name), x=x, y=smooth)]
    if name in ("psnr", "step_ms"):
        out.insert(0, Series(name=f"{name} of one line", x=x, y=y, kind="faint"))
    if name == "psnr":
        test_x, test_y = column(lines, "test_psnr", at)
        out.append(Series(name="held-out", x=test_x, y=test_y, kind="test", dots=True))
    return out


def column(
    lines: Sequence[dict[str, Any]], name: str, at: Callable[[dict[str, Any]], float | None]
) -> tuple[list[float], list[float]]:
    """Positions and finite values of a figure where both are known."""
    pairs = [(place, line[name]) for line in lines if is_number(line.get(name)) and (place := at(line)) is not None]
    return [x for x, _ in pairs], [y for _, y in pairs]


def marks_of(lines: Sequence[dict[str, Any]], at: Callable[[dict[str, Any]], float | None]) -> list[Mark]:
    """Opacity resets and skipped steps."""
    out = []
    for line in lines:
        place = at(line)
        if place is not None and line.get("opacity_resets"):
            out.append(Mark(x=place, text=f"opacity reset at step {line['step']}", kind="reset"))
        if place is not None and line.get("skipped"):
            out.append(Mark(x=place, text=f"step {line['step']} skipped: {line['skipped']}", kind="skipped"))
    return out


# -- pictures, views, schedule -------------------------------------------------------------------------------------


def crops_by_factor(run: RunFiles) -> dict[str, list[dict[str, Any]]]:
    """Zoomed crops with their pictures, by rising zoom."""
    crops = [with_images(run, entry) for entry in run.pictures.get("zoom", [])]
    factors = sorted({crop["factor"] for crop in crops})
    return {f"{factor:g}": [crop for crop in crops if crop["factor"] == factor] for factor in factors}


def flight_of(run: RunFiles) -> dict[str, Any] | None:
    """The flight into a view's detail with its frames embedded; None where there is none."""
    known = part(run.pictures, "flight")
    image = embedded(run.folder / "renders" / Path(str(known.get("file", ""))).name)
    size, frames = known.get("size"), known.get("frames")
    sound = isinstance(size, list) and len(size) == 2 and all(is_number(side) and side > 0 for side in size)
    return known | {"image": image} if image and sound and is_number(frames) and frames > 1 else None


def photographs_of(run: RunFiles) -> dict[str, Any]:
    """What `gsx photographs` found, with the pictures of the worst; empty where it was not asked."""
    found = run.photographs
    if not found:
        return {}
    worst = [view | {"images": images_in(run.folder / "photographs", view)} for view in found["views"]]
    return found | {
        "worst": [view for view in worst if view["images"]],
        "wrong": [view for view in found["views"] if view["remarks"]],
        "stale": found.get("step") != newest_checkpoint(run.folder),
    }


def images_in(folder: Path, entry: dict[str, Any]) -> dict[str, str | None]:
    """Pictures of an entry by kind, embedded; None for files that are gone."""
    return {kind: embedded(folder / Path(str(file)).name) for kind, file in part(entry, "files").items()}


def pages_of(folder: Path) -> list[str]:
    """Pages beside the report that `gsx export RUN FILE.html` wrote."""
    return sorted(path.name for path in folder.glob("*.html") if path.name != "report.html")


def with_images(run: RunFiles, entry: dict[str, Any]) -> dict[str, Any]:
    """An entry of renders/index.json with its pictures embedded; None for files that are gone."""
    images = images_in(run.folder / "renders", entry)
    depth = entry.get("depth")
    sound = isinstance(depth, list) and len(depth) == 2 and all(map(is_number, depth))
    return entry | {"images": images, "depth": depth if sound else []}


def with_pseudo_images(run: RunFiles, entry: dict[str, Any]) -> dict[str, Any]:
    """An entry of pseudo/index.json with its pictures embedded; None for files that are gone."""
    files = {kind: Path(str(entry.get(kind, ""))).name for kind in ("made", "after")}
    return entry | {"images": {kind: embedded(run.folder / "pseudo" / file) for kind, file in files.items()}}


def embedded(path: Path) -> str | None:
    """A picture as a data URI."""
    kind = IMAGE_KINDS.get(path.suffix.lower())
    if kind is None or not is_file(path):
        return None
    return f"data:image/{kind};base64,{base64.b64encode(path.read_bytes()).decode()}"


def quality(view: dict[str, Any]) -> float:
    """PSNR for sorting; views without one come first."""
    value = view.get("psnr")
    return value if is_number(value) else -math.inf


def bars(views: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """PSNR of every view with its height in percent, from a little below the worst to the best."""
    known = [view["psnr"] for view in views if is_number(view.get("psnr"))]
    if not known:
        return []
    low = min(known) - 0.25 * (max(known) - min(known)) - 0.5
    scale = 100 / ((max(known) - low) or 1)  # of huge figures 0.5 is nothing
    return [
        {"name": view.get("name", "?"), "psnr": view["psnr"], "height": round((view["psnr"] - low) * scale, 1)}
        for view in views
        if is_number(view.get("psnr"))
    ]


def plan_rows(plan: dict[str, Any], iterations: int) -> list[dict[str, Any]]:
    """Parts of the schedule: what they say, and the part of the run they cover in percent where that is known."""
    rows = []
    for name, values in plan.items():
        values = values if isinstance(values, dict) else {"value": values}
        first = values.get("from", 0)
        bounded = iterations > 0 and is_number(values.get("until")) and is_number(first)
        rows.append(
            {
                "name": name.replace("_", " "),
                "values": {key.replace("_", " "): plain(value) for key, value in values.items()},
                "bar": (percent(first, iterations), percent(values["until"], iterations)) if bounded else None,
            }
        )
    return rows


def percent(step: Any, iterations: int) -> float:
    """A step as a part of the run."""
    return round(100 * min(max(float(step), 0), iterations) / iterations, 2)


def plain(value: Any) -> str:
    """A value of the schedule."""
    if isinstance(value, int) and not isinstance(value, bool):
        return f"{value:,}"
    return f"{value:.4g}" if isinstance(value, float) else str(value)
