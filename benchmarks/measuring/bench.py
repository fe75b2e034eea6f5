"""One run of the benchmark: what was asked for, and how cases become rows."""

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import torch

from gsx.core.rasterizer import RasterSettings
from measuring import rival
from measuring.adapter import settings_of
from measuring.cases import Case, drawing, pairs_of
from measuring.memory import peak_memory
from measuring.results import Section, stamped
from measuring.watches import Patience, Timing, take_turns

T = TypeVar("T")
Row = dict[str, Any]


@dataclass(frozen=True, kw_only=True)
class Bench:
    """What a run of the benchmark was asked for."""

    device: torch.device
    paths: tuple[str, ...]
    """Those of eager and compiled that can be measured."""
    patience: Patience
    memory: bool
    quick: bool
    """Tiny sizes: to see that everything works."""
    load: float
    """Load average before anything was measured."""
    command: str
    prototype: Path | None
    run: Path | None

    def pick(self, full: T, quick: T) -> T:
        """The size for this run."""
        return quick if self.quick else full


def say(line: str) -> None:
    """Progress, beside the tables."""
    sys.stderr.write(line + "\n")
    sys.stderr.flush()


def compare(bench: Bench, case: Case, overrides: Sequence[str] = (), rivals: Sequence[str] = ()) -> list[Row]:
    """A row for each path and rival that draws the case, timed in turn, with peak memory where asked for."""
    settings = {path: settings_of(path, *overrides) for path in bench.paths}
    settings |= {name: settings_of("eager", *overrides) for name in rivals}
    timings = time_drawing(bench, case, settings)
    tile = next(iter(settings.values())).tile_size
    pairs = pairs_of(case, bench.device, settings_of("eager", *overrides))
    rows = [row_of(case, name, timing, pairs, tile) for name, timing in timings.items()]
    for row, rules in zip(rows, settings.values(), strict=True):
        row |= times_of_others(row, rows)
        if bench.memory:
            peaks = peak_memory(row["path"], case, bench.device, rules)
            row |= {f"{phase}_mb": value for phase, value in peaks.items()}
        say(f"  {case.splats:,} splats, {case.raster}, tile {tile}, {row['path']}: {row['total_ms']:.0f} ms")
    return rows


def time_drawing(bench: Bench, case: Case, settings: dict[str, RasterSettings]) -> dict[str, Timing]:
    """Times of drawing the case each way, in turn."""
    jobs = {name: drawing(name, case, bench.device, rules) for name, rules in settings.items()}
    return take_turns(jobs, bench.device, bench.patience)


def row_of(case: Case, path: str, timing: Timing, pairs: int, tile: int) -> Row:
    """Sizes and times of a case."""
    evaluations = pairs * tile**2 / 1e3
    return {
        "path": path,
        "splats": case.splats,
        "raster": case.raster,
        "size": case.size,
        "tile": tile,
        "pairs": pairs,
        "first_s": timing.first / 1e3,
        "forward_ms": timing.median("forward"),
        "backward_ms": timing.median("backward"),
        "total_ms": timing.total,
        "forward_rate": evaluations / timing.median("forward"),
        "repeats": len(timing.rounds),
    }


def times_of_others(row: Row, rows: Sequence[Row]) -> Row:
    """How many times as long the others take for forward + backward."""
    return {f"{other['path']}_ratio": other["total_ms"] / row["total_ms"] for other in rows if other is not row}


COLUMNS = [
    ["path", "path"],
    ["splats", "splats"],
    ["raster", "raster"],
    ["size", "size x"],
    ["tile", "tile px"],
    ["pairs", "pairs"],
    ["first_s", "first call s"],
    ["forward_ms", "forward ms"],
    ["backward_ms", "backward ms"],
    ["total_ms", "both ms"],
    ["forward_rate", "forward M eval/s"],
    ["eager_ratio", "eager / this"],
    ["naive_ratio", "naive / this"],
    ["gsplat_ratio", "gsplat / this"],
    ["forward_mb", "forward MB"],
    ["backward_mb", "backward MB"],
    ["whole_mb", "process MB"],
]
"""Of a table that `compare` fills: key and heading."""


def section(bench: Bench, title: str, columns: list[list[str]], rows: list[Row], *notes: str) -> Section:
    """A finished table with where and when it was measured."""
    return stamped(title, columns, rows, [note for note in notes if note], bench.load, bench.command)


def about_gsplat(bench: Bench) -> str:
    """A note where gsplat cannot be measured."""
    reason = rival.missing(bench.device)
    return f"gsplat: not runnable here, {reason}." if reason else ""
