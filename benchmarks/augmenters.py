"""Pseudo details against their control on held-out true pixels: the tables of docs/benchmarks/pseudo-details.md.

    python benchmarks/augmenters.py [--scenes FOLDER] [--only fox] [--seeds 3] [--iterations 1000] [--jobs 2]

FOLDER holds `fox` (COLMAP), trained on at an eighth of its size; without it only the built-in scene is measured. Each
run is a process of its own, by the command line, with one thread where several run at a time; those found finished
below --runs are not trained again. Takes one to two hours on two cores.
"""

import argparse
import statistics
import sys
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from gsx.core.files import read_json
from measuring.machine import describe_machine, shown_command, told_load
from measuring.results import Section, read_sections, stamped, text_table, write_results
from measuring.runs import train

RESULTS = Path(__file__).parent / "results"
SUBJECTS = {
    "demo": ("scene=demo",),
    "fox": ("scene=colmap", "scene.downscale=8"),
}
ORACLE = ("augmenter=upscale", "regenerator/upscale=oracle")
PHOTOGRAPHS = ("augmenter=upscale", "augmenter.upscale.scales=[1]", "augmenter.upscale.gain=3")
"""Nothing zoomed: what squares do to the photographs themselves."""
BOTH = "augmenter=[upscale,bootstrap]"


@dataclass(frozen=True, kw_only=True)
class Family:
    """A composition without pseudo details, and what is added to it."""

    control: tuple[str, ...]
    added: dict[str, tuple[str, ...]]
    once: tuple[str, ...] = ()
    """Of `added`: for the first seed only."""


FAMILIES = {
    "gs3d": Family(
        control=("backbone=gs3d",),
        added={
            "upscale_paper": ("augmenter=upscale_paper",),
            "upscale": ("augmenter=upscale",),
            "upscale, lanczos": ("augmenter=upscale", "regenerator/upscale=lanczos"),
            "upscale, scales=[1]": PHOTOGRAPHS,
            "upscale, oracle": ORACLE,
        },
        once=("upscale_paper", "upscale, lanczos", "upscale, scales=[1]", "upscale, oracle"),
    ),
    "mip_splatting": Family(
        control=("backbone=mip_splatting",),
        added={"upscale": ("augmenter=upscale",), "upscale, oracle": ORACLE},
        once=("upscale", "upscale, oracle"),
    ),
    "octree_scaffold": Family(
        control=("backbone=octree_scaffold",),
        added={
            "upscale_paper + bootstrap": ("augmenter=[upscale_paper,bootstrap]",),
            "upscale + bootstrap": (BOTH,),
            "upscale": ("augmenter=upscale",),
            "upscale, oracle": ORACLE,
        },
        once=("upscale_paper + bootstrap", "upscale", "upscale, oracle"),
    ),
    "octree_scaffold preset=octree_zoom": Family(
        control=("backbone=octree_scaffold", "preset=octree_zoom", "training.supersampling.factor=1"),
        added={"upscale + bootstrap": (BOTH,)},
        once=("upscale + bootstrap",),
    ),
}


def arguments(words: Sequence[str]) -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", type=Path, default=None, help="the folder with fox")
    parser.add_argument("--only", default=",".join(SUBJECTS), help="scenes, by commas")
    parser.add_argument("--families", default=",".join(FAMILIES), help="compositions, by commas")
    parser.add_argument("--iterations", type=int, default=1000)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--jobs", type=int, default=1, help="runs at a time")
    parser.add_argument("--runs", type=Path, default=Path("outputs/augmenters"), help="where the runs are kept")
    parser.add_argument("--to", type=Path, default=RESULTS, help="folder of the tables")
    return parser.parse_args(words)


def asked(family: Family, once: bool) -> dict[str, tuple[str, ...]]:
    """What is trained with every seed, the control first, for the others branch from it; or only with the first."""
    added = {name: words for name, words in family.added.items() if (name in family.once) == once}
    return added if once else {"control": (), **added}


def folder_of(scene: str, family: str, name: str, seed: int, given: argparse.Namespace) -> Path:
    """Where a run is kept."""
    words = f"{scene}_{given.iterations}_{family}_{name}_{seed}"
    return given.runs / "".join(letter if letter.isalnum() or letter in "_-" else "-" for letter in words)


def train_group(scene: str, family: str, seed: int, once: bool, given: argparse.Namespace) -> None:
    """What belongs together, one after the other; runs that are finished are left alone."""
    where = () if scene == "demo" else (f"scene.path={given.scenes / scene}",)
    threads = {"OMP_NUM_THREADS": "1"} if given.jobs > 1 else {}
    for name, words in asked(FAMILIES[family], once).items():
        folder = folder_of(scene, family, name, seed, given)
        common = (f"iterations={given.iterations}", f"seed={seed}", "init=warm_start", "eval.zoom=[1,2,4]")
        print(time.strftime("%H:%M"), folder.name, flush=True)
        overrides = [*SUBJECTS[scene], *where, *FAMILIES[family].control, *words, *common]
        train(folder, overrides, threads, folder.with_suffix(".log"))


