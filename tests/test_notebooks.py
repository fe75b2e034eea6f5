"""The notebooks: what is committed is what their sources give, and every cell runs."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
FOLDER = ROOT / "examples" / "notebooks"
sys.path.insert(0, str(ROOT / "scripts"))
from notebooks import cells_of  # noqa: E402

NAMES = sorted(path.stem for path in FOLDER.glob("*.py"))


@pytest.mark.parametrize("name", NAMES)
def test_committed_notebooks_have_the_cells_of_their_sources_and_outputs(name: str) -> None:
    notebook = json.loads((FOLDER / f"{name}.ipynb").read_text())
    cells = [(cell["cell_type"], "".join(cell["source"])) for cell in notebook["cells"]]
    assert cells == cells_of((FOLDER / f"{name}.py").read_text()), "run scripts/notebooks.py"
    outputs = [output for cell in notebook["cells"] for output in cell.get("outputs", [])]
    assert any("image/png" in output.get("data", {}) for output in outputs)
    assert not any(output["output_type"] == "error" for output in outputs)
    assert str(ROOT) not in json.dumps(notebook)


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_every_cell_runs(name: str, tmp_path: Path) -> None:
    """As a script, with a few steps of a small scene."""
    source = re.sub(r"iterations=\d+", "iterations=8", (FOLDER / f"{name}.py").read_text())
    source = re.sub(r"scene\.(width|height)=\d+", r"scene.\1=64", source)
    source = re.sub(r"left=\d+, top=\d+, width=\d+, height=\d+", "left=0, top=0, width=32, height=32", source)
    (tmp_path / "cells.py").write_text(source)
    command, place = [sys.executable, "cells.py"], os.environ | {"GSX_CACHE": str(tmp_path / "cache")}
    ended = subprocess.run(command, cwd=tmp_path, env=place, capture_output=True, text=True, check=False)
    assert ended.returncode == 0, ended.stderr[-3000:]
