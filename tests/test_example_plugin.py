"""The example plugin package, installed as a third party would install it, beside one that is broken."""

import json
import os
import re
import shutil
import statistics
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file
from tiny import words

from gsx import builtin
from gsx.core.data.images import write_image
from gsx.core.plugins import load_plugins
from gsx.experiments.runs.compose import compose
from gsx.experiments.runs.load_scene import load_scene

EXAMPLES = Path(__file__).parents[1] / "examples"


@pytest.fixture(scope="module")
def site(tmp_path_factory) -> Path:
    """A folder on the path with the examples installed, and a distribution whose entry point does not import."""
    folder = tmp_path_factory.mktemp("site")
    source = tmp_path_factory.mktemp("source")
    command = [sys.executable, "-m", "pip", "install", "--no-deps", "--no-index", "--no-build-isolation"]
    for name in ("plugin", "pseudo_plugin", "own_plugin"):
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
    asked = [line["pseudo"]["steady_zoom"]["asked"]["2"] for line in lines if "pseudo" in line]
    assert sum(asked) == 6, "each training view once: told without a word of the augmenter's"
    assert evaluation["pseudo"]["steady_zoom"]["asked"] == {"2": 6}


@pytest.fixture(scope="module")
def snapshots(tmp_path_factory) -> Path:
    """Pictures of the built-in scene in the format of the example's loader."""
    options = {"scene.width": 64, "scene.height": 48, "scene.train_views": 8, "scene.test_views": 1}
    scene = load_scene(compose([f"{key}={value}" for key, value in options.items()], load_plugins([("gsx", builtin)])))
    folder, entries = tmp_path_factory.mktemp("snapshots"), []
    for view in scene.train:
        write_image(folder / f"{view.name}.png", view.image())
        pose = torch.cat([view.camera.rotation, view.camera.translation[:, None]], 1)
        entries.append({"file": f"{view.name}.png", "fx": view.camera.fx, "camera_from_world": pose.tolist()})
    (folder / "snapshots.json").write_text(json.dumps(entries))
    return folder


def test_its_scene_format_is_recognised(site: Path, snapshots: Path) -> None:
    out = gsx(site, "scenes", str(snapshots)).stdout.splitlines()
    assert out[0] == "format    snapshots: snapshots (snapshots.json)"
    assert "split     7 to train on, 1 to test on" in out
    assert out[-1] == f"train     gsx scene=snapshots scene.path={snapshots}"


def test_a_backbone_of_its_own_trains_on_it_resumes_and_is_exported(
    site: Path, snapshots: Path, tmp_path: Path
) -> None:
    """Loss falls; a run that was stopped ends with the same bits; the splat file draws the same pictures."""
    own = ("backbone=spheres", "scene=snapshots", f"scene.path={snapshots}", "iterations=60", "training.log_every=1")
    once, halves = tmp_path / "once", tmp_path / "halves"
    trained = gsx(site, *own, "training.checkpoint_every=20", f"folder={once}")
    assert trained.returncode == 0, trained.stderr
    lines = [json.loads(line) for line in (once / "metrics.jsonl").read_text().splitlines()]
    assert statistics.fmean(line["loss"] for line in lines[-10:]) < 0.8 * statistics.fmean(
        line["loss"] for line in lines[:10]
    )
    shutil.copytree(once, halves)
    for path in (halves / "checkpoints").glob("step_0000060.*"):
        path.unlink()
    assert gsx(site, "resume", str(halves)).returncode == 0
    last = [load_file(folder / "checkpoints" / "step_0000060.safetensors") for folder in (once, halves)]
    assert all(torch.equal(last[0][key], last[1][key]) for key in last[0])
    exported = gsx(site, "export", str(once), str(tmp_path / "spheres.ply"))
    assert exported.returncode == 0, exported.stderr
    worst = float(re.search(r"rendered again: (\S+) dB", exported.stderr).group(1))
    assert worst > 60
