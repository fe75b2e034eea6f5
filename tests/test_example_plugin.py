"""The example plugin package, installed as a third party would install it, beside one that is broken."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from tiny import words

EXAMPLE = Path(__file__).parents[1] / "examples" / "plugin"


@pytest.fixture(scope="module")
def site(tmp_path_factory) -> Path:
    """A folder on the path with the example installed, and a distribution whose entry point does not import."""
    folder = tmp_path_factory.mktemp("site")
    source = tmp_path_factory.mktemp("source")
    command = [sys.executable, "-m", "pip", "install", "--no-deps", "--no-index", "--no-build-isolation"]
    copy = [sys.executable, "-c", f"import shutil; shutil.copytree({str(EXAMPLE)!r}, {str(source / 'plugin')!r})"]
    subprocess.run(copy, check=True)
    subprocess.run([*command, "--target", str(folder), str(source / "plugin")], check=True, capture_output=True)
    broken = folder / "broken-1.0.dist-info"
    broken.mkdir()
    (broken / "METADATA").write_text("Metadata-Version: 2.1\nName: broken\nVersion: 1.0\n")
    (broken / "entry_points.txt").write_text("[gsx]\nbroken = no_such_module\n")
    return folder


def gsx(site: Path, *arguments: str, **environment: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "gsx", *arguments],
        capture_output=True, text=True, check=False, env={**os.environ, "PYTHONPATH": str(site), **environment},
    )  # fmt: skip


def test_it_is_listed_and_the_broken_one_is_reported(site: Path) -> None:
    out = gsx(site, "plugins").stdout
    assert "gs3d_fixed (fixed)" in out
    assert "plugin fixed 0.1.0" in out
    assert "failed to load: broken: ModuleNotFoundError" in out


def test_its_backbone_trains_with_its_own_configuration_file(site: Path, tmp_path: Path) -> None:
    result = gsx(site, *words(tmp_path / "run", "backbone=gs3d_fixed", "iterations=30"))
    assert result.returncode == 0, result.stderr
    assert "plugin broken did not load" in result.stderr
    metrics = (tmp_path / "run" / "metrics.jsonl").read_text()
    assert "cloned" not in metrics
    assert "opacity_resets" not in metrics


def test_external_plugins_can_be_switched_off(site: Path) -> None:
    assert "gs3d_fixed" not in gsx(site, "plugins", GSX_NO_PLUGINS="1").stdout
