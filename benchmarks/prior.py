"""What a pretrained network adds to a model, on held-out true pixels: the tables of docs/explanation/priors.md.

    python benchmarks/prior.py --scenes FOLDER [--only fox,lego] [--seeds 0,1,2] [--rows 'none;photos, span'] [--jobs 2]

Scenes are those of benchmarks/zoom.py, and the built-in scene at mixed distances (`mixed`). Rows are those of
`gsx +experiment=prior_truth`, and `none, more steps`: the baseline by --more times the steps. Finished runs below
--runs are not trained again; --evaluate evaluates them anew. Figures of each run are kept in prior_cpu.json, and the
table is of all that are there. Needs gsx[upscalers,perceptual].
"""

import argparse
import statistics
import subprocess
import sys
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from importlib.resources import files
from pathlib import Path
from threading import Lock
from typing import Any

import torch
from omegaconf import OmegaConf

from gsx.core.files import read_json
from measuring.machine import commit, describe_machine, shown_command, told_load
from measuring.results import Section, read_sections, stamped, text_table, write_results
from measuring.runs import gsx
from zoom import SUBJECTS, scenes_at_hand, shared_arguments, steps_among, trained

FILE, RUNS, TABLE, GAINS = "prior_cpu", "runs", "table", "gains"
"""Name of the results, and of their sections."""
BASE, MORE = "none", "none, more steps"
"""Row that others are compared with, and the same with more steps."""
SCENES = ",".join(SUBJECTS)
PERCEPTUAL = "metrics.perceptual=[st_lpips_alex]"
"""Override of an evaluation: runs of older revisions measure none."""
FIGURES = {
    "x1": (".2f", ("psnr",)),
    "x2": (".2f", ("zoom", "2", "psnr")),
    "x4": (".2f", ("zoom", "4", "psnr")),
    "detail2": (".3f", ("zoom", "2", "detail", "render", "explained")),
    "detail4": (".3f", ("zoom", "4", "detail", "render", "explained")),
    "st_lpips4": (".3f", ("zoom", "4", "perceptual", "st_lpips_alex", "render")),
    "upscaled4": (".2f", ("zoom", "4", "upscaled_psnr")),
    "upscaled_st_lpips4": (".3f", ("zoom", "4", "perceptual", "st_lpips_alex", "upscaled")),
    "agree4": (".2f", ("zoom", "4", "consistency", "render")),
    "upscaled_agree4": (".2f", ("zoom", "4", "consistency", "upscaled")),
    "along4": (".3f", ("zoom", "4", "consistency", "detail", "render")),
    "upscaled_along4": (".3f", ("zoom", "4", "consistency", "detail", "upscaled")),
    "primitives": (",.0f", ("primitives",)),
    "s": (".0f", ("train_seconds",)),
}
"""Format of each figure, and its place in evaluation.json."""
HEADINGS = {
    "detail2": "detail x2",
    "detail4": "detail x4",
    "st_lpips4": "ST-LPIPS x4",
    "upscaled4": "x1 enlarged by SPAN, x4",
    "upscaled_st_lpips4": "its ST-LPIPS",
    "agree4": "consistency x4, dB",
    "upscaled_agree4": "that of x1 by SPAN",
    "along4": "correlation of detail x4",
    "upscaled_along4": "that of x1 by SPAN",
}
RATIOS = ("detail4", "st_lpips4", "s")
"""Figures whose gains are ratios."""
Row = dict[str, Any]
"""Figures of one run, or a line of a table."""
KEEPING = Lock()
"""One run is written at a time."""


def arguments(words: Sequence[str]) -> argparse.Namespace:
    """Parses the command line."""
    parser = shared_arguments(__doc__, SCENES, "outputs/prior")
    parser.add_argument("--rows", default="", help="rows of the experiment, separated by semicolons; none: all")
    parser.add_argument("--more", type=float, default=2.4, help="steps of the row with more steps (2.4 times)")
    parser.add_argument("--evaluate", action="store_true", help="evaluate finished runs anew")
    return parser.parse_args(words)


