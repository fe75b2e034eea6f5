"""Counts of the fault suite, one file a test, gathered into docs/benchmarks/faults.md by make test-faults."""

import json
import os
import re
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

COUNTED = Path(__file__).parents[2] / "build" / "faults"
"""Folder of the counts of the last run of the suite."""

MARK = "<!-- faults: written by tests/faults/record.py -->\n"
"""Above the table."""


SHARE = float(os.environ.get("GSX_FAULTS", "1"))
"""Of the cases that are tried: CI takes a small one."""


def some(cases: Sequence[Any]) -> Sequence[Any]:
    """SHARE of the cases, at even distances; at least one."""
    return cases[:: max(1, round(1 / SHARE))] if SHARE < 1 else cases


def shorter(amount: float) -> float:
    """SHARE of an amount."""
    return amount * SHARE


@dataclass
class Counts:
    """Of one part of a test."""

    cases: int = 0


@contextmanager
def record(what: str, part: int = 0, seed: int | None = None) -> Iterator[Counts]:
    """Keep how many cases there were and how long they took, where none failed."""
    counts, begun = Counts(), time.monotonic()
    yield counts
    if SHARE < 1:
        return
    facts = {"what": what, "cases": counts.cases, "seed": seed, "seconds": round(time.monotonic() - begun)}
    COUNTED.mkdir(parents=True, exist_ok=True)
    (COUNTED / f"{re.sub(r'[^A-Za-z0-9]+', '_', what)}_{part}.json").write_text(json.dumps(facts))


def table() -> str:
    """Return the lines of docs/benchmarks/faults.md: cases, seeds and seconds of each test that passed."""
    found: dict[str, list[dict]] = {}
    for path in sorted(COUNTED.glob("*.json")):
        facts = json.loads(path.read_text())
        found.setdefault(facts["what"], []).append(facts)
    lines = ["| what happens | cases | seeds | seconds |", "|---|---:|---|---:|"]
    for what, parts in found.items():
        seeds = ", ".join(str(part["seed"]) for part in parts if part["seed"] is not None) or "none"
        cases, seconds = (sum(part[key] for part in parts) for key in ("cases", "seconds"))
        lines.append(f"| {what} | {cases:,} | {seeds} | {seconds:,} |")
    return "\n".join(lines)


def write(page: Path) -> None:
    """Put the table into the page in place of the one before."""
    text = page.read_text()
    begin = text.index(MARK) + len(MARK)
    page.write_text(text[:begin] + table() + text[text.index("\n\n", begin) :])


if __name__ == "__main__":
    write(Path(__file__).parents[2] / "docs" / "benchmarks" / "faults.md")
