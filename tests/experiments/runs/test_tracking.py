"""Trackers of any kind: a third party's, one that fails, what they must not change, and when they are refused."""

import os
import re
import socket
import subprocess
import sys
import textwrap
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest
from tiny import Raises, StopAfter, same_ending, tiny_run, tiny_settings, words

from gsx import builtin
from gsx.builtin import plugins
from gsx.cli.dispatch import main
from gsx.core.errors import ConfigError, TrainingError
from gsx.core.plugins import Plugins, hookimpl, load_plugins
from gsx.core.training.run import Run
from gsx.experiments.reports.baselines import key_of
from gsx.experiments.run_folder.files import read_run
from gsx.experiments.run_folder.run_key import comparable
from gsx.experiments.runs.compose import compose
from gsx.experiments.runs.execute import execute
from gsx.experiments.runs.open import open_run, start
from gsx.experiments.runs.saved_settings import read_config, write_config
from gsx.experiments.runs.tracking import Tracking
from gsx.experiments.runs.warm_start import warm_start_folder
from gsx.trackers.figures import evaluation_figures, html, line_figures, markdown, zoom_table

ROOT = Path(__file__).parents[3]
NAMES = ",".join(name for name in ("tensorboard", "mlflow", "wandb", "rerun") if find_spec(name))
ALL = (f"tracker=[{NAMES}]", "tracker.mlflow.seconds=0")
FEW = ("scene.points=100", "scene.train_views=3")
DENSE = (*FEW, "iterations=12", "backbone.density.every=400", "backbone.density.reset_passes=1",
         "backbone.density.gradient=1e-6", "training.checkpoint_every=5")  # fmt: skip


@dataclass(frozen=True)
class HeardOptions:
    name: str
    fails_at: int = -1


class Heard:
    """Keeps the names of the events it hears of; fails at one step."""

    events: list[str]

    def __init__(self, options: HeardOptions) -> None:
        self.options = options
        Heard.events = []

    @hookimpl
    def gsx_run_started(self, run: Run) -> None:
        self.events.append(f"started {run.step}")

    @hookimpl
    def gsx_step_finished(self, run: Run) -> None:
        if run.step == self.options.fails_at:
            raise OSError("the disk is full")
        self.events.append(f"step {run.step} of {len(run.progress.curves)}")

    @hookimpl
    def gsx_gradients_ready(self) -> str:
        return "a tracker has no say in this"

    @hookimpl
    def gsx_training_finished(self, run: Run) -> None:
        self.events.append(f"trained {run.complete}")

    @hookimpl
    def gsx_evaluated(self, evaluation: dict[str, Any]) -> None:
        self.events.append(f"evaluated {evaluation['step']}")

    @hookimpl
    def gsx_run_finished(self, run: Run) -> None:
        self.events.append(f"finished {(run.folder / 'report.html').is_file()}")

    @hookimpl
    def gsx_run_failed(self, reason: str) -> None:
        self.events.append(f"failed: {reason}")


class Third:
    """A plugin with one tracker."""

    @hookimpl
    def gsx_register(self, registry: Any) -> None:
        registry.add("tracker", "heard", Heard, HeardOptions)


def loaded() -> Plugins:
    return load_plugins([("gsx", builtin), ("third", Third())], points=[])


def heard_run(folder: Path, *more: str, listener: object | None = None) -> None:
    """A run of 4 steps, each with its line, with the tracker above."""
    known = loaded()
    given = (*FEW, "iterations=4", "training.log_every=1", "+tracker.heard.name=heard", *more)
    settings = compose(words(folder, *given), known)
    run = start(settings, known)
    with known.listening([listener] if listener else []):
        execute(run, settings, known)


def test_a_tracker_hears_every_event_after_the_files_have_it(tmp_path: Path) -> None:
    heard_run(tmp_path / "run")
    steps = [f"step {n} of {n}" for n in (1, 2, 3, 4)]
    assert Heard.events == ["started 0", *steps, "trained True", "evaluated 4", "finished True"]


