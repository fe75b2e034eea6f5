"""Two commands on one run folder at once, at random distances: one wins, or both do, and nothing is damaged."""

import os
import random
import time
from pathlib import Path

import pytest

from faults.children import Ended, run_in_child
from faults.record import record, some
from faults.verbs import VERBS, orphans, prepared

pytestmark = pytest.mark.faults

PARTS, RUNS = 2, 15
"""Shares of each pair, and interleavings of each."""
LONGEST = 1.5
"""Seconds by which one of the two comes later, at most."""
PAIRS = [("resume", "resume"), ("resume", "eval"), ("resume", "report"), ("resume", "export"), ("eval", "eval"),
         ("eval", "report"), ("report", "report"), ("export", "export"), ("render", "render"), ("train", "train"),
         ("reuse", "reuse")]  # fmt: skip
"""Names of verbs; what the first is prepared with, both find."""


def both(place: Path, first: list[str], second: list[str], delay: float) -> tuple[Ended, Ended]:
    """Two commands in one folder, one of them later; negative: the first of the two."""
    other = place.parent / "other.txt"
    pid = os.fork()
    if pid == 0:
        code = 1
        try:
            time.sleep(max(0.0, delay))
            ended = run_in_child(second, place, told_in=place.parent / "second")
            other.write_text(f"{ended.code}\n{ended.said}")
            code = 0
        finally:
            os._exit(code)
    time.sleep(max(0.0, -delay))
    ended = run_in_child(first, place, told_in=place.parent / "first_one")
    os.waitpid(pid, 0)
    code, _, said = other.read_text().partition("\n")
    return ended, Ended(code=int(code), said=said)


@pytest.mark.parametrize("part", range(PARTS))
@pytest.mark.parametrize("pair", PAIRS, ids="-".join)
def test_two_at_once(tmp_path: Path, pair: tuple[str, str], part: int) -> None:
    first, second = (VERBS[name] for name in pair)
    case, choice = prepared(first, tmp_path), random.Random(f"{pair}{part}")
    with record(f"gsx {pair[0]} and gsx {pair[1]} at once", part, seed=part) as counts:
        for number in some(range(RUNS)):
            case.put_back()
            delay = choice.uniform(-LONGEST, LONGEST)
            ends = both(case.place, first.words, second.words, delay)
            for ended in ends:
                assert (ended.code, len(ended.sentences)) in ((0, 0), (2, 1)), (number, delay, ended)
                assert "Traceback" not in ended.said, (number, delay, ended.said)
            assert 0 in (ends[0].code, ends[1].code), (number, delay, ends)
            again = run_in_child(first.words, case.place)
            done = any(words in again.said for words in ("is complete", "is not empty"))
            assert again.code == (2 if done else 0), (number, delay, again.said)
            assert first.result(case.place) == case.expected, (number, delay)
            assert orphans(case.place) == [], (number, delay)
            counts.cases += 1


TABLES = 4
"""At once."""


def test_tables_on_one_output(tmp_path: Path) -> None:
    case = prepared(VERBS["table"], tmp_path)
    with record("four tables at once on one output") as counts:
        for number in some(range(3)):
            case.put_back()
            children = [start(case.verb.words, case.place, index) for index in range(TABLES)]
            for pid in children:
                os.waitpid(pid, 0)
            for index in range(TABLES):
                said = (case.place.parent / f"table_{index}.stderr").read_text()
                assert "Traceback" not in said, (number, said)
            again = run_in_child(case.verb.words, case.place)
            assert again.code == 0, (number, again.said)
            assert case.verb.result(case.place) == case.expected, number
            assert orphans(case.place) == [], number
            counts.cases += 1


def start(words: list[str], place: Path, index: int) -> int:
    """A command in a process that is not waited for; its number."""
    pid = os.fork()
    if pid == 0:
        try:
            run_in_child(words, place, told_in=place.parent / f"table_{index}")
        finally:
            os._exit(0)
    return pid
