"""A multirun of twelve runs, one after the other and over processes: python benchmarks/sweep.py

Both take turns, round by round; the ratio of their times holds within a round. Wants an otherwise idle machine.
"""

import argparse
import statistics
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch

from measuring.machine import describe_machine, shown_command, told_load
from measuring.results import Section, ratios_told, read_sections, stamped, text_table, write_results
from measuring.runs import gsx

RESULTS = Path(__file__).parent / "results"
RUNS = 12
SWEEP = [f"seed={','.join(map(str, range(RUNS)))}", "scene.width=160", "scene.height=120", "scene.train_views=16",
         "scene.test_views=4", "scene.samples=2", "scene.points=4000", "iterations=120", "rasterizer=eager",
         "backbone=gs3d", "device=cpu"]  # fmt: skip
WAYS = {"one after the other": [], "processes": ["hydra/launcher=processes"]}


def seconds(words: list[str], folder: Path) -> float:
    """Wall-clock time of the multirun, reports included."""
    begun = time.perf_counter()
    gsx(["-m", *SWEEP, *words, f"output={folder}"], log=folder.with_suffix(".log"))
    return time.perf_counter() - begun


def main(words: Sequence[str]) -> None:
    """Measure and write results/sweep_cpu.{md,json}."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--to", type=Path, default=RESULTS, help="folder of the table")
    given = parser.parse_args(words)
    machine, load = describe_machine(torch.device("cpu")), told_load()
    read_sections(given.to / "sweep_cpu.json")  # what cannot be added to is refused before measuring
    times: dict[str, list[float]] = {way: [] for way in WAYS}
    with tempfile.TemporaryDirectory() as folder:
        for number in range(given.rounds):
            for way, overrides in WAYS.items():
                times[way].append(seconds(overrides, Path(folder) / f"{number}_{way.replace(' ', '_')}"))
                print(f"round {number + 1}, {way}: {times[way][-1]:.1f} s", flush=True)
    table = section(times, load, shown_command(words, "benchmarks/sweep.py"))
    write_results(given.to, "sweep_cpu", machine, {"sweep": table})
    print(text_table(table))


def section(times: Mapping[str, Sequence[float]], load: float, command: str) -> Section:
    """The table: medians over rounds, and ratios that hold within a round."""
    alone = next(iter(times.values()))
    rows: list[dict[str, Any]] = []
    for way, taken in times.items():
        row = {"way": way, "seconds": f"{statistics.median(taken):.1f}", "rounds": list(taken)}
        rows.append(row | ({} if taken is alone else {"ratio": ratios_told(alone, taken)}))
    columns = [["way", "way"], ["seconds", "seconds"], ["ratio", "times as fast"]]
    note = f"`gsx -m {' '.join(SWEEP)}`, medians of {len(alone)} rounds."
    return stamped(f"{RUNS} runs", columns, rows, [note], load, command)


if __name__ == "__main__":
    main(sys.argv[1:])