def rows_of(scene: str, family: str, given: argparse.Namespace) -> list[dict[str, Any]]:
    """The control's line, and those of what is added to it with their differences from it, seed by seed."""
    controls = {seed: read_evaluation(scene, family, "control", seed, given) for seed in range(given.seeds)}
    rows = []
    for name in ("control", *FAMILIES[family].added):
        found = {seed: read_evaluation(scene, family, name, seed, given) for seed in range(given.seeds)}
        pairs = [(own, controls[seed]) for seed, own in found.items() if own and controls[seed]]
        if pairs:
            rows.append(line(family, name, pairs))
    return rows


def read_evaluation(scene: str, family: str, name: str, seed: int, given: argparse.Namespace) -> dict[str, Any]:
    """evaluation.json of a run, empty where there is none."""
    path = folder_of(scene, family, name, seed, given) / "evaluation.json"
    return read_json(path) if path.is_file() else {}


def line(family: str, name: str, pairs: Sequence[tuple[dict[str, Any], dict[str, Any]]]) -> dict[str, Any]:
    """Means over seeds; differences from the control with half the range over seeds."""
    values: dict[str, Any] = {"backbone": family, "added": name, "seeds": len(pairs)}
    for factor in ("1", "2", "4"):
        own = [evaluation["zoom"][factor]["psnr"] for evaluation, _ in pairs]
        values[f"x{factor}"] = f"{statistics.mean(own):.2f}"
        if name != "control":
            gains = [value - other["zoom"][factor]["psnr"] for value, (_, other) in zip(own, pairs, strict=True)]
            values[f"gain{factor}"] = f"{statistics.mean(gains):+.2f} ± {(max(gains) - min(gains)) / 2:.2f}"
    values["enlarged"] = f"{statistics.mean(pair[0]['zoom']['4']['enlarged_psnr'] for pair in pairs):.2f}"
    values["primitives"] = round(statistics.mean(evaluation["primitives"] for evaluation, _ in pairs))
    values["seconds"] = round(statistics.mean(evaluation["train_seconds"] for evaluation, _ in pairs))
    values["cost"] = f"{statistics.median(a['train_seconds'] / b['train_seconds'] for a, b in pairs):.2f}"
    return values


def section(scene: str, given: argparse.Namespace, rows: list[dict[str, Any]], load: float, command: str) -> Section:
    """The table of one scene."""
    columns = [["backbone", "backbone"], ["added", "augmenters"], ["seeds", "seeds"]]
    for factor in ("1", "2", "4"):
        columns += [[f"x{factor}", f"x{factor}"], [f"gain{factor}", f"x{factor} - control"]]
    columns += [["enlarged", "x1 enlarged to x4"], ["primitives", "primitives"], ["seconds", "training s"]]
    columns += [["cost", "x control's time"]]
    note = (
        f"`gsx {' '.join(SUBJECTS[scene])}`, {given.iterations} iterations, PSNR on held-out views, means over seeds; "
        "differences are taken seed by seed, ± half their range. Lines with oracle are ceilings: pseudo views are "
        "true pixels of the training photographs."
    )
    return stamped(f"Pseudo details on {scene}", columns, rows, [note], load, command)


def main(words: Sequence[str]) -> None:
    """Train everything, and write the tables."""
    given = arguments(words)
    machine, load = describe_machine(torch.device("cpu")), told_load()
    machine |= {"threads": 1} if given.jobs > 1 else {}
    read_sections(given.to / "augmenters_cpu.json")  # what cannot be added to is refused before training
    scenes = [name for name in given.only.split(",") if name == "demo" or given.scenes is not None]
    families = given.families.split(",")
    groups = [(scene, family, seed, False) for seed in range(given.seeds) for scene in scenes for family in families]
    groups += [(scene, family, 0, True) for scene in scenes for family in families]
    with ThreadPoolExecutor(given.jobs) as pool:
        for future in [pool.submit(train_group, *group, given) for group in groups]:
            future.result()
    for scene in scenes:
        rows = [row for family in families for row in rows_of(scene, family, given)]
        table = section(scene, given, rows, load, shown_command(words, "benchmarks/augmenters.py"))
        write_results(given.to, "augmenters_cpu", machine, {f"{scene}_{given.iterations}": table})
        print(text_table(table))


if __name__ == "__main__":
    main(sys.argv[1:])
