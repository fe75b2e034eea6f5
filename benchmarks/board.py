"""A board of methods at equal minutes: each trains as long on the same views, and `gsx judge` judges them all.

    python benchmarks/board.py --scenes FOLDER [--opensplat PROGRAM] [--only fox,lego] [--methods gs3d,zoom_prior]

Scenes are those of benchmarks/zoom.py. Methods of gsx are planned for the minutes as by `gsx minutes=M`. Where a run
misses its time by more than 15 %, the same plan is trained without a clock, in as many steps as last the minutes. Steps
are those that a run takes: one that falls behind skips some. OpenSplat takes as many steps as last the minutes by runs
that were timed before, with its schedules compressed to them. Wall times are those of whole processes, from command to
report, with photos, poses and compiled code in the cache; zoomed pictures are rendered and judged outside of them.
Finished runs below --runs are not repeated, and judgements only if there are other runs. Nothing else should run on the
processor that the runs are pinned to. Two hours on one core for five scenes. OpenSplat 1.1.5 needs the repair that
benchmarks/quality_per_minute.py names.
"""

import argparse
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from gsx.core.files import read_json
from measuring.board_tables import sections_of
from measuring.curves import steps_for
from measuring.machine import describe_machine, first_line, shown_command, told_load
from measuring.opensplat import file_of, kept_scene, run_opensplat
from measuring.results import Section, text_table, write_results
from measuring.runs import clock_of, gsx, train, wall_seconds
from quality_per_minute import OPENSPLAT, PLANNED, PROBES, SHORT, WARM, opensplat_words
from zoom import BUILT_IN, SUBJECTS, USUAL, refuse_unknown, scenes_at_hand, shared_arguments

FILE = "board_cpu"
"""Name of the results."""
METHODS: dict[str, tuple[str, ...]] = {
    "gs3d_zoom": (),
    "gs3d": ("backbone=gs3d",),
    "mip_splatting": ("backbone=mip_splatting",),
    "zoom_prior": ("preset=zoom_prior",),
    "scaffold": ("backbone=scaffold",),
    "octree_scaffold": ("backbone=octree_scaffold",),
}
"""Overrides of methods of gsx by name, in the order of training."""
BASE = "gs3d"
"""Method that others are compared with."""
SCENE = {"demo": ("scene.downscale=2",), "lego": ("scene.random_points=10000",)}
"""What a plan of two minutes on one core chooses for a scene, for all methods."""
ATTEMPTS, TOLERANCE = 4, 0.15
"""Runs at the most until one keeps the minutes, and the share of them to miss."""
REFUSED, FEW = "give more minutes", 200
"""In the log of a plan that finds the minutes too short, and the steps of the run instead."""
ENVIRONMENT, COMPARISON = "environment.json", "comparison.json"
"""Files of a run and of a judgement."""
COMPILED = "once for all later runs"
"""In the log of a run that compiled code, whose time does not count."""
JUDGED = ("eval.zoom=[1,2,4]", "eval.competitor=null")
"""Settings of `gsx judge`."""
Row = dict[str, Any]
"""Figures of one run."""


def arguments(words: Sequence[str]) -> argparse.Namespace:
    """Parses the command line."""
    parser = shared_arguments(__doc__, USUAL, "outputs/board")
    names = [*METHODS, OPENSPLAT]
    parser.add_argument("--methods", default=",".join(names), help=f"by commas, of {', '.join(names)}")
    parser.add_argument("--minutes", type=float, default=2.0, help="wall time of each run (2)")
    parser.add_argument("--threads", type=int, default=1, help="threads of each run (1)")
    parser.add_argument("--opensplat", type=Path, default=None, help="program of OpenSplat; none: without its rows")
    parser.add_argument("--train-only", action="store_true", help="do not judge")
    options = parser.parse_args(words)
    refuse_unknown(options.methods, names)
    if options.jobs > 1:
        parser.error("--jobs is for other benchmarks: these runs take turns")
    return options


