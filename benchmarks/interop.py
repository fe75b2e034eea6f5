"""What gsx and other programs make of each other's splat files: python benchmarks/interop.py RUN

The model of a run (free Gaussians) goes through files both ways: gsx writes a file and the program turns it into a
plain PLY; the program writes a file from that model and gsx reads it. Each result is compared with the model.
Programs come from PyPI and npm at the versions below, into `--packages FOLDER` (a temporary one by default).
The model of the committed table:
`gsx scene=demo scene.points=6000 backbone=gs3d backbone.density.stop=0 iterations=300 folder=run6k`.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from statistics import fmean
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gsx import __version__
from gsx.builtin import plugins
from gsx.core.errors import GsxError, InputError
from gsx.core.gaussians.bands import BAND_0
from gsx.core.gaussians.splats import Gaussians, splats_of
from gsx.core.quality.metrics import psnr
from gsx.core.shapes import Float, Int
from gsx.core.training.render import render
from gsx.core.training.run import Run
from gsx.experiments.runs.export import explicit_of
from gsx.experiments.runs.open import open_run
from gsx.formats.splat_files import SpzForm, read_splats, write_gaussians
from measuring.machine import describe_machine, shown_command, told_load
from measuring.results import stamped, text_table, write_results

RESULTS = Path(__file__).parent / "results"
PROGRAMS = Path(__file__).parent / "measuring" / "programs"
"""What is called of the libraries, which have no command of their own."""
NPM = {
    "@playcanvas/splat-transform": "3.7.0",
    "@adobe/spz": "0.2.3",
    "spz-js": "1.2.5",
    "@mkkellogg/gaussian-splats-3d": "0.4.7",
    "three": "0.187.0",
}
PYPI = {"gsply": "0.4.6", "gaussforge": "0.6.0", "zstandard": "0.25.0"}
VIEWS = 5
ROWS_AT_ONCE = 1024
BOTH = (".ply", ".compressed.ply", ".spz 3", ".spz 4", ".sog", ".glb")
"""Formats that gsx writes."""
COLUMNS = [
    ["program", "program"],
    ["format", "format"],
    ["way", "way"],
    ["alike", "against the model, dB"],
    ["position", "position"],
    ["rotation", "rotation, degrees"],
    ["opacity", "opacity"],
    ["colour", "colour"],
    ["axes", "axes"],
    ["problem", "problem"],
]
NOTE = (
    "PSNR of renders from the first five test views, mean, against those of the model; 200: equal. Largest errors of "
    "any splat: position in scene units, opacity in [0, 1], colour of the constant band in [0, 1]; rotation: median "
    "angle. Splats are matched by position, or by position, colour and opacity, since some formats order them anew. "
    "Axes: those in which gsx read the file."
)


@dataclass(frozen=True, kw_only=True)
class Program:
    """Another program, and how it is called."""

    name: str
    reads: Sequence[str] = ()
    """Formats, of those that gsx writes."""
    writes: Sequence[str] = ()
    command: Callable[[Path, Path, Path, str], list[str]] = field(repr=False)
    """Of (folder of packages, source, target, version of SPZ)."""
    by_json: bool = False
    """It takes and gives columns as JSON, in the axes of training worlds, instead of a PLY."""


def splat_transform(packages: Path, source: Path, target: Path, version: str) -> list[str]:
    """Command of npm's splat-transform."""
    return [str(packages / "node_modules/.bin/splat-transform"), "-q", "-w", "-g", "cpu", str(source), str(target)]


def by_node(script: str) -> Callable[[Path, Path, Path, str], list[str]]:
    """Command of a script for node, which reads if its source is a file of the format, and else writes."""

    def command(packages: Path, source: Path, target: Path, version: str) -> list[str]:
        verb = "write" if source.suffix in (".ply", ".json") else "read"
        return ["node", str(PROGRAMS / script), verb, str(source), str(target), version]

    return command


def by_python(script: str) -> Callable[[Path, Path, Path, str], list[str]]:
    """Command of a script for Python with the packages of PyPI."""

    def command(packages: Path, source: Path, target: Path, version: str) -> list[str]:
        return [str(packages / "venv/bin/python"), str(PROGRAMS / script), str(source), str(target), version]

    return command


