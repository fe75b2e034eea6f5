"""What real captures do, made on purpose, and what mends it: the tables of docs/photographs.md.

    python benchmarks/captures.py --scenes FOLDER [--only demo,fox] [--seeds 0,1,2] [--share 0.4] [--jobs 2]

FOLDER holds `fox`, `desk_bottle` (COLMAP), `lego` (NeRF-Synthetic) and `castle` (photographs alone); without it only
the built-in scene is measured. `exposure`: training photographs at exposures of their own, with and without
`training.exposure.when=auto`, beside the scene as it is, with it. Finished runs below --runs are not trained again.
"""

import argparse
import statistics
import sys
from collections.abc import Mapping, Sequence
from typing import Any

import torch

from gsx.core.files import read_json
from measuring.machine import describe_machine, shown_command, told_load
from measuring.results import read_sections, stamped, text_table, write_results
from zoom import SUBJECTS, looked_at, over_seeds, scenes_at_hand, shared_arguments, steps_among, told, trained

ZOOMS = ("1", "4")
OWN = ("backbone=mip_splatting", "backbone.rates.shortened=0.4")
JUDGED, DISTURBED = ("training.exposure.when=auto",), ("scene.disturb.exposure=0.2",)
ARMS = {"as it is, auto": JUDGED, "disturbed": DISTURBED, "disturbed, auto": (*DISTURBED, *JUDGED)}
"""Overrides by the name of a row; the first is what there is to win back."""


def arguments(words: Sequence[str]) -> argparse.Namespace:
    """The command line."""
    parser = shared_arguments(__doc__, ",".join(SUBJECTS), "outputs/captures")
    parser.add_argument("--share", type=float, default=1.0, help="of the steps")
    return parser.parse_args(words)


def measured(scene: str, seed: int, arm: str, given: argparse.Namespace) -> dict[str, Any]:
    """Figures of a run by both protocols of colours, and what it found of exposures."""
    steps = round(given.share * steps_among(SUBJECTS[scene]))
    words = [*OWN, *ARMS[arm], f"iterations={steps}", f"eval.zoom=[{','.join(ZOOMS)}]"]
    folder = trained(scene, seed, given, words, arm)
    evaluation = read_json(folder / "evaluation.json")
    exposures = evaluation.get("exposures", {})
    return {
        "asking": exposures.get("seconds", 0.0) / evaluation["train_seconds"],
        "rendered": evaluation["zoom"],
        "fitted": looked_at(folder, "fitted", ["eval.colours=fitted"]),
        "exposures": exposures,
    }


Found = Sequence[Mapping[str, Any]]
"""What was measured with each seed."""


def row_of(scene: str, arm: str, by_arm: Mapping[str, Found]) -> dict[str, Any]:
    """Figures of one arm over seeds."""
    found = by_arm[arm]
    row: dict[str, Any] = {"scene": scene, "name": arm, "seeds": len(found)}
    spreads = [100 * one["exposures"]["spread"] for one in found if one["exposures"]]
    row["spread"] = told(spreads, ".1f") if spreads else ""
    row["learnt"] = f"{sum(one['exposures'].get('learnt', 0) > 0 for one in found)} of {len(found)}"
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
    scenes = scenes_at_hand(given)
    found = over_seeds(lambda scene, seed: {arm: measured(scene, seed, arm, given) for arm in ARMS}, scenes, given)
    rows = []
    for scene in scenes:
        by_arm = {arm: [one[arm] for one in found[scene]] for arm in ARMS}
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
