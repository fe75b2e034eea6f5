"""Killed, or failing, at every system call that changes a file: the same command again leaves what it should."""

from pathlib import Path

import pytest

from faults.calls import STRACE, Call, failed, killed, listed
from faults.children import Ended, run_in_child
from faults.record import record, some
from faults.verbs import VERBS, Prepared, orphans, prepared

pytestmark = [pytest.mark.faults, pytest.mark.skipif(STRACE is None, reason="strace is not installed")]

PARTS, TRIES = 4, 5
"""Shares of the calls, so that processes can take one each."""
NAMES = [name for name in VERBS if name != "train"]
"""Commands that can be given again; `train` is `reuse` in a named folder."""
ERRORS = ["ENOSPC", "EIO", "EDQUOT"]
"""In turn, beginning with each of them for a run, whose calls so fail in all ways."""
FIRST = [(name, first) for name in NAMES for first in range(3 if name == "reuse" else 1)]
TITLES = {"reuse": "a run", "table": "a table of two runs", "page": "a page over runs"}
"""What the page says in place of `gsx NAME`."""


def calls_of(case: Prepared) -> list[Call]:
    """Calls of the command that change something."""
    case.put_back()
    ended, calls = listed(case.verb.words, case.place)
    assert ended.code == 0, ended.said
    assert len(calls) > 2, "the test needs changes to be seen"
    return calls[:: case.verb.every]


def again(case: Prepared, at: object) -> None:
    """The same command again ends well, or says that all is done, and leaves what it should and nothing else."""
    ended = run_in_child(case.verb.words, case.place)
    assert ended.code == 0 or (ended.code == 2 and "is complete" in ended.said), (at, ended.said)
    assert case.verb.result(case.place) == case.expected, at
    assert orphans(case.place) == [], at


@pytest.mark.parametrize("part", range(PARTS))
@pytest.mark.parametrize("name", NAMES)
def test_killed_at_every_call(tmp_path: Path, name: str, part: int) -> None:
    case = prepared(VERBS[name], tmp_path)
    calls = [call for call in calls_of(case) if not call.failed]  # which changed nothing
    with record(f"{TITLES.get(name, f'gsx {name}')}: killed at a call, then again", part) as counts:
        for call in some(calls[part::PARTS]):
            case.put_back()
            assert killed(case.verb.words, case.place, call).code == -9, call
            again(case, call)
            counts.cases += 1


@pytest.mark.parametrize("part", range(PARTS))
@pytest.mark.parametrize(("name", "first"), FIRST)
def test_every_call_fails_once(tmp_path: Path, name: str, first: int, part: int) -> None:
    case = prepared(VERBS[name], tmp_path)
    calls = list(enumerate(calls_of(case), first))
    with record(f"{TITLES.get(name, f'gsx {name}')}: a call fails ({', '.join(ERRORS)}), then again",
                PARTS * first + part) as counts:  # fmt: skip
        for number, call in some(calls[part::PARTS]):
            told(first_that(case, call, ERRORS[number % 3]), case, call)
            again(case, call)
            counts.cases += 1


def first_that(case: Prepared, call: Call, error: str) -> Ended:
    """The command, with the first failure out of some that was one of its own files'."""
    for _ in range(TRIES):
        case.put_back()
        ended = failed(case.verb.words, case.place, call, error)
        if ended is not None:
            return ended
    raise AssertionError(f"{call} was not met in {TRIES} runs")


def told(ended: Ended, case: Prepared, call: Call) -> None:
    """A call that failed is told in a sentence, or its loss is none."""
    assert "Traceback" not in ended.said, (call, ended.said)
    if ended.code == 0:
        assert ended.sentences == [], (call, ended.said)
        assert case.verb.result(case.place) == case.expected, call
    else:
        assert ended.code == 2, (call, ended.said)
        warned = [line for line in ended.said.splitlines() if line.startswith("warning: ")]  # tables go on
        sentences = ended.sentences or (warned if case.verb.words is VERBS["table"].words else [])
        assert 0 < len(sentences) <= case.verb.sentences, (call, ended.said)
