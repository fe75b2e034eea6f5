"""Train every backbone on the same photos and measure what zooming shows: the table of docs/benchmarks/backbones.md.

    python benchmarks/backbones.py SCENES [--only lego] [--backbones gs3d,scaffold] [--iterations 3000]

SCENES holds the folders `fox` (COLMAP) and `lego` (NeRF-synthetic). Each run is a process of its own, by the command
line; those found finished below --runs are not trained again. Takes one to two hours on two cores.
"""

import argparse
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from measuring.machine import describe_machine, shown_command, told_load
from measuring.results import Section, read_sections, stamped, text_table, write_results
from measuring.runs import shown, train

BACKBONES = ("gs3d", "mip_splatting", "scaffold", "octree_scaffold", "octree_gs3d")
RESULTS = Path(__file__).parent / "results"


@dataclass(frozen=True, kw_only=True)
class Subject:
    """A scene with what is asked of it."""

    scene: tuple[str, ...]
    zooms: tuple[str, ...]
    changes: dict[str, tuple[str, ...]]
    """Overrides for a backbone: what scripts for that dataset set."""


SUBJECTS = {
    "fox": Subject(scene=("scene=colmap", "scene.downscale=4"), zooms=("1", "2", "4", "0.25"), changes={}),
    "lego": Subject(
        scene=("scene=blender", "scene.downscale=4"),
        zooms=("1", "2", "4", "0.25"),
        changes={
            "scaffold": ("preset=scaffold_nerf_synthetic",),
            "octree_scaffold": ("scene.random_points=10000",),
            "octree_gs3d": ("scene.random_points=10000",),
        },
    ),
}


def arguments(words: Sequence[str]) -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", type=Path, help="the folder with fox and lego")
    parser.add_argument("--only", default=",".join(SUBJECTS), help="scenes, by commas")
    parser.add_argument("--backbones", default=",".join(BACKBONES), help="backbones, by commas")
    parser.add_argument("--iterations", type=int, default=3000)
    parser.add_argument("--runs", type=Path, default=Path("outputs/backbones"), help="where the runs are kept")
    parser.add_argument("--to", type=Path, default=RESULTS, help="folder of the tables")
    return parser.parse_args(words)


def overrides(name: str, backbone: str, given: argparse.Namespace) -> list[str]:
    """What the run is given after `gsx`."""
    subject = SUBJECTS[name]
    return [
        *subject.scene,
        f"scene.path={given.scenes / name}",
        f"backbone={backbone}",
        *subject.changes.get(backbone, ()),
        f"iterations={given.iterations}",
        f"eval.zoom=[{','.join(subject.zooms)}]",
    ]


def trained(name: str, backbone: str, given: argparse.Namespace) -> dict[str, Any]:
    """evaluation.json of a run, trained unless that was done before."""
    return train(given.runs / f"{name}_{given.iterations}_{backbone}", overrides(name, backbone, given))


def row(backbone: str, evaluation: dict[str, Any]) -> dict[str, Any]:
    """A run's line of the table."""
    zooms = {factor: entry for factor, entry in evaluation["zoom"].items() if factor != "1"}
    return {
        "backbone": backbone,
        "psnr": f"{evaluation['psnr']:.2f}",
        "ssim": f"{evaluation['ssim']:.4f}",
        **{f"x{factor}": shown(entry) for factor, entry in zooms.items()},
        **{f"x{factor} ssim": f"{entry['ssim']:.4f}" for factor, entry in zooms.items()},
        "primitives": evaluation["primitives"],
        "visible": round(evaluation["visible_primitives"]),
        "mb": f"{evaluation['megabytes']:.1f}",
        "seconds": round(evaluation["train_seconds"]),
        "fps": f"{evaluation['render_fps']:.1f}",
        "peak_mb": round(evaluation["peak_memory_mb"]),
    }


def section(name: str, given: argparse.Namespace, rows: list[dict[str, Any]], load: float, command: str) -> Section:
    """The table of one scene."""
    zooms = [factor for factor in SUBJECTS[name].zooms if factor != "1"]
    columns = [
        ["backbone", "backbone"],
        ["psnr", "PSNR x1"],
        *[[f"x{factor}", f"x{factor} (x1 resized)"] for factor in zooms],
        ["ssim", "SSIM x1"],
        *[[f"x{factor} ssim", f"SSIM x{factor}"] for factor in zooms],
        *[["primitives", "primitives"], ["visible", "drawn"], ["mb", "MB"], ["seconds", "training s"]],
        *[["fps", "renders/s"], ["peak_mb", "peak MB"]],
    ]
    subject = SUBJECTS[name]
    changes = "; ".join(f"{backbone}: `{' '.join(words)}`" for backbone, words in subject.changes.items())
    note = f"`gsx {' '.join(subject.scene)}`, {given.iterations} iterations{'; ' * bool(changes)}{changes}."
    note += " In brackets: what the x1 render gives when it is resized."
    return stamped(f"Backbones on {name}", columns, rows, [note], load, command)


def main(words: Sequence[str]) -> None:
    """Train, and write the table after every run."""
    given = arguments(words)
    machine, load = describe_machine(torch.device("cpu")), told_load()
    command = shown_command(words, "benchmarks/backbones.py")
    read_sections(given.to / "backbones_cpu.json")  # what cannot be added to is refused before training
    for name in given.only.split(","):
        rows: list[dict[str, Any]] = []
        for backbone in given.backbones.split(","):
            rows.append(row(backbone, trained(name, backbone, given)))
            table = section(name, given, rows, load, command)
            write_results(given.to, "backbones_cpu", machine, {f"{name}_{given.iterations}": table})
        print(text_table(table))


if __name__ == "__main__":
    main(sys.argv[1:])
