"""Errors and signals at awkward moments: what there is stays, and the run that goes on ends in the same bits."""

import errno
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import torch
from synthetic_colmap import synthesize, write_scene
from tiny import Raises, final_tensors, tiny_run, tiny_settings

from gsx.augmenters.redraw import Redrawer
from gsx.builtin import plugins
from gsx.cli.dispatch import main
from gsx.core import files
from gsx.core.errors import CompilerError, TrainingError
from gsx.core.files import remove_partial, replacing
from gsx.core.plugins import hookimpl
from gsx.core.training import trainer
from gsx.core.training.run import Run
from gsx.engine.compiling import available
from gsx.experiments.run_folder import checkpoint
from gsx.experiments.run_folder.files import read_run, state_of
from gsx.experiments.runs import rasterizer_path, verified
from gsx.experiments.runs.execute import execute
from gsx.experiments.runs.job import train
from gsx.experiments.runs.open import open_run, start

SHORT = ("iterations=8", "training.checkpoint_every=100", "training.random_background=true",
         "backbone.density.every=80", "backbone.density.gradient=1e-6")  # fmt: skip
EVENT = ("iterations=8", "augmenter=[upscale]", "regenerator/upscale=lanczos",
         *(f"augmenter.upscale.timing.{key}=15000" for key in ("start", "every", "span")))  # fmt: skip


def assert_ends_as(folder: Path, whole: Path) -> None:
    """A run that goes on ends with the bits of one that nothing happened to."""
    run, settings = open_run(folder, plugins(), training=True)
    execute(run, settings, plugins())
    expected = final_tensors(whole)
    assert all(torch.equal(value, expected[name]) for name, value in final_tensors(folder).items())


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("faults") / "whole"
    tiny_run(folder, SHORT)
    return folder


def full_disk() -> OSError:
    """As where metrics are written."""
    return OSError(errno.ENOSPC, "No space left on device", "metrics.jsonl")


def at_call(number: int, function: Callable[..., Any], error: BaseException) -> Callable[..., Any]:
    """The function, which raises at its `number`-th call."""
    calls = []

    def failing(*given: Any, **named: Any) -> Any:
        calls.append(1)
        if len(calls) == number:
            raise error
        return function(*given, **named)

    return failing


@pytest.mark.parametrize(
    ("module", "name", "call", "error"),
    [
        (trainer, "photometric", 6, torch.OutOfMemoryError("none")),
        (trainer, "photometric", 6, KeyboardInterrupt()),
        (trainer, "photometric", 6, OSError(5, "unreadable")),
        (rasterizer_path, "warm", 1, KeyboardInterrupt()),  # while code is compiled: before the first step
        (rasterizer_path, "warm", 1, CompilerError("blend cannot be compiled")),
    ],
)
def test_an_error_within_a_step_keeps_the_step_before(
    tmp_path: Path,
    whole: Path,
    monkeypatch: pytest.MonkeyPatch,
    module: ModuleType,
    name: str,
    call: int,
    error: BaseException,
) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(module, name, at_call(call, getattr(module, name), error))
        with pytest.raises(type(error)):
            tiny_run(tmp_path / "run", SHORT)
    assert json.loads((tmp_path / "run" / "status.json").read_text())["state"] == "failed"
    kept = [path.stem for path in (tmp_path / "run" / "checkpoints").glob("*.json")]
    assert kept == [f"step_{call - 1:07d}"]
    assert_ends_as(tmp_path / "run", whole)


