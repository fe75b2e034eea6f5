"""The scene format `snapshots`: photographs and their poses in snapshots.json."""

import json
from dataclasses import dataclass
from pathlib import Path

import torch

from gsx.core.data.camera import Camera
from gsx.core.data.images import ImageCache, image_size
from gsx.core.data.resize import ResizeRule
from gsx.core.data.scene import PointCloud, Scene, View, extent_of
from gsx.core.data.scene_format import SceneFormat
from gsx.core.errors import InputError
from gsx.core.options import without_effect
from gsx.core.ranges import Interval, Points
from gsx.scenes.photo_source import PhotoSource

FILE = "snapshots.json"
FORMAT = SceneFormat(meaning=f"snapshots ({FILE})", sign=FILE, recognise=lambda path: (path / FILE).is_file())


@dataclass(frozen=True, kw_only=True)
class SnapshotOptions:
    name: str
    path: str = without_effect()  # a run is named by what lies there
    every: Interval
    points: Points


def load(options: SnapshotOptions) -> Scene:
    folder, cache = Path(options.path), ImageCache(10**9)
    if not (folder / FILE).is_file():
        raise InputError(f"'{folder}' has no {FILE}: set scene.path to a folder with one")
    try:
        views = [view(folder, entry, cache) for entry in json.loads((folder / FILE).read_text())]
    except (KeyError, TypeError, ValueError) as error:
        needed = "file, fx and camera_from_world (3 rows of 4) of every picture"
        raise InputError(f"'{folder / FILE}' cannot be read ({error!r}): it must give {needed}") from error
    if options.every < 2:
        raise InputError(f"scene.every is {options.every}: give at least 2, so that views are left to train on")
    train = [taken for number, taken in enumerate(views) if number % options.every]
    extent = extent_of([taken.camera for taken in train])
    generator = torch.Generator().manual_seed(0)
    return Scene(
        name=folder.name,
        train=train,
        test=views[:: options.every],
        points=PointCloud(
            positions=(extent * (torch.rand(options.points, 3, generator=generator) - 0.5)).float(),
            colours=torch.full((options.points, 3), 128, dtype=torch.uint8),
        ),
        background=torch.zeros(3),
        extent=extent,
        provenance={"format": options.name, "every": options.every},
    )


def view(folder: Path, entry: dict, cache: ImageCache) -> View:
    """A photograph as the truth at any size up to its own."""
    pose, (width, height) = torch.tensor(entry["camera_from_world"]), image_size(folder / entry["file"])
    camera = Camera(
        rotation=pose[:, :3], translation=pose[:, 3], fx=entry["fx"], fy=entry["fx"],
        cx=width / 2, cy=height / 2, width=width, height=height,
    )  # fmt: skip
    rule = ResizeRule(filter="area", light="display", background=(0, 0, 0))
    return View(entry["file"], camera, PhotoSource(path=folder / entry["file"], rule=rule, cache=cache, whole=camera))
