"""Structure from motion of photos alone: how many it places, how exactly, and how long it takes.

    python benchmarks/walk.py [--scenes FOLDER] [--only walk,office,castle,fox] [--count 300]

`walk`: the built-in room along a walk, ray traced, the names of the photos shuffled; truth are its cameras. FOLDER
holds captures; those with a COLMAP model are compared with that. One thread, no reconstruction from the cache. Photos
of the walk are kept below --runs.
"""

import argparse
import os
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import pycolmap
import torch

from gsx.api import show_messages
from gsx.builtin import plugins
from gsx.core.data.camera import Camera
from gsx.core.data.images import write_image
from gsx.core.data.scene import Scene
from gsx.experiments.runs.compose import compose
from gsx.experiments.runs.load_scene import load_scene
from gsx.scenes import sfm
from gsx.scenes.readable import readable_size
from measuring.machine import describe_machine, shown_command, told_load
from measuring.results import read_sections, stamped, text_table, write_results

RESULTS = Path(__file__).parent / "results"
CAPTURES = ("office", "castle", "fox")
BARE = 20
"""Features below which a photo shows nothing to match: COLMAP verifies a pair by 15 matches."""
COLUMNS = [
    *(["scene", "scene"], ["photos", "photos"], ["placed", "placed"], ["share", "share placed, %"]),
    *(["bare", f"not placed: fewer than {BARE} features"], ["others", "not placed: others"]),
    *(["points", "points"], ["centre", "camera centre, median error, %"], ["worst", "largest, %"]),
    *(["turn", "direction, median error, degrees"], ["worst_turn", "largest, degrees"], ["seconds", "CPU s"]),
]
NOTE = (
    "Errors after the similarity transform that fits camera centres best; those of centres in % of the extent of the "
    "true cameras. CPU s: processor time of structure from motion, one thread."
)
Cameras = Mapping[str, Camera]
"""Cameras by name of photo."""


def scene_from(*words: str) -> Scene:
    """The scene of some settings, with all views for training."""
    return load_scene(compose([*words, "scene.split=none"], plugins()))


def walk(folder: Path, given: argparse.Namespace) -> Cameras:
    """Writes photos of a walk under shuffled names, unless they are there; returns the true cameras by name."""
    size = (f"scene.width={given.width}", f"scene.height={given.width * 3 // 4}", "scene.samples=2")
    views = scene_from("scene=room", f"scene.train_views={given.count - 1}", "scene.test_views=1", *size).train
    order = torch.randperm(len(views), generator=torch.Generator().manual_seed(given.seed)).tolist()
    photos = {f"{number:04d}.jpg": view for number, view in zip(order, views, strict=True)}
    folder.mkdir(parents=True, exist_ok=True)
    for name, view in photos.items():
        if not (folder / name).is_file():
            write_image(folder / name, (view.image() * 255 + 0.5).to(torch.uint8))
    return {name: view.camera for name, view in photos.items()}


def true_cameras(folder: Path) -> Cameras:
    """The cameras of a capture's COLMAP model; none without a model."""
    if not (folder / "sparse").is_dir():
        return {}
    return {view.name: view.camera for view in scene_from("scene=colmap", f"scene.path={folder}").train}


@contextmanager
def empty_cache() -> Iterator[None]:
    """A cache with nothing in it."""
    with tempfile.TemporaryDirectory() as folder, mock.patch.dict(os.environ, {"GSX_CACHE": folder}):
        yield


def placed_row(name: str, folder: Path, photos: int, truth: Cameras) -> dict[str, Any]:
    """Reconstructs the photos of a folder and compares their cameras with the truth."""
    threads = ("scene.num_threads=1", "scene.mapping_threads=1")
    with empty_cache():
        start = time.process_time()
        scene = scene_from("scene=photos", f"scene.path={folder}", *threads)
        seconds = time.process_time() - start
    row = {"scene": name, "photos": photos, "placed": len(scene.train), "share": 100 * len(scene.train) / photos}
    found = {view.name: view.camera for view in scene.train}
    lost = sorted({file.name for file in folder.iterdir()} - found.keys())
    bare = sum(count < BARE for count in feature_counts(folder, lost)) if lost else 0
    row |= {"bare": bare, "others": len(lost) - bare}
    return row | {"points": len(scene.points), "seconds": round(seconds)} | pose_errors(found, truth)


