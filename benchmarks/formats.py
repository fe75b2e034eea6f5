"""What splat formats keep of a model, and who else reads them: python benchmarks/formats.py RUN ...

Each run is exported to every format, which is read back and rendered from its test views. Independent readers are asked
where they are: `--splat-transform PROGRAM` (npm's @playcanvas/splat-transform: turns the file into a plain PLY, which
is rendered), gsply (the same, of PLY, compressed PLY and SPZ), trimesh (GLB: number of positions and their bounds).
Models without a standard form are baked.
"""

import argparse
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import replace
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from statistics import fmean
from typing import Any

import numpy as np
import torch

from gsx.builtin import plugins
from gsx.core.gaussians.splats import Gaussians, splats_of
from gsx.core.quality.metrics import psnr
from gsx.core.training.render import render
from gsx.core.training.run import Run
from gsx.experiments.runs.export import Exported, as_in_page, export, is_page
from gsx.experiments.runs.open import open_run
from gsx.formats.splat_files import read_gaussians
from gsx.formats.turned import turned
from measuring.machine import describe_machine, shown_command, told_load
from measuring.results import stamped, text_table, write_results

RESULTS = Path(__file__).parent / "results"
NAMES = ("model.ply", "model.compressed.ply", "model.spz", "model.sog", "model.glb", "model.html")
VIEWS = 5
COLUMNS = [
    ["run", "run"],
    ["format", "format"],
    ["splats", "splats"],
    ["bytes", "bytes a splat"],
    ["megabytes", "MB"],
    ["seconds", "s to write"],
    ["alike", "against the model, dB"],
    ["truth", "held-out PSNR"],
    ["lost", "dB lost"],
    ["reader", "read by"],
    ["reader_alike", "its reading against the model, dB"],
    ["second", "and by"],
    ["second_alike", "its reading, dB"],
]
NOTE = (
    "PSNR of renders from five test views, mean: of what is read back against the model's own, and against the "
    "photographs; dB lost: held-out PSNR of the model less that of the file. Another reader's PLY is read by gsx and "
    "rendered likewise. 200: equal."
)


def arguments(words: Sequence[str]) -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="+", type=Path, metavar="RUN", help="run folders")
    parser.add_argument("--splat-transform", default="", metavar="PROGRAM", help="npm's, to read what is written")
    parser.add_argument("--to", type=Path, default=RESULTS, help="folder of the table")
    return parser.parse_args(words)


def rows_of(folder: Path, program: str) -> list[dict[str, Any]]:
    """A line for each format."""
    run, _ = open_run(folder, plugins())
    run.raster = replace(run.raster, path="eager")
    views = run.scene.test[:VIEWS]
    own = [render(run, view.camera).image for view in views]
    best = fmean(psnr(image, view.image()) for image, view in zip(own, views, strict=True))
    with tempfile.TemporaryDirectory() as place:
        return [row(run, folder.name, Path(place) / name, own, best, program) for name in NAMES]


def row(run: Run, name: str, path: Path, own: list[torch.Tensor], best: float, program: str) -> dict[str, Any]:
    """One format."""
    begun = time.perf_counter()
    written = export(run, path) or export(run, path, zoom=1.0)  # models of anchors have a PLY of their own
    seconds = time.perf_counter() - begun
    assert written is not None
    read = as_in_page(written.gaussians) if is_page(path) else read_gaussians(path)
    images = pictures(run, read)
    truth = fmean(psnr(image, view.image()) for image, view in zip(images, run.scene.test, strict=False))
    size = path.stat().st_size
    return {
        "run": name, "format": path.name.removeprefix("model"), "splats": len(read.means),
        "bytes": size / len(read.means), "megabytes": size / 1e6, "seconds": seconds, "alike": mean(images, own),
        "truth": truth, "lost": best - truth, "baked": written.baked,
    } | by_another(run, path, written, own, program) | by_gsply(run, path, own)  # fmt: skip


