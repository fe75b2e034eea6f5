"""Peak resident memory of whole training processes by phase.

    python benchmarks/memory.py SCENES [--only fox,many] [--against REVISION]

SCENES holds the folder `fox` (COLMAP). `many` is a capture of 500 photos that is made in a temporary folder: random
pictures, since memory does not depend on what photos show, and 100,000 points. Linux only; one process after the other.
"""

import argparse
import json
import math
import os
import subprocess
import sys
from collections.abc import Sequence
from contextlib import nullcontext
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import torch

from gsx.core.data.camera import look_at
from gsx.core.data.images import write_image
from gsx.core.data.scene import PointCloud
from gsx.core.files import write_json
from gsx.core.plugins import hookimpl
from gsx.core.training.run import Run
from gsx.experiments.prepare.transforms_file import write_points
from measuring.machine import ROOT, describe_machine, shown_command, told_load
from measuring.memory import MB, forget_peak, host_peak, unmeasurable
from measuring.results import stamped, text_table, write_results
from measuring.revisions import checked_out

RESULTS = Path(__file__).parent / "results"
PHOTOS, WIDTH, HEIGHT, POINTS = 500, 1600, 1200, 100_000
CAPTURE = ["scene=transforms", "scene.split=none"]
SUBJECTS = {
    "fox": ["scene=colmap", "scene.downscale=4", "iterations=600"],
    "many": [*CAPTURE, "iterations=20", "rasterizer=compiled"],
    "many_eager": [*CAPTURE, "iterations=10", "rasterizer=eager"],
}
"""Settings by scene; those of `many` have few steps of both sizes, by the rasterizer that longer runs choose."""
MADE = ("many", "many_eager")
"""Scenes that are made here."""
PHASES = ("start", "steps", "finer steps", "evaluation")
COLUMNS = [["scene", "scene"], *([phase, f"{phase}, MB"] for phase in PHASES), ["peak", "peak, MB"]]
NOTE = "Largest resident memory of the process in each phase, MB (1e6 bytes): also libraries, photos, Adam's moments."


def arguments(words: Sequence[str]) -> argparse.Namespace:
    """Parses the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", type=Path, help="the folder with fox")
    parser.add_argument("--only", default=",".join(SUBJECTS), help="scenes, by commas")
    parser.add_argument("--against", default="", help="revision to compare with")
    parser.add_argument("--peaks-of", default="", help="train with these settings (JSON) and print peaks, as JSON")
    return parser.parse_args(words)


class Peaks:
    """Listener that reads the peak of resident memory at the end of each phase, MB."""

    def __init__(self) -> None:
        self.phases = dict.fromkeys(PHASES, 0.0)

    def lap(self, phase: str) -> None:
        """Ends a phase, or a part of it."""
        self.phases[phase] = max(self.phases[phase], host_peak() / MB)
        forget_peak()

    @hookimpl(trylast=True)
    def gsx_run_started(self, run: Run) -> None:
        """Ends loading and building, and decodes all photos once, as in the first steps."""
        for view in run.scene.train:
            view.picture()
        self.lap("start")

    @hookimpl
    def gsx_step_finished(self, run: Run) -> None:
        """Ends a step."""
        self.lap("steps" if run.views.raster_scale(run.step) == 1 else "finer steps")

    @hookimpl
    def gsx_run_finished(self) -> None:
        """Ends evaluation, export and report."""
        self.lap("evaluation")


def print_peaks(words: Sequence[str]) -> None:
    """Trains in this process and prints the peaks of its phases."""
    from gsx.builtin import plugins
    from gsx.experiments.runs.compose import compose
    from gsx.experiments.runs.job import train

    peaks, loaded = Peaks(), plugins()
    with loaded.listening([peaks]):
        train(compose(words, loaded), loaded, [])
    print(json.dumps(peaks.phases))


def peaks_of(source: Path, words: Sequence[str]) -> dict[str, float]:
    """Returns the peaks of a run by that source, in a process of its own."""
    with TemporaryDirectory() as folder:
        task = json.dumps([*words, "device=cpu", f"folder={folder}/run"])
        command = [sys.executable, __file__, ".", "--peaks-of", task]
        done = subprocess.run(command, check=True, env=os.environ | {"PYTHONPATH": str(source)}, stdout=subprocess.PIPE)
    return json.loads(done.stdout.splitlines()[-1])


def make_capture(folder: Path, photos: int = PHOTOS, size: tuple[int, int] = (WIDTH, HEIGHT)) -> None:
    """Writes a capture in the form of nerfstudio: cameras on a ring, random pictures, points on a sphere."""
    generator, (width, height), frames = torch.Generator().manual_seed(0), size, []
    coarse = torch.rand(1, 3, height // 16, width // 16, generator=generator)
    picture = torch.nn.functional.interpolate(coarse, size=(height, width), mode="bicubic").clamp(0, 1)[0]
    for index in range(photos):
        angle = 2 * math.pi * index / photos
        eye = 3 * math.cos(angle), 3 * math.sin(angle), 0.5
        camera = look_at(eye, (0, 0, 0), fov_x=1, width=width, height=height)
        to_world = torch.eye(4)
        to_world[:3, :3] = camera.rotation.float().T * torch.tensor([1.0, -1, -1])  # OpenGL: y up, z backwards
        to_world[:3, 3] = camera.centre.float()
        write_image(folder / f"{index}.jpg", picture.roll(index * width // photos, 2))
        frames.append({"file_path": f"{index}.jpg", "transform_matrix": to_world.tolist()})
    directions = torch.nn.functional.normalize(torch.randn(POINTS, 3, generator=generator), dim=1)
    grey = torch.full((POINTS, 3), 128, dtype=torch.uint8)
    write_points(folder / "points.ply", PointCloud(directions, grey), (0, 0, 0))
    lens = {"fl_x": camera.fx, "fl_y": camera.fy, "cx": camera.cx, "cy": camera.cy, "w": width, "h": height}
    write_json(folder / "transforms.json", lens | {"frames": frames, "ply_file_path": "points.ply"})


def row_of(name: str, source: Path, scenes: Path, label: str) -> dict[str, Any]:
    """Returns the table's line of one scene by one source."""
    with TemporaryDirectory() as folder:
        if name in MADE:
            make_capture(Path(folder))
        path = folder if name in MADE else scenes / name
        phases = peaks_of(source, [*SUBJECTS[name], f"scene.path={path}"])
    used = {phase: round(value) for phase, value in phases.items() if value}
    return {"scene": label, **used, "peak": max(used.values())}


def main(words: Sequence[str]) -> None:
    """Measures and writes."""
    options = arguments(words)
    if options.peaks_of:
        return print_peaks(json.loads(options.peaks_of))
    if reason := unmeasurable(torch.device("cpu")):
        raise SystemExit(reason)
    sections, command = dict[str, Any](), shown_command(words, "benchmarks/memory.py")
    with checked_out(options.against) if options.against else nullcontext() as old:
        for name in options.only.split(","):
            load, sources = told_load(), {name: ROOT / "src"} | ({f"{name}, {options.against}": old} if old else {})
            rows = [row_of(name, source, options.scenes, label) for label, source in sources.items()]
            notes = [NOTE, f"{name}: `gsx {' '.join(SUBJECTS[name])}`."]
            sections[name] = stamped(f"Peak memory: {name}", COLUMNS, rows, notes, load, command)
    write_results(RESULTS, "memory_cpu", describe_machine(torch.device("cpu")), sections)
    print(*map(text_table, sections.values()), sep="\n")


if __name__ == "__main__":
    main(sys.argv[1:])
