"""Measure every case of the extremes suite and write the table into docs/benchmarks/extremes.md.

    python benchmarks/extremes.py

Needs only the sources. Takes about half a minute, and the compilations where a compiler works.
"""

import sys
from pathlib import Path

import torch

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tests"))

from extremes.cases import CASES, Case, scientific  # type: ignore[import-not-found]  # noqa: E402
from extremes.comparison import measure, paths  # type: ignore[import-not-found]  # noqa: E402
from extremes.table import COLUMNS, PATHS, rewritten  # type: ignore[import-not-found]  # noqa: E402

PAGE = ROOT / "docs" / "benchmarks" / "extremes.md"


def worst(case: Case, path: str) -> tuple[float, float]:
    """Largest image error and largest relative gradient error of float32 under both culling rules."""
    found = [measure(case, path, torch.float32, cull) for cull in ("published", "tight")]
    return max(one.image_error for one in found), max(max(one.gradient_errors.values()) for one in found)


def row(case: Case) -> list[str]:
    """The case, two numbers of each path, and what happens."""
    cells = [case.name]
    for path in PATHS:
        measured = not case.refused and path in paths()
        cells += [scientific(error, digits=1) for error in worst(case, path)] if measured else ["", ""]
    return [*cells, case.happens]


def main() -> None:
    """Rewrite the block between the markers."""
    table = [COLUMNS, ["---"] * len(COLUMNS), *map(row, CASES)]
    PAGE.write_text(rewritten(PAGE.read_text(), table))
    print(f"{len(CASES)} cases on {', '.join(paths())}: {PAGE.relative_to(ROOT)}")


if __name__ == "__main__":
    main()
