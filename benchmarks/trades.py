"""Measure what settings of training and of the rasterizer cost and bring (docs/benchmarks/settings.md).

    python benchmarks/trades.py [--scenes FOLDER] [--only demo,fox,lego] [--seeds 0,1] [--jobs 2]
    python benchmarks/trades.py --what rasterizer [--run RUN] [rasterizer.KEY=VALUE ...]

FOLDER holds `fox` (COLMAP) and `lego` (NeRF-Synthetic). Runs that are finished below --runs are not trained again.
`--page-only` writes the page anew from the committed figures. Half an hour of a core for a scene and a seed.
`rasterizer` changes one setting of the rasterizer at a time, on test views of a run, else on random splats.
"""

import argparse
import statistics
import subprocess
import sys
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import torch

from capacity import ADAPTIVE, SUBJECTS, ZOOMS, scenes_of
from gsx.core.files import replace_text
from gsx.experiments.reports.charts import pareto_front
from gsx.experiments.runs.build import choose_device
from measuring.adapter import missing, settings_of
from measuring.knobs import COLUMNS as KNOB_COLUMNS
from measuring.knobs import NOTE as KNOB_NOTE
from measuring.knobs import knob_rows, shots_of
from measuring.machine import describe_machine, shown_command, told_load
from measuring.results import Section, cell, read_sections, stamped, text_table, write_results
from measuring.runs import train
from measuring.watches import Patience
from zoom import shared_arguments, steps_among, told

PAGE = Path(__file__).parents[1] / "docs" / "benchmarks" / "settings.md"
TITLES = {"demo": "The built-in scene", "fox": "fox, an eighth", "lego": "lego, a quarter"}
HALF, TWICE = "half the steps", "twice the steps"
TRADES: dict[str, dict[str, tuple[str, ...]]] = {
    "primitives": {
        "published growth": ("backbone.capacity=published",),
        "adaptive, price 0.3": ("backbone.adaptive.price=0.3",),
        "adaptive, price 2": ("backbone.adaptive.price=2",),
    },
    "steps": {
        HALF: (),
        "faster rates": ("backbone.rates.shortened=0.4",),
        "cooled down": ("training.cooldown=0.2",),
    },
    "resolution": {
        "coarse to fine": ("training.coarse_to_fine.factor=2", "training.coarse_to_fine.until=0.3"),
        "supersampled at last": ("training.supersampling.factor=2", "training.supersampling.start=0.8"),
    },
    "filter": {"mip": ("backbone.filter=mip",)},
    "colour": {"SH degree 1": ("backbone.sh_degree=1",)},
    "bands": {"SH bands judged": ("backbone.sh_judged=0.8", "backbone.sh_price=0.2")},
    "levels": {"octree": ("backbone=octree_gs3d",)},
    "more steps": {TWICE: ()},
    "pseudo details": {"upscaled by Lanczos": ("augmenter=[upscale]", "regenerator/upscale=lanczos")},
}
"""What each setting adds to the composition, by what is traded."""
LENGTHS = {HALF: 0.5, TWICE: 2.0}
"""Times the steps of the composition."""
GIVEN = "as given"
COLUMNS = [
    *(["setting", "setting"], ["overrides", "overrides"]),
    *(column for f in ZOOMS for column in ([f"x{f}", f"x{f}"], [f"more{f}", f"x{f} - as given"])),
    *(["primitives", "primitives"], ["megabytes", "MB"], ["seconds", "training s"], ["times", "of as given"]),
    ["front", "best for its"],
]
PAGE_COLUMNS = {
    "setting": "setting",
    "x1": "x1",
    "more1": "x1 - base",
    "more2": "x2 - base",
    "more4": "x4 - base",
    "primitives": "primitives",
    "megabytes": "MB",
    "times": "time, of base",
    "front": "best for its",
}
"""Headings of the page by column."""
NOTE = (
    "PSNR on held-out views, dB, means over seeds ± half their range; differences seed by seed, times are those of the "
    "last seed. MB of the standard splat file. Best: nothing else is at least as good at x4 for no more."
)
Evaluation = Mapping[str, Any]


