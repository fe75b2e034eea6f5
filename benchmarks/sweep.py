"""A multirun of twelve runs, one after the other and over processes: python benchmarks/sweep.py

Both take turns, round by round; the ratio of their times holds within a round. Wants an otherwise idle machine.
"""

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import torch

from measuring.machine import describe_machine, told_load

RESULTS = Path(__file__).parent / "results"
RUNS = 12
SWEEP = [f"seed={','.join(map(str, range(RUNS)))}", "scene.width=160", "scene.height=120", "scene.train_views=16",
         "scene.test_views=4", "scene.samples=2", "scene.points=4000", "iterations=120", "rasterizer=eager",
         "device=cpu"]  # fmt: skip
WAYS = {"one after the other": [], "processes": ["hydra/launcher=processes"]}


def seconds(words: list[str], folder: Path) -> float:
    """Wall-clock time of the multirun, reports included."""
    begun = time.perf_counter()
    command = [sys.executable, "-m", "gsx", "-m", *SWEEP, *words, f"output={folder}"]
    subprocess.run(command, check=True, capture_output=True)
    return time.perf_counter() - begun


def main() -> None:
    """Measure and write results/sweep_cpu.{md,json}."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=3)
    given = parser.parse_args()
    load = told_load()
    times: dict[str, list[float]] = {way: [] for way in WAYS}
    with tempfile.TemporaryDirectory() as folder:
        for number in range(given.rounds):
            for way, words in WAYS.items():
                times[way].append(seconds(words, Path(folder) / f"{number}_{way.replace(' ', '_')}"))
                print(f"round {number + 1}, {way}: {times[way][-1]:.1f} s", flush=True)
    ratios = [alone / together for alone, together in zip(*times.values(), strict=True)]
    result: dict[str, Any] = {
        "date": time.strftime("%Y-%m-%d"),
        "load_before": load,
        "machine": describe_machine(torch.device("cpu")),
        "command": f"gsx -m {' '.join(SWEEP)}",
        "seconds": times,
        "ratios": ratios,
    }
    (RESULTS / "sweep_cpu.json").write_text(json.dumps(result, indent=1) + "\n")
    (RESULTS / "sweep_cpu.md").write_text(table(times, ratios, result["machine"]["cpu"]))
    print(table(times, ratios, result["machine"]["cpu"]))


def table(times: dict[str, list[float]], ratios: list[float], machine: str) -> str:
    """The result in words and numbers."""
    lines = [
        f"# {RUNS} runs",
        "",
        f"`gsx -m {' '.join(SWEEP)}`, medians of {len(ratios)} rounds, {time.strftime('%Y-%m-%d')}, "
        f"{machine}, {os.cpu_count()} cores.",
        "",
        "| | seconds | times as fast |",
        "|---|--:|--:|",
    ]
    for way, taken in times.items():
        first = way == next(iter(times))
        ratio = "" if first else f"{statistics.median(ratios):.2f} ({min(ratios):.2f} to {max(ratios):.2f})"
        lines.append(f"| {way} | {statistics.median(taken):.1f} | {ratio} |")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    main()
