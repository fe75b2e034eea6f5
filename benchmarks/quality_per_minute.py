"""Measure PSNR over wall time: gsx at an older revision, gsx now, and OpenSplat, one after another.

    python benchmarks/quality_per_minute.py --scenes FOLDER [--opensplat PROGRAM] [--only fox_4] [--minutes 1,2,5,10]

FOLDER holds `fox` (COLMAP), `lego` (NeRF-Synthetic) and `castle` (photos alone); without it only built-in scenes are
measured. Arms: `before` is the default of an older revision, in as many steps as last the minutes; `now` is
`gsx minutes=M`; `opensplat` is OpenSplat on the same training photos, in as many steps as last the minutes;
`opensplat_short` is the same with its schedules compressed to these steps. Steps are interpolated between runs that
were timed before. Wall times are those of whole processes, with photos, poses and compiled code in the cache. Every
model is evaluated on the same held-out views by the present `gsx eval`, outside of its time. Runs in the results, and
finished runs below --runs, are not repeated. Nothing else should run. Half an hour for a scene, an arm and a seed.
OpenSplat 1.1.5 sorts Gaussians by another number than depth on a CPU (rasterizer/gsplat-cpu/gsplat_cpu.cpp reads a
column of a matrix as if it were contiguous): give a program that is repaired.
"""

import argparse
import os
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch

from gsx.core.files import read_json
from measuring.curves import Point, steps_for
from measuring.machine import commit, describe_machine, first_line, shown_command, told_load
from measuring.opensplat import file_of, kept_scene, run_opensplat
from measuring.panels import panels
from measuring.quality_tables import REACHED_ZOOMS, Row, curve_of, place_of, reached, runs_section
from measuring.results import Section, read_sections, text_table, write_results
from measuring.revisions import checked_out
from measuring.runs import clock_of, gsx, train, wall_seconds
from zoom import refuse_unknown, shared_arguments

FILE, RUNS, REACHED = "quality_per_minute_cpu", "runs", "reached"
"""Name of the results, and of their sections."""
REVISION = "f0651b8"
"""Revision of the arm `before`."""
SUBJECTS = {
    "fox_4": ("scene=colmap", "scene.downscale=4"),
    "lego_4": ("scene=blender", "scene.downscale=4"),
    "demo": ("scene=demo",),
    "castle": ("scene=photos", "scene.downscale=8"),
    "room": ("scene=room",),
}
BUILT_IN = ("demo", "room")
BEFORE, NOW, OPENSPLAT, SHORT = "before", "now", "opensplat", "opensplat_short"
ARMS = (BEFORE, NOW, OPENSPLAT, SHORT)
OTHERS = (OPENSPLAT, SHORT)
"""Arms of another program."""
PROBES = {BEFORE: (300, 500), OPENSPLAT: (200, 800), SHORT: (200, 800)}
"""Steps of the two runs that are timed first."""
WARM = ("iterations=30", "training.test_points=0", "rasterizer=compiled")
"""Run that fills the cache: compiled code, poses, pictures."""
PLANNED = ("backbone.capacity=budget", "backbone.budget.primitives=10000")
"""Options of planned runs that need other code."""
EVALUATION = ("eval.zoom=[1,2,4]", "eval.pairs=0", "eval.flight=false", "metrics.perceptual=[]")
"""Overrides of `gsx eval`, the same for all arms."""
AGREEMENT = 0.01
"""Difference at x1 between a run's own evaluation and that by the present revision, which is an error, dB."""
ZOOMS = ("1", "2", "4")
SCHEDULES = {
    "--resolution-schedule": 3000, "--sh-degree-interval": 1000, "--warmup-length": 500, "--stop-screen-size-at": 4000,
}  # fmt: skip
"""OpenSplat's options in steps, of 30,000 (its --help); --refine-every stays, as each refinement needs views."""
PUBLISHED = 30000
"""Steps of OpenSplat's default."""