def arguments(words: Sequence[str]) -> argparse.Namespace:
    """The command line."""
    parser = shared_arguments(__doc__, ",".join(TITLES), "outputs/trades")
    parser.set_defaults(seeds=[0, 1])
    parser.add_argument("--what", default="training", choices=("training", "rasterizer"), help="what is traded")
    parser.add_argument("--trades", default=",".join(TRADES), help="of a training, by commas (all)")
    parser.add_argument("--run", type=Path, help="rasterizer: run folder (random splats)")
    parser.add_argument("--paths", default="eager,compiled", help="rasterizer: by commas (both, where they work)")
    parser.add_argument("--device", default="cpu", help="rasterizer: cpu or cuda (cpu)")
    parser.add_argument("--views", type=int, default=2, help="rasterizer: test views of the run (2)")
    parser.add_argument("--repeats", type=int, default=7, help="rasterizer: rounds of timing (7)")
    parser.add_argument("--quick", action="store_true", help="rasterizer: tiny sizes, to see that everything works")
    parser.add_argument("--page", type=Path, default=PAGE, help="the page to write")
    parser.add_argument("--page-only", action="store_true", help="measure nothing")
    parser.add_argument("overrides", nargs="*", help="rasterizer: base settings, rasterizer.KEY=VALUE")
    given = parser.parse_intermixed_args(words)
    for trade in given.trades.split(","):
        if trade not in TRADES:
            parser.error(f"'{trade}' is no trade: choose from {', '.join(TRADES)}")
    return given


# -- the rasterizer --------------------------------------------------------------------------------------------------


def trade_rasterizer(given: argparse.Namespace, command: str) -> None:
    """Measure every setting of the rasterizer, print and write the table."""
    device, load = choose_device(given.device), told_load()
    path = [] if any(word.startswith("rasterizer.path=") for word in given.overrides) else ["rasterizer.path=eager"]
    base = settings_of("auto", *path, *given.overrides)
    shots, name = shots_of(given.run, given.views, given.quick, device)
    paths = [path for path in given.paths.split(",") if not missing(path, device)]
    rows = knob_rows(shots, base, paths, Patience(2 if given.quick else given.repeats, 600))
    section = stamped("Settings of the rasterizer", KNOB_COLUMNS, rows, [f"{name}. {KNOB_NOTE}"], load, command)
    result = f"trades_rasterizer_{device.type}{'_quick' if given.quick else ''}"
    write_results(given.to, result, describe_machine(device), {"settings": section})
    sys.stdout.write(text_table(section))


# -- training --------------------------------------------------------------------------------------------------------


def settings_of_trades(trades: str, iterations: int) -> dict[str, list[str]]:
    """Overrides by the name of a setting; the composition as given comes first."""
    out: dict[str, list[str]] = {GIVEN: []}
    for trade in trades.split(","):
        for name, words in TRADES[trade].items():
            length = [f"iterations={round(LENGTHS[name] * iterations)}"] if name in LENGTHS else []
            out[name] = [*words, *length]
    return out


def trained(scene: str, name: str, words: Sequence[str], given: argparse.Namespace) -> list[Evaluation]:
    """Evaluations of a setting by seed; none where the setting does not suit the scene."""
    where = [] if scene == "demo" else [f"scene.path={given.scenes / scene}"]
    threads = {"OMP_NUM_THREADS": "1"} if given.jobs > 1 else {}
    out = list[Evaluation]()
    for seed in given.seeds:
        folder = given.runs / scene / f"{name.replace(',', '').replace(' ', '_')}_{seed}"
        zooms = f"eval.zoom=[{','.join(ZOOMS)}]"
        composition = ["backbone=gs3d", ADAPTIVE, *SUBJECTS[scene], *where, zooms, f"seed={seed}", *words]
        folder.parent.mkdir(parents=True, exist_ok=True)
        try:
            out.append(train(folder, composition, threads, folder.with_name(f"{folder.name}.log")))
        except subprocess.CalledProcessError:
            if name == GIVEN:
                raise
            print(f"{scene}: '{name}' cannot be trained, see {folder.name}.log", file=sys.stderr)
            return []
    return out


def measured(given: argparse.Namespace) -> dict[str, list[dict[str, Any]]]:
    """Rows by scene."""
    listed = {scene: settings_of_trades(given.trades, steps_among(SUBJECTS[scene])) for scene in scenes_of(given)}
    with ThreadPoolExecutor(given.jobs) as pool:
        jobs = {
            scene: {name: pool.submit(trained, scene, name, words, given) for name, words in settings.items()}
            for scene, settings in listed.items()
        }
        found = {scene: {name: job.result() for name, job in named.items()} for scene, named in jobs.items()}
    return {scene: rows_of(found[scene], settings) for scene, settings in listed.items()}


