"""Whole runs: what they leave, exact resume, repeatability, zoom evaluation, interruption."""

import errno
import hashlib
import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from tiny import final_tensors, same_ending, stopped_at, tiny_run, tiny_settings

from gsx.builtin import plugins
from gsx.cli.dispatch import main
from gsx.core.errors import CheckpointError, ConfigError, InputError, LostModel
from gsx.core.plugins import hookimpl
from gsx.core.training.run import Run
from gsx.experiments.run_folder import checkpoint
from gsx.experiments.runs.evaluate import advice, remedies
from gsx.experiments.runs.execute import execute
from gsx.experiments.runs.open import open_run, start
from gsx.formats.splat_files import read_gaussians


def resume(folder: Path, *overrides: str) -> None:
    run, settings = open_run(folder, plugins(), overrides, training=True)
    execute(run, settings, plugins())


@pytest.fixture(scope="module")
def finished(tmp_path_factory) -> Path:
    """A finished tiny run of 24 steps, with density events and an opacity reset on the way."""
    folder = tmp_path_factory.mktemp("runs") / "whole"
    tiny_run(folder, [*DENSE, "eval.flight=true"])
    return folder


DENSE = ("iterations=24", "eval.zoom=[1,2]", "backbone.density.every=400", "backbone.density.reset_passes=1",
         "backbone.density.gradient=1e-6", "training.checkpoint_every=7")  # fmt: skip


def test_a_run_leaves_everything_documented(finished: Path) -> None:
    names = {path.name for path in finished.iterdir()}
    assert names >= {
        "config.yaml", "environment.json", "metrics.jsonl", "evaluation.json", "status.json", "report.html",
        "point_cloud.ply", "checkpoints", "renders",
    }  # fmt: skip
    assert json.loads((finished / "status.json").read_text())["state"] == "ok"
    header = (finished / "point_cloud.ply").read_bytes().split(b"end_header")[0].decode()
    assert "\ncomment SplatRenderMode: default\n" in header
    lines = [json.loads(line) for line in (finished / "metrics.jsonl").read_text().splitlines()]
    assert lines[-1]["step"] == 24
    assert sum(line.get("cloned", 0) + line.get("split", 0) for line in lines) > 0, "the test needs density events"
    assert any("opacity_resets" in line for line in lines), "the test needs an opacity reset"
    assert sum("test_psnr" in line for line in lines) == 2
    flight = json.loads((finished / "renders" / "index.json").read_text())["flight"]
    assert (finished / "renders" / flight["file"]).is_file()


def test_the_flight_can_be_left_out(tmp_path: Path) -> None:
    tiny_run(tmp_path / "run", ["iterations=1", "eval.flight=false"])
    assert "flight" not in json.loads((tmp_path / "run" / "renders" / "index.json").read_text())
    assert not list((tmp_path / "run" / "renders").glob("*flight*"))


def test_evaluation_has_the_published_layout(finished: Path) -> None:
    evaluation = json.loads((finished / "evaluation.json").read_text())
    assert evaluation.keys() >= {
        "protocol", "psnr", "ssim", "lpips", "primitives", "visible_primitives", "megabytes", "render_fps",
        "render_path", "train_seconds", "evaluate_seconds", "peak_memory_mb", "groups", "zoom", "views",
    }  # fmt: skip
    assert evaluation["lpips"] is None
    assert len(evaluation["protocol"]["hash"]) == 16
    assert evaluation["zoom"]["2"].keys() >= {"psnr", "ssim", "enlarged_psnr", "enlarged_ssim"}
    assert evaluation["zoom"]["1"]["psnr"] == pytest.approx(evaluation["psnr"])
    assert [view["name"] for view in evaluation["views"]] == evaluation["protocol"]["test_views"]
    gaussians = read_gaussians(finished / "point_cloud.ply")
    assert len(gaussians.means) == evaluation["primitives"]


