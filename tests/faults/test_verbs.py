"""Verbs on run folders, killed or out of disk at every change of a file: the same again leaves what it should."""

import errno
from pathlib import Path

import pytest

from faults.children import run_in_child
from faults.record import record, some
from faults.verbs import VERBS, Prepared, orphans, prepared

pytestmark = pytest.mark.faults

AGAIN = [name for name in VERBS if name not in ("train", "reuse")]
"""Verbs that can be given again on what they left; of runs test_disks has the same."""


def given_again(case: Prepared, at: int) -> None:
    """The same command again ends well, or says that all is done, and leaves what it should and nothing else."""
    again = run_in_child(case.verb.words, case.place)
    assert again.code == 0 or (again.code == 2 and "is complete" in again.said), (at, again.said)
    assert case.verb.result(case.place) == case.expected, at
    assert orphans(case.place) == [], at


@pytest.mark.parametrize("name", AGAIN)
def test_killed_at_every_change(tmp_path: Path, name: str) -> None:
    case = prepared(VERBS[name], tmp_path)
    with record(f"gsx {name}: killed at a change of a file, then again") as counts:
        for at in some(range(1, case.whole.changes + 1, case.verb.every)):
            case.put_back()
            assert run_in_child(case.verb.words, case.place, at=at).code == -9
            given_again(case, at)
            counts.cases += 1


@pytest.mark.parametrize("name", AGAIN)
def test_a_disk_that_is_full_from_any_change_on(tmp_path: Path, name: str) -> None:
    case = prepared(VERBS[name], tmp_path)
    with record(f"gsx {name}: ENOSPC from a change of a file on, then again") as counts:
        for at in some(range(1, case.whole.changes + 1, case.verb.every)):
            case.put_back()
            ended = run_in_child(case.verb.words, case.place, at=at, error=errno.ENOSPC)
            told = len(ended.sentences)
            assert ended.code == (2 if ended.failed else 0), (at, ended.said)
            assert 0 < told <= case.verb.sentences if ended.failed else told == 0, (at, ended.said)
            assert "Traceback" not in ended.said, (at, ended.said)
            given_again(case, at)
            counts.cases += 1