OTHERS = [
    Program(
        name=f"splat-transform {NPM['@playcanvas/splat-transform']}",
        reads=(".ply", ".compressed.ply", ".spz 3", ".spz 4", ".sog"),
        writes=(".ply", ".compressed.ply", ".spz 4", ".sog", ".glb"),
        command=splat_transform,
    ),
    Program(
        name=f"@adobe/spz {NPM['@adobe/spz']}",
        reads=(".spz 3", ".spz 4"),
        writes=(".spz 3", ".spz 4"),
        command=by_node("adobe_spz.mjs"),
        by_json=True,
    ),
    Program(name=f"spz-js {NPM['spz-js']}", reads=(".spz 3", ".spz 4"), writes=(".spz 2",),
            command=by_node("spz_js.mjs")),
    Program(
        name=f"gsply {PYPI['gsply']}",
        reads=(".ply", ".compressed.ply", ".spz 3", ".spz 4"),
        writes=(".ply", ".compressed.ply", ".spz 3"),
        command=by_python("by_gsply.py"),
    ),
    Program(
        name=f"gaussforge {PYPI['gaussforge']}",
        reads=(".ply", ".compressed.ply", ".spz 3", ".spz 4", ".sog"),
        writes=(".ply", ".compressed.ply", ".spz 3", ".spz 4", ".sog", ".splat", ".ksplat"),
        command=by_python("by_gaussforge.py"),
    ),
    Program(
        name=f"gaussian-splats-3d {NPM['@mkkellogg/gaussian-splats-3d']}",
        writes=(".ksplat 0", ".ksplat 1", ".ksplat 2"),
        command=by_node("gaussian_splats_3d.mjs"),
    ),
]  # fmt: skip


def arguments(words: Sequence[str]) -> argparse.Namespace:
    """Parse the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path, metavar="RUN", help="run folder of a model of free Gaussians")
    parser.add_argument("--packages", type=Path, help="folder for the programs; one that has them is used as it is")
    parser.add_argument("--to", type=Path, default=RESULTS, help="folder of the table")
    return parser.parse_args(words)


def install(packages: Path) -> None:
    """Install the programs into a folder that lacks them."""
    packages.mkdir(parents=True, exist_ok=True)
    if not (packages / "node_modules").is_dir():
        named = [f"{name}@{version}" for name, version in NPM.items()]
        subprocess.run(["npm", "install", "--silent", "--prefix", str(packages), *named], check=True)
    if not (packages / "venv").is_dir():
        subprocess.run([sys.executable, "-m", "venv", str(packages / "venv")], check=True)
        named = [f"{name}=={version}" for name, version in PYPI.items()]
        subprocess.run([str(packages / "venv/bin/pip"), "install", "--quiet", *named], check=True)


@dataclass(frozen=True, eq=False)
class Model:
    """The model of a run, its pictures, and a folder for files."""

    run: Run
    gaussians: Gaussians
    pictures: list[Float[Tensor, "3 H W"]]
    place: Path
    packages: Path

    def render(self, gaussians: Gaussians) -> list[Float[Tensor, "3 H W"]]:
        """Render splats for the first test views."""
        cameras = [view.camera for view in self.run.scene.test[:VIEWS]]
        return [render(self.run, camera, splats=splats_of(gaussians, camera.centre)).image for camera in cameras]

    def compare(self, gaussians: Gaussians) -> dict[str, float]:
        """Return the errors of splats against the model's."""
        pairs = zip(self.render(gaussians), self.pictures, strict=True)
        return {"alike": fmean(min(200.0, psnr(a, b)) for a, b in pairs)} | errors(gaussians, self.gaussians)


def errors(found: Gaussians, model: Gaussians) -> dict[str, float]:
    """Return the largest errors of splats, each compared with the model's splat most like it."""
    rows = matches(found, model)
    cosines = (unit(found.quats) * unit(model.quats)[rows]).sum(1).abs().clamp_max(1)
    opacities = found.opacity_logits.sigmoid() - model.opacity_logits[rows].sigmoid()
    return {
        "position": float((found.means - model.means[rows]).norm(dim=1).max()),
        "rotation": float(torch.rad2deg(2 * cosines.acos()).median()),
        "opacity": float(opacities.abs().max()),
        "colour": float((found.sh_dc - model.sh_dc[rows]).abs().max()) * BAND_0,
    }


