"""Run `gsx +experiment=zoom_truth` for several seeds and tabulate it (docs/benchmarks/zooming.md).

    python benchmarks/zoom_truth.py --scenes FOLDER [--only fox,lego] [--seeds 0,1,2] [--rows zoom,...] [--jobs 2]

FOLDER is as `benchmarks/zoom.py` has it. Each scene is trained by each row of the experiment, by --share of its steps,
what rows have in common once, and by its row `zoom` by a quarter more of them. Figures of every seed are kept in
zoom_truth_cpu.json as soon as they are there, so that seeds may be measured one after another, on other days and by
other machines; the table is of all that are kept. Finished runs below --runs are not trained again. A seed of all rows
takes an hour of two cores and more.
"""

import argparse
import csv
import statistics
import sys
from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from threading import Lock
from typing import Any

import torch

from measuring.machine import commit, describe_machine, shown_command, told_load
from measuring.results import Section, read_sections, stamped, text_table, write_results
from measuring.runs import gsx
from zoom import USUAL, scenes_at_hand, shared_arguments, told

FILE, RUNS, TABLE = "zoom_truth_cpu", "runs", "table"
"""Of the results, and its sections."""
MORE, MORE_STEPS = 1.25, "zoom, a quarter more steps"
"""By how many more steps `zoom` is trained once again, which is what its arms with pseudo details take in time, and the
name of that row."""
BASE = "Mip-Splatting"
"""The row that others are compared with, seed by seed."""
FIGURES = {
    "PSNR": "x1",
    "PSNR x2": "x2",
    "PSNR x4": "x4",
    "over enlarged x2": "over2",
    "over enlarged x4": "over4",
    "detail x2": "detail2",
    "detail x4": "detail4",
    "s": "s",
}
"""Metrics of the experiment's table: keys of ours."""
FORMS = {"over2": "+.2f", "over4": "+.2f", "detail2": ".3f", "detail4": ".3f"}
"""Of figures that are not told in dB with two digits."""
COMPARED = ("x1", "x2", "x4", "detail4")
"""Figures of which the table tells the difference from BASE."""
KEEPING = Lock()
"""One seed is written at a time."""
Row = dict[str, Any]
"""Figures of one row of the experiment, scene and seed, or of the table."""


def arguments(words: Sequence[str]) -> argparse.Namespace:
    """The command line."""
    parser = shared_arguments(__doc__, USUAL, "outputs/zoom_truth")
    parser.add_argument("--share", type=float, default=0.4, help="of the steps of benchmarks/zoom.py (0.4)")
    parser.add_argument("--rows", default="", help="of the experiment, by commas; none given: all")
    given = parser.parse_args(words)
    if not 0 < given.share <= 1 / MORE:
        sys.exit(f"--share {given.share:g}: give more than 0 and at most {1 / MORE:g} ({MORE_STEPS})")
    return given


# -- one seed ----------------------------------------------------------------------------------------------------------


def measured(scene: str, seed: int, given: argparse.Namespace) -> list[Row]:
    """Figures of all rows of a scene, and of `zoom` by more steps."""
    chosen = [f"experiment.only=[{given.rows}]"] if given.rows else []
    found = figures(experiment(scene, seed, given, given.share, chosen))
    more = figures(experiment(scene, seed, given, MORE * given.share, ["experiment.only=[zoom]"]))
    where = {"share": f"{given.share:g}", "scene": scene, "seed": seed, "commit": commit()}
    return [where | {"name": name} | row for name, row in (found | {MORE_STEPS: more["zoom"]}).items()]


def experiment(
    scene: str, seed: int, given: argparse.Namespace, share: float, more: Sequence[str]
) -> list[dict[str, str]]:
    """Lines of the experiment's table of a scene by one seed."""
    words = ["+experiment=zoom_truth", f"output={given.runs / f'{share:g}'}", f"budget.share={share:g}", *more]
    words += [f"experiment.seeds=[{seed}]", f"experiment.scenes=[{scene}]"]
    words += [f"data_root={given.scenes}"] if given.scenes else []
    log = given.runs / f"{share:g}_{scene}_{seed}.log"
    log.parent.mkdir(parents=True, exist_ok=True)
    gsx(words, {"OMP_NUM_THREADS": "1"} if given.jobs > 1 else {}, log)
    path = Path(log.read_text().splitlines()[-1]).with_suffix(".csv")
    with path.open() as file:
        return [line for line in csv.DictReader(file) if int(line["seeds"])]  # other datasets have none


def figures(lines: Iterable[dict[str, str]]) -> dict[str, Row]:
    """Figures by row, as text of three decimals, from lines of one scene and seed."""
    found: dict[str, Row] = {}
    for line in lines:
        if (key := FIGURES.get(line["metric"])) and line["ours"]:
            found.setdefault(line["row"], {})[key] = f"{float(line['ours']):.3f}"
    return found


