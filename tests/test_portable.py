"""Windows has neither fcntl nor resource: everything is imported without them, and what they do is done otherwise."""

import subprocess
import sys
from pathlib import Path

import pytest

WINDOWS = """
import subprocess  # which takes a Python with msvcrt for one on Windows: before there is one
import sys, types
sys.modules["fcntl"] = sys.modules["resource"] = None
held = set()

def locking(descriptor, mode, count):
    "As msvcrt's, within one process: a file by its number on the disk."
    import os
    assert (mode, count) == (2, 1)
    place = os.fstat(descriptor).st_ino
    if place in held:
        raise PermissionError(13, "Permission denied")
    held.add(place)

sys.modules["msvcrt"] = types.SimpleNamespace(LK_NBLCK=2, locking=locking) if {msvcrt} else None
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
from gsx.core.errors import GsxError
from gsx.experiments.run_folder.claims import claimed_name
folder = Path(sys.argv[1]) / "run"
with claimed_name(folder):
    try:
        claimed_name(folder).__enter__()
    except GsxError as error:
        print("refused:", error)
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


def on_windows(code: str, folder: Path, msvcrt: bool = True) -> subprocess.CompletedProcess[str]:
    """Run Python code that believes it has Windows' modules."""
    command = [sys.executable, "-c", WINDOWS.replace("{msvcrt}", str(msvcrt)) + code, str(folder)]
    return subprocess.run(command, capture_output=True, text=True, check=False)


def test_everything_is_imported_without_what_only_unix_has(tmp_path: Path) -> None:
    done = on_windows(IMPORT_ALL, tmp_path)
    assert done.returncode == 0, done.stderr
    sources = list((Path(__file__).parents[1] / "src" / "gsx").rglob("*.py"))
    assert int(done.stdout) >= len(sources) - 2  # gsx itself and its __main__


def test_a_folder_is_claimed_by_one_at_a_time_by_windows_locks(tmp_path: Path) -> None:
    done = on_windows(LOCKS, tmp_path)
    assert "refused: " in done.stdout, done.stderr
    assert "is in use by " in done.stdout


def test_without_any_locks_a_claim_is_refused_and_not_taken_for_granted(tmp_path: Path) -> None:
    done = on_windows(LOCKS, tmp_path, msvcrt=False)
    assert done.returncode != 0
    assert "this Python has neither fcntl nor msvcrt" in done.stderr


def test_peak_memory_that_is_not_known_is_said_to_be_so(tmp_path: Path) -> None:
    done = on_windows(MEMORY.replace("{tests}", repr(str(Path(__file__).parent))), tmp_path)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("None\n")
    assert "peak memory n/a" in done.stderr
    assert " splats  " not in done.stderr, "megabytes follow"


@pytest.mark.parametrize("wait", [False, True])
def test_a_lock_is_free_again_when_its_file_is_closed(wait: bool, tmp_path: Path) -> None:
    from gsx.core.locks import lock

    with (tmp_path / "a").open("w") as first, (tmp_path / "a").open("w") as second:
        assert lock(first, wait)
        assert not lock(second)
    with (tmp_path / "a").open("w") as again:
        assert lock(again, wait)