def matches(found: Gaussians, model: Gaussians) -> Int[Tensor, "N"]:
    """Return the model's splat for each one found: by position, or by position, colour and opacity, whichever leaves
    fewer of the model's without one."""
    pairs = [(found.means, model.means), (features(found), features(model))]
    return max((nearest(*pair) for pair in pairs), key=lambda rows: len(rows.unique()))


def nearest(found: Float[Tensor, "N k"], model: Float[Tensor, "M k"]) -> Int[Tensor, "N"]:
    """Return the nearest row of the model for each row found."""
    return torch.cat([torch.cdist(rows, model).argmin(1) for rows in found.split(ROWS_AT_ONCE)])


def features(gaussians: Gaussians) -> Float[Tensor, "N 7"]:
    """Return what tells splats apart in any order."""
    return torch.cat([gaussians.means, gaussians.sh_dc, gaussians.opacity_logits.sigmoid()[:, None]], 1)


def unit(quats: Float[Tensor, "N 4"]) -> Float[Tensor, "N 4"]:
    """Normalise quaternions."""
    return torch.nn.functional.normalize(quats.double(), dim=1)


def model_of(folder: Path, place: Path, packages: Path) -> Model:
    """Open a run and draw its model.

    Raises:
        InputError: its Gaussians are decoded for each camera.
    """
    run, _ = open_run(folder, plugins())
    run.raster = replace(run.raster, path="eager")
    gaussians = explicit_of(run, None)
    if gaussians is None:
        raise InputError(f"{folder} has no Gaussians without a camera: give a run of backbone=gs3d")
    model = Model(run, gaussians, [], place, packages)
    return replace(model, pictures=model.render(gaussians))


# -- one file, one way -------------------------------------------------------------------------------------------------


def convert(program: Program, model: Model, source: Path, target: Path, version: str) -> None:
    """Have a program turn a file into another.

    Raises:
        InputError: it failed, in its words.
    """
    environment = os.environ | {"PACKAGES": str(model.packages)}
    command = program.command(model.packages, source, target, version)
    done = subprocess.run([word for word in command if word], capture_output=True, text=True, env=environment)
    if done.returncode or not target.is_file():
        lines = [line for line in (done.stderr + done.stdout).splitlines() if line.strip()]
        raise InputError(next((line for line in lines if "rror" in line), (lines or ["no word"])[-1]).strip()[:120])


def parts(kind: str) -> tuple[str, str]:
    """Split a format into its suffix and the version or level."""
    suffix, _, version = kind.partition(" ")
    return suffix, version


def gsx_writes(program: Program, model: Model, kind: str) -> dict[str, Any]:
    """Return the errors of what a program reads of a file of gsx."""
    suffix, version = parts(kind)
    file, plain = model.place / f"gsx{suffix}", model.place / ("read.json" if program.by_json else "read.ply")
    write_gaussians(file, model.gaussians, spz=SpzForm(version=int(version or 3)))
    plain.unlink(missing_ok=True)
    convert(program, model, file, plain, "")
    if program.by_json:
        return model.compare(from_json(plain))
    found = read_splats(plain).gaussians
    if suffix != ".spz":
        return model.compare(single(found))
    candidates = {"as stored": found, "turned": read_splats(plain, "rub").gaussians}
    compared = {how: model.compare(single(one)) for how, one in candidates.items()}
    how = max(compared, key=lambda how: compared[how]["alike"])
    return compared[how] | {"axes": how}


def gsx_reads(program: Program, model: Model, kind: str) -> dict[str, Any]:
    """Return the errors of what gsx reads of a file that a program writes."""
    suffix, version = parts(kind)
    source = model.place / ("model.json" if program.by_json else "model.ply")
    (to_json if program.by_json else write_gaussians)(source, model.gaussians)
    file = model.place / f"theirs{suffix}"
    file.unlink(missing_ok=True)
    convert(program, model, source, file, version)
    content = read_splats(file)
    if suffix != ".spz" or content.by == "stated":
        return model.compare(single(content.gaussians)) | {"axes": content.axes}
    compared = {axes: model.compare(single(read_splats(file, axes).gaussians)) for axes in ("rub", "rdf")}
    axes = max(compared, key=lambda axes: compared[axes]["alike"])
    return compared[axes] | {"axes": f"{axes}, not stated"}


