"""How long it takes from `gsx` on the command line to the first step, and to the end of the shortest run.

    python benchmarks/first_step.py [--against REVISION] [--rounds 3]

Cold: with an empty cache, and an empty folder for temporary files, where torch keeps its prepared headers; all is
compiled, and pictures of the built-in scene are made. Warm: what that has left is found. Each round is of processes of
their own, revisions in turn. Nothing else should run.
"""

import argparse
import os
import shutil
import statistics
import subprocess
import sys
import time
from collections.abc import Sequence
from contextlib import nullcontext
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import torch

from measuring.machine import ROOT, describe_machine, shown_command, told_load
from measuring.results import Section, stamped, text_table, write_results
from measuring.revisions import checked_out

RESULTS = Path(__file__).parent / "results"
WORDS = ("iterations=2", "training.test_points=0", "rasterizer=compiled", "device=cpu")
"""Runs of a usual length draw no held-out view before a tenth of their steps."""
WARM = 3
"""Warm runs after each cold one."""
COLUMNS = [
    *(["cache", "cache"], ["step", "to the first step, s"], ["end", "to the report, s"]),
    *(["old_step", "before: first step, s"], ["old_end", "report, s"], ["ratio", "before / now, first step"]),
]
NOTE = (
    f"`gsx {' '.join(WORDS)}`: the built-in scene. Seconds since the process was started, medians of rounds; a round "
    f"is one run with an empty cache, where torch has no prepared headers either, and {WARM} with what that has left."
)


def arguments(words: Sequence[str]) -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--against", default="", help="a revision to compare with")
    parser.add_argument("--rounds", type=int, default=3, help="cold runs of each revision")
    parser.add_argument("--to", type=Path, default=RESULTS, help="folder of the table")
    return parser.parse_args(words)


def seconds_of(source: Path, cache: Path) -> dict[str, float]:
    """Seconds from the start of a run to its first step, and to its end."""
    own = {"GSX_CACHE": str(cache), "TMPDIR": str(cache / "temporary")}
    environment = os.environ | {"PYTHONPATH": str(source), "PYTHONUNBUFFERED": "1"} | own
    (cache / "temporary").mkdir(exist_ok=True)
    environment.pop("TORCHINDUCTOR_CACHE_DIR", None)
    command = [sys.executable, "-m", "gsx", *WORDS, f"folder={cache / 'run'}"]
    shutil.rmtree(cache / "run", ignore_errors=True)
    begun, found = time.perf_counter(), dict[str, float]()
    with subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as run:
        assert run.stdout is not None
        for line in run.stdout:
            if line.startswith("step 1/"):
                found["step"] = time.perf_counter() - begun
    found["end"] = time.perf_counter() - begun
    if run.returncode or "step" not in found:
        raise SystemExit(f"{' '.join(command)} ended with {run.returncode}, without a first step")
    return found


def rounds_of(sources: Sequence[Path], rounds: int) -> list[dict[str, list[dict[str, float]]]]:
    """Of each source the times of its runs, by what they find in the cache."""
    found: list[dict[str, list[dict[str, float]]]] = [{"cold": [], "warm": []} for _ in sources]
    for _ in range(rounds):
        for times, source in zip(found, sources, strict=True):
            with TemporaryDirectory() as folder:
                cache = Path(folder)
                times["cold"].append(seconds_of(source, cache))
                times["warm"] += [seconds_of(source, cache) for _ in range(WARM)]
    return found


def row_of(cache: str, found: Sequence[dict[str, list[dict[str, float]]]]) -> dict[str, Any]:
    """Medians of the runs that found that in the cache."""
    now, *before = (
        {what: statistics.median(run[what] for run in times[cache]) for what in ("step", "end")} for times in found
    )
    row: dict[str, Any] = {"cache": cache, **now}
    for old in before:
        row |= {"old_step": old["step"], "old_end": old["end"], "ratio": old["step"] / now["step"]}
    return row


def measured(given: argparse.Namespace, command: str) -> Section:
    """The table."""
    load = told_load()
    with checked_out(given.against) if given.against else nullcontext() as old:
        found = rounds_of([ROOT / "src", *([old] if old else [])], given.rounds)
    notes = [NOTE, *([f"Before: revision {given.against}."] if given.against else [])]
    rows = [row_of(cache, found) for cache in ("cold", "warm")]
    return stamped("To the first step", COLUMNS, rows, notes, load, command)


def main(words: Sequence[str]) -> None:
    """Measure and write."""
    given = arguments(words)
    section = measured(given, shown_command(words, "benchmarks/first_step.py"))
    write_results(given.to, "first_step_cpu", describe_machine(torch.device("cpu")), {"demo": section})
    print(text_table(section))


if __name__ == "__main__":
    main(sys.argv[1:])