@dataclass(frozen=True, eq=False)
class Bench:
    """Folder, scenes and environment of the runs."""

    options: argparse.Namespace

    @property
    def root(self) -> Path:
        """Folder of the runs."""
        return self.options.runs.resolve()

    @property
    def goal(self) -> float:
        """Wall time of each run, s."""
        return 60.0 * self.options.minutes

    @property
    def environment(self) -> dict[str, str]:
        """Threads and cache of each run."""
        return {"OMP_NUM_THREADS": str(self.options.threads), "GSX_CACHE": str(self.root / "cache")}

    def folder(self, *parts: object) -> Path:
        """Returns the place of a run."""
        return self.root / "_".join(map(str, parts))

    def scene_words(self, scene: str) -> list[str]:
        """Returns the overrides that choose a scene."""
        where = () if scene in BUILT_IN else (f"scene.path={(self.options.scenes / scene).resolve()}",)
        words = (word for word in SUBJECTS[scene] if not word.startswith("iterations="))
        return [*words, *SCENE.get(scene, ()), *where]

    def train(self, folder: Path, words: Sequence[str]) -> dict[str, Any]:
        """Trains by gsx unless the run is there; returns its evaluation."""
        if not clock_of(folder).is_file():
            announce(folder)
        return train(folder, words, self.environment, log_of(folder))


def announce(folder: Path) -> None:
    """Prints time and name of a run."""
    print(time.strftime("%H:%M"), folder.name, flush=True)


def log_of(folder: Path) -> Path:
    """Returns the file with what a run prints."""
    return folder.with_name(f"{folder.name}.log")


# -- runs of gsx -------------------------------------------------------------------------------------------------------


def warm_up(bench: Bench, method: str, scene: str) -> None:
    """Fills the cache of gsx: poses and photos of a scene, compiled code of a method."""
    bench.train(bench.folder("warm", method, scene), [*bench.scene_words(scene), *METHODS[method], *WARM, *PLANNED])


def trained(bench: Bench, method: str, scene: str) -> Row:
    """Trains a method of gsx until a run keeps the minutes; returns the figures of the run that kept them best."""
    if not clock_of(bench.folder(method, scene, 1)).is_file():
        warm_up(bench, next(iter(METHODS)), scene)
        warm_up(bench, method, scenes_at_hand(bench.options)[0])
    row, kept = planned(bench, method, scene), list[Row]()
    for attempt in range(2, ATTEMPTS + 2):
        kept += [] if row["compiled"] else [row]
        if attempt > ATTEMPTS or (kept and missed(bench, kept[-1]) <= TOLERANCE):
            break
        words = repeated(kept, bench.goal) if kept else row["words"]
        row = attempted(bench, bench.folder(method, scene, attempt), words)
    return min(kept, key=lambda row: missed(bench, row))


def planned(bench: Bench, method: str, scene: str) -> Row:
    """Trains by a plan for the minutes; where it is refused, some steps by the plan of the method before."""
    folder = bench.folder(method, scene, 1)
    try:
        return attempted(bench, folder, [*bench.scene_words(scene), *METHODS[method], f"seconds={bench.goal:g}"])
    except subprocess.CalledProcessError:
        if REFUSED not in log_of(folder).read_text():
            raise
    before = planned(bench, list(METHODS)[list(METHODS).index(method) - 1], scene)
    words = [word for word in before["repeat"] if not word.startswith(("iterations=", "backbone=", "preset="))]
    return attempted(bench, folder, [*words, *METHODS[method], f"iterations={FEW}"])


def missed(bench: Bench, row: Row) -> float:
    """Returns by what share a run missed its minutes."""
    return abs(float(row["seconds"]) / bench.goal - 1)


def attempted(bench: Bench, folder: Path, words: Sequence[str]) -> Row:
    """Trains a run unless it is there; returns its figures, and what a repeated one needs."""
    evaluation = bench.train(folder, words)
    environment, late = read_json(folder / ENVIRONMENT), evaluation.get("late", [])
    left_out = sum(round(last - first) + 1 for first, last in zip(late[::2], late[1::2], strict=True))
    return {
        "path": folder,
        "seconds": wall_seconds(folder),
        "steps": evaluation["step"] - left_out,
        "primitives": evaluation["primitives"],
        "peak_mb": evaluation["peak_memory_mb"],
        "program": f"gsx {environment['gsx']}, source {environment['source'][:8]}",
        "train_seconds": evaluation["train_seconds"],
        "before": environment.get("minutes", {}).get("before_s", 0.0),
        "repeat": environment.get("minutes", {}).get("repeat", words),
        "words": words,
        "compiled": COMPILED in log_of(folder).read_text(),
    }


def repeated(rows: Sequence[Row], goal: float) -> list[str]:
    """Returns the words of a planned run without its clock and its short measurement, in steps that last the goal."""
    row, used = rows[-1], [(row["steps"], row["seconds"] - row["before"]) for row in rows]
    other = row["seconds"] - row["train_seconds"] - row["before"]
    steps = steps_for(goal, used) if len(used) > 1 else round(row["steps"] * (goal - other) / row["train_seconds"])
    return [*(word for word in row["repeat"] if not word.startswith("iterations=")), f"iterations={steps}"]