def pictures(run: Run, gaussians: Gaussians) -> list[torch.Tensor]:
    """Renders of Gaussians by the rules of the run."""
    cameras = [view.camera for view in run.scene.test[:VIEWS]]
    return [render(run, camera, splats=splats_of(gaussians, camera.centre)).image for camera in cameras]


def mean(images: list[torch.Tensor], others: list[torch.Tensor]) -> float:
    """PSNR over pairs; 200 where they are equal."""
    return fmean(min(200.0, psnr(a, b)) for a, b in zip(images, others, strict=True))


def by_another(run: Run, path: Path, written: Exported, own: list[torch.Tensor], program: str) -> dict[str, Any]:
    """What an independent reader makes of a file; nothing where there is none."""
    if path.suffix == ".glb" and find_spec("trimesh"):
        return {
            "reader": f"trimesh {version('trimesh')}" if glb_is_sound(path, written.gaussians) else "trimesh: FAILED"
        }
    if not program or path.suffix in (".glb", ".html"):
        return {}
    plain = path.with_name("again.ply")
    told = subprocess.run([program, "--version"], capture_output=True, text=True, check=True)
    done = subprocess.run([program, "-q", "-w", str(path), str(plain)], capture_output=True, text=True, check=False)
    if done.returncode:
        return {"reader": f"splat-transform: FAILED, {done.stderr.strip()[:100]}"}
    again = read_gaussians(plain)
    if path.suffix == ".spz":  # it takes SPZ for the axes of PLY, which are turned by half a turn about x
        again = half_turn(again)
    reader = (told.stdout + told.stderr).split(" (")[0].strip()
    return {"reader": reader, "reader_alike": mean(pictures(run, again), own)}


def by_gsply(run: Run, path: Path, own: list[torch.Tensor]) -> dict[str, Any]:
    """What gsply makes of a file, written again as a plain PLY; nothing where it is not installed, or reads no such."""
    if find_spec("gsply") is None or path.suffix not in (".ply", ".spz"):
        return {}
    import gsply

    plain = path.with_name("by_gsply.ply")
    gsply.plywrite(plain, gsply.read_spz(path) if path.suffix == ".spz" else gsply.plyread(path))
    again = read_gaussians(plain)
    turns = {"as told": again, "turned": half_turn(again)} if path.suffix == ".spz" else {"": again}
    found = {how: mean(pictures(run, gaussians), own) for how, gaussians in turns.items()}
    how = max(found, key=found.__getitem__)
    return {"second": f"gsply {version('gsply')}{f', {how}' if how else ''}", "second_alike": found[how]}


def half_turn(gaussians: Gaussians) -> Gaussians:
    """About x: from the axes of SPZ's specification to those of PLY."""
    return turned(gaussians, torch.diag(torch.tensor([1.0, -1.0, -1.0])))


def glb_is_sound(path: Path, gaussians: Gaussians) -> bool:
    """Whether trimesh finds as many positions, within the bounds of ours turned to glTF's axes."""
    import trimesh

    scene: Any = trimesh.load(path)
    ((name, cloud),) = scene.geometry.items()
    turn, _ = scene.graph.get(scene.graph.geometry_nodes[name][0])  # the node's
    ours = gaussians.means.numpy() * np.array([-1, -1, 1])
    found = np.asarray(cloud.vertices) @ turn[:3, :3].T
    return len(found) == len(ours) and np.allclose(found.min(0), ours.min(0)) and np.allclose(found.max(0), ours.max(0))


def main(words: Sequence[str]) -> None:
    """Measure, show and write."""
    given = arguments(words)
    load = told_load()
    rows = [line for folder in given.runs for line in rows_of(folder, given.splat_transform)]
    command = shown_command(sys.argv[1:], "benchmarks/formats.py")
    section = stamped("Formats of splat files", COLUMNS, rows, [NOTE], load, command)
    sys.stdout.write(text_table(section))
    write_results(given.to, "formats_cpu", describe_machine(torch.device("cpu")), {"formats": section})


if __name__ == "__main__":
    main(sys.argv[1:])