def test_a_model_that_loses_zoomed_in_ends_with_what_to_try(finished: Path) -> None:
    run, settings = open_run(finished, plugins())
    assert settings.evaluation.remedy == "backbone=gs3d_zoom"  # whose runs are compensated, and get no such advice

    def told(remedy: str = "backbone=gs3d_zoom", **beats: bool | None) -> list[str]:
        zoom = {factor.strip("x"): {"beats_enlarged": won} for factor, won in beats.items()}
        return remedies(run, {"zoom": zoom | {"8": {"unavailable": "no truth"}}}, remedy)

    (line,) = told(x1=None, x2=True, x4=False)
    assert line.endswith("repeat the command with backbone=gs3d_zoom")
    assert told(x1=None, x2=True, x4=True) == told(**{"x0.5": False}) == told("", x4=False) == []
    run.raster = replace(run.raster, compensate=True)
    assert told(x4=False) == []


def test_a_plain_run_is_advised_where_a_pretrained_upscaler_is_installed(finished: Path) -> None:
    """Settings say which augmenters a run had: `gsx eval` opens it without them."""
    _, tiny = open_run(finished, plugins())
    settings = replace(tiny, resolved=tiny.resolved | {"scene": {"path": "photos"}})
    installed = {"competitor": {"name": "span", "networks": {"x2": {}}}}
    assert settings.evaluation.advice == "preset=zoom_prior"
    (line,) = advice(installed, settings)
    assert "preset=zoom_prior" in line
    assert advice({"competitor": {"name": "lanczos"}}, settings) == []
    assert advice({}, settings) == []
    assert advice(installed, tiny) == []  # ray-cast, where the prior does not help
    assert advice(installed, replace(settings, augmenters={"upscale": settings.backbone})) == []
    assert advice(installed, replace(settings, evaluation=replace(settings.evaluation, advice=""))) == []


def test_the_same_seed_gives_the_same_bits_and_another_seed_does_not(finished: Path, tmp_path: Path) -> None:
    tiny_run(tmp_path / "again", DENSE)
    same_ending(finished, tmp_path / "again")
    tiny_run(tmp_path / "other", (*DENSE, "seed=1"))
    other = final_tensors(tmp_path / "other")["parameters.means"]
    assert other.shape != final_tensors(finished)["parameters.means"].shape or not torch.equal(
        other, final_tensors(finished)["parameters.means"]
    )


def test_resume_equals_never_having_stopped(finished: Path, tmp_path: Path) -> None:
    folder = tmp_path / "run"
    stopped_at(folder, DENSE, 1, 5, 12, 13, 23)
    same_ending(finished, folder)
    steps = [json.loads(line)["step"] for line in (folder / "metrics.jsonl").read_text().splitlines()]
    assert steps == sorted(set(steps))


def test_a_killed_run_resumes_from_its_last_checkpoint(finished: Path, tmp_path: Path) -> None:
    # checkpoints at 7 and 14; the files a kill at step 16 would leave: later metrics, a stale temporary file
    tiny_run(tmp_path / "run", DENSE, stop_after=16)
    assert json.loads((tmp_path / "run" / "status.json").read_text())["state"] == "interrupted"
    assert (tmp_path / "run" / "report.html").is_file()
    for path in (tmp_path / "run" / "checkpoints").glob("step_0000016.*"):
        path.unlink()
    (tmp_path / "run" / "checkpoints" / ".step_0000021.safetensors.1.partial").write_bytes(b"half")
    resume(tmp_path / "run")
    same_ending(finished, tmp_path / "run")


def test_a_run_can_be_lengthened(tmp_path: Path) -> None:
    tiny_run(tmp_path / "run", ("iterations=4",))
    resume(tmp_path / "run", "iterations=8")
    assert json.loads((tmp_path / "run" / "evaluation.json").read_text())["step"] == 8


def test_only_the_newest_checkpoints_are_kept(finished: Path) -> None:
    assert len(list((finished / "checkpoints").glob("*.safetensors"))) == 2
    assert len(list((finished / "checkpoints").glob("*.json"))) == 2


