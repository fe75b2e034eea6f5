"""Steps on a device that is not there (stand_in_gpu.py): the CPU's losses, few waits, few launches."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

TESTS = Path(__file__).parents[2]
MOST = {
    ("backbone=gs3d",): (5, 285),
    ("backbone=gs3d", "training.exposure.when=always", "training.exposure.start=0.01"): (5, 325),
    ("backbone=octree_scaffold",): (9, 560),
}
"""Waits and launches of a step: sizes of four lists and the guard, with anchors four more."""
CLOSE, CLOSE_WITH_ADAM_OF_FEW = 1e-4, 1e-3
"""Relative differences of losses. Exposures are a dozen numbers a photograph, which Adam's first steps move by their
gradient's sign: where that is next to nothing it is another by rounding, by how much depends on the processor."""


@pytest.mark.parametrize("words", MOST)
def test_a_step_waits_for_a_gpu_seldom_and_launches_little(words: tuple[str, ...]) -> None:
    """In a process of its own: nothing may have been compiled before."""
    command = [sys.executable, str(TESTS / "stand_in_gpu.py"), *words]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, [str(TESTS), os.environ.get("PYTHONPATH")]))}
    ended = subprocess.run(command, capture_output=True, text=True, env=environment, check=False)
    assert ended.returncode == 0, ended.stderr
    told = json.loads(ended.stdout)
    close = CLOSE_WITH_ADAM_OF_FEW if any("exposure" in word for word in words) else CLOSE
    assert told["device"] == pytest.approx(told["cpu"], rel=close)
    for counts, most in zip((told["waits"], told["launches"]), MOST[words], strict=True):
        assert 0 < sum(counts.values()) <= most, counts
