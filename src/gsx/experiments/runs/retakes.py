"""Photos to take: of thinly covered places, of faulty photos, and around photos without a place, with pictures."""

import logging
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import interpolate

from gsx.core.data.images import read_image
from gsx.core.data.scene import View
from gsx.core.errors import InputError
from gsx.core.files import write_json
from gsx.core.quality.sharpness import BLURRED, NEIGHBOURS, against_neighbours, fineness, sharpness
from gsx.core.shapes import Float
from gsx.core.training.render import render
from gsx.core.training.run import Run
from gsx.experiments.evaluation.chosen_views import distinct
from gsx.experiments.evaluation.thin_places import Retake, retakes_of
from gsx.experiments.evaluation.view_coverage import ENOUGH, Covered, SceneCoverage, grid_of
from gsx.experiments.reports.pictures import Pictures, forget
from gsx.experiments.run_folder.files import part
from gsx.experiments.runs.capture import UNEVEN, exposures, ring, ring_gaps
from gsx.experiments.runs.load_scene import in_one_place
from gsx.scenes.photos import photos_in

logger = logging.getLogger(__name__)

FOLDER = "retakes"
"""Folder of a run with index.json and pictures."""
OF_PHOTOS = ("colmap", "photos", "transforms")
"""Scene formats of a photographer's own photos."""
PLACED = ("colmap", "photos")
"""Formats whose photos without a pose lie in the folder of the others."""
THUMBNAIL = 384
"""Longer side of pictures, px."""
MOST_PICTURES = 5
"""Pictures of faulty photos, and of photos without a place."""
EXPOSED = 1.0
"""Stops from the median from which on a photo is taken again: half or twice the light."""
MOST_FILES = 10
"""Photos whose sharpness is measured in their files, with their neighbours: some 0.1 s for each file of 10^7 px."""
MOST_LINES = 3
"""Lines in the log."""
MARK = (0.95, 0.35, 0.1)
"""Colour of thin parts, display RGB."""
MARKED = 0.45
"""Opacity of that colour."""


@dataclass(frozen=True, kw_only=True)
class PhotoFault:
    """Photo with a fault."""

    name: str
    excess: float
    """Larger fault, relative to its threshold."""
    remarks: list[str]


@dataclass(frozen=True, kw_only=True)
class Statistics:
    """Exposure and sharpness of all photos of a scene."""

    names: list[str]
    stops: list[float]
    """Exposure against the median, stops; NaN: unknown."""
    sharpness: list[float]
    """Fine contrast by that of neighbours; NaN: unknown."""

    @property
    def spread(self) -> float | None:
        """Returns the largest difference of two exposures, stops; None: unknown."""
        known = [value for value in self.stops if math.isfinite(value)]
        return max(known) - min(known) if known else None

    def faults(self) -> list[PhotoFault]:
        """Returns the photos with a fault, worst first."""
        found = [
            PhotoFault(name=name, excess=max(abs(stops) / EXPOSED, BLURRED / max(ratio, 1e-6)), remarks=remarks)
            for name, stops, ratio in zip(self.names, known(self.stops, 0.0), known(self.sharpness, 1.0), strict=True)
            if (remarks := list(fault_words(stops, ratio)))
        ]
        return sorted(found, key=lambda fault: -fault.excess)


def known(values: Sequence[float], neutral: float) -> list[float]:
    """Return values, with a neutral one in place of NaN."""
    return [value if math.isfinite(value) else neutral for value in values]


def fault_words(stops: float, ratio: float) -> Iterator[str]:
    """Yield the faults of a photo in words."""
    if ratio < BLURRED:
        yield f"blurred: it has {ratio:.2f} of its neighbours' fine contrast"
    if abs(stops) > EXPOSED:
        yield f"{abs(stops):.2f} stops {'brighter' if stops > 0 else 'darker'} than the others"


def takes_photos(run: Run) -> bool:
    """Return True for a scene of a photographer's photos."""
    return part(run.config, "scene").get("name") in OF_PHOTOS


def statistics_of(run: Run) -> Statistics:
    """Measure exposure, at the training resolution, and sharpness of all photos."""
    views = all_views(run)
    gains = exposures(views, run.scene.points) if len(run.scene.points) else None
    stops = torch.full((len(views),), torch.nan) if gains is None else gains
    return Statistics(names=[view.name for view in views], stops=stops.tolist(), sharpness=sharpness_of(views))


