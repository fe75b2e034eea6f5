"""A wheel installed outside the tree runs without network. Give GSX_TEST_WHEEL to test a wheel built before."""

import os
import shutil
import subprocess
import sys
import sysconfig
import zipfile
from pathlib import Path

import pytest
from tiny import words

ROOT = Path(__file__).parents[1]

OFFLINE = """
import socket, sys
def refuse(*a, **k): raise OSError("no network in this test")
socket.socket.connect = refuse
from gsx.cli.dispatch import main
import gsx
assert {target!r} in gsx.__file__, gsx.__file__
sys.exit(main(sys.argv[1:]))
"""


@pytest.fixture(scope="module")
def wheel(tmp_path_factory) -> Path:
    """The wheel under test; built here unless one is given."""
    given = os.environ.get("GSX_TEST_WHEEL")
    if given:
        return (ROOT / given).resolve()
    folder = tmp_path_factory.mktemp("wheel")
    shutil.rmtree(ROOT / "build" / "lib", ignore_errors=True)  # setuptools packs what an earlier build has left
    command = [sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", str(folder), str(ROOT)]
    subprocess.run(command, check=True, capture_output=True)
    return next(folder.glob("*.whl"))


def test_wheel_holds_every_module_and_configuration_file(wheel: Path) -> None:
    inside = set(zipfile.ZipFile(wheel).namelist())
    sources = (ROOT / "src").rglob("*")
    expected = {str(p.relative_to(ROOT / "src")) for p in sources if p.suffix in (".py", ".html", ".typed", ".xz")}
    assert "gsx/py.typed" in expected
    kept = (path for path in (ROOT / "conf").rglob("*") if path.suffix in (".yaml", ".csv", ".py"))
    expected |= {f"gsx/conf/{path.relative_to(ROOT / 'conf')}" for path in kept}
    assert expected == {name for name in inside if ".dist-info/" not in name}


def test_installed_wheel_trains_the_built_in_scene_offline(wheel: Path, tmp_path: Path) -> None:
    target = tmp_path / "site"
    subprocess.run(
        [sys.executable, "-m", "pip", "install", "--no-deps", "--no-index", "--target", str(target), str(wheel)],
        check=True, capture_output=True,
    )  # fmt: skip
    # the libraries come from this environment; its own (editable) gsx does not: -S skips the files that install it
    environment = {
        "PATH": os.environ["PATH"],
        "GSX_CACHE": str(tmp_path / "cache"),
        "PYTHONPATH": os.pathsep.join([str(target), sysconfig.get_path("purelib")]),
    }
    code = OFFLINE.format(target=str(target))
    command = [sys.executable, "-S", "-c", code, *words(tmp_path / "run", "iterations=2")]
    result = subprocess.run(command, capture_output=True, text=True, check=False, env=environment, cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    assert (tmp_path / "run" / "report.html").is_file()