@pytest.mark.skipif(not available(), reason="no working compiler")
def test_a_run_that_asked_for_no_code_goes_eagerly_where_it_cannot_be_compiled(
    tmp_path: Path, whole: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """A disk of the cache that is full, say."""
    failing = at_call(1, rasterizer_path.warm, CompilerError("blend cannot be compiled (full)"))
    monkeypatch.setattr(rasterizer_path, "warm", failing)
    tiny_run(tmp_path / "run", (*SHORT, "rasterizer.path=auto", "rasterizer.auto_steps=1"))
    assert "blend cannot be compiled (full); using the eager path" in caplog.text
    assert json.loads((tmp_path / "run" / "environment.json").read_text())["rasterizer"] == "eager"
    ends, other = final_tensors(tmp_path / "run"), final_tensors(whole)
    assert all(torch.equal(ends[name], other[name]) for name in other)


def test_half_a_step_is_no_checkpoint(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    settings, loaded = tiny_settings(tmp_path / "run", *SHORT, "training.checkpoint_every=3"), plugins()
    run = start(settings, loaded)
    monkeypatch.setattr(run.backbone, "update", at_call(5, run.backbone.update, RuntimeError("in the middle")))
    with pytest.raises(RuntimeError, match="in the middle"):
        execute(run, settings, loaded)
    assert [path.stem for path in (run.folder / "checkpoints").glob("*.json")] == ["step_0000003"]


def test_a_disk_that_stays_full_does_not_hide_the_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    settings, loaded = tiny_settings(tmp_path / "run", *SHORT), plugins()
    run = start(settings, loaded)
    monkeypatch.setattr("gsx.experiments.run_folder.checkpoint.write", at_call(1, checkpoint.write, full_disk()))
    with loaded.listening([Raises(RuntimeError("first"), 5)]), pytest.raises(RuntimeError, match="first"):
        execute(run, settings, loaded)
    assert "the checkpoint of step 5 could not be saved" in caplog.text
    assert json.loads((run.folder / "status.json").read_text())["state"] == "failed"


def test_a_run_that_is_asked_to_stop_leaves_an_event_at_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    tiny_run(tmp_path / "whole", EVENT)
    asked: list[str] = []
    request = Redrawer.request

    def stopping(self: Redrawer, run: Run, event: int, spec: Any) -> Any:
        asked.append(spec.kind)
        run.progress.stopping = len(asked) == 2
        return request(self, run, event, spec)

    with monkeypatch.context() as patch:
        patch.setattr(Redrawer, "request", stopping)
        run = tiny_run(tmp_path / "run", EVENT)
    assert run.step == run.augmenters["upscale"].events[0] < 8
    assert len(asked) == 2, "the third picture is not asked for"
    assert json.loads((run.folder / "status.json").read_text())["state"] == "interrupted"
    assert not list((run.folder / "pseudo").glob("*.safetensors"))
    assert_ends_as(run.folder, tmp_path / "whole")


def test_a_batch_is_left_between_its_views(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    batch = (*SHORT, "training.batch=3")
    tiny_run(tmp_path / "whole", batch)
    view_loss, seen = trainer.view_loss, list[int]()

    def stopping(run: Run, *given: Any) -> Any:
        seen.append(run.step)
        run.progress.stopping = len(seen) == 8  # the second view of the third step
        return view_loss(run, *given)

    with monkeypatch.context() as patch:
        patch.setattr(trainer, "view_loss", stopping)
        run = tiny_run(tmp_path / "run", batch)
    assert (run.step, len(seen)) == (2, 8)
    assert all(parameter.grad is None for parameter in run.backbone.table.parameters.values())
    assert_ends_as(run.folder, tmp_path / "whole")


class Sending:
    """Listener: sends a signal to this process after a step, and again before the checkpoint is written."""

    def __init__(self, number: int) -> None:
        self.number = number

    @hookimpl
    def gsx_step_finished(self, run: Run) -> None:
        if run.step == 3:
            os.kill(os.getpid(), self.number)

    @hookimpl(tryfirst=True)
    def gsx_training_finished(self, run: Run) -> None:
        assert not list((run.folder / "checkpoints").glob("*.json"))
        os.kill(os.getpid(), self.number)


@pytest.mark.parametrize("name", ["SIGTERM", "SIGHUP", "SIGUSR2"])
def test_signals_of_a_jobs_end_keep_its_last_step(signals: None, tmp_path: Path, name: str) -> None:
    number, received = getattr(signal, name), []
    before = signal.signal(number, lambda *_: received.append(name))
    loaded = plugins()
    try:
        with loaded.listening([Sending(number)]), pytest.raises(SystemExit) as ended:
            train(tiny_settings(tmp_path / "run", *SHORT), loaded, [])
    finally:
        signal.signal(number, before)
    assert received == [name]  # once stopped and saved, it goes to whoever waited for it before
    assert ended.value.code == 128 + number
    assert [path.stem for path in (tmp_path / "run" / "checkpoints").glob("*.json")] == ["step_0000003"]


def test_a_signal_that_is_ignored_stays_ignored(tmp_path: Path) -> None:
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)  # as nohup does
    loaded = plugins()
    try:
        with loaded.listening([Sending(signal.SIGHUP)]):
            assert train(tiny_settings(tmp_path / "run", "iterations=4"), loaded, []) == 0
    finally:
        signal.signal(signal.SIGHUP, before)


@pytest.mark.parametrize("gone", ["report.html", "point_cloud.ply", "renders/index.json"])
def test_resume_finishes_what_was_killed_after_the_evaluation(whole: Path, tmp_path: Path, gone: str) -> None:
    copy = tmp_path / "run"
    shutil.copytree(whole, copy)
    (copy / "log.txt").touch()  # that of the command line
    assert main(["resume", str(copy)]) == 2  # there is nothing left to do
    (copy / gone).unlink()
    (copy / "status.json").write_text('{"state": "running", "step": 8}')
    assert state_of(read_run(copy)) == (
        "running",
        f"running or killed: 8 of 8 steps, evaluated at step 8, without {gone}",
    )
    assert main(["resume", str(copy)]) == 0
    assert (copy / gone).is_file()
    assert state_of(read_run(copy)) == ("ok", "")
    assert 'id="notice"' not in (copy / "report.html").read_text()


def test_what_a_killed_process_left_half_written_is_removed(tmp_path: Path) -> None:
    (tmp_path / "inner").mkdir()
    with replacing(tmp_path / "inner" / "a.json") as under_way:
        under_way.write_text("new")
        old = tmp_path / "inner" / ".b.elsewhere-1-01234567.partial.json"
        others = tmp_path / ".c.elsewhere-1-01234567.partial"
        dead = subprocess.Popen([sys.executable, "-c", ""])
        dead.wait()
        of_the_dead = tmp_path / f".d.{files.process_tag().rpartition('-')[0]}-{dead.pid}-01234567.partial.png"
        for path in (old, others, of_the_dead):
            path.write_text("half")
        os.utime(old, (time.time() - files.ABANDONED - 1,) * 2)
        remove_partial(tmp_path)
    assert sorted(path.name for path in tmp_path.rglob("*")) == [others.name, "a.json", "inner"]


class AtGradients:
    """Listener: an error before the fourth step is applied."""

    @hookimpl
    def gsx_gradients_ready(self, run: Run) -> None:
        if run.step == 3:
            raise TrainingError("at the gradients")


@pytest.mark.parametrize(
    ("listener", "step"), [(AtGradients(), 3), (Raises(full_disk(), 5), 5), (Raises(full_disk(), 8), 8)]
)
def test_errors_of_listeners_keep_the_bits(tmp_path: Path, whole: Path, listener: object, step: int) -> None:
    """At the gradients the step has not been taken; after a step it is kept."""
    settings, loaded = tiny_settings(tmp_path / "run", *SHORT), plugins()
    run = start(settings, loaded)
    with loaded.listening([listener]), pytest.raises((TrainingError, OSError)):
        execute(run, settings, loaded)
    assert [path.stem for path in (run.folder / "checkpoints").glob("*.json")] == [f"step_000000{step}"]
    assert_ends_as(run.folder, whole)


def test_a_damaged_photograph_is_told_before_a_folder_exists(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    write_scene(synthesize(), tmp_path / "scene")
    command = ["backbone=gs3d", "scene=colmap", f"scene.path={tmp_path / 'scene'}", "iterations=2", "device=cpu"]
    command += ["scene.downscale=1", "training.test_points=0"]
    looked: list[Path] = []
    problem_of = verified.problem_of
    monkeypatch.setattr(verified, "problem_of", lambda path: looked.append(path) or problem_of(path))
    photographs = sorted((tmp_path / "scene" / "images").rglob("*.png"))
    content = photographs[3].read_bytes()
    photographs[3].write_bytes(content[: len(content) // 2])
    assert main([*command, f"folder={tmp_path / 'run'}"]) == 2
    said = capsys.readouterr().err
    assert str(photographs[3]) in said
    assert "damaged" in said
    assert not (tmp_path / "run").exists()
    photographs[3].write_bytes(content)
    looked.clear()
    for name in ("one", "two"):
        assert main([*command, f"folder={tmp_path / name}"]) == 0
    assert sorted(looked) == photographs, "each is looked at once for both runs"


@pytest.mark.parametrize(
    "change", [{"step": -1}, {"step": 5}, {"step": True}, {"seconds": -1.0}, {"seconds": 10**400}, {"orders": -3}]
)
def test_a_sidecar_with_numbers_of_no_step_is_refused(tmp_path: Path, change: dict[str, object]) -> None:
    """The digest is that of the tensors: numbers beside it are looked at by themselves."""
    from gsx.core.files import step_of
    from gsx.experiments.run_folder.checkpoint import is_valid

    sidecar = tmp_path / "step_0000004.json"
    meta = {"step": 4, "seconds": 0.5, "orders": 1, "sampler": [0, 1], "views": {"train": ["a", "b"], "test": ["c"]}}
    assert is_valid(meta, step_of(sidecar))
    assert not is_valid(meta | change, step_of(sidecar))


def test_other_files_beside_checkpoints_are_none(tmp_path: Path) -> None:
    from gsx.core.files import sidecars

    for name in ("step_0000004.json", "step_copy.json", "step_.json"):
        (tmp_path / name).write_text("{}")
    assert [path.name for path in sidecars(tmp_path)] == ["step_0000004.json"]