def gsx_alone(model: Model, kind: str) -> dict[str, Any]:
    """Return the errors of what gsx reads of its own file."""
    suffix, version = parts(kind)
    file = model.place / f"own{suffix}"
    write_gaussians(file, model.gaussians, spz=SpzForm(version=int(version or 3)))
    content = read_splats(file)
    return model.compare(single(content.gaussians)) | {"axes": content.axes}


def single(gaussians: Gaussians) -> Gaussians:
    """Return Gaussians in float32."""
    return Gaussians(**{name: value.float() for name, value in vars(gaussians).items()})


def from_json(path: Path) -> Gaussians:
    """Read the columns that the format's own library gives."""
    columns = json.loads(path.read_text())
    count = columns["numPoints"]
    values = {name: np.array(columns[name], np.float32).reshape(count, -1) for name in columns if name != "numPoints"}
    tensors = {name: torch.from_numpy(value) for name, value in values.items()}
    return Gaussians(
        means=tensors["positions"],
        log_scales=tensors["scales"],
        quats=tensors["rotations"][:, [3, 0, 1, 2]],
        opacity_logits=tensors["alphas"][:, 0].nan_to_num(torch.nan, 30, -30),
        sh_dc=tensors["colors"],
        sh_rest=tensors["sh"].view(count, -1, 3),
    )


def to_json(path: Path, gaussians: Gaussians) -> None:
    """Write the columns that the format's own library takes."""
    degree = round((gaussians.sh_rest.shape[1] + 1) ** 0.5) - 1
    columns = {
        "positions": gaussians.means, "scales": gaussians.log_scales, "rotations": gaussians.quats[:, [1, 2, 3, 0]],
        "alphas": gaussians.opacity_logits, "colors": gaussians.sh_dc, "sh": gaussians.sh_rest,
    }  # fmt: skip
    flat = {name: value.flatten().tolist() for name, value in columns.items()}
    path.write_text(json.dumps({"numPoints": len(gaussians.means), "shDegree": degree, **flat}))


def row(program: str, kind: str, way: str, measure: Callable[[], dict[str, Any]]) -> dict[str, Any]:
    """Return a line of the table; what failed says why."""
    suffix, version = parts(kind)
    shown = f"{suffix} {version}".strip()
    try:
        found = measure()
    except (GsxError, OSError) as problem:
        found = {"problem": str(problem).replace(str(Path(tempfile.gettempdir())), "")}
    line = {"program": program, "format": shown, "way": way} | found
    sys.stderr.write(f"{line}\n")
    return line


def rows_of(model: Model) -> list[dict[str, Any]]:
    """Return the whole table."""
    rows = [row(f"gsx {__version__}", kind, "writes and reads", lambda kind=kind: gsx_alone(model, kind))  # type: ignore[misc]
            for kind in BOTH]  # fmt: skip
    for program in OTHERS:
        for kind in program.reads:
            rows.append(row(program.name, kind, "reads gsx's", lambda p=program, k=kind: gsx_writes(p, model, k)))  # type: ignore[misc]
        for kind in program.writes:
            rows.append(row(program.name, kind, "writes for gsx", lambda p=program, k=kind: gsx_reads(p, model, k)))  # type: ignore[misc]
    return rows


def main(words: Sequence[str]) -> None:
    """Measure, show and write."""
    given = arguments(words)
    load = told_load()
    with tempfile.TemporaryDirectory() as temporary:
        packages = given.packages or Path(temporary) / "packages"
        install(packages)
        place = Path(temporary) / "files"
        place.mkdir()
        rows = rows_of(model_of(given.run, place, packages.resolve()))
    command = shown_command(sys.argv[1:], "benchmarks/interop.py")
    section = stamped("Splat files of other programs", COLUMNS, rows, [NOTE], load, command)
    sys.stdout.write(text_table(section))
    write_results(given.to, "interop_cpu", describe_machine(torch.device("cpu")), {"interop": section})


if __name__ == "__main__":
    main(sys.argv[1:])