def arguments(words: Sequence[str]) -> argparse.Namespace:
    """Parses the command line."""
    parser = shared_arguments(__doc__, ",".join(SUBJECTS), "outputs/quality_per_minute")
    parser.add_argument("--arms", default=f"{BEFORE},{NOW},{OPENSPLAT}", help=f"by commas, of {', '.join(ARMS)}")
    parser.add_argument("--minutes", type=times, default=[1.0, 2.0, 5.0, 10.0], help="wall times by commas (1,2,5,10)")
    parser.add_argument("--opensplat", type=Path, default=None, help="program of OpenSplat; none: without its rows")
    parser.add_argument("--threads", type=int, default=2, help="threads of each run (2)")
    parser.set_defaults(seeds=[0])
    options = parser.parse_args(words)
    if options.jobs > 1:
        parser.error("--jobs is for other benchmarks: these runs take turns")
    return options


def times(text: str) -> list[float]:
    """Reads wall times by commas, minutes."""
    return [float(word) for word in text.split(",")]


# -- runs --------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Bench:
    """Folder and environment of the runs, and what is known of them."""

    options: argparse.Namespace
    old: Path | None
    """Source of the older revision; None: its arm is not measured."""
    rows: dict[tuple[Any, ...], Row] = field(default_factory=dict)
    """Finished runs by place."""

    @property
    def root(self) -> Path:
        """Folder of the runs."""
        return self.options.runs.resolve()

    def environment(self, arm: str) -> dict[str, str]:
        """Returns threads, cache and source of an arm."""
        source = {"PYTHONPATH": str(self.old)} if arm == BEFORE else {}
        cache = self.root / "cache" / (BEFORE if arm == BEFORE else NOW)
        return {"OMP_NUM_THREADS": str(self.options.threads), "GSX_CACHE": str(cache), **source}

    def scene_words(self, scene: str) -> list[str]:
        """Returns the overrides that choose a scene."""
        where = () if scene in BUILT_IN else (f"scene.path={(self.options.scenes / scene.split('_')[0]).resolve()}",)
        return [*SUBJECTS[scene], *where]

    def folder(self, arm: str, scene: str, *parts: object) -> Path:
        """Returns the place of a run."""
        return self.root / "_".join(map(str, (arm, scene, *parts)))

    def train(self, arm: str, scene: str, words: Sequence[str], folder: Path) -> dict[str, Any]:
        """Trains by gsx unless the run is there; returns its evaluation."""
        print(time.strftime("%H:%M"), folder.name, flush=True)
        log = folder.with_name(f"{folder.name}.log")
        return train(folder, [*self.scene_words(scene), *words], self.environment(arm), log)

    def warm_up(self, arm: str, scene: str) -> None:
        """Fills the cache of an arm of gsx."""
        words = (*WARM, *PLANNED) if arm == NOW else WARM
        self.train(arm, scene, words, self.folder("warm", scene, arm))


def opensplat_words(arm: str, steps: int) -> list[str]:
    """Returns OpenSplat's options for a number of steps."""
    words = ["--num-iters", str(steps)]
    if arm == SHORT:
        for option, published in SCHEDULES.items():
            words += [option, str(max(1, round(published * steps / PUBLISHED)))]
    return words


def opensplat_scene(bench: Bench, scene: str) -> Path:
    """Writes the scene in OpenSplat's form unless it is there; returns its folder."""
    return kept_scene(bench.scene_words(scene), bench.folder("scene", scene))


# -- times and figures of a run ----------------------------------------------------------------------------------------


def run_arm(bench: Bench, arm: str, scene: str, name: str, steps: int, minutes: float, seed: int) -> Row:
    """Trains a run unless it is there; returns its wall time, peak memory, steps and its own PSNR."""
    folder = bench.folder(arm, scene, name, seed)
    if arm in OTHERS:
        return run_other(bench, arm, scene, folder, steps)
    length = f"minutes={minutes:g}" if arm == NOW else f"iterations={steps}"
    evaluation = bench.train(arm, scene, [length, f"seed={seed}"], folder)
    facts = {"seconds": wall_seconds(folder), "peak_mb": evaluation["peak_memory_mb"], "steps": evaluation["step"]}
    return facts | {"own": evaluation["psnr"]}


