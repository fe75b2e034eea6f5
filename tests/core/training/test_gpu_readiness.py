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
CLOSE, CLOSE_WITH_ADAM_OF_FEW = 1e-4, 1e-3
"""Relative differences of losses. Exposures are a dozen numbers a photograph, which Adam's first steps move by their
gradient's sign: where that is next to nothing it is another by rounding, by how much depends on the processor."""


@pytest.fixture(scope="module")
def told() -> dict[tuple[str, ...], Any]:
    """What the stand-in tells, case by case, in a process of its own: nothing may have been compiled before."""
    words = [word for case in MOST for word in ("/", *case)][1:]
    command = [sys.executable, str(TESTS / "stand_in_gpu.py"), *words]
    paths = os.pathsep.join(filter(None, [str(TESTS), os.environ.get("PYTHONPATH")]))
    environment = os.environ | {"PYTHONPATH": paths, "OMP_NUM_THREADS": "1"}  # as `make test` has it
    ended = subprocess.run(command, capture_output=True, text=True, env=environment, check=False)
    assert ended.returncode == 0, ended.stderr
    return dict(zip(MOST, json.loads(ended.stdout), strict=True))


@pytest.mark.parametrize("words", MOST)
def test_a_step_waits_for_a_gpu_seldom_and_launches_little(told: dict[Any, Any], words: tuple[str, ...]) -> None:
    close = CLOSE_WITH_ADAM_OF_FEW if any("exposure" in word for word in words) else CLOSE
    assert told[words]["device"] == pytest.approx(told[words]["cpu"], rel=close)
    for counts, most in zip((told[words]["waits"], told[words]["launches"]), MOST[words], strict=True):
        assert 0 < sum(counts.values()) <= most, counts
