"""Time a training step by stage and compare it with another revision (docs/benchmarks/rasterizer.md).

    python benchmarks/step.py [--backbones gs3d,octree_scaffold]
    python benchmarks/step.py --scene fox --scenes FOLDER
    python benchmarks/step.py --against REVISION

Runs of the built-in scene, or of `fox` or `lego` in FOLDER at a quarter, are trained once below --runs; then steps from
their last state are taken over and over, each stage on its own clock. `--against` measures another revision of the
source in turn, in processes of their own, and exits with 1 where a stage takes 10 % and 0.5 ms longer. Nothing else
should run.
"""

import argparse
import json
import os
import statistics
import subprocess
import sys
from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import torch

from measuring.limits import BACKWARD_FLOPS, FLOAT, FORWARD_FLOPS, Limit, best, measured_limits, sizes_of
from measuring.machine import ROOT, describe_machine, shown_command, told_load
from measuring.results import Section, stamped, text_table, write_results
from measuring.revisions import checked_out
from measuring.runs import train
from measuring.stages import measure_stages

RESULTS = Path(__file__).parent / "results"
BACKBONES = ("gs3d", "mip_splatting", "octree_gs3d", "scaffold", "octree_scaffold")
SCENES = {
    "demo": ("the built-in scene", ["scene=demo", "iterations=600"]),
    "fox": ("fox at a quarter", ["scene=colmap", "scene.downscale=4", "iterations=1000"]),
    "lego": ("lego at a quarter", ["scene=blender", "scene.downscale=4", "iterations=1000"]),
}
"""What is trained, as it is called and by which words."""
SLOWER, LEAST = 1.1, 0.5
"""A stage has become slower when it takes this many times as long, and this many ms longer."""
ROUNDS = 3
"""Processes of each revision, in turn."""
COLUMNS = [
    *(["backbone", "backbone"], ["stage", "stage"], ["ms", "ms"], ["share", "of the step"]),
    *(["least", "least ms"], ["bound", "bound by"], ["old", "before, ms"], ["ratio", "before / now"]),
]
NOTE = (
    "Median over steps of a stage's own time, density control left out; of processes in turn where two revisions are "
    "compared. Least: what memory traffic that cannot be avoided, or arithmetic, takes at the machine's best."
)


def arguments(words: Sequence[str]) -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scene", choices=list(SCENES), default="demo", help="what is trained (demo)")
    parser.add_argument("--scenes", type=Path, default=None, help="the folder with the captures")
    parser.add_argument("--backbones", default=",".join(BACKBONES), help="by commas")
    parser.add_argument("--steps", type=int, default=30, help="steps of each process")
    parser.add_argument("--against", default="", help="a revision to compare with")
    parser.add_argument("--runs", type=Path, default=Path("outputs/step"), help="where the runs are kept")
    parser.add_argument("--to", type=Path, default=RESULTS, help="folder of the table")
    parser.add_argument("--stages-of", type=Path, default=None, help="print the stages of this run, as JSON")
    given = parser.parse_args(words)
    if given.scene != "demo" and not given.scenes:
        parser.error(f"--scene {given.scene} needs --scenes FOLDER, the folder with the captures")
    return given


def subject(backbone: str, given: argparse.Namespace) -> Path:
    """The run whose steps are measured."""
    words = SCENES[given.scene][1] + ([f"scene.path={given.scenes / given.scene}"] if given.scene != "demo" else [])
    folder = given.runs / f"{given.scene}_{backbone}"
    chosen = [f"backbone={backbone}", *(["backbone.capacity=published"] if "scaffold" not in backbone else [])]
    train(folder, [*words, *chosen, "rasterizer=compiled", "device=cpu"], log=folder.with_name(f"{folder.name}.log"))
    return folder


def stages_by(source: Path, run: Path, steps: int) -> dict[str, Any]:
    """What a process with that source measures."""
    command = [sys.executable, __file__, "--stages-of", str(run), "--steps", str(steps)]
    environment = os.environ | {"PYTHONPATH": str(source)}
    done = subprocess.run(command, check=True, env=environment, stdout=subprocess.PIPE, text=True)
    return json.loads(done.stdout.splitlines()[-1])