def run_other(bench: Bench, arm: str, scene: str, folder: Path, steps: int) -> Row:
    """Trains by OpenSplat unless the run is there."""
    if not clock_of(folder).is_file():
        print(time.strftime("%H:%M"), folder.name, flush=True)
        words = opensplat_words(arm, steps)
        data, log = opensplat_scene(bench, scene), folder.with_name(f"{folder.name}.log")
        run_opensplat(bench.options.opensplat, data, folder, words, bench.environment(arm), log)
    kept = read_json(clock_of(folder))
    return {"seconds": kept["wall_seconds"], "peak_mb": kept["peak_mb"], "steps": steps}


def evaluated(bench: Bench, arm: str, scene: str, folder: Path) -> Row:
    """Evaluates a model on the held-out views at every zoom, by the present revision."""
    model = [str(file_of(folder)), *bench.scene_words(scene), f"folder={folder}"]
    words = model if arm in OTHERS else [str(folder)]
    gsx(["eval", *words, *EVALUATION], bench.environment(NOW), folder.with_name(f"{folder.name}.eval.log"))
    evaluation = read_json(folder / "evaluation.json")
    figures = {f"x{zoom}": evaluation["zoom"][zoom]["psnr"] for zoom in ZOOMS}
    return figures | {"primitives": evaluation["primitives"]}


def refuse_disagreement(own: float | None, figures: Row, folder: Path) -> None:
    """Raises ValueError if the evaluation of the run that trained differs; None: it evaluated nothing."""
    if own is not None and abs(own - figures["x1"]) > AGREEMENT:
        raise ValueError(f"{folder.name} has {own:.3f} dB by its own evaluation, {figures['x1']:.3f} dB by this one")


def planned_steps(bench: Bench, arm: str, scene: str, minutes: float) -> int:
    """Returns the steps of an arm that last the minutes: those of other seeds, else by runs that were timed."""
    rows = [row for row in bench.rows.values() if (row["scene"], row["arm"]) == (scene, arm)]
    if same := [row["steps"] for row in rows if row["minutes"] == minutes]:
        return same[0]
    timed = [(row["steps"], row["seconds"]) for row in rows]
    for steps in PROBES[arm] if len({length for length, _ in timed}) < 2 else ():
        timed.append((steps, run_arm(bench, arm, scene, f"probe_{steps}", steps, 0, 0)["seconds"]))
    return steps_for(60 * minutes, timed)


def measure(bench: Bench, arm: str, scene: str, minutes: float, seed: int) -> Row:
    """Trains, times and evaluates one run."""
    steps = 0 if arm == NOW else planned_steps(bench, arm, scene, minutes)
    name = f"{minutes:g}_minutes"
    folder, facts = bench.folder(arm, scene, name, seed), run_arm(bench, arm, scene, name, steps, minutes, seed)
    figures = evaluated(bench, arm, scene, folder)
    refuse_disagreement(facts.pop("own", None), figures, folder)
    place = {"scene": scene, "arm": arm, "minutes": minutes, "seed": seed}
    return place | facts | figures | {"revision": revision_of(bench, arm)}


def revision_of(bench: Bench, arm: str) -> str:
    """Returns the revision, or name and version of another program."""
    if arm in OTHERS:
        program = bench.options.opensplat
        return f"{program.name} {first_line([str(program), '--version'])}"
    return REVISION if arm == BEFORE else commit()


# -- tables ------------------------------------------------------------------------------------------------------------


