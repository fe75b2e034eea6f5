"""OpenSplat, another program that trains on a CPU: a scene in its form, and its runs."""

import os
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path

from gsx.builtin import plugins
from gsx.core.data.images import write_image
from gsx.core.data.scene import Scene, View
from gsx.core.files import write_json
from gsx.experiments.prepare.colmap_files import write_model
from gsx.experiments.runs.compose import compose
from gsx.experiments.runs.load_scene import load_scene
from measuring.runs import clock_of

WRAPPER = """\
import pathlib, resource, subprocess, sys
code = subprocess.call(sys.argv[2:])
pathlib.Path(sys.argv[1]).write_text(str(resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss))
sys.exit(code)
"""
"""Small process that starts a program: Linux counts the starting process's memory in the peak of its child."""
IMAGES, MODEL = "images", "sparse/0"
"""Folders of the photos and of the COLMAP model."""
WHOLE = "whole"
"""File in the folder of a scene that is written to its end."""
CENTRE = 0.01
"""Distance of a principal point from the centre that OpenSplat's CPU projection may ignore, px."""


def write_scene(scene: Scene, folder: Path) -> Path:
    """Writes the training views of a scene with their points as a COLMAP scene; returns its folder.

    Photos are the 8-bit pictures that gsx trains on, cameras are pinholes of their size. Test views are left out.

    Raises:
        ValueError: a principal point is off the centre, which OpenSplat ignores.
    """
    for view in scene.train:
        refuse_off_centre(view)
    (folder / IMAGES).mkdir(parents=True, exist_ok=True)
    names = [f"{number:04d}.png" for number in range(1, len(scene.train) + 1)]
    for name, view in zip(names, scene.train, strict=True):
        write_image(folder / IMAGES / name, view.picture())
    cameras = [(name, view.camera) for name, view in zip(names, scene.train, strict=True)]
    write_model(folder / MODEL, cameras, scene.points, scene.origin)
    return folder


def kept_scene(words: Sequence[str], folder: Path) -> Path:
    """Writes the scene that overrides choose by `write_scene` unless it is there; returns its folder."""
    if not (folder / WHOLE).is_file():
        write_scene(load_scene(compose(words, plugins())), folder)
        (folder / WHOLE).touch()
    return folder


def refuse_off_centre(view: View) -> None:
    """Raises ValueError if the principal point is off the centre of the picture."""
    camera = view.camera
    off = max(abs(camera.cx - camera.width / 2), abs(camera.cy - camera.height / 2))
    if off > CENTRE:
        raise ValueError(
            f"the principal point of '{view.name}' is {off:.2f} px off the centre, which OpenSplat ignores: compare "
            "on scene.principal_point=centred"
        )


def file_of(place: Path) -> Path:
    """Returns the file with the splats of a run."""
    return place.with_name(f"{place.name}.ply")


def run_opensplat(
    program: Path, scene: Path, place: Path, words: Sequence[str], environment: Mapping[str, str], log: Path
) -> dict[str, float]:
    """Trains by OpenSplat in a process of its own; returns wall time and peak memory, kept next to `file_of(place)`.

    Raises:
        subprocess.CalledProcessError: it failed.
    """
    to = file_of(place)
    command = [str(program), str(scene), "--keep-crs", "--output", str(to), *words]
    to.parent.mkdir(parents=True, exist_ok=True)
    peak = to.with_suffix(".peak")
    started = time.perf_counter()
    with log.open("w") as stream:
        words = [sys.executable, "-c", WRAPPER, str(peak), *command]
        code = subprocess.call(words, env=os.environ | environment, stdout=stream, stderr=subprocess.STDOUT)
    if code or not to.is_file():
        raise subprocess.CalledProcessError(code, command)
    facts = {"wall_seconds": time.perf_counter() - started, "peak_mb": int(peak.read_text()) * 1024 / 1e6}
    peak.unlink()
    write_json(clock_of(place), facts)
    return facts
