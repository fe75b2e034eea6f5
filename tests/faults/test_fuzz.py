"""Files that grow, by what they reach in gsx's readers, out of sound ones (atheris); where it is installed."""

import os
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest

from faults.record import record, shorter

pytestmark = [
    pytest.mark.faults,
    pytest.mark.skipif(find_spec("atheris") is None, reason="atheris is not installed"),
]

RUNS = 10_000
FILES = [
    ("PLY", 0),
    ("PLY", 1),
    ("transforms.json", 0),
    ("transforms of NeRF-synthetic", 0),
    ("JSON files of a run", 0),
    ("JSON files of a run", 2),
    ("JSON files of a run", 3),
    ("checkpoint of the right digest", 0),
]
"""Reader, and number of its file."""


@pytest.mark.parametrize(("reader", "number"), FILES)
def test_grown_files(tmp_path: Path, reader: str, number: int) -> None:
    runs = int(shorter(RUNS))
    words = [sys.executable, "-m", "faults.fuzz", reader, str(number), str(tmp_path), str(runs), "0"]
    tests = Path(__file__).parents[1]
    paths = os.pathsep.join(map(str, (tests, tests / "scenes")))
    with record(f"a file that atheris grows: {reader}", number, seed=0) as counts:
        environment = {**os.environ, "PYTHONPATH": paths, "GSX_CACHE": str(tmp_path / "cache")}
        ended = subprocess.run(words, env=environment, capture_output=True, text=True, errors="replace", check=False)
        problem = tmp_path / "problem.txt"
        assert ended.returncode == 0, problem.read_text() if problem.exists() else ended.stderr[-2000:]
        assert f"Done {runs} runs" in ended.stderr, ended.stderr[-2000:]
        counts.cases += runs
