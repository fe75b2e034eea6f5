"""What real captures do, made on purpose, and what mends it: the tables of docs/photographs.md.

    python benchmarks/captures.py --scenes FOLDER [--only demo,fox] [--seeds 0,1,2] [--share 0.4] [--jobs 2]

FOLDER holds `fox`, `desk_bottle` (COLMAP), `lego` (NeRF-Synthetic) and `castle` (photographs alone); without it only
the built-in scene is measured. `exposure`: training photographs at exposures of their own, with and without
`training.exposure.when=auto`, beside the scene as it is, with it. Finished runs below --runs are not trained again.
"""

import argparse
import statistics
import sys
import time
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import torch

from gsx.builtin import plugins
from gsx.core.files import read_json, write_json
from gsx.experiments.evaluation.evaluator import Evaluator
from gsx.experiments.runs.open import open_run
from measuring.machine import describe_machine, shown_command, told_load
from measuring.results import read_sections, stamped, text_table, write_results
from measuring.runs import train
from zoom import SUBJECTS, numbers, told

RESULTS = Path(__file__).parent / "results"
ZOOMS = ("1", "4")
OWN = ("backbone=mip_splatting", "backbone.rates.shortened=0.4")
JUDGED, DISTURBED = ("training.exposure.when=auto",), ("scene.disturb.exposure=0.2",)
ARMS = {"as it is, auto": JUDGED, "disturbed": DISTURBED, "disturbed, auto": (*DISTURBED, *JUDGED)}
"""Overrides by the name of a row; the first is what there is to win back."""


def arguments(words: Sequence[str]) -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", type=Path, default=None, help="the folder with the captures")
    parser.add_argument("--only", default=",".join(SUBJECTS), help="scenes, by commas")
    parser.add_argument("--seeds", type=numbers, default=[0, 1, 2], help="by commas (0,1,2)")
    parser.add_argument("--share", type=float, default=1.0, help="of the steps")
    parser.add_argument("--jobs", type=int, default=1, help="runs at a time")
    parser.add_argument("--runs", type=Path, default=Path("outputs/captures"), help="where the runs are kept")
    parser.add_argument("--to", type=Path, default=RESULTS, help="folder of the tables")
    return parser.parse_args(words)


def measured(scene: str, seed: int, arm: str, given: argparse.Namespace) -> dict[str, Any]:
    """A run, and its figures by both protocols of colours."""
    folder = given.runs / "_".join([*arm.replace(",", "").split(), scene, str(seed)])
    print(time.strftime("%H:%M"), folder.name, flush=True)
    where = [] if scene == "demo" else [f"scene.path={given.scenes / scene}"]
    words = [*OWN, *ARMS[arm], *SUBJECTS[scene], *where, f"seed={seed}", f"eval.zoom=[{','.join(ZOOMS)}]"]
    steps = next(int(word.partition("=")[2]) for word in words if word.startswith("iterations="))
    words = [
        *(word for word in words if not word.startswith("iterations=")),
        f"iterations={round(given.share * steps)}",
    ]
    threads = {"OMP_NUM_THREADS": "1"} if given.jobs > 1 else {}
    rendered = train(folder, words, threads, folder.with_name(f"{folder.name}.log"))
    path = folder / "fitted.json"
    if not path.is_file():
        run, settings = open_run(folder, plugins(), ["eval.colours=fitted"])
        write_json(path, Evaluator(run, settings.evaluation).evaluate()["zoom"])
    asking = (rendered.get("exposures") or {}).get("seconds", 0.0) / rendered["train_seconds"]
    return {
        "asking": asking,
        "rendered": rendered["zoom"],
        "fitted": read_json(path),
        "exposures": rendered.get("exposures"),
    }


Found = Sequence[Mapping[str, Any]]
"""What was measured with each seed."""


def row_of(scene: str, arm: str, by_arm: Mapping[str, Found]) -> dict[str, Any]:
    """Figures of one arm over seeds."""
    found = by_arm[arm]
    row: dict[str, Any] = {"scene": scene, "name": arm, "seeds": len(found)}
    spreads = [100 * one["exposures"]["spread"] for one in found if one["exposures"]]
    row["spread"] = told(spreads, ".1f") if spreads else ""
    row["learnt"] = f"{sum(bool(one['exposures'] and one['exposures']['learnt']) for one in found)} of {len(found)}"
    row["asking"] = f"{100 * statistics.mean(one['asking'] for one in found):.1f}" if spreads else ""
    for zoom in ZOOMS:
        row[f"fitted{zoom}"] = told(fitted(found, zoom), ".2f")
        if arm == "disturbed, auto":
            row[f"back{zoom}"] = told(shares_won(by_arm, zoom), ".2f")
    return row | {f"x{zoom}": told([one["rendered"][zoom]["psnr"] for one in found], ".2f") for zoom in ZOOMS}


def fitted(found: Found, zoom: str) -> list[float]:
    """PSNR in fitted colours with each seed."""
    return [one["fitted"][zoom]["psnr"] for one in found]


def shares_won(by_arm: Mapping[str, Found], zoom: str) -> list[float]:
    """Of what the disturbance cost, with each seed."""
    best, worst, mended = (fitted(by_arm[arm], zoom) for arm in ARMS)
    return [(m - w) / (b - w) for b, w, m in zip(best, worst, mended, strict=True)]


def main(words: Sequence[str]) -> None:
    """Train and look, and write the table."""
    given = arguments(words)
    machine, load = describe_machine(torch.device("cpu")), told_load()
    machine |= {"threads": 1} if given.jobs > 1 else {}
    read_sections(given.to / "captures_cpu.json")  # what cannot be added to is refused before training
    if unknown := [name for name in given.only.split(",") if name not in SUBJECTS]:
        sys.exit(f"{', '.join(unknown)}: choose from {', '.join(SUBJECTS)}")
    scenes = [name for name in given.only.split(",") if name == "demo" or given.scenes is not None]
    if not scenes:
        sys.exit(f"--only {given.only}: all but demo need --scenes FOLDER")
    keys = [(scene, seed, arm) for scene in scenes for seed in given.seeds for arm in ARMS]
    with ThreadPoolExecutor(given.jobs) as pool:
        measurements = pool.map(lambda key: measured(key[0], key[1], key[2], given), keys)
        found = dict(zip(keys, measurements, strict=True))
    rows = []
    for scene in scenes:
        by_arm = {arm: [found[scene, seed, arm] for seed in given.seeds] for arm in ARMS}
        rows += [row_of(scene, arm, by_arm) for arm in ARMS]
    columns = [["scene", "scene"], ["name", "photographs"], ["seeds", "seeds"], ["spread", "spread found, %"]]
    columns += [["learnt", "learnt"], ["asking", "asking, % of training"], ["fitted1", "x1"], ["fitted4", "x4"]]
    columns += [["back1", "won back at x1"], ["back4", "at x4"], ["x1", "x1 as rendered"], ["x4", "x4 as rendered"]]
    note = (
        f"{given.share:g} of the steps; PSNR on held-out views that are not disturbed, of right halves in colours "
        "fitted on the left (as rendered: of whole views as the model shows them); means over seeds ± half their range."
    )
    title = "Photographs at exposures of their own"
    table = stamped(title, columns, rows, [note], load, shown_command(words, "benchmarks/captures.py"))
    write_results(given.to, "captures_cpu", machine, {"exposure": table})
    print(text_table(table))


if __name__ == "__main__":
    main(sys.argv[1:])
