"""Compare starting points and growth in rooms with plain walls (docs/benchmarks/capacity.md).

    python benchmarks/starts.py [--scenes FOLDER] [--only room,castle] [--seeds 0,1,2] [--jobs 2]

The same steps of `gs3d`: published and adaptive growth, from the points of the scene, and with points where training
views show none (`scene.fill`); and adaptive growth by a third more steps. FOLDER holds `fox`
(COLMAP) and `castle` (photographs alone). Finished runs below --runs are not trained again.
"""

import argparse
import statistics
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch

from capacity import ADAPTIVE, PUBLISHED, SUBJECTS, ZOOMS, row_of, scenes_of, trained, words_of
from gsx.experiments.runs.progress import read_curves
from measuring.machine import describe_machine, shown_command, told_load
from measuring.results import read_sections, stamped, text_table, write_results
from zoom import over_seeds, shared_arguments, steps_among, told

BACKBONE = "gs3d"
FILL = {"room": 3000, "fox": 5000, "castle": 3000}
"""Points that are asked for."""
ARMS = {
    "published": (PUBLISHED,),
    "published, more points": (PUBLISHED, "scene.fill"),
    "adaptive": (ADAPTIVE,),
    "adaptive, more points": (ADAPTIVE, "scene.fill"),
    "adaptive, more points and steps": (ADAPTIVE, "scene.fill", "iterations"),
}
"""`scene.fill` by as many as FILL says; `iterations`: LONGER times as many."""
LONGER = 4 / 3
COLUMNS = [
    *(["scene", "scene"], ["arm", "growth and start"], ["seeds", "seeds"]),
    *(column for f in ZOOMS for column in ([f"x{f}", f"x{f}"], [f"more{f}", f"x{f} - published"])),
    *(["seen", "training views"], ["gap", "training views - x1"], ["primitives", "primitives"]),
    *(["share", "of published"], ["seconds", "training s"], ["times", "of published"]),
]
NOTE = (
    "PSNR, dB, means over seeds ± half their range; differences and shares seed by seed, times are medians. Training "
    "views: mean over the last tenth of the steps, each before it was learnt from."
)


def arguments(words: Sequence[str]) -> argparse.Namespace:
    """The command line."""
    return shared_arguments(__doc__, ",".join(FILL), "outputs/starts").parse_args(words)


def evaluation_of(scene: str, arm: str, seed: int, given: argparse.Namespace) -> dict[str, Any]:
    """Of a run, with the PSNR of its training views."""
    wish = [f"scene.fill={FILL[scene]}" if word == "scene.fill" else word for word in ARMS[arm] if word != "iterations"]
    words = [*words_of(wish, scene, BACKBONE, seed, given), "training.log_every=1"]
    if "iterations" in ARMS[arm]:
        words.append(f"iterations={round(LONGER * steps_among(SUBJECTS[scene]))}")
    folder = given.runs / "_".join([scene, *arm.replace(",", "").split(), str(seed)])
    found = trained(folder, words, given)
    return found | {"seen": seen_in_training(folder)}


def seen_in_training(folder: Path) -> float:
    """Mean PSNR of training views over the last tenth of the steps, dB."""
    lines = read_curves(folder)
    values = [line["psnr"] for line in lines if "psnr" in line and line["step"] > 0.9 * lines[-1]["step"]]
    return statistics.mean(values)


def rows_of(scene: str, found: Sequence[dict[str, dict[str, Any]]]) -> list[dict[str, Any]]:
    """Of a scene; `found`: evaluations by arm, of each seed."""
    rows = []
    for arm in ARMS:
        own = [one[arm] for one in found]
        gaps = [run["seen"] - run["zoom"]["1"]["psnr"] for run in own]
        more = {"seen": told([run["seen"] for run in own], ".2f"), "gap": told(gaps, "+.2f")}
        rows.append(row_of(scene, arm, own, [one["published"] for one in found]) | more)
    return rows


def main(words: Sequence[str]) -> None:
    """Train and write the table."""
    given = arguments(words)
    machine, load = describe_machine(torch.device("cpu")), told_load()
    machine |= {"threads": 1} if given.jobs > 1 else {}
    read_sections(given.to / "starts_cpu.json")  # what cannot be added to is refused before training
    scenes = scenes_of(given)
    found = over_seeds(lambda scene, seed: {arm: evaluation_of(scene, arm, seed, given) for arm in ARMS}, scenes, given)
    rows = [row for scene in scenes for row in rows_of(scene, found[scene])]
    title, command = "Growth and start of gs3d", shown_command(words, "benchmarks/starts.py")
    section = stamped(title, COLUMNS, rows, [NOTE], load, command)
    write_results(given.to, "starts_cpu", machine, {BACKBONE: section})
    print(text_table(section))


if __name__ == "__main__":
    main(sys.argv[1:])