def feature_counts(folder: Path, names: Sequence[str]) -> list[int]:
    """Numbers of features of some photos."""
    options = compose(["scene=photos", f"scene.path={folder}"], plugins()).scene.options
    sizes = {name: readable_size(folder / name) for name in names}
    with tempfile.TemporaryDirectory() as work:
        database = Path(work) / "database.db"
        with sfm.quiet():
            sfm.import_photos(database, folder, sizes, options)
            sfm.extract(database, folder, sizes, options)
        with pycolmap.Database.open(database) as reader:
            return [reader.num_keypoints_for_image(image.image_id) for image in reader.read_all_images()]


def pose_errors(found: Cameras, truth: Cameras) -> dict[str, float]:
    """Errors of camera centres, % of the extent of the true ones, and of directions, degrees; none without truth."""
    names = sorted(found.keys() & truth.keys())
    if len(names) < 3:
        return {}
    here, there = (np.array([of[name].centre.double().numpy() for name in names]) for of in (found, truth))
    moved = pycolmap.estimate_sim3d(here, there)
    assert moved is not None
    apart = np.linalg.norm(np.array([moved * centre for centre in here]) - there, axis=1)
    extent = np.linalg.norm(there - there.mean(0), axis=1).max()
    turns = [turn_between(truth[name], found[name], moved.rotation.matrix()) for name in names]
    return {
        "centre": float(100 * np.median(apart) / extent),
        "worst": float(100 * apart.max() / extent),
        "turn": float(np.median(turns)),
        "worst_turn": max(turns),
    }


def turn_between(true: Camera, found: Camera, world: np.ndarray) -> float:
    """Angle between two cameras, degrees; world: rotation from the found world to the true one."""
    between = true.rotation.double().numpy() @ world @ found.rotation.double().numpy().T
    return float(np.degrees(np.arccos(np.clip((np.trace(between) - 1) / 2, -1, 1))))


def row_of(name: str, given: argparse.Namespace) -> dict[str, Any]:
    """Measures the walk or a capture."""
    if name in CAPTURES:
        folder = given.scenes / name
        return placed_row(name, folder / "images", len(list((folder / "images").iterdir())), true_cameras(folder))
    folder = given.runs / f"walk_{given.count}_{given.width}_{given.seed}"
    return placed_row(name, folder, given.count, walk(folder, given))


def main(words: Sequence[str]) -> None:
    """Reconstructs and writes the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", type=Path, default=None, help="the folder with the captures")
    parser.add_argument("--only", default="walk", help="scenes, by commas (walk)")
    parser.add_argument("--count", type=int, default=300, help="photos of the walk (300)")
    parser.add_argument("--width", type=int, default=640, help="their width, px (640)")
    parser.add_argument("--seed", type=int, default=0, help="of their order (0)")
    parser.add_argument("--runs", type=Path, default=Path("outputs/walk"), help="where photos are kept")
    parser.add_argument("--to", type=Path, default=RESULTS, help="folder of the results")
    given, load = parser.parse_args(words), told_load()
    read_sections(given.to / "walk_cpu.json")  # what cannot be added to is refused before measuring
    show_messages()
    machine = describe_machine(torch.device("cpu")) | {"threads": 1}
    command = shown_command(words, "benchmarks/walk.py")
    for name in given.only.split(","):
        section = stamped("Photos placed", COLUMNS, [row_of(name, given)], [NOTE], load, command)
        write_results(given.to, "walk_cpu", machine, {name: section})
        print(text_table(section))


if __name__ == "__main__":
    main(sys.argv[1:])