def sharpness_of(views: Sequence[View]) -> list[float]:
    """Measure sharpness at the training resolution, and that of up to MOST_FILES blurred photos again in their files.

    Returns the larger of both: reduced photos of plain walls look blurred, and decoding all files takes long.
    """
    reduced = against_neighbours(torch.stack([fineness(view.picture()) for view in views])).tolist()
    blurred = sorted((index for index, ratio in enumerate(reduced) if ratio < BLURRED), key=lambda one: reduced[one])
    for index in blurred[:MOST_FILES]:
        near = views[max(0, index - NEIGHBOURS) : index + NEIGHBOURS + 1]
        files = [view.file for view in near if view.file is not None]
        whole = sharpness(files).get(views[index].file or Path()) if files else None
        reduced[index] = max(reduced[index], whole or 0.0)
    for index in blurred[MOST_FILES:]:
        reduced[index] = math.nan
    return reduced


def unplaced(run: Run) -> list[Path]:
    """Return photos in the folders of a scene's photos that have no pose, sorted; none for formats that list them."""
    scene = part(run.config, "scene")
    lists = str(scene.get("split", "")).startswith(("files:", "counts:"))
    if scene.get("name") not in PLACED or lists:
        return []
    files = [view.file for view in (*run.scene.train, *run.scene.test) if view.file is not None]
    used = {file.resolve() for file in files}
    folders = sorted({file.parent for file in files})
    listed = [folder / name for folder in folders for name in photos_in(folder, "*")]
    return [file for file in listed if file.resolve() not in used]


def gaps_around(run: Run) -> str:
    """Return gaps between cameras that look at one place, in degrees; empty without any."""
    views = all_views(run)
    if in_one_place([view.camera for view in run.scene.train], run.scene.points):
        return ""
    around = ring(views)
    return "" if around is None else ring_gaps(views, around)


def all_views(run: Run) -> list[View]:
    """Return training and test views by name, each once."""
    return sorted(distinct([*run.scene.train, *run.scene.test]), key=lambda view: view.name)


def between_words(file: Path, placed: Sequence[str]) -> str:
    """Return the photos before and after an unplaced one, by name."""
    before = [name for name in placed if Path(name).name < file.name][-1:]
    after = [name for name in placed if Path(name).name > file.name][:1]
    if before and after:
        return f"between {before[0]} and {after[0]}"
    return f"after {before[0]}" if before else f"before {after[0]}" if after else ""


@torch.no_grad()
def write_retakes(run: Run, coverage: SceneCoverage, pixels: int) -> list[str]:
    """Write index.json and pictures of what to photograph again; return it in lines for the log."""
    place = Pictures(run.folder / FOLDER, run.step)
    place.folder.mkdir(parents=True, exist_ok=True)
    forget(place.folder)
    retakes, statistics, missing, gaps = retakes_of(coverage), statistics_of(run), unplaced(run), gaps_around(run)
    faults, placed = statistics.faults(), statistics.names
    facts = fact_line(statistics, faults, missing)
    index = {
        "step": run.step,
        "least_views": ENOUGH,
        "facts": facts,
        "gaps": gaps,
        "places": [place_entry(run, place, number, one, pixels) for number, one in enumerate(retakes, 1)],
        "photos": photo_entries(run, place, faults),
        "unplaced": unplaced_entries(place, missing, placed),
    }
    write_json(place.folder / "index.json", index)
    return [facts, *again_lines(retakes, gaps, faults, missing)]


def place_entry(run: Run, place: Pictures, number: int, retake: Retake, pixels: int) -> dict[str, Any]:
    """Draw a thin place: the photo with its thin part marked, a render from where to stand, the neighbour."""
    thin, stem = retake.place, f"place_{number}"
    camera = retake.camera.zoom(min(1.0, THUMBNAIL / max(retake.camera.size)))
    draft = render(run, camera, pixels).image
    pictures = {"photo": (stem, "truth", marked(thin.covered)), "render": (stem, "render", draft)}
    if retake.neighbour is not None:
        pictures["neighbour"] = (f"{stem}_next", "truth", thumbnail(retake.neighbour.image()))
    files = {key: place.save(f"{name}.{kind}", image, lossy=True) for key, (name, kind, image) in pictures.items()}
    return {
        "view": thin.view.name,
        "held_out": thin.held_out,
        "part": thin.part,
        "share": thin.share,
        "words": retake.words,
        "reason": retake.reason,
        "neighbour": None if retake.neighbour is None else retake.neighbour.name,
        "files": files,
    }


