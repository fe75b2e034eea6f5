"""Compare the default in fewer steps with published 3D-GS (docs/benchmarks/capacity.md).

    python benchmarks/sooner.py [--scenes FOLDER] [--only demo,room,fox_4] [--seeds 0,1,2] [--jobs 2]

Each scene is trained by published `gs3d`, and by `gs3d_zoom`, the default, in shares of its steps; all are runs of
their own, with schedules of their length. FOLDER holds `fox` (COLMAP). Finished runs below --runs are not
trained again.
"""

import argparse
import sys
from collections.abc import Sequence
from typing import Any

import torch

from capacity import PUBLISHED, SUBJECTS, ZOOMS, row_of, scenes_of, trained, words_of
from measuring.machine import describe_machine, shown_command, told_load
from measuring.results import read_sections, stamped, text_table, write_results
from starts import seen_in_training
from zoom import over_seeds, refuse_unknown, shared_arguments, steps_among, told

PUBLISHED_ARM = ("gs3d", 1.0)
"""Backbone, with its share of the steps, that all are compared with."""
SHARES = {"demo": (0.75, 0.5), "room": (0.9, 0.75), "fox_4": (0.75, 0.5)}
"""Of the steps, for the default."""
COLUMNS = [
    *(["scene", "scene"], ["arm", "backbone"], ["steps", "steps"], ["seeds", "seeds"]),
    *(column for f in ZOOMS for column in ([f"x{f}", f"x{f}"], [f"more{f}", f"x{f} - published"])),
    *(["gap", "training views - x1"], ["primitives", "primitives"], ["seconds", "training s"]),
    ["times", "of published"],
]
NOTE = (
    "`gs3d` at all its steps is what the others are compared with. PSNR, dB, means over seeds ± half their range; "
    "differences seed by seed, times are medians. Training views: mean over the last tenth of the steps, each before "
    "it was learnt from."
)


def arguments(words: Sequence[str]) -> argparse.Namespace:
    """The command line."""
    return shared_arguments(__doc__, "demo,room,fox_4", "outputs/sooner").parse_args(words)


def arms_of(scene: str) -> list[tuple[str, float]]:
    """Backbones, with shares of the steps of a scene."""
    return [PUBLISHED_ARM, *(("gs3d_zoom", share) for share in SHARES[scene])]


def steps_of(scene: str, share: float) -> int:
    """A share of the steps of a scene."""
    return round(share * steps_among(SUBJECTS[scene]))


def evaluation_of(scene: str, backbone: str, share: float, seed: int, given: argparse.Namespace) -> dict[str, Any]:
    """Of a run, with how far its training views are above held-out ones."""
    steps = steps_of(scene, share)
    words = [word for word in words_of([PUBLISHED], scene, backbone, seed, given) if not word.startswith("iterations=")]
    folder = given.runs / f"{backbone}_{scene}_{steps}_{seed}"
    found = trained(folder, [*words, f"iterations={steps}", "training.log_every=1"], given)
    return found | {"gap": seen_in_training(folder) - found["zoom"]["1"]["psnr"]}


def rows_of(scene: str, found: Sequence[dict[tuple[str, float], dict[str, Any]]]) -> list[dict[str, Any]]:
    """Of a scene; `found`: evaluations by arm, of each seed."""
    rows = []
    for backbone, share in arms_of(scene):
        own = [one[backbone, share] for one in found]
        row = row_of(scene, backbone, own, [one[PUBLISHED_ARM] for one in found])
        rows.append(row | {"steps": steps_of(scene, share), "gap": told([run["gap"] for run in own], "+.2f")})
    return rows


def main(words: Sequence[str]) -> None:
    """Train and write the table."""
    given = arguments(words)
    refuse_unknown(given.only, SHARES)
    machine, load = describe_machine(torch.device("cpu")), told_load()
    machine |= {"threads": 1} if given.jobs > 1 else {}
    read_sections(given.to / "sooner_cpu.json")  # what cannot be added to is refused before training
    scenes = scenes_of(given)

    def look(scene: str, seed: int) -> dict[Any, Any]:
        return {arm: evaluation_of(scene, *arm, seed, given) for arm in arms_of(scene)}

    found = over_seeds(look, scenes, given)
    rows = [row for scene in scenes for row in rows_of(scene, found[scene])]
    title, command = "The default in fewer steps, beside published 3D-GS", shown_command(words, "benchmarks/sooner.py")
    section = stamped(title, COLUMNS, rows, [NOTE], load, command)
    write_results(given.to, "sooner_cpu", machine, {"gs3d_zoom": section})
    print(text_table(section))


if __name__ == "__main__":
    main(sys.argv[1:])