@pytest.fixture(scope="module")
def stopped(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of 6 steps, stopped after the fifth, with checkpoints of the third and the fifth."""
    folder = tmp_path_factory.mktemp("runs") / "stopped"
    tiny_run(folder, ("iterations=6", "training.checkpoint_every=3"), stop_after=5)
    return folder


@pytest.mark.parametrize("damage", ["truncate", "flip", "gone", "no sidecar data", "head", "views", "order"])
def test_a_damaged_checkpoint_is_named_and_the_one_before_used(
    stopped: Path, tmp_path: Path, damage: str, caplog: pytest.LogCaptureFixture
) -> None:
    folder = shutil.copytree(stopped, tmp_path / "run")
    newest = sorted((folder / "checkpoints").glob("*.safetensors"))[-1]
    data = newest.read_bytes()
    sidecar = newest.with_suffix(".json")
    if damage == "truncate":
        newest.write_bytes(data[: len(data) // 2])
    elif damage == "flip":
        newest.write_bytes(data[:-5] + bytes([data[-5] ^ 1]) + data[-4:])
    elif damage == "head":  # by somebody who gave it the right digest
        newest.write_bytes(data[:8] + b"\xff" + data[9:])
        digest = hashlib.sha256(newest.read_bytes()).hexdigest()
        sidecar.write_text(json.dumps(json.loads(sidecar.read_text()) | {"sha256": digest}))
    elif damage in ("views", "order"):
        changed = {"views": {"train": None}} if damage == "views" else {"sampler": [6]}  # of views 0 to 5
        sidecar.write_text(json.dumps(json.loads(sidecar.read_text()) | changed))
    elif damage == "gone":
        newest.unlink()
    else:
        sidecar.write_text("{")
    run, _ = open_run(folder, plugins())
    assert run.step == 3
    assert str(newest.with_suffix("")) in caplog.text


@pytest.mark.parametrize("hindrance", ["schema", "permission"])
def test_a_checkpoint_that_is_not_damaged_is_never_passed_over(
    stopped: Path, tmp_path: Path, hindrance: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = shutil.copytree(stopped, tmp_path / "run")
    newest = sorted((folder / "checkpoints").glob("*.safetensors"))[-1]
    read_bytes = Path.read_bytes

    def refused(path: Path) -> bytes:
        if path == newest:
            raise PermissionError(errno.EACCES, "Permission denied", str(path))
        return read_bytes(path)

    if hindrance == "schema":
        sidecar = newest.with_suffix(".json")
        sidecar.write_text(sidecar.read_text().replace('"schema": 1', '"schema": 2'))
    else:
        monkeypatch.setattr(Path, "read_bytes", refused)
    before = sorted(path.name for path in (folder / "checkpoints").iterdir())
    capsys.readouterr()
    assert main(["resume", str(folder)]) == 2
    *_, said = capsys.readouterr().err.splitlines()
    assert said.startswith("gsx: ")
    assert str(newest) in said
    assert ("has schema 2, this gsx reads schema 1" if hindrance == "schema" else "Permission denied") in said
    assert sorted(path.name for path in (folder / "checkpoints").iterdir()) == before


def test_without_any_usable_checkpoint_the_error_says_so(stopped: Path, tmp_path: Path) -> None:
    shutil.copytree(stopped, tmp_path / "run")
    for path in (tmp_path / "run" / "checkpoints").iterdir():
        path.unlink()
    with pytest.raises(CheckpointError, match="holds no checkpoint"):
        open_run(tmp_path / "run", plugins())


def test_a_used_folder_is_refused(tmp_path: Path) -> None:
    (tmp_path / "mine.txt").write_text("keep me")
    settings = tiny_settings(tmp_path)
    with pytest.raises(InputError, match="is not empty"):
        start(settings, plugins())
    assert [path.name for path in tmp_path.iterdir()] == ["mine.txt"]


def test_zero_iterations_and_unknown_devices_are_refused_before_anything_is_written(tmp_path: Path) -> None:
    for override, pattern in (("iterations=0", "iterations is 0"), ("device=tpu", "device is 'tpu'")):
        with pytest.raises(ConfigError, match=pattern):
            start(tiny_settings(tmp_path / "run", override), plugins())
        assert not (tmp_path / "run").exists()


def test_other_views_than_trained_on_are_refused(finished: Path) -> None:
    with pytest.raises(CheckpointError, match=r"trained with other train views \(now 5, then 6"):
        open_run(finished, plugins(), ["scene.train_views=5"])


def test_evaluating_a_finished_run_keeps_its_training_peak_and_mends_its_status(finished: Path, tmp_path: Path) -> None:
    copy = tmp_path / "copy"
    shutil.copytree(finished, copy)
    (copy / "evaluation.json").unlink()
    (copy / "status.json").write_text('{"state": "failed", "reason": "power cut", "step": 24}')
    assert main(["eval", str(copy)]) == 0
    assert json.loads((copy / "status.json").read_text())["state"] == "ok"
    peak = max(json.loads(line)["memory_mb"] for line in (copy / "metrics.jsonl").read_text().splitlines())
    assert json.loads((copy / "evaluation.json").read_text())["peak_memory_mb"] >= peak


def test_the_zooms_looked_at_do_not_change_the_protocol_hash(finished: Path, tmp_path: Path) -> None:
    copy = tmp_path / "copy"
    shutil.copytree(finished, copy)
    before = json.loads((copy / "evaluation.json").read_text())["protocol"]["hash"]
    assert main(["eval", str(copy), "eval.zoom=[1]"]) == 0
    assert json.loads((copy / "evaluation.json").read_text())["protocol"]["hash"] == before
    assert main(["eval", str(copy), "eval.ssim=valid"]) == 0
    assert json.loads((copy / "evaluation.json").read_text())["protocol"]["hash"] != before


@pytest.fixture(scope="module")
def stopped_with_one(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same, of which one checkpoint is kept."""
    folder = tmp_path_factory.mktemp("runs") / "stopped"
    tiny_run(folder, ("iterations=6", "training.checkpoint_every=3", "training.checkpoints_kept=1"), stop_after=5)
    return folder


def test_a_checkpoint_that_is_written_while_an_older_one_is_read_stays(
    stopped_with_one: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = shutil.copytree(stopped_with_one, tmp_path / "run")
    read = checkpoint.read

    def slowly(sidecar: Path) -> Any:
        found = read(sidecar)
        for suffix in (".safetensors", ".json"):
            shutil.copy(sidecar.with_suffix(suffix), sidecar.with_name("step_0000099").with_suffix(suffix))
        return found

    monkeypatch.setattr(checkpoint, "read", slowly)
    open_run(folder, plugins(), training=True)
    assert (folder / "checkpoints" / "step_0000099.json").is_file()


def test_a_newer_damaged_checkpoint_does_not_outlive_good_ones(stopped_with_one: Path, tmp_path: Path) -> None:
    folder = shutil.copytree(stopped_with_one, tmp_path / "run")
    newest = sorted((folder / "checkpoints").glob("*.safetensors"))[-1]
    shutil.copy(newest, newest.with_name("step_0000099.safetensors"))
    newest.with_name("step_0000099.json").write_text("{")
    before = sorted(path.name for path in (folder / "checkpoints").iterdir())
    open_run(folder, plugins())  # who looks leaves all as it is
    assert sorted(path.name for path in (folder / "checkpoints").iterdir()) == before
    resume(folder)
    assert [path.name for path in (folder / "checkpoints").glob("*.json")] == ["step_0000006.json"]


class Ruining:
    """Listener: spoils most of the model after a checkpoint."""

    @hookimpl
    def gsx_step_finished(self, run: Run) -> None:
        if run.step == 8:
            with torch.no_grad():
                run.backbone.table["log_scales"][: len(run.backbone.table) // 2] = torch.nan


def test_what_is_left_of_a_ruined_model_is_never_a_checkpoint(tmp_path: Path) -> None:
    settings, loaded = tiny_settings(tmp_path / "run", "iterations=12", "training.checkpoint_every=4"), plugins()
    run = start(settings, loaded)
    with loaded.listening([Ruining()]), pytest.raises(LostModel, match=r"step 9: 150 of 300 primitives"):
        execute(run, settings, loaded)
    assert json.loads((run.folder / "status.json").read_text())["state"] == "failed"
    again, _ = open_run(run.folder, loaded)
    assert (again.step, len(again.backbone.table)) == (8, 300)
