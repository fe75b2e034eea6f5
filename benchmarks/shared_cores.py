"""Training while another program wants the cores, too: python benchmarks/shared_cores.py

Threads of a step wait for each other, turning as long as GNU OpenMP does by default, or as long as gsx has them
(core/threads.py): alone, beside a program that keeps one core busy, and two runs at once. Ways take turns, round by
round; ratios hold within a round. Wants an otherwise idle machine.
"""

import argparse
import statistics
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, contextmanager, nullcontext
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import torch

from gsx.core.threads import SPINS
from measuring.machine import describe_machine, shown_command, told_load
from measuring.results import Section, read_sections, stamped, text_table, write_results
from measuring.runs import train

RESULTS = Path(__file__).parent / "results"
RUN = ("iterations=150", "rasterizer=compiled", "backbone=gs3d", "training.test_points=0", "eval.zoom=[1]",
       "eval.flight=false", "device=cpu")  # fmt: skip
WAYS = {"default": {SPINS: "300000"}, "brief": dict[str, str]()}
"""Environments: GNU OpenMP's default (its manual, GOMP_SPINCOUNT), and what gsx sets."""
COLUMNS = [
    *(["beside", "beside the run"], ["default", "OpenMP's default, s"], ["brief", "gsx, s"]),
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


def seconds(folder: Path, environment: Mapping[str, str], runs: int) -> float:
    """Seconds of training of the slowest of so many runs at once."""

    def one(number: int) -> float:
        own = folder / str(number)
        return float(train(own, RUN, environment, log=own.with_suffix(".log"))["train_seconds"])

    folder.mkdir(parents=True)
    with ThreadPoolExecutor(runs) as pool:
        return max(pool.map(one, range(runs)))


BESIDE: dict[str, tuple[int, Callable[[], AbstractContextManager[None]]]] = {
    "nothing": (1, nullcontext),
    "a program that keeps a core busy": (1, busy),
    "another run": (2, nullcontext),
}
"""How many runs, and what else there is meanwhile."""


def measured(rounds: int) -> dict[str, dict[str, list[float]]]:
    """Seconds by what is beside the run and by way; what is compiled is compiled before."""
    found: dict[str, dict[str, list[float]]] = {beside: {way: [] for way in WAYS} for beside in BESIDE}
    with TemporaryDirectory() as folder:
        seconds(Path(folder) / "first", {}, 1)
        for number in range(rounds):
            for beside, (runs, meanwhile) in BESIDE.items():
                for way, environment in WAYS.items():
                    with meanwhile():
                        taken = seconds(Path(folder) / f"{number} {beside} {way}", environment, runs)
                    found[beside][way].append(taken)
                    print(f"round {number + 1}, beside {beside}, {way}: {taken:.1f} s", flush=True)
    return found


def row_of(beside: str, times: Mapping[str, Sequence[float]]) -> dict[str, Any]:
    """Medians over rounds, and the ratio, which holds within a round."""
    ratios = [before / now for before, now in zip(times["default"], times["brief"], strict=True)]
    told = f"{statistics.median(ratios):.2f} ({min(ratios):.2f} to {max(ratios):.2f})"
    medians = {way: round(statistics.median(taken), 1) for way, taken in times.items()}
    return {"beside": beside, **medians, "ratio": told, "rounds": {way: list(taken) for way, taken in times.items()}}


def main(words: Sequence[str]) -> None:
    """Measure and write results/shared_cores_cpu.{md,json}."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--to", type=Path, default=RESULTS, help="folder of the table")
    given = parser.parse_args(words)
    machine, load = describe_machine(torch.device("cpu")), told_load()
    read_sections(given.to / "shared_cores_cpu.json")  # what cannot be added to is refused before measuring
    rows = [row_of(beside, times) for beside, times in measured(given.rounds).items()]
    table: Section = stamped(
        "Shared cores", COLUMNS, rows, [NOTE], load, shown_command(words, "benchmarks/shared_cores.py")
    )
    write_results(given.to, "shared_cores_cpu", machine, {"demo": table})
    print(text_table(table))


if __name__ == "__main__":
    main(sys.argv[1:])
