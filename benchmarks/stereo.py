"""Starting points by stereo: the same runs with and without them (docs/benchmarks/capacity.md).

    python benchmarks/stereo.py [--scenes FOLDER] [--only demo,room,fox,castle,desk_bottle,office] [--seeds 0,1]

Runs of one scene have the same steps and the same budget of primitives. FOLDER holds the captures.
Finished runs below --runs are not trained again.
"""

import argparse
import sys
from collections.abc import Sequence
from typing import Any

import torch

from measuring.machine import describe_machine, shown_command, told_load
from measuring.results import read_sections, stamped, text_table, write_results
from measuring.runs import train
from zoom import over_seeds, refuse_unknown, shared_arguments, steps_among, told

COMMON = (
    *("backbone.capacity=budget", "training.cooldown=0.25", "training.supersampling.start=0.95"),
    *("backbone.density.reset_every=1000000", "eval.zoom=[1,4]", "rasterizer=compiled"),
)
"""Schedule of planned runs (conf/minutes.yaml)."""
FITTED = ("eval.colours=fitted", "eval.poses=aligned")
"""Evaluation of a capture whose photos differ in exposure."""
SUBJECTS = {
    "demo": ("iterations=600", "backbone.budget.primitives=50000"),
    "room": ("scene=room", "iterations=600", "backbone.budget.primitives=50000"),
    "fox": ("scene=colmap", "scene.downscale=8", "iterations=600", "backbone.budget.primitives=50000"),
    "castle": ("scene=photos", "scene.downscale=8", "iterations=600", "backbone.budget.primitives=40000"),
    "desk_bottle": ("scene=colmap", "scene.downscale=4", "iterations=600", "backbone.budget.primitives=50000"),
    "office": ("scene=colmap", "scene.downscale=4", "iterations=1000", "backbone.budget.primitives=60000", *FITTED),
}
"""Options of each scene."""
BUILT_IN = ("demo", "room")
POINTS = (0, 25_000)
"""Points by stereo of the two arms."""
FIGURES = {"x1": "1", "x4": "4"}
"""Columns by zoom."""
COLUMNS = [
    *(["scene", "scene"], ["steps", "steps"], ["seeds", "seeds"], ["points", "points by stereo"]),
    *(["x1", "x1"], ["more1", "x1 - without"], ["x4", "x4"], ["more4", "x4 - without"]),
    *(["st_lpips", "ST-LPIPS x1"], ["primitives", "primitives"]),
]
NOTE = (
    "PSNR of held-out views, dB, means over seeds ± half their range; differences seed by seed. office: colours fitted "
    "and poses aligned on left halves."
)


def arguments(words: Sequence[str]) -> argparse.Namespace:
    """The command line."""
    return shared_arguments(__doc__, ",".join(SUBJECTS), "outputs/stereo").parse_args(words)


def evaluations(scene: str, seed: int, given: argparse.Namespace) -> dict[int, dict[str, Any]]:
    """Evaluation of a scene with each number of points by stereo."""
    where = () if scene in BUILT_IN else (f"scene.path={folder_of(scene, given)}",)
    words = [*SUBJECTS[scene], *where, *COMMON, f"seed={seed}"]
    folders = {count: given.runs / f"{scene}_{count}_{seed}" for count in POINTS}
    return {
        count: train(folder, [*words, f"scene.stereo={count}"], log=folder.with_name(f"{folder.name}.log"))
        for count, folder in folders.items()
    }


def folder_of(scene: str, given: argparse.Namespace) -> str:
    """Folder of a capture."""
    return str(given.scenes / scene)


def rows_of(scene: str, found: Sequence[dict[int, dict[str, Any]]]) -> list[dict[str, Any]]:
    """Rows of a scene; found: evaluations by number of points, of each seed."""
    return [row_of(scene, count, found) for count in POINTS]


def row_of(scene: str, count: int, found: Sequence[dict[int, dict[str, Any]]]) -> dict[str, Any]:
    """Means over seeds, and differences from runs without points by stereo."""
    row = {"scene": scene, "steps": steps_among(SUBJECTS[scene]), "seeds": len(found), "points": count}
    for key, zoom in FIGURES.items():
        own = [one[count]["zoom"][zoom]["psnr"] for one in found]
        without = [one[0]["zoom"][zoom]["psnr"] for one in found]
        row[key] = told(own, ".2f")
        if count:
            row[f"more{zoom}"] = told([a - b for a, b in zip(own, without, strict=True)], "+.2f")
    row["st_lpips"] = told([one[count]["perceptual"]["st_lpips_alex"] for one in found], ".3f", ".3f")
    row["primitives"] = round(sum(one[count]["primitives"] for one in found) / len(found))
    return row


def main(words: Sequence[str]) -> None:
    """Train and write the table."""
    given = arguments(words)
    refuse_unknown(given.only, SUBJECTS)
    machine, load = describe_machine(torch.device("cpu")), told_load()
    read_sections(given.to / "stereo_cpu.json")  # what cannot be added to is refused before training
    scenes = [scene for scene in given.only.split(",") if scene in BUILT_IN or given.scenes]
    found = over_seeds(lambda scene, seed: evaluations(scene, seed, given), scenes, given)
    rows = [row for scene in scenes for row in rows_of(scene, found[scene])]
    title, command = "Runs with and without starting points by stereo", shown_command(words, "benchmarks/stereo.py")
    section = stamped(title, COLUMNS, rows, [NOTE], load, command)
    write_results(given.to, "stereo_cpu", machine, {"starts": section})
    print(text_table(section))


if __name__ == "__main__":
    main(sys.argv[1:])
