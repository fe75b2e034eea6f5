"""Pictures of several runs in a row with the truth: the same test view, the same window, the same zoom.

Windows are chosen from the truth alone (`pictures.most_detailed`), so runs of one scene and protocol have the same.
"""

import math
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gsx.core.errors import command
from gsx.experiments.reports.comparison import Entry, Group
from gsx.experiments.run_folder.files import gain_of, part
from gsx.experiments.run_folder.shapes import is_number

PNG, JPEG = (b"\x89PNG\r\n\x1a\n", b"IEND\xaeB`\x82"), (b"\xff\xd8\xff", b"\xff\xd9")
"""First and last bytes of complete files."""
ENDS = {".png": PNG, ".jpg": JPEG, ".jpeg": JPEG}


@dataclass(frozen=True, kw_only=True)
class Shot:
    """A picture of one run: `window` is (left, top, width, height) in px of the zoomed picture."""

    entry: Entry
    view: str
    factor: float
    window: tuple[float, ...]
    index: dict[str, Any]
    """Its entry in renders/index.json."""

    @property
    def run(self) -> str:
        """Returns the run's folder."""
        return str(self.entry.row["run"])


def pictures_of(group: Group, folder: Path) -> dict[str, Any]:
    """Returns what the page shows of a group: views, zooms, and a row of pictures for each; paths are from `folder`."""
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
        "without": [
            {
                "name": entry.name,
                "reason": entry.run.problems.get("renders/index.json", "renders/index.json is missing"),
                "remedy": command("eval", entry.run.folder),
            }
            for entry in entries
            if not entry.run.pictures
        ],
    }


def shots_of(entry: Entry) -> Iterator[Shot]:
    """Yields whole views at x1, and windows at every other zoom."""
    for view in entry.run.pictures.get("views", []):
        window = (0, 0, *view["size"])
        yield Shot(entry=entry, view=str(view.get("name")), factor=1.0, window=window, index=view)
    for crop in entry.run.pictures.get("zoom", []):
        window, factor = tuple(crop["window"]), float(crop["factor"])
        yield Shot(entry=entry, view=str(crop.get("view")), factor=factor, window=window, index=crop)


def shared_shots(shots: Sequence[Shot]) -> list[list[Shot]]:
    """Groups shots that at least two runs have in common: views of most runs first, then by zoom."""
    groups: dict[tuple[Any, ...], dict[str, Shot]] = {}
    for one in shots:
        groups.setdefault((one.view, one.factor, one.window), {}).setdefault(one.run, one)
    shared = [list(members.values()) for members in groups.values() if len(members) > 1]
    most: dict[str, int] = {}
    for members in shared:
        most[members[0].view] = max(most.get(members[0].view, 0), len(members))
    places = {view: place for place, view in enumerate(dict.fromkeys(one.view for one in shots))}
    return sorted(shared, key=lambda m: (-most[m[0].view], places[m[0].view], m[0].factor, -len(m)))


def set_of(shots: Sequence[Shot], entries: Sequence[Entry], view: str, folder: Path) -> dict[str, Any]:
    """Returns one row of pictures: the truth, then every run that has it."""
    first, runs = shots[0], {one.run for one in shots}
    truths = (picture(one, "truth", folder) for one in shots)
    known = [one.index["psnr"] for one in shots if is_number(one.index.get("psnr"))]
    best = max(known, default=math.nan) if len(known) > 1 else math.nan
    left, top, width, height = first.window
    return {
        "tokens": f"{view} z{first.factor:g}",
        "view": first.view,
        "factor": f"{first.factor:g}",
        "place": f"{width:g} × {height:g} px at ({left:g}, {top:g})" if first.factor != 1 else "the whole view",
        "width": width,
        "height": height,
        "truth": next((path for path in truths if path), None),
        "shots": [figure_of(one, folder, best) for one in shots],
        "lacking": [entry.name for entry in entries if entry.row["run"] not in runs and entry.run.pictures],
    }


def figure_of(one: Shot, folder: Path, best: float) -> dict[str, Any]:
    """Returns a picture with its caption."""
    run, step = one.entry.run, one.entry.run.pictures.get("step")
    at_zoom = part(part(run.evaluation, "zoom"), f"{one.factor:g}")
    return {
        "name": one.entry.name,
        "run": one.run,
        "link": one.entry.row["link"],
        "source": picture(one, "render", folder),
        "psnr": one.index.get("psnr"),
        "gain": gain_of(one.index),
        "all_views": (run.evaluation if one.factor == 1 else at_zoom).get("psnr"),
        "step": step if step != run.evaluation.get("step") else None,
        "best": one.index.get("psnr") == best,
    }


def picture(one: Shot, kind: str, folder: Path) -> str | None:
    """Returns the path of a picture from the page; None where it is missing or no picture."""
    path = one.entry.run.folder / "renders" / Path(part(one.index, "files").get(kind, "")).name
    return Path(os.path.relpath(path, folder)).as_posix() if is_complete(path) else None


def is_complete(path: Path) -> bool:
    """Recognises a PNG or JPEG file by its first bytes and its last."""
    start, end = ENDS.get(path.suffix.lower(), PNG)
    try:
        with path.open("rb") as stream:
            starts = stream.read(len(start)) == start
            stream.seek(-len(end), os.SEEK_END)
            return starts and stream.read() == end
    except (OSError, ValueError):
        return False