def test_the_tracker_of_the_documentation_works(tmp_path: Path) -> None:
    text = (ROOT / "docs" / "how-to" / "write-a-plugin.md").read_text()
    code = re.search(r"## A tracker\n\n[^\n]*\n\n((?:    [^\n]*\n|\n)+)", text)
    module: dict[str, Any] = {"dataclass": dataclass, "hookimpl": hookimpl}
    exec(textwrap.dedent(code.group(1)), module)
    plugin = type("Documented", (), {"gsx_register": staticmethod(module["gsx_register"])})()
    known = load_plugins([("gsx", builtin), ("documented", plugin)], points=[])
    given = (*FEW, "iterations=2", "+tracker.noted.name=noted", f"+tracker.noted.file={tmp_path / 'notes'}")
    settings = compose(words(tmp_path / "run", *given), known)
    execute(start(settings, known), settings, known)
    assert re.fullmatch(r"run: \d+\.\d\d dB\n", (tmp_path / "notes").read_text())


def test_a_tracker_that_fails_is_warned_of_once_and_the_run_goes_on(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    heard_run(tmp_path / "run", "+tracker.heard.fails_at=3")
    assert Heard.events == ["started 0", "step 1 of 1", "step 2 of 2"]
    said = [record.getMessage() for record in caplog.records if record.getMessage().startswith("tracker")]
    assert said == [
        "tracker heard failed at step 3 (OSError: the disk is full): the run continues without it",
        "tracker heard is incomplete from step 3 on; the run folder has everything",
    ]
    assert read_run(tmp_path / "run").status["state"] == "ok"
    assert len(read_run(tmp_path / "run").lines) == 4


def test_an_interrupted_run_says_what_a_tracker_missed(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    heard_run(tmp_path / "run", "+tracker.heard.fails_at=1", listener=StopAfter(2))
    assert "tracker heard is incomplete from step 1 on" in caplog.text


@pytest.mark.parametrize(
    ("error", "reason"),
    [
        (TrainingError("three steps in a row"), "three steps in a row"),
        (RuntimeError("no memory"), "RuntimeError: no memory"),
        (KeyboardInterrupt(), "KeyboardInterrupt: "),
    ],
)
def test_a_run_that_fails_is_heard_of(error: BaseException, reason: str, tmp_path: Path) -> None:
    with pytest.raises(type(error)):
        heard_run(tmp_path / "run", listener=Raises(error))
    assert Heard.events[-1] == f"failed: {reason}"
    assert read_run(tmp_path / "run").status["state"] == "failed"
    assert read_run(tmp_path / "run").status["reason"] == reason


def test_a_listener_that_fails_too_does_not_hide_why(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    class Worse(Raises):
        @hookimpl
        def gsx_run_failed(self) -> None:
            raise OSError("and no disk")

    with pytest.raises(RuntimeError, match="no memory"):
        heard_run(tmp_path / "run", listener=Worse(RuntimeError("no memory")))
    assert "a listener to the run's failure failed: and no disk" in caplog.text


def test_a_run_that_never_began_is_not_told(tmp_path: Path) -> None:
    class Early:
        @hookimpl(tryfirst=True)
        def gsx_run_started(self) -> None:
            raise RuntimeError("before anybody heard")

    with pytest.raises(RuntimeError, match="before anybody"):
        heard_run(tmp_path / "run", listener=Early())
    assert Heard.events == []


def test_a_misspelt_hook_of_a_tracker_is_refused() -> None:
    class Unmarked:
        def gsx_step_finished(self) -> None: ...

    with pytest.raises(TypeError, match="gsx_step_finished is not marked with @hookimpl"):
        Tracking("wrong", Unmarked())


OFFLINE = """
import socket, sys, time
asked = []
connect = socket.socket.connect
def refuse(*words, **more):
    if words[0].family == socket.AF_UNIX:  # W&B's own process, which has a server of this test to ask
        return connect(*words)
    asked.append(words)
    raise OSError("no network in this test")
socket.socket.connect = refuse
socket.getaddrinfo = lambda *words, **more: refuse(socket.socket(), *words)
from gsx.cli.dispatch import main
from gsx.builtin import plugins
plugins()
trackers = set(sys.argv[1].split(","))
assert not trackers & set(sys.modules), "imported before they were chosen"
code = main(sys.argv[2:])
assert trackers <= set(sys.modules)
from mlflow.telemetry.client import get_telemetry_client
assert get_telemetry_client() is None, "telemetry is on"
time.sleep(1)  # it would ask from another thread
assert not asked, asked
sys.exit(code)
"""
Tracked = tuple[Path, subprocess.CompletedProcess[str]]


@pytest.fixture(scope="module")
def tracked(tmp_path_factory: pytest.TempPathFactory) -> Tracked:
    """A run with all trackers, in a process of its own, as a user's: MLflow's telemetry is always off inside pytest
    and CI."""
    folder = tmp_path_factory.mktemp("tracked")
    hidden = ("PYTEST", "CI", "MLFLOW", "WANDB", "DO_NOT_TRACK", "GITHUB", "BUILD")
    environment = {key: value for key, value in os.environ.items() if not key.startswith(hidden)}
    environment["GSX_CACHE"] = str(tmp_path_factory.mktemp("cache"))
    command = [sys.executable, "-c", OFFLINE, NAMES, *words(folder / "run", *DENSE, *ALL, f"output={folder}")]
    with socket.create_server(("127.0.0.1", 0)) as server:
        environment["WANDB_BASE_URL"] = f"http://127.0.0.1:{server.getsockname()[1]}"
        result = subprocess.run(command, capture_output=True, text=True, check=False, env=environment, cwd=folder)
        server.settimeout(0.1)
        with pytest.raises(TimeoutError):  # nobody asked it for anything
            server.accept()
    return folder, result


def test_a_run_with_trackers_ends_in_the_same_bits(tmp_path: Path, tracked: Tracked) -> None:
    folder, _ = tracked
    run = tiny_run(tmp_path / "without", DENSE)
    assert any("split" in line for line in run.progress.curves)
    same_ending(tmp_path / "without", folder / "run")
    assert (folder / "mlflow.db").is_file()
    assert (folder / "run" / "tensorboard").is_dir()
    assert all((folder / "run" / name).is_dir() == (name in NAMES) for name in ("wandb", "rerun"))


def test_runs_with_and_without_trackers_are_one_composition(tmp_path: Path) -> None:
    settings = tiny_settings(tmp_path / "run", "iterations=2")
    run = start(settings, plugins())
    folder = warm_start_folder(run, settings.idle, {})
    key, config = key_of(read_run(run.folder)), comparable(run.config)
    write_config(run.folder / "config.yaml", tiny_settings(tmp_path / "other", "iterations=2", *ALL).resolved)
    run.config = compose(words(run.folder, "iterations=2", *ALL), plugins()).resolved
    assert "mlflow" in run.config["tracker"]
    assert warm_start_folder(run, settings.idle, {}) == folder
    assert key_of(read_run(run.folder)) == key
    assert comparable(run.config) == config


def test_the_configuration_of_a_run_from_before_trackers_opens(tmp_path: Path) -> None:
    resolved = tiny_settings(tmp_path / "run").resolved
    resolved.pop("tracker", None)
    write_config(tmp_path / "config.yaml", resolved)
    assert read_config(tmp_path / "config.yaml", plugins()).trackers == {}


def test_trackers_come_in_the_order_of_the_command_line(tmp_path: Path) -> None:
    assert list(tiny_settings(tmp_path, "tracker=[mlflow,tensorboard]").trackers) == ["mlflow", "tensorboard"]
    assert tiny_settings(tmp_path).trackers == {}


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ("tracker=[tensorbord]", "Did you mean 'tensorboard'?"),
        ("tracker=[mlflow] tracker.mlflow.ur=x", "Did you mean 'tracker.mlflow.uri'?"),
        ("tracker=[tensorboard] tracker.tensorboard.pictures=-1", "give a number from 0"),
        ("tracker=[tensorboard] tracker.tensorboard.pictures=few", "tracker.tensorboard.pictures"),
        ("tracker=[mlflow] tracker.mlflow.seconds=-1", "give a number from 0"),
    ],
)
def test_wrong_choices_are_refused(given: str, message: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=re.escape(message)):
        tiny_settings(tmp_path, *given.split())


@pytest.mark.parametrize(
    ("tracker", "package"),
    [
        ("tensorboard", "tensorboard"),
        ("mlflow", "mlflow"),
        ("mlflow", "sqlalchemy"),
        ("wandb", "wandb"),
        ("rerun", "rerun"),
    ],
)
def test_a_missing_package_is_refused_before_anything_is_done(
    tracker: str, package: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, package, None)  # an import of it fails
    monkeypatch.setattr("gsx.experiments.runs.open.load_scene", lambda settings: pytest.fail("the scene was loaded"))
    settings = tiny_settings(tmp_path / "run", f"tracker=[{tracker}]")
    with pytest.raises(ConfigError, match=rf"tracker {tracker} needs {package}.*: pip install 'gsx\[{tracker}\]'"):
        start(settings, plugins())
    assert not (tmp_path / "run").exists()


def test_a_package_that_went_missing_is_refused_when_a_run_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    tiny_run(tmp_path / "run", (*FEW, "iterations=2", "tracker=[tensorboard]"), stop_after=1)
    monkeypatch.setitem(sys.modules, "tensorboard", None)
    assert main(["resume", str(tmp_path / "run")]) == 2
    assert "pip install 'gsx[tensorboard]'" in capsys.readouterr().err
    run, _ = open_run(tmp_path / "run", plugins())  # to look at a run needs no tracker
    assert run.step == 1


def test_trackers_are_listed(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["plugins"]) == 0
    assert re.search(
        r"tracker: +mlflow \(gsx\), rerun \(gsx\), tensorboard \(gsx\), wandb \(gsx\)", capsys.readouterr().out
    )


def test_numbers_are_named_as_in_the_files() -> None:
    line = {
        "step": 7,
        "loss": 0.5,
        "psnr": float("inf"),
        "terms": {"own": 0.4, "up": 0.1},
        "skipped": "why",
        "cloned": 3,
    }
    assert line_figures(line) == {
        "loss": 0.5, "psnr": float("inf"), "cloned": 3.0, "terms/own": 0.4, "terms/up": 0.1,
    }  # fmt: skip
    zoom = {"2": {"psnr": 20.0, "beats_enlarged": True}, "4": {"unavailable": "no truth"}}
    evaluation = {"step": 7, "psnr": 21.0, "lpips": None, "zoom": zoom, "protocol": {"hash": "x"}, "views": []}
    assert evaluation_figures(evaluation) == {"evaluation/psnr": 21.0, "evaluation/x2/psnr": 20.0}
    zoom["2"]["perceptual"] = {"st_lpips_alex": {"render": 0.25, "enlarged": 0.5}}
    zoom["2"]["detail"] = {"render": {"explained": 0.75, "energy": 1.0}}
    perceptual = {"perceptual": {"st_lpips_alex": 0.125, "niqe": None}}
    assert evaluation_figures(evaluation | perceptual) == evaluation_figures(evaluation) | {
        "evaluation/st_lpips_alex": 0.125,
        "evaluation/x2/detail": 0.75,
        "evaluation/x2/st_lpips_alex": 0.25,
        "evaluation/x2/enlarged_st_lpips_alex": 0.5,
    }


def test_the_zoom_table_has_a_row_for_each_zoom() -> None:
    zoom = {"2": {"psnr": 20.0, "enlarged_psnr": 18.5, "views": 3}, "4": {"unavailable": "no truth"}}
    table = zoom_table({"zoom": zoom})
    assert table == [
        {"zoom": "x2", "gain": "1.5", "psnr": "20", "enlarged_psnr": "18.5", "views": "3"},
        {"zoom": "x4", "gain": "", "psnr": "", "enlarged_psnr": "", "views": ""},
    ]
    few = [{"zoom": "x2", "psnr": "20"}]
    assert markdown(few) == "| zoom | psnr |\n| --- | --- |\n| x2 | 20 |\n"
    assert "<tr><td>zoom</td><td>psnr</td></tr><tr><td>x2</td><td>20</td></tr>" in html(few)
    assert (zoom_table({}), markdown([]), html([])) == ([], "", "")


def test_nothing_is_asked_of_the_network_and_little_is_said(tracked: Tracked) -> None:
    folder, result = tracked
    assert result.returncode == 0, result.stderr
    assert result.stdout == f"{folder / 'run' / 'report.html'}\n"
    assert not re.search(r"(?i)warn|alembic|INFO", result.stderr), result.stderr
    names = {path.name for path in folder.iterdir()}
    assert names == {"run", "mlflow.db", "mlflow_files", ".mlflow.lock"}
