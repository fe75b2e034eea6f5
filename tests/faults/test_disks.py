"""Killed or out of disk at every change of a file: the same command again ends in the bits of a run left alone."""

import errno
import hashlib
import shutil
from collections.abc import Sequence
from pathlib import Path

import pytest
from tiny import OVERRIDES

from faults.children import Ended, preload, run_in_child
from faults.record import record, some
from faults.verbs import orphans

pytestmark = pytest.mark.faults

PARTS = 4
"""Shares of the places at which something happens, so that processes can take one each."""
RUN = [*OVERRIDES, "reuse=true", "iterations=6", "training.checkpoint_every=2", "training.log_every=1",
       "rasterizer=eager", "eval.zoom=[1,2]", "augmenter=[upscale]", "regenerator/upscale=lanczos",
       *(f"augmenter.upscale.timing.{key}=10000" for key in ("start", "every", "span"))]  # fmt: skip


def digest(place: Path) -> str:
    """Of all tensors of the run's last checkpoint."""
    (last,) = [sorted(folder.glob("*.safetensors"))[-1] for folder in place.glob("outputs/demo/gs3d/*/checkpoints")]
    assert last.stem == "step_0000006"
    return hashlib.sha256(last.read_bytes()).hexdigest()


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> tuple[Ended, str]:
    """How the command ends that nothing happens to, and the digest of its model."""
    place = tmp_path_factory.mktemp("disks") / "whole"
    preload(RUN, place.parent / "first")
    ended = run_in_child(RUN, place)
    assert ended.code == 0, ended.said
    assert ended.changes > 50, "the test needs changes to be seen"
    return ended, digest(place)


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
            assert digest(place) == whole[1], at
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
            told = sum(line.startswith("gsx: ") for line in ended.said.splitlines())
            assert (ended.code, told) == ((2, 1) if ended.failed else (0, 0)), (at, ended.said)
            assert "Traceback" not in ended.said, (at, ended.said)
            again = run_in_child(RUN, place)
            assert again.code == 0, (at, again.said)
            assert digest(place) == whole[1], at
            assert orphans(place) == [], at
            counts.cases += 1
            shutil.rmtree(place)