def least_times(counts: Mapping[str, float], limits: Sequence[Limit]) -> dict[str, tuple[float, str]]:
    """(ms that a stage takes at least, what binds it) of the stages of free Gaussians of degree 3."""
    bytes_, flops = best(list(limits), "B/s"), best(list(limits), "flop/s")
    n, m, pairs, pixels = (counts[name] for name in ("primitives", "shown", "pairs", "pixels"))
    evaluations = 64 * pairs
    moved = {
        "splats": FLOAT * n * (59 + 14),
        "projection": FLOAT * (n * 14 + m * (14 + 14)),
        "tiles": FLOAT * m * 7 + pairs * 4 * 8,
        "lists": pairs * 3 * FLOAT,
        "backward, but for blending": FLOAT * (m * (14 + 14) + n * (14 + 2 * 59)),
        "Adam": FLOAT * 7 * counts["numbers"],
    }
    exp = evaluations / best(list(limits), "exp/s")
    computed = {
        "blending": exp + evaluations * sum(FORWARD_FLOPS.values()) / flops,
        "blending, backward": exp + evaluations * sum(BACKWARD_FLOPS.values()) / flops,
        "loss": 3 * pixels * 8 * 2 * 22 / flops,
    }
    by_memory = {name: (1e3 * size / bytes_, "memory") for name, size in moved.items()}
    return by_memory | {name: (1e3 * seconds, "arithmetic") for name, seconds in computed.items()}


def rows_of(
    backbone: str, given: argparse.Namespace, limits: Sequence[Limit], other: Path | None
) -> list[dict[str, Any]]:
    """A row for each stage of a backbone's step, the longest first."""
    run, sources = subject(backbone, given), [ROOT / "src", *([other] if other else [])]
    found: list[list[dict[str, Any]]] = [[] for _ in sources]
    for _ in range(ROUNDS):
        for several, source in zip(found, sources, strict=True):
            several.append(stages_by(source, run, given.steps))
    now, *before = (medians([one["milliseconds"] for one in several]) for several in found)
    least = least_times(found[0][0]["counts"], limits) if backbone in ("gs3d", "mip_splatting") else {}
    rows = []
    for stage, spent in sorted(now.items(), key=lambda item: -item[1]):
        row = {"backbone": backbone, "stage": stage, "ms": spent, "share": f"{spent / now['step']:.2f}"}
        row |= dict(zip(("least", "bound"), least.get(stage, (None, None)), strict=True))
        if before:
            old = before[0].get(stage)
            row |= {"old": old, "ratio": old / spent if old and spent else None}
        rows.append(row)
    return rows


def medians(several: Sequence[Mapping[str, float]]) -> dict[str, float]:
    """Over processes, by stage."""
    return {name: statistics.median(each.get(name, 0.0) for each in several) for name in several[0]}


def slower(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """Stages that take longer than before."""
    found = [row for row in rows if row.get("old") and row["ms"] > max(SLOWER * row["old"], row["old"] + LEAST)]
    return [f"{row['backbone']}, {row['stage']}: {row['old']:.1f} ms before, {row['ms']:.1f} now" for row in found]


def measured(given: argparse.Namespace, command: str) -> Section:
    """The table."""
    load, device = told_load(), torch.device("cpu")
    limits = measured_limits(device, sizes_of(device, False), True)
    with checked_out(given.against) if given.against else nullcontext() as old:
        rows = [row for name in given.backbones.split(",") for row in rows_of(name, given, limits, old)]
    notes = [NOTE, *([f"Before: revision {given.against}."] if given.against else [])]
    title = f"Stages of a training step, {SCENES[given.scene][0]}"
    return stamped(title, COLUMNS, rows, notes, load, command)


def main(words: Sequence[str]) -> int:
    """Measure, write, and say what has become slower."""
    given = arguments(words)
    if given.stages_of:
        print(json.dumps(vars(measure_stages(given.stages_of, given.steps))))
        return 0
    section = measured(given, shown_command(words, "benchmarks/step.py"))
    write_results(given.to, "step_cpu", describe_machine(torch.device("cpu")), {given.scene: section})
    print(text_table(section))
    found = slower(section["rows"])
    print("\n".join(found))
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
