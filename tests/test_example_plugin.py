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
from gsx.cli.dispatch import main
from gsx.core.data.images import write_image
from gsx.core.plugins import load_plugins
from gsx.experiments.runs.compose import compose
from gsx.experiments.runs.load_scene import load_scene

EXAMPLES = Path(__file__).parents[1] / "examples"
PAGE = Path(__file__).parents[1] / "docs" / "how-to" / "write-a-plugin.md"
FEW = ("scene.points=100",)


def write_files_of_page(folder: Path) -> None:
    """Write the files of the page's complete plugin: those named in bold, with the code below them or empty."""
    for name, code in re.findall(
        r"^\*\*`(my_plugin/[^`]+)`\*\*[^\n]*(?:\n\n```\w+\n(.*?)^```)?", PAGE.read_text(), re.M | re.S
    ):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(code)


@pytest.fixture(scope="module")
def site(tmp_path_factory) -> Path:
    """A folder on the path with the examples installed, and a distribution whose entry point does not import."""
    folder = tmp_path_factory.mktemp("site")
    source = tmp_path_factory.mktemp("source")
    for name in ("plugin", "pseudo_plugin", "own_plugin", "module_plugin"):
        shutil.copytree(EXAMPLES / name, source / name)
    write_files_of_page(source)
    command = [sys.executable, "-m", "pip", "install", "--no-deps", "--no-index", "--no-build-isolation"]
    command += ["--target", str(folder), *map(str, source.iterdir())]
    subprocess.run(command, check=True, capture_output=True)
    broken = folder / "broken-1.0.dist-info"
    broken.mkdir()
    (broken / "METADATA").write_text("Metadata-Version: 2.1\nName: broken\nVersion: 1.0\n")
    (broken / "entry_points.txt").write_text("[gsx]\nbroken = no_such_module\n")
    return folder