def rows_of(found: Mapping[str, Sequence[Evaluation]], settings: Mapping[str, list[str]]) -> list[dict[str, Any]]:
    """Rows of a scene, without settings that could not be trained."""
    runs = {name: evaluations for name, evaluations in found.items() if evaluations}
    fronts = fronts_of(list(runs.values()))
    rows = []
    for index, (name, own) in enumerate(runs.items()):
        words = {"setting": name, "overrides": " ".join(f"`{word}`" for word in settings[name])}
        front = ", ".join(unit for unit, best in fronts.items() if index in best)
        rows.append(words | row_of(own, runs[GIVEN]) | {"front": front})
    return rows


def row_of(runs: Sequence[Evaluation], first: Sequence[Evaluation]) -> dict[str, Any]:
    """Figures of a setting over seeds, and differences from the composition as given."""
    row: dict[str, Any] = {}
    for zoom in ZOOMS:
        values, others = ([run["zoom"][zoom]["psnr"] for run in group] for group in (runs, first))
        row[f"x{zoom}"] = told(values, ".2f")
        if runs is not first:
            row[f"more{zoom}"] = told([a - b for a, b in zip(values, others, strict=True)], "+.2f")
    row["primitives"] = round(statistics.mean(run["primitives"] for run in runs))
    row["megabytes"] = f"{statistics.mean(run['megabytes'] for run in runs):.1f}"
    row["seconds"] = round(runs[-1]["train_seconds"])
    row["times"] = f"{runs[-1]['train_seconds'] / first[-1]['train_seconds']:.2f}"
    return row


def fronts_of(settings: Sequence[Sequence[Evaluation]]) -> dict[str, list[int]]:
    """Indices of the settings that none beats at the finest zoom, for the time of the last seed and for the size."""
    gains = [statistics.mean(run["zoom"][ZOOMS[-1]]["psnr"] for run in runs) for runs in settings]
    costs = {
        "time": [runs[-1]["train_seconds"] for runs in settings],
        "MB": [statistics.mean(run["megabytes"] for run in runs) for runs in settings],
    }
    return {unit: pareto_front(values, gains) for unit, values in costs.items()}


def trade_training(given: argparse.Namespace, command: str) -> None:
    """Train every setting on every scene and write the tables."""
    machine, load = describe_machine(torch.device("cpu")), told_load()
    machine |= {"threads": 1} if given.jobs > 1 else {}
    notes = [f"{NOTE} Seeds: {', '.join(map(str, given.seeds))}."]
    tables = {
        scene: stamped(TITLES[scene], COLUMNS, rows, notes, load, command) for scene, rows in measured(given).items()
    }
    write_results(given.to, "trades_cpu", machine, tables)


# -- the page --------------------------------------------------------------------------------------------------------


def page(text: str, sections: Mapping[str, Section]) -> str:
    """Replace the tables of the page: each follows a comment that names its scene, up to a blank line."""
    for scene, section in sections.items():
        mark = f"<!-- {scene}: written by benchmarks/trades.py -->\n"
        before, after = text.split(mark)
        text = before + mark + table(section) + after[after.index("\n\n") :]
    return text


def table(section: Section) -> str:
    """Returns the rows with the columns of the page."""
    rows = [{**section["rows"][0], "setting": "base"}, *section["rows"][1:]]
    lines = [[cell(row.get(key)) for key in PAGE_COLUMNS] for row in rows]
    table = [list(PAGE_COLUMNS.values()), ["---"] * len(PAGE_COLUMNS), *lines]
    return "\n".join(f"| {' | '.join(row)} |" for row in table)


def main(words: Sequence[str]) -> None:
    """Measure and write the tables and the page."""
    given, command = arguments(words), shown_command(words, "benchmarks/trades.py")
    if given.what == "rasterizer":
        trade_rasterizer(given, command)
        return
    read_sections(given.to / "trades_cpu.json")  # what cannot be added to is refused before training
    if not given.page_only:
        trade_training(given, command)
    replace_text(given.page, page(given.page.read_text(), read_sections(given.to / "trades_cpu.json")))


if __name__ == "__main__":
    main(sys.argv[1:])