def tasks_of(options: argparse.Namespace, arms: Sequence[str]) -> Iterator[tuple[str, str, float, int]]:
    """Yields arm, scene, minutes and seed of each run; arms take turns, and a scene's runs get longer."""
    for seed in options.seeds:
        for scene in options.only.split(","):
            for minutes in sorted(options.minutes):
                yield from ((arm, scene, minutes, seed) for arm in arms)


def write_tables(bench: Bench, machine: dict[str, Any], stamp: Sequence[Any]) -> Section:
    """Writes both tables and the picture of all finished runs; returns the second table."""
    rows = [bench.rows[place] for place in sorted(bench.rows)]
    sections = {RUNS: runs_section(rows, stamp), REACHED: reached(rows, ARMS, stamp)}
    write_results(bench.options.to, FILE, machine, sections, panels(curves_by_scene(rows)))
    return sections[REACHED]


def curves_by_scene(rows: Sequence[Row]) -> dict[str, dict[tuple[str, str], list[Point]]]:
    """Returns the curves to draw: scene, then arm and zoom."""
    scenes = list(dict.fromkeys(row["scene"] for row in rows))
    drawn = [(arm, zoom) for zoom in REACHED_ZOOMS for arm in ARMS]
    return {
        scene: {(arm, f"x{zoom}"): curve for arm, zoom in drawn if (curve := curve_of(rows, scene, arm, zoom))}
        for scene in scenes
    }


def read_rows(folder: Path) -> dict[tuple[Any, ...], Row]:
    """Reads the finished runs of the results, by place."""
    sections = read_sections(folder / f"{FILE}.json")
    return {place_of(row): row for row in sections[RUNS]["rows"]} if RUNS in sections else {}


def chosen_arms(options: argparse.Namespace) -> list[str]:
    """Returns the arms that can be measured; ends with a message if a name is unknown or a folder is missing."""
    refuse_unknown(options.only, SUBJECTS)
    refuse_unknown(options.arms, ARMS)
    if lacking := [scene for scene in options.only.split(",") if scene not in BUILT_IN and options.scenes is None]:
        sys.exit(f"--only {','.join(lacking)} needs --scenes FOLDER")
    arms = options.arms.split(",")
    if options.opensplat is None and any(arm in OTHERS for arm in arms):
        print("OpenSplat is left out: give its program by --opensplat", file=sys.stderr)
        arms = [arm for arm in arms if arm not in OTHERS]
    return arms


def run_tasks(bench: Bench, arms: Sequence[str], machine: dict[str, Any], stamp: Sequence[Any]) -> None:
    """Measures what is not in the results; a run that fails is reported and left out."""
    for arm, scene, minutes, seed in tasks_of(bench.options, arms):
        if (scene, arm, minutes, seed) in bench.rows:
            continue
        try:
            bench.warm_up(BEFORE if arm == BEFORE else NOW, scene)
            row = measure(bench, arm, scene, minutes, seed)
        except (subprocess.CalledProcessError, ValueError) as error:
            print(f"{arm}, {scene}, {minutes:g} minutes, seed {seed} failed: {error}", file=sys.stderr, flush=True)
            continue
        bench.rows[place_of(row)] = row
        write_tables(bench, machine, stamp)


def main(words: Sequence[str]) -> None:
    """Trains, evaluates, and writes the tables after each run."""
    options = arguments(words)
    arms, rows = chosen_arms(options), read_rows(options.to)  # what cannot be added to is refused before training
    machine, load = describe_machine(torch.device("cpu")) | {"threads": options.threads}, told_load()
    stamp = (load, shown_command(words, "benchmarks/quality_per_minute.py"))
    with checked_out(REVISION) if BEFORE in arms else nullcontext() as old:
        bench = Bench(options, old, rows)
        os.environ |= bench.environment(NOW)  # scenes are loaded here, too
        run_tasks(bench, arms, machine, stamp)
    if bench.rows:
        print(text_table(write_tables(bench, machine, stamp)))


if __name__ == "__main__":
    main(sys.argv[1:])