def rows_of(given: argparse.Namespace) -> dict[str, str]:
    """Returns the overrides of the chosen rows."""
    config: Any = OmegaConf.load(str(files("gsx.conf") / "experiment" / "prior_truth.yaml"))
    rows = {str(name): str(words) for name, words in config.rows.items()}
    rows[MORE] = rows[BASE]
    chosen = [name.strip() for name in given.rows.split(";")] if given.rows else list(rows)
    if unknown := [name for name in chosen if name not in rows]:
        sys.exit(f"--rows {'; '.join(unknown)}: choose from {'; '.join(rows)}")
    return {name: rows[name] for name in chosen}


# -- runs --------------------------------------------------------------------------------------------------------------


def measured(scene: str, seed: int, name: str, words: str, given: argparse.Namespace) -> Row:
    """Trains a run unless it is there, and returns its figures."""
    overrides = words.split()
    if name == MORE:
        overrides.append(f"iterations={round(given.more * steps_among(SUBJECTS[scene]))}")
    folder = trained(scene, seed, given, overrides, name)
    if given.evaluate:
        gsx(
            ["eval", str(folder), PERCEPTUAL],
            {"OMP_NUM_THREADS": "1"} if given.jobs > 1 else {},
            folder.with_suffix(".eval.log"),
        )
    return {"scene": scene, "name": name, "seed": seed} | figures(folder) | {"commit": commit()}


def figures(folder: Path) -> Row:
    """Returns the figures of a run that its evaluation has."""
    evaluation = read_json(folder / "evaluation.json")
    found = {key: value_at(evaluation, path) for key, (_, path) in FIGURES.items()}
    return {key: value for key, value in found.items() if value is not None}


def value_at(node: Any, path: Sequence[str]) -> float | None:
    """Returns the number at a path of keys; None: there is none."""
    for key in path:
        node = node.get(key) if isinstance(node, Mapping) else None
    return None if node is None else float(node)


def place_of(row: Row) -> tuple[Any, ...]:
    """Returns what identifies a run."""
    return row["scene"], row["name"], row["seed"]


def keep(row: Row, given: argparse.Namespace, machine: dict[str, Any], stamp: Sequence[Any]) -> None:
    """Writes a run's figures in place of earlier ones, and the tables of all that are there then."""
    with KEEPING:
        kept = {place_of(one): one for one in read_rows(given.to)} | {place_of(row): row}
        rows = [kept[place] for place in sorted(kept)]
        sections = {RUNS: section_of_runs(rows, stamp), TABLE: table(rows, stamp), GAINS: gains(rows, stamp)}
        write_results(given.to, FILE, machine, sections)


def read_rows(folder: Path) -> list[Row]:
    """Reads the kept figures."""
    sections = read_sections(folder / f"{FILE}.json")
    return sections[RUNS]["rows"] if RUNS in sections else []


# -- tables ------------------------------------------------------------------------------------------------------------


def section_of_runs(rows: list[Row], stamp: Sequence[Any]) -> Section:
    """Returns the table of single runs."""
    keys = ["scene", "name", "seed", *FIGURES, "commit"]
    return stamped("Runs", [[key, HEADINGS.get(key, key)] for key in keys], rows, ["One run a line."], *stamp)


def groups_of(rows: Sequence[Row]) -> dict[tuple[str, str], dict[int, Row]]:
    """Groups runs by scene and row, then by seed."""
    out: dict[tuple[str, str], dict[int, Row]] = {}
    for row in rows:
        out.setdefault((row["scene"], row["name"]), {})[row["seed"]] = row
    return out


def table(rows: Sequence[Row], stamp: Sequence[Any]) -> Section:
    """Returns means over seeds, with half of their range."""
    lines = [
        {"scene": scene, "name": name, "seeds": len(by_seed)}
        | {key: spread([one.get(key) for one in by_seed.values()], form) for key, (form, _) in FIGURES.items()}
        for (scene, name), by_seed in groups_of(rows).items()
    ]
    columns = [
        ["scene", "scene"],
        ["name", "row"],
        ["seeds", "seeds"],
        *[[key, HEADINGS.get(key, key)] for key in FIGURES],
    ]
    note = "Held-out views against true pixels: means over seeds ± half their range. s: of training."
    return stamped("What a prior brings", columns, lines, [note], *stamp)


