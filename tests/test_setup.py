"""What `make` would do, without doing it."""

import shutil
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


def steps(goal: str, venv: Path, *have: str) -> str:
    """Commands of `make GOAL` where the stamps `have` are up to date."""
    venv.mkdir()
    for stamp in have:
        (venv / stamp).touch()
    command = ["make", "--dry-run", f"VENV={venv}", goal]
    return subprocess.run(command, cwd=ROOT, check=True, capture_output=True, text=True).stdout


@pytest.mark.skipif(shutil.which("make") is None, reason="no make")
@pytest.mark.skipif(not (ROOT / "Makefile").is_file(), reason="tests without their tree")
def test_a_demo_installs_what_a_run_needs_and_tests_the_rest(tmp_path: Path) -> None:
    demo = steps("demo", tmp_path / "a")
    assert "--editable ." in demo
    assert "[dev]" not in demo
    assert "gsx -m backbone=gs3d,gs3d_zoom 'eval.zoom=[1,2,4]'" in demo
    test = steps("test", tmp_path / "b")
    assert test.index("--editable .") < test.index("--editable '.[dev]'") < test.index("-m pytest")
    more = steps("test", tmp_path / "c", ".ready")
    assert " venv " not in more
    assert "[dev]" in more
    assert "pip install" not in steps("test", tmp_path / "d", ".ready", ".ready-dev")
    assert "pip install" not in steps("demo", tmp_path / "e", ".ready")
