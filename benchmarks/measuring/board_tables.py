"""Tables of a board: each method on each scene, and means over the scenes that all methods have."""

import statistics
from collections.abc import Mapping, Sequence
from typing import Any

from measuring.results import Section, stamped

Row = dict[str, Any]
"""Figures of one run, or a line of a table."""
BOARD, MEANS = "board", "means"
"""Names of the sections."""
FIGURES = {
    "psnr": "x",
    "ssim": "ssim",
    "explained_detail": "detail",
    "st_lpips_alex": "st_lpips",
    "consistency": "agree",
}
"""Figures of `gsx judge`, and how their columns begin; the zoom follows."""
COLUMNS = [
    *(["scene", "scene"], ["method", "method"], ["seconds", "wall time, s"], ["steps", "steps"]),
    *(["primitives", "primitives"], ["peak_mb", "peak MB"], ["x1", "x1, dB"], ["x2", "x2, dB"], ["x4", "x4, dB"]),
    *(["over", "x4 over {base}, dB"], ["half", "±, over views"], ["ssim1", "SSIM x1"], ["ssim4", "SSIM x4"]),
    *(["detail4", "detail x4"], ["st_lpips4", "ST-LPIPS x4"], ["agree4", "consistency x4, dB"]),
    *(["program", "program"],),
]
MEAN_COLUMNS = [
    *(["method", "method"], ["scenes", "scenes"], ["seconds", "wall time, s"], ["x1", "x1, dB"], ["x2", "x2, dB"]),
    *(["x4", "x4, dB"], ["over", "x4 over {base}, dB"], ["detail4", "detail x4"], ["st_lpips4", "ST-LPIPS x4"]),
    *(["agree4", "consistency x4, dB"],),
]
NOTE = (
    "One run a line, {minutes:g} minutes each, seed 0; OpenSplat takes no seed. Wall time: of the process, from "
    "command to report; OpenSplat writes a file and no report. Figures by `gsx judge` on held-out views, outside of "
    "that time. ±: half the 95 % interval of the difference over views."
)
MEANS_NOTE = "Means over the scenes that every method has."


def sections_of(
    runs: Sequence[Row], judged: Mapping[str, Row], base: str, minutes: float, stamp: Sequence[Any]
) -> dict[str, Section]:
    """Returns both tables.

    Args:
        runs: Scene, method, and figures of training.
        judged: What `gsx judge` found, by scene.
        base: Method that others are compared with.
        minutes: Wall time of each run.
        stamp: Load and command.
    """
    rows = [line_of(run, judged[run["scene"]]) for run in runs]
    rows.sort(key=lambda row: row["scene"])  # stable: methods stay in order
    board = stamped("Board", headed(COLUMNS, base), rows, [NOTE.format(minutes=minutes)], *stamp)
    means = stamped("Means over scenes", headed(MEAN_COLUMNS, base), means_of(rows), [MEANS_NOTE], *stamp)
    return {BOARD: board, MEANS: means}


def headed(columns: Sequence[Sequence[str]], base: str) -> list[list[str]]:
    """Returns columns with the name of the compared method in their headings."""
    return [[key, heading.format(base=base)] for key, heading in columns]


def line_of(run: Row, judged: Row) -> Row:
    """Returns a run with what was judged of its method."""
    line = {"primitives": primitives_of(run["method"], judged)}
    line |= {key: value for key, value in run.items() if key in dict(COLUMNS)}
    for row in (row for row in judged["rows"] if row["method"] == run["method"]):
        line |= {f"{begin}{row['zoom']}": row[key] for key, begin in FIGURES.items() if row.get(key) is not None}
        if row["zoom"] == "4":
            line |= {"over": row.get("difference_mean"), "half": row.get("difference_over_views")}
    return line


def primitives_of(method: str, judged: Row) -> int | None:
    """Returns the primitives of a method's model; None: it was judged by pictures."""
    found = [one for result in judged["results"] for one in result["methods"] if one["name"] == method]
    return found[0].get("primitives") if found else None


def means_of(rows: Sequence[Row]) -> list[Row]:
    """Returns a line for each method that every scene has."""
    scenes = {row["scene"] for row in rows}
    lines = []
    for method in dict.fromkeys(row["method"] for row in rows):
        own = [row for row in rows if row["method"] == method]
        if len(own) == len(scenes):
            lines.append({"method": method, "scenes": len(own)} | mean_of(own))
    return lines


def mean_of(rows: Sequence[Row]) -> Row:
    """Returns the means of the figures that all lines have."""
    keys = [key for key, _ in MEAN_COLUMNS if all(isinstance(row.get(key), int | float) for row in rows)]
    return {key: statistics.fmean(row[key] for row in rows) for key in keys}
