"""Tables of PSNR over wall time: single runs, and the seconds in which arms reach one PSNR."""

import statistics
from collections.abc import Iterable, Sequence
from typing import Any

from measuring.curves import Point, psnr_at, seconds_to
from measuring.results import Section, stamped

Row = dict[str, Any]
"""Figures of one run, or a line of a table."""
RUN_COLUMNS = [
    *(["scene", "scene"], ["arm", "arm"], ["minutes", "minutes"], ["steps", "steps"], ["seed", "seed"]),
    *(["seconds", "wall time, s"], ["x1", "x1, dB"], ["x2", "x2, dB"], ["x4", "x4, dB"]),
    *(["primitives", "primitives"], ["peak_mb", "peak MB"], ["revision", "revision"]),
]
RUNS_NOTE = (
    "One run a line. Wall time: of the process, from command to report; OpenSplat writes a file and no report. PSNR on "
    "held-out views, evaluated outside of that time. OpenSplat takes no seed: these are repetitions."
)
REACHED_ZOOMS, REFERENCES = ("1", "4"), (5, 10)
"""Zooms, and minutes of the first arm whose PSNR others are timed to."""
REACHED_NOTE = (
    "PSNR that `before` has after the minutes, and the seconds in which another arm has it: linear in log(seconds) "
    "between runs, means over seeds. Ratio: seconds of `before` over those of `now`. At most: the shortest run has it, "
    "and its seconds stand here."
)


def place_of(row: Row) -> tuple[Any, ...]:
    """Returns what identifies a run."""
    return row["scene"], row["arm"], row["minutes"], row["seed"]


def curve_of(rows: Iterable[Row], scene: str, arm: str, zoom: str) -> list[Point]:
    """Returns (seconds, PSNR) by rising minutes, means over seeds."""
    by_minutes: dict[float, list[Point]] = {}
    for row in rows:
        if (row["scene"], row["arm"]) == (scene, arm) and row.get(f"x{zoom}") is not None:
            by_minutes.setdefault(row["minutes"], []).append((row["seconds"], row[f"x{zoom}"]))
    groups = [by_minutes[minutes] for minutes in sorted(by_minutes)]
    return [(statistics.fmean(s for s, _ in group), statistics.fmean(p for _, p in group)) for group in groups]


def runs_section(rows: Sequence[Row], stamp: Sequence[Any]) -> Section:
    """Returns the table of single runs."""
    return stamped("Runs", RUN_COLUMNS, list(rows), [RUNS_NOTE], *stamp)


def reached(rows: Sequence[Row], arms: Sequence[str], stamp: Sequence[Any]) -> Section:
    """Returns the table of seconds to a PSNR; the first arm sets it, the second is compared with it."""
    scenes = list(dict.fromkeys(row["scene"] for row in rows))
    lines = [
        line
        for scene in scenes
        for zoom in REACHED_ZOOMS
        for minutes in REFERENCES
        if (line := reached_line(rows, arms, scene, zoom, minutes))
    ]
    columns = [["scene", "scene"], ["zoom", "zoom"], ["minutes", "minutes of before"], [arms[0], "its PSNR, dB"]]
    for arm in arms[1:]:
        columns += [[f"{arm}_seconds", f"{arm}, s"], [f"{arm}_psnr", f"{arm} in these minutes, dB"]]
    columns += [["ratio", "ratio"], ["at_most", "at most"]]
    return stamped("Seconds to the same PSNR", columns, lines, [REACHED_NOTE], *stamp)


def reached_line(rows: Sequence[Row], arms: Sequence[str], scene: str, zoom: str, minutes: float) -> Row | None:
    """Returns the line of a scene, zoom and length; None: the first arm has no figure there."""
    curves = {arm: curve_of(rows, scene, arm, zoom) for arm in arms}
    seconds = 60.0 * minutes
    psnr = psnr_at(curves[arms[0]], seconds)
    if psnr is None:
        return None
    line: Row = {"scene": scene, "zoom": f"x{zoom}", "minutes": minutes, arms[0]: round(psnr, 2)}
    for arm in arms[1:]:
        line |= {f"{arm}_seconds": rounded(seconds_to(curves[arm], psnr), 1)}
        line |= {f"{arm}_psnr": rounded(psnr_at(curves[arm], seconds), 2)}
    first = [arm for arm in arms[1:] if curves[arm] and min(curves[arm])[1] >= psnr]
    needed = seconds_to(curves[arms[1]], psnr)
    return line | {"ratio": rounded(needed and seconds / needed, 2), "at_most": ", ".join(first) or None}


def rounded(value: float | None, digits: int) -> float | None:
    """Returns a rounded value; None stays."""
    return None if value is None else round(value, digits)
