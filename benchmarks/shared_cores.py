"""Training while another program wants the cores, too: python benchmarks/shared_cores.py --against REVISION

Alone, beside a program that keeps one core busy, and two runs at once (engine/threads.py). Both revisions take turns,
round by round; ratios hold within a round. Wants an otherwise idle machine.
"""

import argparse
import statistics
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, contextmanager, nullcontext
from itertools import product
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import torch

from measuring.machine import ROOT, describe_machine, shown_command, told_load
from measuring.results import ratios_told, read_sections, stamped, text_table, write_results
from measuring.revisions import checked_out
from measuring.runs import train

RESULTS = Path(__file__).parent / "results"
RUN = ("iterations=150", "rasterizer=compiled", "backbone=gs3d", "training.test_points=0", "eval.zoom=[1]",
       "eval.flight=false", "device=cpu")  # fmt: skip
COLUMNS = [
    *(["beside", "beside the run"], ["before", "before, s"], ["now", "now, s"]),
    ["ratio", "times as fast"],
]
NOTE = f"`gsx {' '.join(RUN)}`, seconds of training, medians of rounds."


@contextmanager
def busy() -> Iterator[None]:
    """A program that does nothing else but keep one core busy."""
    with subprocess.Popen([sys.executable, "-c", "while True: pass"]) as program:
        try:
            yield
        finally:
            program.kill()


def seconds(folder: Path, source: Path, runs: int) -> float:
    """Seconds of training of the slowest of so many runs at once."""

    def one(number: int) -> float:
        own = folder / str(number)
        return float(train(own, RUN, {"PYTHONPATH": str(source)}, log=own.with_suffix(".log"))["train_seconds"])

    folder.mkdir(parents=True)
    with ThreadPoolExecutor(runs) as pool:
        return max(pool.map(one, range(runs)))


BESIDE: dict[str, tuple[int, Callable[[], AbstractContextManager[None]]]] = {
    "nothing": (1, nullcontext),
    "a program that keeps a core busy": (1, busy),
    "another run": (2, nullcontext),
}
"""How many runs, and what else there is meanwhile."""
TURNS = {"nothing": 4}
"""Times that each revision is measured in a round, once elsewhere: alone there is least to tell apart."""


def measured(sources: Mapping[str, Path], rounds: int) -> dict[str, dict[str, list[float]]]:
    """Seconds by what is beside the run and by revision; what is compiled is compiled before."""
    found: dict[str, dict[str, list[float]]] = {beside: {which: [] for which in sources} for beside in BESIDE}
    with TemporaryDirectory() as folder:
        for which, source in sources.items():
            seconds(Path(folder) / f"first {which}", source, 1)
        for number in range(rounds):
            for beside, (runs, meanwhile) in BESIDE.items():
                for turn, (which, source) in product(range(TURNS.get(beside, 1)), sources.items()):
                    with meanwhile():
                        taken = seconds(Path(folder) / f"{number} {turn} {beside} {which}", source, runs)
                    found[beside][which].append(taken)
                    print(f"round {number + 1}, beside {beside}, {which}: {taken:.1f} s", flush=True)
    return found


def row_of(beside: str, times: Mapping[str, Sequence[float]]) -> dict[str, Any]:
    """Medians over rounds, and the ratio, which holds within a round."""
    medians = {which: round(statistics.median(taken), 1) for which, taken in times.items()}
    return {
        "beside": beside,
        **medians,
        "ratio": ratios_told(times["before"], times["now"]),
        "rounds": {which: list(taken) for which, taken in times.items()},
    }


def main(words: Sequence[str]) -> None:
    """Measure and write results/shared_cores_cpu.{md,json}."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--against", required=True, help="a revision to compare with")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--to", type=Path, default=RESULTS, help="folder of the table")
    given = parser.parse_args(words)
    machine, load = describe_machine(torch.device("cpu")), told_load()
    read_sections(given.to / "shared_cores_cpu.json")  # what cannot be added to is refused before measuring
    with checked_out(given.against) as before:
        found = measured({"before": before, "now": ROOT / "src"}, given.rounds)
    rows = [row_of(beside, times) for beside, times in found.items()]
    notes, command = [NOTE, f"Before: revision {given.against}."], shown_command(words, "benchmarks/shared_cores.py")
    table = stamped("Shared cores", COLUMNS, rows, notes, load, command)
    write_results(given.to, "shared_cores_cpu", machine, {"demo": table})
    print(text_table(table))


if __name__ == "__main__":
    main(sys.argv[1:])