def place_of(row: Row) -> tuple[Any, ...]:
    """What a kept row is the figures of."""
    return row["share"], row["scene"], row["name"], row["seed"]


def keep(rows: Sequence[Row], given: argparse.Namespace, machine: dict[str, Any], stamp: Sequence[Any]) -> None:
    """Write rows in place of those of the same seeds, and the table of all that are there then."""
    with KEEPING:
        kept = {place_of(row): row for row in read_rows(given.to)} | {place_of(row): row for row in rows}
        merged = [kept[place] for place in sorted(kept)]
        write_results(given.to, FILE, machine, {RUNS: section_of_runs(merged, stamp), TABLE: table(merged, stamp)})


def read_rows(folder: Path) -> list[Row]:
    """Rows that are kept."""
    sections = read_sections(folder / f"{FILE}.json")
    return sections[RUNS]["rows"] if RUNS in sections else []


# -- the table ---------------------------------------------------------------------------------------------------------


def section_of_runs(rows: list[Row], stamp: Sequence[Any]) -> Section:
    """Every seed by itself."""
    keys = ["share", "scene", "name", "seed", *FIGURES.values(), "commit"]
    note = "One seed a line; `commit`: of the revision that measured it. s: of training, branches counted whole."
    return stamped("What helps when looking closer, seed by seed", [[key, key] for key in keys], rows, [note], *stamp)


def table(rows: Sequence[Row], stamp: Sequence[Any]) -> Section:
    """Means over the seeds that are kept, ± half their range; differences seed by seed."""
    columns = [["share", "of the steps"], ["scene", "scene"], ["name", "row"], ["seeds", "seeds"]]
    columns += [[key, key] for key in ("x1", "x2", "x4")]
    columns += [["over2", "x2 - x1 enlarged"], ["over4", "x4 - x1 enlarged"]]
    columns += [["detail2", "detail at x2"], ["detail4", "detail at x4"]]
    columns += [[f"more_{key}", f"{key} - {BASE}"] for key in COMPARED]
    note = (
        "PSNR on held-out views and explained detail above the training Nyquist frequency, means over the seeds that "
        "were measured ± half their range, blank where a seed lacks the figure; differences seed by seed. s: of "
        "training, branches counted whole."
    )
    names = list(dict.fromkeys((row["share"], row["scene"], row["name"]) for row in rows))
    by_seed = {place_of(row): row for row in rows}
    lines = [line_of(*name, by_seed) for name in names]
    return stamped("What helps when looking closer", [*columns, ["s", "s"]], lines, [note], *stamp)


def line_of(share: str, scene: str, name: str, by_seed: dict[tuple[Any, ...], Row]) -> Row:
    """One line of the table."""
    seeds = sorted(place[3] for place in by_seed if place[:3] == (share, scene, name))
    own = [by_seed[share, scene, name, seed] for seed in seeds]
    line: Row = {"share": share, "scene": scene, "name": name, "seeds": len(seeds)}
    for key in FIGURES.values():
        known = [float(row[key]) for row in own if key in row]
        line[key] = spread_text(known if len(known) == len(own) else [], FORMS.get(key, ".2f"))
    pairs = [(row, by_seed[place]) for row in own if (place := (share, scene, BASE, row["seed"])) in by_seed]
    for key in COMPARED if name not in (BASE, MORE_STEPS) else ():
        gains = [float(row[key]) - float(base[key]) for row, base in pairs if key in row and key in base]
        line[f"more_{key}"] = spread_text(gains, f"+{FORMS.get(key, '.2f')}")
    return line | {"s": round(statistics.mean(float(row["s"]) for row in own))}


def spread_text(values: Sequence[float], form: str) -> str:
    """Mean ± half the range, both with the digits of the form; nothing of no values."""
    return told(values, form, form.removeprefix("+")) if values else ""


def main(words: Sequence[str]) -> None:
    """Train, look, and write each seed and the table."""
    given = arguments(words)
    machine, load = describe_machine(torch.device("cpu")), told_load()
    machine |= {"threads": 1} if given.jobs > 1 else {}
    read_rows(given.to)  # what cannot be added to is refused before training
    scenes, stamp = scenes_at_hand(given), (load, shown_command(words, "benchmarks/zoom_truth.py"))

    def measure(scene: str, seed: int) -> None:
        keep(measured(scene, seed, given), given, machine, stamp)

    with ThreadPoolExecutor(given.jobs) as pool:
        for task in [pool.submit(measure, scene, seed) for seed in given.seeds for scene in scenes]:
            task.result()  # raises what it raised
    print(text_table(table([row for row in read_rows(given.to) if row["share"] == f"{given.share:g}"], stamp)))


if __name__ == "__main__":
    main(sys.argv[1:])
