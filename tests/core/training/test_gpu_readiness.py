"""Steps on a device that is not there (stand_in_gpu.py): the CPU's losses, few waits, few launches."""

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

TESTS = Path(__file__).parents[2]
EXPOSURES = tuple(f"training.exposure.{word}" for word in ("when=always", "start=0.01", "until=0.02", "times=2"))
"""Told before the second and the third of four steps."""
MOST = {
    ("backbone=gs3d",): (5, 230),
    ("backbone=gs3d", *EXPOSURES): (5, 270),
    ("backbone=octree_scaffold",): (9, 415),
}
"""Waits and launches of a step: sizes of four lists and the guard, with anchors four more."""
MOST_RECORDED = (1, 40)
"""The same of a step that is replayed: the host hears once whether all went well."""
CLOSE, CLOSE_WITH_ADAM_OF_FEW = 1e-4, 1e-3
"""Relative differences of losses. Exposures are a dozen numbers a photograph, which Adam's first steps move by their
gradient's sign: where that is next to nothing it is another by rounding, by how much depends on the processor."""


RECORDED = ("--recorded", "backbone=mip_splatting", "training.coarse=2", "training.coarse_until=0.05")
SIZES = ("--recorded", "--sizes", "backbone=gs3d", "backbone.density.stop=0", "backbone.sh_degree=0")
BROKEN = ("--broken", "backbone=gs3d")
SECOND_BROKEN = ("--second-broken", *SIZES[1:])


@pytest.fixture(scope="module")
def told() -> dict[tuple[str, ...], Any]:
    """What the stand-in tells, case by case, in a process of its own: nothing may have been compiled before."""
    cases = [*MOST, RECORDED, SIZES, BROKEN, SECOND_BROKEN]
    words = [word for case in cases for word in ("/", *case)][1:]
    command = [sys.executable, str(TESTS / "stand_in_gpu.py"), *words]
    paths = os.pathsep.join(filter(None, [str(TESTS), os.environ.get("PYTHONPATH")]))
    environment = os.environ | {"PYTHONPATH": paths, "OMP_NUM_THREADS": "1"}  # as `make test` has it
    ended = subprocess.run(command, capture_output=True, text=True, env=environment, check=False)
    assert ended.returncode == 0, ended.stderr
    return dict(zip(cases, json.loads(ended.stdout), strict=True))


@pytest.mark.parametrize("words", MOST)
def test_a_step_waits_for_a_gpu_seldom_and_launches_little(told: dict[Any, Any], words: tuple[str, ...]) -> None:
    close = CLOSE_WITH_ADAM_OF_FEW if any("exposure" in word for word in words) else CLOSE
    assert told[words]["device"] == pytest.approx(told[words]["cpu"], rel=close)
    for counts, most in zip((told[words]["waits"], told[words]["launches"]), MOST[words], strict=True):
        assert 0 < sum(counts.values()) <= most, counts


def test_a_recorded_step_waits_once_and_is_the_step_that_is_not_recorded(told: dict[Any, Any]) -> None:
    """With Mip-Splatting's filter, density control and a change of resolution in between. The stand-in asserts that
    what is recorded never waits, copies nothing from the host, and is replayed on the tensors that it has read."""
    found = told[RECORDED]
    assert found["device"] == found["unrecorded"]
    assert found["launches"].get("compiled graph") == 1
    for counts, most in zip((found["waits"], found["launches"]), MOST_RECORDED, strict=True):
        assert 0 < sum(counts.values()) <= most, counts


def test_photographs_of_many_sizes_are_not_recorded_anew_each_time(told: dict[Any, Any]) -> None:
    """Of three, in any order: two have a record."""
    found = told[SIZES]
    assert found["device"] == found["unrecorded"]
    assert found["made"] == 2, "of 9 steps"


def test_where_recording_fails_steps_go_on_without_it(told: dict[Any, Any]) -> None:
    found = told[BROKEN]
    assert found["device"] == found["unrecorded"]
    assert found["failed"] == 1, "tried once, and not again"
    assert "compiled graph" not in found["launches"]


def test_where_recording_fails_for_pictures_of_another_size_the_first_record_stays(told: dict[Any, Any]) -> None:
    """For want of memory, say."""
    found = told[SECOND_BROKEN]
    assert found["device"] == found["unrecorded"]
    assert (found["failed"], found["made"]) == (1, 1)
    assert found["replayed"] > 1
