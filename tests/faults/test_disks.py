"""Killed or out of disk at every change of a file: the same command again ends in the bits of a run left alone."""

import errno
import shutil
from collections.abc import Sequence
from pathlib import Path

import pytest

from faults.children import Ended, preload, run_in_child
from faults.record import record, some
from faults.verbs import VERBS, model_by_name, orphans

pytestmark = pytest.mark.faults

PARTS = 4
"""Shares of the places at which something happens, so that processes can take one each."""
RUN = VERBS["reuse"].words


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> tuple[Ended, str]:
    """How the command ends that nothing happens to, and the digest of its model."""
    place = tmp_path_factory.mktemp("disks") / "whole"
    preload(RUN, place.parent / "first")
    ended = run_in_child(RUN, place)
    assert ended.code == 0, ended.said
    assert ended.changes > 50, "the test needs changes to be seen"
    return ended, model_by_name(place)


def places(ended: Ended, part: int, every: int = 1) -> Sequence[int]:
    """Numbers of changes, from the first to the last."""
    return some(range(1 + part, ended.changes + 1, PARTS * every))


@pytest.mark.parametrize("part", range(PARTS))
def test_killed_at_every_change(whole: tuple[Ended, str], tmp_path: Path, part: int) -> None:
    with record("killed at a change of a file, then the same command", part) as counts:
        for at in places(whole[0], part):
            place = tmp_path / f"at_{at}"
            assert run_in_child(RUN, place, at=at).code == -9
            again = run_in_child(RUN, place)
            assert again.code == 0, (at, again.said)
            assert model_by_name(place) == whole[1], at
            assert orphans(place) == [], at
            assert 'class="notice' not in next(place.glob("outputs/demo/gs3d/*/report.html")).read_text(), at
            counts.cases += 1
            shutil.rmtree(place)


@pytest.mark.parametrize("part", range(PARTS))
@pytest.mark.parametrize(("name", "every"), [("ENOSPC", 2), ("EIO", 5), ("EDQUOT", 9)])
def test_a_disk_that_fails_from_any_change_on(
    whole: tuple[Ended, str], tmp_path: Path, name: str, every: int, part: int
) -> None:
    with record(f"{name} from a change of a file on, then the same command", part) as counts:
        for at in places(whole[0], part, every):
            place = tmp_path / f"at_{at}"
            ended = run_in_child(RUN, place, at=at, error=getattr(errno, name))
            assert (ended.code, len(ended.sentences)) == ((2, 1) if ended.failed else (0, 0)), (at, ended.said)
            assert "Traceback" not in ended.said, (at, ended.said)
            again = run_in_child(RUN, place)
            assert again.code == 0, (at, again.said)
            assert model_by_name(place) == whole[1], at
            assert orphans(place) == [], at
            counts.cases += 1
            shutil.rmtree(place)