@pytest.fixture
def installed(site: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """That folder on the path of this process, which spares the start of others."""
    monkeypatch.syspath_prepend(site)


def test_it_is_listed_and_the_broken_one_is_reported(site: Path) -> None:
    command, environment = [sys.executable, "-m", "gsx", "plugins"], {**os.environ, "PYTHONPATH": str(site)}
    out = subprocess.run(command, capture_output=True, text=True, check=True, env=environment).stdout
    assert "gs3d_fixed (fixed)" in out
    assert "plugin fixed 0.1.0" in out
    assert "failed to load: broken: ModuleNotFoundError" in out


@pytest.mark.usefixtures("installed")
def test_its_backbone_trains_with_its_own_configuration_file(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(words(tmp_path / "run", "backbone=gs3d_fixed", *FEW, "scene.train_views=3", "iterations=12")) == 0
    assert "plugin broken did not load" in capsys.readouterr().err
    metrics = (tmp_path / "run" / "metrics.jsonl").read_text()
    assert "cloned" not in metrics
    assert "opacity_resets" not in metrics


@pytest.mark.usefixtures("installed")
def test_external_plugins_can_be_switched_off(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    told = []
    for switch in ("", "1"):
        monkeypatch.setenv("GSX_NO_PLUGINS", switch)
        assert main(["plugins"]) == 0
        told.append("gs3d_fixed" in capsys.readouterr().out)
    assert told == [True, False]


@pytest.mark.usefixtures("installed")
def test_its_augmenter_trains_with_its_regenerator(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    chosen = ("augmenter=steady_zoom", "regenerator/upscale=sharpened", "iterations=20", "training.log_every=1")
    assert main(words(tmp_path / "run", *chosen, *FEW)) == 0
    assert "schedule of steady_zoom: from 10" in capsys.readouterr().err
    lines = [json.loads(line) for line in (tmp_path / "run" / "metrics.jsonl").read_text().splitlines()]
    assert ["terms" in line for line in lines] == [False] * 10 + [True] * 10
    assert all(line["terms"]["steady_zoom"] > 0 for line in lines[10:])
    evaluation = json.loads((tmp_path / "run" / "evaluation.json").read_text())
    assert evaluation["psnr"] > 5
    asked = [line["pseudo"]["steady_zoom"]["asked"]["2"] for line in lines if "pseudo" in line]
    assert sum(asked) == 6, "each training view once: told without a word of the augmenter's"
    assert evaluation["pseudo"]["steady_zoom"]["asked"] == {"2": 6}


@pytest.mark.usefixtures("installed")
def test_the_plugin_of_the_page_trains_as_written(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    chosen = ("augmenter=upscale", "regenerator/upscale=doubled", "scene.width=48", "scene.height=36", "iterations=8")
    assert main(words(tmp_path / "run", *chosen, *FEW)) == 0
    assert re.search(r"upscale at step \d+: (\d+) of \1 pictures", capsys.readouterr().err)


@pytest.fixture(scope="module")
def snapshots(tmp_path_factory) -> Path:
    """Pictures of the built-in scene in the format of the example's loader."""
    options = {
        "scene.points": 100,
        "scene.width": 48,
        "scene.height": 36,
        "scene.samples": 1,
        "scene.train_views": 8,
        "scene.test_views": 1,
    }
    scene = load_scene(compose([f"{key}={value}" for key, value in options.items()], load_plugins([("gsx", builtin)])))
    folder, entries = tmp_path_factory.mktemp("snapshots"), []
    for view in scene.train:
        write_image(folder / f"{view.name}.png", view.image())
        pose = torch.cat([view.camera.rotation, view.camera.translation[:, None]], 1)
        entries.append({"file": f"{view.name}.png", "fx": view.camera.fx, "camera_from_world": pose.tolist()})
    (folder / "snapshots.json").write_text(json.dumps(entries))
    return folder


@pytest.mark.usefixtures("installed")
def test_its_scene_format_is_recognised(snapshots: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["scenes", str(snapshots)]) == 0
    out = capsys.readouterr().out.splitlines()
    assert out[0] == "format    snapshots: snapshots (snapshots.json)"
    assert "split     7 to train on, 1 to test on" in out
    assert out[-1] == f"train     gsx scene=snapshots scene.path={snapshots}"


@pytest.mark.usefixtures("installed")
def test_a_backbone_of_its_own_trains_on_it_resumes_and_is_exported(
    snapshots: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Loss falls; a run that was stopped ends with the same bits; the splat file draws the same pictures."""
    own = ("backbone=spheres", "scene=snapshots", f"scene.path={snapshots}", "iterations=60")
    once, halves = tmp_path / "once", tmp_path / "halves"
    often = ("training.log_every=1", "training.checkpoint_every=45", "training.test_points=0", "eval.flight=false")
    assert main([*own, *often, f"folder={once}"]) == 0
    lines = [json.loads(line) for line in (once / "metrics.jsonl").read_text().splitlines()]
    assert statistics.fmean(line["loss"] for line in lines[-10:]) < 0.8 * statistics.fmean(
        line["loss"] for line in lines[:10]
    )
    shutil.copytree(once, halves)
    for path in (halves / "checkpoints").glob("step_0000060.*"):
        path.unlink()
    assert main(["resume", str(halves)]) == 0
    last = [load_file(folder / "checkpoints" / "step_0000060.safetensors") for folder in (once, halves)]
    assert all(torch.equal(last[0][key], last[1][key]) for key in last[0])
    capsys.readouterr()
    assert main(["export", str(once), str(tmp_path / "spheres.ply")]) == 0
    worst = float(re.search(r"(\S+) dB at worst", capsys.readouterr().err).group(1))
    assert worst > 60


@pytest.mark.usefixtures("installed")
def test_a_training_module_of_its_own_trains_resumes_and_reports(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Codes are learnt; a run that was stopped ends with the same bits; log and report have its lines."""
    often = ("training.log_every=1", "training.checkpoint_every=8", "training.checkpoints_kept=9")
    chosen = ("module=[tint]", "training.tint.size=3", "iterations=16", *often, *FEW)
    once, halves = tmp_path / "once", tmp_path / "halves"
    assert main(words(once, *chosen)) == 0
    remark = "tints of photos have a spread of"
    assert remark in capsys.readouterr().err
    assert remark in (once / "report.html").read_text()
    lines = [json.loads(line) for line in (once / "metrics.jsonl").read_text().splitlines()]
    spreads = [line["tint"] for line in lines]
    assert spreads[0] == 0 < spreads[8] < spreads[-1]
    assert json.loads((once / "evaluation.json").read_text())["tint"] == {"spread": spreads[-1]}
    shutil.copytree(once, halves)
    for path in (halves / "checkpoints").glob("step_0000016.*"):
        path.unlink()
    assert main(["resume", str(halves)]) == 0
    last = [load_file(folder / "checkpoints" / "step_0000016.safetensors") for folder in (once, halves)]
    assert last[0]["tint.codes"].shape == (6, 3)
    assert all(torch.equal(last[0][key], last[1][key]) for key in last[0])


@pytest.mark.usefixtures("installed")
def test_options_of_its_module_are_checked(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["module=[tints]"]) == 2
    assert "Did you mean 'tint'?" in capsys.readouterr().err
    assert main(["module=[tint]", "training.tint.sise=3"]) == 2
    assert "training.tint.size" in capsys.readouterr().err
