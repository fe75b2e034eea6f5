"""How well `minutes=N` keeps its time, and the cost model of a step fitted to the same runs.

    python benchmarks/minutes.py --scenes FOLDER [--only fox_4,demo] [--minutes 2,5,10] [--backbones gs3d_zoom] [--cold]

Each run is `gsx ... minutes=N` as a user starts it, on an idle machine, one after the other. --cold: with an empty
cache. Finished runs below --runs are not trained again. Figures of each run are kept in minutes_cpu.json.
"""

import argparse
import itertools
import math
import os
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch

from gsx.core.files import read_json
from gsx.experiments.minutes.cost import MILLION, plan_options
from gsx.experiments.run_folder.files import read_lines
from measuring.machine import commit, describe_machine, shown_command, told_load
from measuring.results import Section, read_sections, stamped, text_table, write_results
from measuring.runs import train, wall_seconds

FILE, ENDS, COST = "minutes_cpu", "ends", "cost"
"""Name of the results, and of their sections."""
RESULTS = Path(__file__).parent / "results"
SUBJECTS = {
    "fox_4": ("scene=colmap", "scene.path={fox}", "scene.downscale=4"),
    "fox": ("scene=colmap", "scene.path={fox}"),
    "lego_4": ("scene=blender", "scene.path={lego}", "scene.downscale=4"),
    "castle": ("scene=photos", "scene.path={castle}"),
    "castle_8": ("scene=photos", "scene.path={castle}", "scene.downscale=8"),
    "demo": ("scene=demo",),
    "room": ("scene=room",),
}
"""Words of each scene."""
COLUMNS = [
    *(["scene", "scene"], ["backbone", "backbone"], ["cache", "cache"], ["minutes", "minutes"], ["took", "took, s"]),
    *(["over", "took / limit"], ["before", "before the plan, s"], ["planned", "training planned, s"]),
    *(["trained", "training, s"], ["steps", "steps"], ["skipped", "steps skipped"], ["downscale", "downscale"]),
    *(["x1", "x1, dB"], ["primitives", "primitives"], ["commit", "commit"]),
]
Row = dict[str, Any]
"""Figures of one run."""


