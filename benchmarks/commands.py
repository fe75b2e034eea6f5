"""Whole commands as a user types them, one after the other: python benchmarks/commands.py

Each is a process of its own; those found finished below --runs are not trained again, and keep the times they had.
Further words go to every command, to try this out: `iterations=20 scene.width=64 scene.height=48 --to FOLDER`. Takes
about an hour on two cores, and wants an otherwise idle machine.
"""

import argparse
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch

from gsx.core.files import read_json
from measuring.machine import describe_machine, shown_command, told_load
from measuring.results import Section, read_sections, stamped, text_table, write_results
from measuring.runs import evaluate_seconds, in_shell, shown, train, wall_seconds

RESULTS = Path(__file__).parent / "results"
COMMANDS = {
    "demo": ("eval.zoom=[1,2,4]",),
    "pseudo_details": ("backbone=octree_scaffold", "augmenter=[upscale,bootstrap]", "eval.zoom=[1,2,4]"),
    "octree_ub": ("variant=octree_ub", "dataset=demo", "budget=quick"),
}
"""By the name of the run's folder; `demo` is the second run of `make demo`."""
ZOOMED = ("2", "4")
COLUMNS = [
    ["command", "command"],
    ["state", "ended"],
    ["steps", "steps"],
    ["x1", "PSNR x1"],
    *[[f"x{factor}", f"x{factor} (x1 enlarged)"] for factor in ZOOMED],
    ["primitives", "primitives"],
    ["training", "training s"],
    ["evaluating", "evaluation s"],
    ["whole", "whole command s"],
    ["peak_mb", "peak MB"],
]
NOTE = (
    "PSNR on held-out views, in brackets what the x1 render gives when it is enlarged. Evaluation: of all of them at "
    "all zooms, with pictures. The whole command: with starting, loading, compiling and reports."
)


def arguments(words: Sequence[str]) -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("overrides", nargs="*", help="added to every command")
    parser.add_argument("--only", default=",".join(COMMANDS), help="commands, by commas")
    parser.add_argument("--runs", type=Path, default=Path("outputs/commands"), help="where the runs are kept")
    parser.add_argument("--to", type=Path, default=RESULTS, help="folder of the table")
    return parser.parse_args(words)


def row(overrides: Sequence[str], folder: Path) -> dict[str, Any]:
    """A command's line of the table, from the files of its finished run."""
    evaluation, status = read_json(folder / "evaluation.json"), read_json(folder / "status.json")
    zooms: Mapping[str, Any] = evaluation["zoom"]
    return {
        "command": f"`{in_shell(overrides)}`",
        "state": status["state"],
        "steps": status["step"],
        "x1": f"{evaluation['psnr']:.2f}",
        **{f"x{factor}": shown(zooms[factor]) for factor in ZOOMED if "psnr" in zooms.get(factor, {})},
        "primitives": evaluation["primitives"],
        "training": whole(evaluation["train_seconds"]),
        "evaluating": whole(evaluate_seconds(folder, evaluation)),
        "whole": whole(wall_seconds(folder)),
        "peak_mb": whole(evaluation["peak_memory_mb"]),
    }


def whole(value: float | None) -> int | None:
    """Rounded; None stays what is not known."""
    return None if value is None else round(value)


def section(rows: list[dict[str, Any]], load: float, command: str) -> Section:
    """The table."""
    return stamped("Whole commands", COLUMNS, rows, [NOTE], load, command)


def main(words: Sequence[str]) -> None:
    """Run the commands, and write the table after each."""
    given = arguments(words)
    machine, load = describe_machine(torch.device("cpu")), told_load()
    read_sections(given.to / "commands_cpu.json")  # what cannot be added to is refused before training
    rows: list[dict[str, Any]] = []
    for name in given.only.split(","):
        overrides, folder = [*COMMANDS[name], *given.overrides], given.runs / name
        train(folder, overrides)
        rows.append(row(overrides, folder))
        table = section(rows, load, shown_command(words, "benchmarks/commands.py"))
        write_results(given.to, "commands_cpu", machine, {"commands": table})
    print(text_table(table))


if __name__ == "__main__":
    main(sys.argv[1:])
