"""Write the gallery, pictures of every backbone at x1 and x4: python benchmarks/gallery.py

Trains the built-in scene by each backbone with its defaults, one seed, and writes docs/gallery.md: a held-out view, its
middle four times as fine, and the truth. Runs below --runs are resumed and kept.
"""

import argparse
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

import gsx
from gsx.core.data.images import write_image
from gsx.core.data.window import Window
from gsx.core.files import read_json, replace_file
from gsx.core.shapes import Float
from measuring.machine import ROOT, describe_machine, shown_command, told_load
from measuring.results import stamped, text_table, write_results

RESULTS = Path(__file__).parent / "results"
PAGE = ROOT / "docs" / "gallery.md"
BACKBONES = ("gs3d", "mip_splatting", "gs3d_zoom", "octree_gs3d", "scaffold", "octree_scaffold")
MEANING = {
    "gs3d": "3D-GS, as published",
    "mip_splatting": "Mip-Splatting, with its 3D and 2D filters",
    "gs3d_zoom": "The default of `gsx`, Mip filters and training through finer pixels",
    "octree_gs3d": "Explicit Gaussians in levels of detail",
    "scaffold": "Scaffold-GS, Gaussians decoded from anchors",
    "octree_scaffold": "Octree-GS, anchors in levels of detail",
}
VIEW, ZOOM, SIDE = "test_003", 4, (320, 240)
"""A test view, the factor of its zoom, and the size in px of the window in its middle."""
SOURCE = "<!-- figures: benchmarks/results/gallery_cpu.json gallery -->"
"""Comment above figures that names their results."""
COLUMNS = [
    ["backbone", "backbone"],
    ["x1", "PSNR x1, dB"],
    ["x4", "PSNR x4, dB"],
    ["enlarged", "enlarged x1, dB"],
    ["primitives", "primitives"],
]
NOTE = "Built-in scene, 900 steps, one seed, ten held-out views. One seed says nothing about small differences."
CAPTION = (
    "*Demo, 900 steps, one seed, ten held-out views, on a CPU ([machine](../benchmarks/results/gallery_cpu.md)).*\n"
    "`python benchmarks/gallery.py`"
)
"""Of the page."""


def trained(backbone: str, folder: Path) -> gsx.TrainedRun:
    """Trains a backbone where its run is missing or unfinished, and loads the run."""
    if not (folder / "evaluation.json").is_file():
        words = [f"backbone={backbone}", f"folder={folder}", "eval.zoom=[1,4]"]
        verb = ["resume", str(folder)] if folder.is_dir() else words
        subprocess.run([sys.executable, "-m", "gsx", *verb], check=True)
    run = gsx.load(folder)
    assert isinstance(run, gsx.TrainedRun)
    return run


def middle(image: Float[Tensor, "3 H W"]) -> Float[Tensor, "3 h w"]:
    """Cuts the window out of the middle of a zoomed picture."""
    width, height = SIDE
    return Window((image.shape[2] - width) // 2, (image.shape[1] - height) // 2, width, height).cut(image)


def row(backbone: str, run: gsx.TrainedRun) -> dict[str, Any]:
    """Returns the figures of a run."""
    found = read_json(run.folder / "evaluation.json")
    return {
        "backbone": backbone,
        "x1": found["psnr"],
        "x4": found["zoom"]["4"]["psnr"],
        "enlarged": found["zoom"]["4"]["enlarged_psnr"],
        "primitives": found["primitives"],
    }


def draw(name: str, whole: Float[Tensor, "3 H W"], fine: Float[Tensor, "3 H W"]) -> None:
    """Writes the two pictures of a backbone, or of the truth."""
    folder = PAGE.with_suffix("")
    folder.mkdir(parents=True, exist_ok=True)
    write_image(folder / f"{name}.x1.jpg", whole)
    write_image(folder / f"{name}.x4.jpg", middle(fine))


def page(rows: Sequence[dict[str, Any]]) -> str:
    """Returns the text of the page."""
    lines = [
        "# Gallery",
        "",
        "Compare the backbones by eye: a held-out view, and its middle four times as fine as any training picture.",
        "Each is trained with its defaults on the built-in scene (`gsx backbone=NAME`). PSNR is the mean over all",
        "held-out views; one seed says nothing about small differences. Figures of other scenes:",
        "[backbones](benchmarks/backbones.md). Why zooming shows artefacts: [zooming in](explanation/zooming.md).",
        "",
        CAPTION,
    ]
    for entry in rows:
        name = entry["backbone"]
        figures = f"{entry['x1']:.2f} dB at x1, {entry['x4']:.2f} dB at x4, {entry['primitives']:,} primitives"
        lines += ["", f"## {name}", "", SOURCE, f"{MEANING[name]}: {figures}.", "", pictures(name)]
    lines += ["", "## The truth", "", pictures("truth"), ""]
    return "\n".join(lines)


def pictures(name: str) -> str:
    """Returns the links to both pictures."""
    return f"![{name}, x1](gallery/{name}.x1.jpg) ![{name}, x4](gallery/{name}.x4.jpg)"


def main(words: Sequence[str]) -> None:
    """Trains what is missing, draws the pictures, writes results and page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=Path, default=Path("outputs/gallery"), help="folder of the runs")
    parser.add_argument("--only", default=",".join(BACKBONES), help="backbones, comma-separated")
    given = parser.parse_args(words)
    load, rows = told_load(), []
    for backbone in given.only.split(","):
        run = trained(backbone, given.runs / backbone)
        rows.append(row(backbone, run))
        draw(backbone, run.render(VIEW), run.render(VIEW, ZOOM))
    (view,) = (view for view in run.scene.test if view.name == VIEW)
    finer = view.zoom(ZOOM)
    assert finer is not None
    draw("truth", view.image(), finer.image())
    section = stamped("Gallery", COLUMNS, rows, [NOTE], load, shown_command(words, "benchmarks/gallery.py"))
    write_results(RESULTS, "gallery_cpu", describe_machine(torch.device("cpu")), {"gallery": section})
    replace_file(PAGE, page(rows).encode())
    sys.stdout.write(text_table(section))


if __name__ == "__main__":
    main(sys.argv[1:])