def marked(covered: Covered) -> Float[Tensor, "3 h w"]:
    """Return a thumbnail of a photo with its thin samples coloured."""
    picture, sampled = thumbnail(covered.sampled.view.image()), covered.sampled
    camera = sampled.surface.camera
    thin = torch.zeros(camera.height * camera.width)
    thin[sampled.indices] = ((covered.counts < ENOUGH) & ~sampled.empty).float()
    columns, rows = grid_of(camera)
    grid = thin.reshape(camera.height, camera.width)[rows[:, None], columns]
    weight = MARKED * interpolate(grid[None, None], size=picture.shape[1:], mode="bilinear")[0].clamp(0, 1)
    return picture * (1 - weight) + weight * torch.tensor(MARK)[:, None, None]


def thumbnail(image: Float[Tensor, "3 H W"]) -> Float[Tensor, "3 h w"]:
    """Reduce a picture to at most THUMBNAIL px."""
    scale = min(1.0, THUMBNAIL / max(image.shape[1:]))
    size = [max(1, round(side * scale)) for side in image.shape[1:]]
    return interpolate(image[None], size=size, mode="bilinear", antialias=True)[0].clamp(0, 1)


def photo_entries(run: Run, place: Pictures, faults: Sequence[PhotoFault]) -> list[dict[str, Any]]:
    """List faulty photos, with pictures of the worst."""
    views = {view.name: view for view in (*run.scene.train, *run.scene.test)}
    entries: list[dict[str, Any]] = [{"name": fault.name, "remarks": fault.remarks} for fault in faults]
    for number, entry in enumerate(entries[:MOST_PICTURES], 1):
        file = place.save(f"photo_{number}.truth", thumbnail(views[entry["name"]].image()), lossy=True)
        entry["files"] = {"photo": file}
    return entries


def unplaced_entries(place: Pictures, files: Sequence[Path], placed: Sequence[str]) -> list[dict[str, Any]]:
    """List photos without a pose and their neighbours by name, with pictures of the first that can be read."""
    entries: list[dict[str, Any]] = [{"name": file.name, "where": between_words(file, placed)} for file in files]
    for number, (entry, file) in enumerate(zip(entries[:MOST_PICTURES], files, strict=False), 1):
        try:
            image = read_image(file)[:3].float() / 255
        except InputError as error:
            entry["problem"] = str(error)
            continue
        entry["files"] = {"photo": place.save(f"unplaced_{number}.truth", thumbnail(image), lossy=True)}
    return entries


def fact_line(statistics: Statistics, faults: Sequence[PhotoFault], missing: Sequence[Path]) -> str:
    """Report in a line how many photos have a place, and the state of the photos."""
    count, spread = len(statistics.names), statistics.spread
    line = f"photos: {count} of {count + len(missing)} placed"
    line += "" if spread is None else f"; exposures differ by up to {spread:.2f} stops"
    line += " (lock exposure and white balance)" if spread is not None and spread > UNEVEN else ""
    blurred = sum(ratio < BLURRED for ratio in known(statistics.sharpness, 1.0))
    return f"{line}; {blurred} blurred, {len(faults)} with a fault"


def again_lines(
    retakes: Sequence[Retake], gaps: str, faults: Sequence[PhotoFault], missing: Sequence[Path]
) -> list[str]:
    """Report in up to MOST_LINES lines what to photograph again."""
    lines = []
    if retakes:
        more = f"; {len(retakes) - 1} more places in the report" if len(retakes) > 1 else ""
        lines.append(f"photograph more {retakes[0].words}: {retakes[0].reason}{more}")
    if gaps:
        lines.append(f"photograph more around the middle, in gaps of {gaps} (degrees)")
    if faults:
        named = ", ".join(f"{fault.name} ({fault.remarks[0]})" for fault in faults[:2])
        more = f", and {len(faults) - 2} more in the report" if faults[2:] else ""
        lines.append(f"photograph again {named}{more}")
    if missing:
        named = ", ".join(file.name for file in missing[:3]) + (", ..." if missing[3:] else "")
        lines.append(f"{len(missing)} photos have no place ({named}): take photos between them and their neighbours")
    return lines[:MOST_LINES] or ["photograph again: nothing stands out"]