def gains(rows: Sequence[Row], stamp: Sequence[Any]) -> Section:
    """Returns differences from the baseline, seed by seed: their mean and half of their range."""
    groups = groups_of(rows)
    lines = []
    for (scene, name), by_seed in groups.items():
        base = groups.get((scene, BASE), {})
        pairs = [(one, base[seed]) for seed, one in by_seed.items() if seed in base]
        if name != BASE and pairs:
            lines.append({"scene": scene, "name": name, "seeds": len(pairs)} | line_of(pairs))
    columns = [
        ["scene", "scene"], ["name", "row"], ["seeds", "seeds"], ["x1", "x1, dB"], ["x2", "x2, dB"], ["x4", "x4, dB"],
        ["detail4", "detail x4, times"], ["st_lpips4", "ST-LPIPS x4, times"], ["s", "seconds, times"],
        ["over_upscaled", "x4 over x1 by SPAN, dB"], ["over_agree", "consistency over it, dB"],
    ]  # fmt: skip
    note = "Each seed against the same seed of the row `none`: means ± half the range of the seeds."
    return stamped("Gains over no prior", columns, lines, [note], *stamp)


def line_of(pairs: Sequence[tuple[Row, Row]]) -> Row:
    """Returns the gains of a row from pairs of (run, baseline)."""
    own = [one for one, _ in pairs]
    return (
        {key: spread([less(a.get(key), b.get(key)) for a, b in pairs], "+.2f") for key in ("x1", "x2", "x4")}
        | {key: spread([over(a.get(key), b.get(key)) for a, b in pairs], ".2f") for key in RATIOS}
        | {"over_upscaled": spread([less(a.get("x4"), a.get("upscaled4")) for a in own], "+.2f")}
        | {"over_agree": spread([less(a.get("agree4"), a.get("upscaled_agree4")) for a in own], "+.2f")}
    )


def less(value: float | None, other: float | None) -> float | None:
    """Returns the difference of two figures; None where one is missing."""
    return None if value is None or other is None else value - other


def over(value: float | None, other: float | None) -> float | None:
    """Returns the ratio of two figures; None where one is missing or the second is not above 0."""
    return None if value is None or other is None or other <= 0 else value / other


def spread(values: Sequence[float | None], form: str) -> str:
    """Formats the mean ± half the range; empty where a value is missing."""
    known = [value for value in values if value is not None]
    if not known or len(known) < len(values):
        return ""
    half = f" ± {(max(known) - min(known)) / 2:{form.removeprefix('+')}}" if len(known) > 1 else ""
    return f"{statistics.mean(known):{form}}{half}"


def main(words: Sequence[str]) -> None:
    """Trains, evaluates, and writes each run and the tables."""
    given = arguments(words)
    machine, load = describe_machine(torch.device("cpu")), told_load()
    machine |= {"threads": 1} if given.jobs > 1 else {}
    read_rows(given.to)  # what cannot be added to is refused before training
    stamp, rows = (load, shown_command(words, "benchmarks/prior.py")), rows_of(given)

    def measure(scene: str, seed: int, name: str) -> None:
        try:
            keep(measured(scene, seed, name, rows[name], given), given, machine, stamp)
        except subprocess.CalledProcessError as error:
            print(f"{scene}, {name}, seed {seed} failed: {error}", flush=True)

    tasks = [(scene, seed, name) for seed in given.seeds for scene in scenes_at_hand(given) for name in rows]
    with ThreadPoolExecutor(given.jobs) as pool:
        for task in [pool.submit(measure, *task) for task in tasks]:
            task.result()  # raises what it raised
    print(text_table(gains(read_rows(given.to), stamp)))


if __name__ == "__main__":
    main(sys.argv[1:])
