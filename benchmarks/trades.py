"""What a training costs and brings by its settings, on several scenes: `gsx trade training`, and docs/trade-offs.md.

    python benchmarks/trades.py [--scenes FOLDER] [--only demo,fox,lego] [--seeds 0,1] [--jobs 2]

FOLDER holds `fox` (COLMAP) and `lego` (NeRF-Synthetic). Runs that are finished below --runs are not trained again.
`--page-only` writes the page anew from the committed figures. Half an hour of a core for a scene and a seed.
"""

import argparse
import statistics
import sys
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import torch

from capacity import ADAPTIVE, RESULTS, SUBJECTS, ZOOMS, scenes_of
from gsx.core.files import read_json, replace_text
from gsx.experiments.reports.charts import pareto_front
from measuring.machine import describe_machine, shown_command, told_load
from measuring.results import Section, cell, read_sections, stamped, write_results
from measuring.runs import gsx
from zoom import numbers, told

PAGE = Path(__file__).parents[1] / "docs" / "trade-offs.md"
TITLES = {"demo": "The built-in scene", "fox": "fox, an eighth", "lego": "lego, a quarter"}
COLUMNS = [
    *(["setting", "setting"], ["overrides", "overrides"]),
    *(column for f in ZOOMS for column in ([f"x{f}", f"x{f}"], [f"more{f}", f"x{f} - as given"])),
    *(["primitives", "primitives"], ["megabytes", "MB"], ["seconds", "training s"], ["times", "of as given"]),
    ["front", "best for its"],
]
SHOWN = ("setting", "x1", "more1", "more2", "more4", "primitives", "megabytes", "times", "front")
"""Columns of the page."""
NOTE = (
    "PSNR on held-out views, dB, means over seeds ± half their range; differences seed by seed, times are those of the "
    "last seed. MB of the standard splat file. Best: nothing else is at least as good at x4 for no more."
)


def arguments(words: Sequence[str]) -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", type=Path, default=None, help="the folder with the captures")
    parser.add_argument("--only", default=",".join(TITLES), help="scenes, by commas")
    parser.add_argument("--seeds", type=numbers, default=[0, 1], help="by commas (0,1)")
    parser.add_argument("--trades", default="", help="of conf/trade, by commas (all)")
    parser.add_argument("--combinations", type=int, default=1, help="of good settings, at most (1)")
    parser.add_argument("--jobs", type=int, default=1, help="commands at a time")
    parser.add_argument("--runs", type=Path, default=Path("outputs/trades"), help="where the runs are kept")
    parser.add_argument("--to", type=Path, default=RESULTS, help="folder of the tables")
    parser.add_argument("--page", type=Path, default=PAGE, help="the page to write")
    parser.add_argument("--page-only", action="store_true", help="measure nothing")
    return parser.parse_args(words)


def words_of(scene: str, seeds: Sequence[int], combinations: int, given: argparse.Namespace) -> list[str]:
    """The command for a scene."""
    where = [] if scene == "demo" else [f"scene.path={given.scenes / scene}"]
    trades = ["--trades", given.trades] if given.trades else []
    asked = ["--seeds", ",".join(map(str, seeds)), "--combinations", str(combinations), *trades]
    zooms = f"eval.zoom=[{','.join(ZOOMS)}]"
    return ["trade", "training", "backbone=gs3d", ADAPTIVE, *SUBJECTS[scene], *where, zooms, *asked]


def tried(scene: str, seeds: Sequence[int], combinations: int, given: argparse.Namespace) -> dict[str, Any]:
    """trade.json of a scene with these seeds; runs of all seeds lie in one folder."""
    folder, name = given.runs / scene, "_".join([scene, *map(str, seeds)])
    folder.mkdir(parents=True, exist_ok=True)
    threads = {"OMP_NUM_THREADS": "1"} if given.jobs > 1 else {}
    words = words_of(scene, seeds, combinations, given)
    gsx([*words, "--to", str(folder)], threads, given.runs / f"{name}.log")
    return read_json(folder / "trade.json")