# -- runs of OpenSplat -------------------------------------------------------------------------------------------------


def trained_by_opensplat(bench: Bench, scene: str) -> Row:
    """Trains by OpenSplat in the minutes unless the run is there, in as many steps as last them by runs before."""
    runs = [opensplat(bench, scene, steps) for steps in PROBES[SHORT]]
    for _ in range(ATTEMPTS):
        if missed(bench, runs[-1]) <= TOLERANCE:
            break
        steps = steps_for(bench.goal, [(run["steps"], run["seconds"]) for run in runs])
        runs.append(opensplat(bench, scene, steps))
    return min(runs, key=lambda run: missed(bench, run))


def opensplat(bench: Bench, scene: str, steps: int) -> Row:
    """Trains by OpenSplat for some steps unless the run is there; returns its figures."""
    place, program = bench.folder(OPENSPLAT, scene, steps), bench.options.opensplat
    if not clock_of(place).is_file():
        announce(place)
        words = opensplat_words(SHORT, steps)
        data = kept_scene(bench.scene_words(scene), bench.folder("scene", scene))
        run_opensplat(program, data, place, words, bench.environment, log_of(place))
    kept = read_json(clock_of(place))
    facts = {"path": file_of(place), "seconds": kept["wall_seconds"], "steps": steps, "peak_mb": kept["peak_mb"]}
    return facts | {"program": f"OpenSplat {first_line([str(program), '--version'])}"}


# -- all runs ----------------------------------------------------------------------------------------------------------


def tasks_of(options: argparse.Namespace) -> Iterator[tuple[str, str]]:
    """Yields method and scene of each run."""
    for method in options.methods.split(","):
        if method == OPENSPLAT and options.opensplat is None:
            print(f"{method} is left out: give its program by --opensplat", file=sys.stderr)
            continue
        yield from ((method, scene) for scene in scenes_at_hand(options))


def train_all(bench: Bench) -> list[Row]:
    """Trains what is not there; a run that fails is reported and left out."""
    rows = []
    for method, scene in tasks_of(bench.options):
        try:
            facts = trained_by_opensplat(bench, scene) if method == OPENSPLAT else trained(bench, method, scene)
        except (subprocess.CalledProcessError, ValueError) as error:
            print(f"{method}, {scene} failed: {error}", file=sys.stderr, flush=True)
            continue
        print(f"      {facts['seconds']:.0f} s, {facts['steps']:,} steps", flush=True)
        rows.append({"scene": scene, "method": method} | facts)
    return rows


def judged(bench: Bench, scene: str, methods: Mapping[str, Path]) -> dict[str, Any]:
    """Judges the models of a scene unless the same ones were judged there; returns what `gsx judge` found."""
    folder = bench.folder("judged", scene)
    words = [*(f"{name}={path}" for name, path in methods.items()), *bench.scene_words(scene), *JUDGED]
    kept = folder.with_name(f"{folder.name}.words.txt")
    if not (folder / COMPARISON).is_file() or kept.read_text() != "\n".join(words):
        announce(folder)
        shutil.rmtree(folder, ignore_errors=True)
        kept.write_text("\n".join(words))
        against = ["--against", BASE] if BASE in methods else []
        gsx(["judge", *words, *against, "--to", str(folder)], bench.environment, log_of(folder))
    return read_json(folder / COMPARISON)


def judge_all(bench: Bench, rows: Sequence[Row]) -> dict[str, Row]:
    """Judges scene by scene; returns what `gsx judge` found, by scene."""
    out = {}
    for scene in dict.fromkeys(row["scene"] for row in rows):
        methods = {row["method"]: row["path"] for row in rows if row["scene"] == scene}
        out[scene] = judged(bench, scene, methods)
    return out


def main(words: Sequence[str]) -> None:
    """Trains, judges and writes the tables."""
    options = arguments(words)
    machine, load = describe_machine(torch.device("cpu")) | {"threads": options.threads}, told_load()
    bench = Bench(options)
    os.environ |= bench.environment  # scenes are loaded here, too
    rows = train_all(bench)
    if options.train_only or not rows:
        return
    sections: dict[str, Section] = sections_of(
        rows, judge_all(bench, rows), BASE, options.minutes, (load, shown_command(words, "benchmarks/board.py"))
    )
    write_results(options.to, FILE, machine, sections)
    print("\n".join(text_table(section) for section in sections.values()))


if __name__ == "__main__":
    main(sys.argv[1:])
