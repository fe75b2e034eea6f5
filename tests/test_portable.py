"""Windows has neither fcntl nor resource: everything is imported without them, and what they do is done otherwise."""

import subprocess
import sys
from pathlib import Path

WINDOWS = """
import sys
sys.modules["fcntl"] = sys.modules["resource"] = None
"""

IMPORT_ALL = """
import importlib, pkgutil
import gsx
names = [found.name for found in pkgutil.walk_packages(gsx.__path__, "gsx.") if found.name != "gsx.__main__"]
for name in names:
    importlib.import_module(name)
print(len(names))
"""

LOCKS = """
from pathlib import Path
from gsx.experiments.run_folder.claims import claimed_name
claimed_name(Path(sys.argv[1]) / "run").__enter__()
"""

MEMORY = """
from pathlib import Path
import torch
from gsx.experiments.evaluation.evaluator import peak_memory_mb
print(peak_memory_mb(torch.device("cpu")))
from gsx.cli.dispatch import main
sys.path.insert(0, {tests})
from tiny import words
assert main(words(Path(sys.argv[1]) / "run", "iterations=1")) == 0
"""


def without_unix(code: str, folder: Path) -> subprocess.CompletedProcess[str]:
    """Runs Python code without the modules that only Unix has."""
    command = [sys.executable, "-c", WINDOWS + code, str(folder)]
    return subprocess.run(command, capture_output=True, text=True, check=False)


def test_everything_is_imported_without_what_only_unix_has(tmp_path: Path) -> None:
    done = without_unix(IMPORT_ALL, tmp_path)
    assert done.returncode == 0, done.stderr
    sources = list((Path(__file__).parents[1] / "src" / "gsx").rglob("*.py"))
    assert int(done.stdout) >= len(sources) - 2  # gsx itself and its __main__


def test_without_any_locks_a_claim_is_refused_and_not_taken_for_granted(tmp_path: Path) -> None:
    done = without_unix(LOCKS, tmp_path)
    assert done.returncode != 0
    assert "file system without locks (fcntl is unavailable)" in done.stderr


def test_peak_memory_that_is_not_known_is_said_to_be_so(tmp_path: Path) -> None:
    done = without_unix(MEMORY.replace("{tests}", repr(str(Path(__file__).parent))), tmp_path)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("None\n")
    assert "peak memory n/a" in done.stderr
    assert " splats  " not in done.stderr, "megabytes follow"