def arguments(words: Sequence[str]) -> argparse.Namespace:
    """Parses the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", type=Path, default=None, help="folder of the captures fox, lego and castle")
    parser.add_argument("--only", default="fox_4,lego_4,castle_8,demo,room", help="scenes")
    parser.add_argument("--minutes", default="2,5,10", help="times")
    parser.add_argument("--backbones", default="gs3d_zoom", help="backbones")
    parser.add_argument("--cold", action="store_true", help="with an empty cache")
    parser.add_argument("--runs", type=Path, default=Path("outputs/minutes"), help="folder of the runs")
    parser.add_argument("--to", type=Path, default=RESULTS, help="folder of the table")
    return parser.parse_args(words)


def words_of(scene: str, scenes: Path | None) -> list[str]:
    """Returns the words of a scene."""
    if scene not in SUBJECTS:
        sys.exit(f"--only {scene}: choose from {', '.join(SUBJECTS)}")
    paths = {name: str(scenes / name) if scenes else name for name in ("fox", "lego", "castle")}
    return [word.format(**paths) for word in SUBJECTS[scene]]


# -- runs --------------------------------------------------------------------------------------------------------------


def measured(scene: str, backbone: str, minutes: float, options: argparse.Namespace) -> Row:
    """Trains a run unless it is there, and returns its figures."""
    cache = "cold" if options.cold else "warm"
    folder = options.runs / f"{scene}_{backbone}_{minutes:g}_{cache}"
    words = [*words_of(scene, options.scenes), f"backbone={backbone}", f"minutes={minutes:g}"]
    with tempfile.TemporaryDirectory() as empty:
        keys = ("GSX_CACHE", "TMPDIR", "TORCHINDUCTOR_CACHE_DIR") if options.cold else ()
        places = dict.fromkeys(keys, empty)
        train(folder, words, places, folder.with_suffix(".log"))
    return {"scene": scene, "backbone": backbone, "cache": cache, "minutes": minutes} | figures(folder)


def figures(folder: Path) -> Row:
    """Returns the figures of a finished run."""
    evaluation, plan = read_json(folder / "evaluation.json"), plan_of(folder)
    took, skipped = wall_seconds(folder), skipped_steps(folder)
    return {
        "took": took,
        "over": None if took is None else took / plan["limit_s"],
        "before": plan["before_s"],
        "planned": plan["training_s"],
        "trained": evaluation["train_seconds"],
        "steps": plan["steps"],
        "skipped": len(skipped),
        "downscale": plan["downscale"],
        "x1": evaluation["psnr"],
        "primitives": evaluation["primitives"],
        "commit": commit(),
    }


def skipped_steps(folder: Path) -> set[int]:
    """Returns the steps that a late run skipped."""
    late = [round(step) for step in read_json(folder / "evaluation.json").get("late", [])]
    return {step for first, last in zip(late[::2], late[1::2], strict=True) for step in range(first, last + 1)}


def plan_of(folder: Path) -> dict[str, Any]:
    """Returns what a run says of its plan."""
    plan: dict[str, Any] = read_json(folder / "environment.json")["minutes"]
    return plan


# -- cost model --------------------------------------------------------------------------------------------------------


def observations(folder: Path) -> Iterator[tuple[float, float, float, float]]:
    """Yields (seconds, pixels, rows, measured seconds of a pixel) of a step between two lines of metrics.jsonl."""
    config, plan = read_json_of(folder), plan_of(folder)
    measurement, pixels = plan["measurement"], pixels_of(folder)
    lasting = plan_options().cost.of(measurement["device"]).random if measurement["random"] else 1.0
    lines = [line for line in read_lines(folder / "metrics.jsonl", {}) if "late_from" not in line]
    skipped = skipped_steps(folder)
    for before, after in itertools.pairwise(lines):
        steps = len(set(range(before["step"] + 1, after["step"] + 1)) - skipped)
        if steps >= 5:
            scale = scale_at(config, after["step"])
            seconds = (after["seconds"] - before["seconds"]) / steps
            yield seconds, pixels * scale**2, after["primitives"], lasting * measurement["megapixel"] / MILLION


def read_json_of(folder: Path) -> Mapping[str, Any]:
    """Returns the settings of a run."""
    from omegaconf import OmegaConf

    config: Any = OmegaConf.to_container(OmegaConf.load(folder / "config.yaml"))
    return config


def pixels_of(folder: Path) -> float:
    """Returns the pixels of a training view of a run."""
    plan = plan_of(folder)
    measurement = plan["measurement"]
    return float(measurement["pixels"] * (measurement["downscale"] / plan["downscale"]) ** 2)


def scale_at(config: Mapping[str, Any], step: int) -> float:
    """Returns the sides of the renders of a step, of those of photos."""
    training, share = config["training"], step / config["iterations"]
    coarse, fine = training["coarse_to_fine"], training["supersampling"]
    if coarse["factor"] > 1 and share <= coarse["until"]:
        halvings = math.floor(math.log2(coarse["factor"]) * share / coarse["until"])
        return 1.0 / (coarse["factor"] >> min(halvings, coarse["factor"].bit_length() - 2))
    return float(fine["factor"]) if fine["factor"] > 1 and share > fine["start"] else 1.0


def fitted(folders: Sequence[Path]) -> Row:
    """Fits base, pixels and rows of a step to runs by least squares on relative errors.

    Returns:
        `late` and `primitives` of conf/minutes.yaml, the base in ms, and the median relative error of a step.
    """
    values = torch.tensor([one for folder in folders for one in observations(folder)], dtype=torch.float64)
    seconds, pixels, rows, unit = values.unbind(1)
    design = torch.stack([torch.ones_like(seconds), pixels * unit, rows * unit], 1) / seconds[:, None]
    base, late, primitives = torch.linalg.lstsq(design, torch.ones_like(seconds)).solution.tolist()
    error = (design @ torch.tensor([base, late, primitives], dtype=torch.float64) - 1).abs()
    return {
        "late": late,
        "primitives": primitives,
        "base": 1000 * base,
        "error": float(error.median()),
        "steps": len(values),
    }


def cost_rows(rows: Sequence[Row], options: argparse.Namespace) -> list[Row]:
    """Returns the fitted cost model of each backbone over its warm runs."""
    out = []
    for backbone in sorted({row["backbone"] for row in rows}):
        folders = [
            folder
            for row in rows
            if row["backbone"] == backbone
            and (folder := options.runs / f"{row['scene']}_{backbone}_{row['minutes']:g}_{row['cache']}").is_dir()
        ]
        if folders:
            out.append({"backbone": backbone, "runs": len(folders)} | fitted(folders))
    return out


# -- tables ------------------------------------------------------------------------------------------------------------


def keep(row: Row, options: argparse.Namespace, stamp: Sequence[Any]) -> list[Section]:
    """Writes a run's figures in place of earlier ones, and the fitted cost model."""
    sections = read_sections(options.to / f"{FILE}.json")
    rows = sections[ENDS]["rows"] if ENDS in sections else []
    kept = {place_of(one): one for one in rows} | {place_of(row): row}
    rows = [kept[place] for place in sorted(kept)]
    note = "Wall time from the command to the end of the process. x1: held-out views."
    ends = stamped("Time kept", COLUMNS, rows, [note], *stamp)
    columns = [
        *(["backbone", "backbone"], ["runs", "runs"], ["steps", "lines"], ["base", "base, ms"], ["late", "late"]),
        *(["primitives", "primitives"], ["error", "median error"]),
    ]
    note = "Fitted to lines of metrics.jsonl of the runs above; late and primitives as in conf/minutes.yaml."
    cost = stamped("Cost of a step", columns, cost_rows(rows, options), [note], *stamp)
    write_results(options.to, FILE, describe_machine(torch.device("cpu")), {ENDS: ends, COST: cost})
    return [ends, cost]


def place_of(row: Row) -> tuple[Any, ...]:
    """Returns what identifies a run."""
    return row["scene"], row["backbone"], row["minutes"], row["cache"]


def main(words: Sequence[str]) -> None:
    """Trains, and writes each run and the tables."""
    options = arguments(words)
    os.environ.setdefault("OMP_NUM_THREADS", str(os.cpu_count()))
    stamp = told_load(), shown_command(words, "benchmarks/minutes.py")
    sections: list[Section] = []
    for scene in options.only.split(","):
        for backbone in options.backbones.split(","):
            for minutes in map(float, options.minutes.split(",")):
                sections = keep(measured(scene, backbone, minutes, options), options, stamp)
    print("\n".join(map(text_table, sections)))


if __name__ == "__main__":
    main(sys.argv[1:])
