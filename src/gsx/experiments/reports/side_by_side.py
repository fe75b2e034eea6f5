"""Pictures of several runs beside each other and the truth: the same test view, the same window, the same zoom.

Windows are chosen from the truth alone (`pictures.most_detailed`): runs of one scene and protocol show the same ones.
"""

import math
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gsx.core.errors import command
from gsx.experiments.reports.comparison import Entry, Group
from gsx.experiments.run_folder.files import RunFiles, gain_of, part
from gsx.experiments.run_folder.shapes import is_number

PNG, JPEG = (b"\x89PNG\r\n\x1a\n", b"IEND\xaeB`\x82"), (b"\xff\xd8\xff", b"\xff\xd9")
"""How whole files begin and end."""
ENDS = {".png": PNG, ".jpg": JPEG, ".jpeg": JPEG}


@dataclass(frozen=True, kw_only=True)
class Shot:
    """What one run shows of a view: `window` is (left, top, width, height) in px of the zoomed picture."""

    entry: Entry
    view: str
    factor: float
    window: tuple[float, ...]
    psnr: Any
    gain: float | None
    """dB over the x1 render resized, inside the window; None at x1 or where unknown."""
    files: dict[str, Any]

    @property
    def key(self) -> tuple[Any, ...]:
        """What shots share that may stand side by side."""
        return self.view, self.factor, self.window


def pictures_of(group: Group, folder: Path) -> dict[str, Any]:
    """What the page shows of a group: views, zooms, and a row of pictures for each; paths are from `folder`."""
    entries = group.evaluated
    sets = shared_shots([shot for entry in entries for shot in shots_of(entry)])
    views = list(dict.fromkeys(shots[0].view for shots in sets))
    factors = sorted({shots[0].factor for shots in sets})
    first = [shots[0].factor for shots in sets if shots[0].view == views[0]]
    return {
        "first": f"v0 z{max(first):g}" if first else "",
        "views": {f"v{number}": view for number, view in enumerate(views)},
        "factors": {f"z{factor:g}": f"×{factor:g}" for factor in factors},
        "sets": [set_of(shots, entries, f"v{views.index(shots[0].view)}", folder) for shots in sets],
        "without": [without(entry) for entry in entries if not entry.run.pictures],
    }


def shots_of(entry: Entry) -> Iterator[Shot]:
    """Whole views at x1, and windows at every other zoom."""
    for view in entry.run.pictures.get("views", []):
        window = (0, 0, *numbers(view.get("size"), 2))
        if len(window) == 4:
            yield shot(entry, view, str(view.get("name")), 1.0, window)
    for crop in entry.run.pictures.get("zoom", []):
        window = numbers(crop.get("window"), 4)
        if window:
            yield shot(entry, crop, str(crop.get("view")), float(crop["factor"]), window)


def shot(entry: Entry, node: dict[str, Any], view: str, factor: float, window: tuple[float, ...]) -> Shot:
    """An entry of renders/index.json."""
    figure, files = node.get("psnr"), part(node, "files")
    return Shot(entry=entry, view=view, factor=factor, window=window, psnr=figure, gain=gain_of(node), files=files)


def numbers(value: Any, count: int) -> tuple[float, ...]:
    """So many numbers, the last two of them a size above 0; empty where it is anything else."""
    if not isinstance(value, list) or len(value) != count or not all(is_number(one) for one in value):
        return ()
    return tuple(value) if min(value[-2:]) > 0 else ()


def shared_shots(shots: Sequence[Shot]) -> list[list[Shot]]:
    """Shots that at least two runs have in common: views that most runs show first, then by zoom."""
    found: dict[tuple[Any, ...], dict[str, Shot]] = {}
    for one in shots:
        found.setdefault(one.key, {}).setdefault(one.entry.row["run"], one)
    shared = [list(members.values()) for members in found.values() if len(members) > 1]
    most: dict[str, int] = {}
    for members in shared:
        most[members[0].view] = max(most.get(members[0].view, 0), len(members))
    places = {view: place for place, view in enumerate(dict.fromkeys(one.view for one in shots))}
    return sorted(shared, key=lambda m: (-most[m[0].view], places[m[0].view], m[0].factor, -len(m)))


def set_of(shots: Sequence[Shot], entries: Sequence[Entry], view: str, folder: Path) -> dict[str, Any]:
    """One row of pictures: the truth, then every run that shows it."""
    first, shown = shots[0], {one.entry.row["run"] for one in shots}
    truths = (picture(one.entry.run, one.files.get("truth"), folder) for one in shots)
    known = [one.psnr for one in shots if is_number(one.psnr)]
    best = max(known, default=math.nan)
    left, top, width, height = first.window
    return {
        "tokens": f"{view} z{first.factor:g}",
        "view": first.view,
        "factor": f"{first.factor:g}",
        "place": f"{width:g} × {height:g} px at ({left:g}, {top:g})" if first.factor != 1 else "the whole view",
        "width": width,
        "height": height,
        "truth": next((path for path in truths if path), None),
        "shots": [figure_of(one, folder, one.psnr == best and len(known) > 1) for one in shots],
        "lacking": [entry.name for entry in entries if entry.row["run"] not in shown and entry.run.pictures],
    }


def figure_of(one: Shot, folder: Path, best: bool) -> dict[str, Any]:
    """A picture with its caption."""
    run = one.entry.run
    everywhere = part(part(run.evaluation, "zoom"), f"{one.factor:g}").get("psnr")
    step = run.pictures.get("step")
    return {
        "name": one.entry.name,
        "run": one.entry.row["run"],
        "link": one.entry.row["link"],
        "source": picture(run, one.files.get("render"), folder),
        "psnr": one.psnr,
        "gain": one.gain,
        "all_views": run.evaluation.get("psnr") if one.factor == 1 else everywhere,
        "step": step if step != run.evaluation.get("step") else None,
        "best": best,
    }


def picture(run: RunFiles, file: Any, folder: Path) -> str | None:
    """Where the page finds a picture of a run; None where it is missing or no picture."""
    path = run.folder / "renders" / Path(str(file)).name
    return Path(os.path.relpath(path, folder)).as_posix() if whole(path) else None


def whole(path: Path) -> bool:
    """Whether it is a PNG or JPEG file from its first bytes to its last."""
    start, end = ENDS.get(path.suffix.lower(), PNG)
    try:
        with path.open("rb") as stream:
            begun = stream.read(len(start)) == start
            stream.seek(-len(end), os.SEEK_END)
            return begun and stream.read() == end
    except (OSError, ValueError):
        return False


def without(entry: Entry) -> dict[str, str]:
    """A run that has figures and no pictures, and why."""
    run = entry.run
    reason = run.problems.get("renders/index.json", "renders/index.json is missing")
    return {"name": entry.name, "reason": reason, "remedy": command("eval", run.folder)}