def measured(given: argparse.Namespace) -> dict[str, dict[str, Any]]:
    """trade.json by scene: first the settings with every seed, each on its own, then all together with combinations."""
    scenes = scenes_of(given)
    with ThreadPoolExecutor(given.jobs) as pool:
        for done in [pool.submit(tried, scene, [seed], 0, given) for seed in given.seeds for scene in scenes]:
            done.result()
        whole = {scene: pool.submit(tried, scene, given.seeds, given.combinations, given) for scene in scenes}
        return {scene: found.result() for scene, found in whole.items()}


def row_of(row: Mapping[str, Any], first: Mapping[str, Any]) -> dict[str, Any]:
    """A setting over seeds, beside the composition as given."""
    runs, pairs = row["outcomes"], list(zip(row["outcomes"], first["outcomes"], strict=True))
    shown: dict[str, Any] = {
        "setting": row["setting"]["name"],
        "overrides": " ".join(f"`{w}`" for w in row["overrides"]),
    }
    for zoom in ZOOMS:
        shown[f"x{zoom}"] = told([run["psnr"][zoom] for run in runs], ".2f")
        if row is not first:
            shown[f"more{zoom}"] = told([a["psnr"][zoom] - b["psnr"][zoom] for a, b in pairs], "+.2f")
    shown["primitives"] = round(statistics.mean(run["primitives"] for run in runs))
    shown["megabytes"] = f"{statistics.mean(run['megabytes'] for run in runs):.1f}"
    shown["seconds"] = round(runs[-1]["seconds"])
    shown["times"] = f"{runs[-1]['seconds'] / first['outcomes'][-1]['seconds']:.2f}"
    return shown


def rows_of(found: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Rows of a scene, without what does not go there."""
    rows = [row for row in found["rows"] if row["outcomes"]]
    fronts = fronts_of(rows)
    return [
        row_of(row, rows[0]) | {"front": ", ".join(unit for unit, front in fronts.items() if number in front)}
        for number, row in enumerate(rows)
    ]


def fronts_of(rows: Sequence[Mapping[str, Any]]) -> dict[str, list[int]]:
    """Numbers of the rows that none beats at the finest zoom, for its time with the last seed, and for its size."""
    gains = [statistics.mean(run["psnr"][ZOOMS[-1]] for run in row["outcomes"]) for row in rows]
    costs = {
        "time": [row["outcomes"][-1]["seconds"] for row in rows],
        "MB": [statistics.mean(run["megabytes"] for run in row["outcomes"]) for row in rows],
    }
    return {unit: pareto_front(values, gains) for unit, values in costs.items()}


# -- the page ----------------------------------------------------------------------------------------------------------


def page(text: str, sections: Mapping[str, Section]) -> str:
    """docs/trade-offs.md with its tables anew: each stands below a comment that names its scene, up to a blank line."""
    for scene, section in sections.items():
        mark = f"<!-- {scene}: written by benchmarks/trades.py -->\n"
        before, after = text.split(mark)
        text = before + mark + table(section) + after[after.index("\n\n") :]
    return text


def table(section: Section) -> str:
    """For people."""
    headings = dict(section["columns"])
    lines = [[cell(row.get(key)) for key in SHOWN] for row in section["rows"]]
    table = [[headings[key] for key in SHOWN], ["---"] * len(SHOWN), *lines]
    return "\n".join(f"| {' | '.join(row)} |" for row in table)


def main(words: Sequence[str]) -> None:
    """Measure and write the tables and the page."""
    given = arguments(words)
    read_sections(given.to / "trades_cpu.json")  # what cannot be added to is refused before training
    if not given.page_only:
        machine, load = describe_machine(torch.device("cpu")), told_load()
        machine |= {"threads": 1} if given.jobs > 1 else {}
        command, notes = (
            shown_command(words, "benchmarks/trades.py"),
            [f"{NOTE} Seeds: {', '.join(map(str, given.seeds))}."],
        )
        tables = {
            scene: stamped(TITLES[scene], COLUMNS, rows_of(found), notes, load, command)
            for scene, found in measured(given).items()
        }
        write_results(given.to, "trades_cpu", machine, tables)
    replace_text(given.page, page(given.page.read_text(), read_sections(given.to / "trades_cpu.json")))


if __name__ == "__main__":
    main(sys.argv[1:])
