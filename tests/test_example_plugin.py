"""The example plugin package, installed as a third party would install it, beside one that is broken."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from tiny import words

EXAMPLES = Path(__file__).parents[1] / "examples"


@pytest.fixture(scope="module")
def site(tmp_path_factory) -> Path:
    """A folder on the path with the examples installed, and a distribution whose entry point does not import."""
    folder = tmp_path_factory.mktemp("site")
    source = tmp_path_factory.mktemp("source")
    command = [sys.executable, "-m", "pip", "install", "--no-deps", "--no-index", "--no-build-isolation"]
    for name in ("plugin", "pseudo_plugin"):
        shutil.copytree(EXAMPLES / name, source / name)
        subprocess.run([*command, "--target", str(folder), str(source / name)], check=True, capture_output=True)
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


def test_its_augmenter_trains_with_its_regenerator(site: Path, tmp_path: Path) -> None:
    chosen = ("augmenter=steady_zoom", "regenerator/upscale=sharpened", "iterations=20", "training.log_every=1")
    result = gsx(site, *words(tmp_path / "run", *chosen))
    assert result.returncode == 0, result.stderr
    assert "plan of steady_zoom: from 10" in result.stderr
    lines = [json.loads(line) for line in (tmp_path / "run" / "metrics.jsonl").read_text().splitlines()]
    assert ["terms" in line for line in lines] == [False] * 10 + [True] * 10
    assert all(line["terms"]["steady_zoom"] > 0 for line in lines[10:])
    evaluation = json.loads((tmp_path / "run" / "evaluation.json").read_text())
    assert evaluation["psnr"] > 5
