"""Ways of looking closer at one trained model, on held-out true pixels: the tables of docs/zoom.md.

    python benchmarks/zoom.py --scenes FOLDER [--only fox,lego] [--seeds 3] [--jobs 2]

FOLDER holds `fox`, `desk_bottle` (COLMAP), `lego` (NeRF-Synthetic) and `castle` (photographs alone); without it only
the built-in scene is measured. Each scene is trained by plain 3D-GS, once with every seed, and drawn by every rule for
zoomed cameras: nothing is trained anew. Finished runs below --runs are not trained again. An hour on two cores.
"""

import argparse
import statistics
import sys
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import torch

from gsx.builtin import plugins
from gsx.core.files import read_json, write_json
from gsx.experiments.evaluation.evaluator import Evaluator
from gsx.experiments.runs.open import open_run
from measuring.machine import describe_machine, shown_command, told_load
from measuring.results import Section, read_sections, stamped, text_table, write_results
from measuring.runs import train

RESULTS = Path(__file__).parent / "results"
SUBJECTS = {
    "fox": ("scene=colmap", "scene.downscale=8", "iterations=1000"),
    "lego": ("scene=blender", "scene.downscale=4", "iterations=1200"),
    "desk_bottle": ("scene=colmap", "scene.downscale=8", "iterations=1000"),
    "castle": ("scene=photos", "scene.downscale=8", "iterations=800"),
    "demo": ("scene=demo", "iterations=900"),
}
RULES = ("none", "magnified", "resampled")
"""Values of backbone.filter that suit a model of plain 3D-GS."""
ZOOMS = ("1", "2", "4")


def arguments(words: Sequence[str]) -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", type=Path, default=None, help="the folder with the captures")
    parser.add_argument("--only", default=",".join(SUBJECTS), help="scenes, by commas")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--jobs", type=int, default=1, help="runs at a time")
    parser.add_argument("--runs", type=Path, default=Path("outputs/zoom"), help="where the runs are kept")
    parser.add_argument("--to", type=Path, default=RESULTS, help="folder of the tables")
    return parser.parse_args(words)


def folder_of(scene: str, seed: int, given: argparse.Namespace) -> Path:
    """Where a run is kept."""
    return given.runs / f"{scene}_{seed}"


def train_and_look(scene: str, seed: int, given: argparse.Namespace) -> None:
    """One model, and what it shows by every rule; what is there already is left alone."""
    where = () if scene == "demo" else (f"scene.path={given.scenes / scene}",)
    threads = {"OMP_NUM_THREADS": "1"} if given.jobs > 1 else {}
    folder = folder_of(scene, seed, given)
    print(time.strftime("%H:%M"), folder.name, flush=True)
    overrides = ["backbone=gs3d", *SUBJECTS[scene], *where, f"seed={seed}", f"eval.zoom=[{','.join(ZOOMS)}]"]
    train(folder, overrides, threads, folder.with_suffix(".log"))
    for rule in RULES:
        if not (folder / f"zoom_{rule}.json").is_file():
            run, settings = open_run(folder, plugins(), [f"backbone.filter={rule}"])
            write_json(folder / f"zoom_{rule}.json", Evaluator(run, settings.evaluation).evaluate()["zoom"])


def figure(shown: Sequence[dict[str, Any]], factor: str, *keys: str) -> list[float]:
    """One figure of every seed."""
    out = []
    for zoom in shown:
        value: Any = zoom[factor]
        for key in keys:
            value = value[key]
        out.append(value)
    return out


def told(values: Sequence[float], form: str) -> str:
    """Mean, ± half the range where there are several."""
    half = f" ± {(max(values) - min(values)) / 2:.2f}" if len(values) > 1 else ""
    return f"{statistics.mean(values):{form}}{half}"


def rows_of(scene: str, given: argparse.Namespace) -> list[dict[str, Any]]:
    """A line for every rule, over the seeds that are there."""
    rows = []
    for rule in RULES:
        paths = [folder_of(scene, seed, given) / f"zoom_{rule}.json" for seed in range(given.seeds)]
        shown = [read_json(path) for path in paths if path.is_file()]
        row: dict[str, Any] = {"scene": scene, "rule": rule, "seeds": len(shown)}
        for factor in ZOOMS if shown else ():
            own = figure(shown, factor, "psnr")
            row[f"x{factor}"] = told(own, ".2f")
            if factor != "1":
                enlarged = figure(shown, factor, "enlarged_psnr")
                row[f"over{factor}"] = told([a - b for a, b in zip(own, enlarged, strict=True)], "+.2f")
                row[f"photograph{factor}"] = told(figure(shown, factor, "photograph_psnr"), ".2f")
                for name in ("render", "enlarged", "photograph"):
                    share = figure(shown, factor, "detail", name, "explained")
                    row[f"{name}_detail{factor}"] = f"{statistics.mean(share):+.3f}"
        rows.append(row)
    return rows


def section(given: argparse.Namespace, rows: list[dict[str, Any]], load: float, command: str) -> Section:
    """The table of all scenes."""
    columns = [["scene", "scene"], ["rule", "backbone.filter"], ["seeds", "seeds"], ["x1", "x1"]]
    for factor in ZOOMS[1:]:
        columns += [[f"x{factor}", f"x{factor}"], [f"over{factor}", f"x{factor} - x1 enlarged"]]
        columns += [[f"photograph{factor}", f"photograph enlarged to x{factor}"]]
        columns += [[f"render_detail{factor}", f"detail x{factor}"]]
        columns += [[f"enlarged_detail{factor}", "of x1 enlarged"], [f"photograph_detail{factor}", "of the photograph"]]
    note = (
        "Plain 3D-GS trained by photographs alone, drawn by each rule; PSNR on held-out views and explained detail "
        "above the training Nyquist frequency, means over seeds ± half their range; differences seed by seed."
    )
    return stamped("Ways of looking closer", columns, rows, [note], load, command)


def main(words: Sequence[str]) -> None:
    """Train and look, and write the table."""
    given = arguments(words)
    machine, load = describe_machine(torch.device("cpu")), told_load()
    machine |= {"threads": 1} if given.jobs > 1 else {}
    read_sections(given.to / "zoom_cpu.json")  # what cannot be added to is refused before training
    unknown = [name for name in given.only.split(",") if name not in SUBJECTS]
    scenes = [name for name in given.only.split(",") if name == "demo" or given.scenes is not None]
    if unknown or not scenes:
        sys.exit(f"--only {given.only}: choose from {', '.join(SUBJECTS)}; all but demo need --scenes FOLDER")
    with ThreadPoolExecutor(given.jobs) as pool:
        for future in [pool.submit(train_and_look, s, seed, given) for seed in range(given.seeds) for s in scenes]:
            future.result()
    rows = [row for scene in scenes for row in rows_of(scene, given)]
    table = section(given, rows, load, shown_command(words, "benchmarks/zoom.py"))
    write_results(given.to, "zoom_cpu", machine, {"rules": table})
    print(text_table(table))


if __name__ == "__main__":
    main(sys.argv[1:])
