"""MLflow's own client finds what metrics.jsonl and evaluation.json hold."""

import json
import re
import shutil
import sqlite3
from contextlib import closing
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from tiny import Raises, tiny_run, tiny_settings

from gsx.builtin import plugins
from gsx.core.errors import ConfigError, TrainingError
from gsx.core.options import flattened
from gsx.core.plugins import hookimpl
from gsx.core.training.run import Run
from gsx.experiments.runs.execute import execute
from gsx.experiments.runs.open import open_run, start
from gsx.trackers.figures import evaluation_figures, line_figures
from gsx.trackers.mlflow import MLflow, MLflowOptions, chunks, client_of, default_store, experiment_id, parameters

RUN = ("iterations=12", "scene.points=100", "scene.train_views=3", "training.checkpoint_every=4",
       "training.log_every=2", "tracker=[mlflow]", "tracker.mlflow.seconds=0")  # fmt: skip


def kept(folder: Path) -> tuple[Any, str]:
    """MLflow's client and the id of a run."""
    content = json.loads((folder / "mlflow.json").read_text())
    return client_of(content["uri"]), content["run"]


def status(folder: Path) -> str:
    client, run_id = kept(folder)
    return client.get_run(run_id).info.status


def lines(folder: Path) -> list[dict]:
    return [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]


def curves(folder: Path) -> dict[str, list[tuple[int, float]]]:
    """Every point of every metric."""
    client, run_id = kept(folder)
    names = client.get_run(run_id).data.metrics
    return {name: [(point.step, point.value) for point in client.get_metric_history(run_id, name)] for name in names}


def expected_curves(folder: Path) -> dict[str, list[tuple[int, float]]]:
    """What metrics.jsonl and evaluation.json hold."""
    expected: dict[str, list[tuple[int, float]]] = {}
    for line in lines(folder):
        for name, value in line_figures(line).items():
            expected.setdefault(name, []).append((line["step"], value))
    evaluation = json.loads((folder / "evaluation.json").read_text())
    return expected | {name: [(evaluation["step"], value)] for name, value in evaluation_figures(evaluation).items()}


@pytest.fixture(scope="module")
def output(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Output folder of all runs: making the tables takes a while."""
    return tmp_path_factory.mktemp("mlflow")


@pytest.fixture(scope="module")
def empty(output: Path) -> Path:
    """A copy of the database as it is before the first run: with its tables, and nothing in them."""
    client_of(f"sqlite:///{output / 'mlflow.db'}")
    return Path(shutil.copy(output / "mlflow.db", output / "empty.db"))


@pytest.fixture(scope="module")
def finished(output: Path, empty: Path) -> Path:
    tiny_run(output / "finished", (*RUN, "eval.zoom=[1,2]", f"output={output}"))
    return output / "finished"


def test_metrics_are_those_of_the_files(finished: Path) -> None:
    found = curves(finished)
    assert found == expected_curves(finished)
    assert {"loss", "psnr", "test_psnr", "evaluation/psnr", "evaluation/x2/psnr"} <= found.keys()


@pytest.mark.parametrize("name", ["what?", "100%25"])
def test_its_own_database_lies_in_the_output_folder_whatever_that_is_called(tmp_path: Path, name: str) -> None:
    run: Any = SimpleNamespace(config={"output": str(tmp_path / name)})
    experiment = experiment_id(client_of(default_store(run)), default_store(run), "demo")
    assert experiment
    assert sorted(path.name for path in tmp_path.iterdir()) == [name]
    assert (tmp_path / name / "mlflow.db").is_file()


def test_the_run_is_named_and_has_its_parameters_and_files(finished: Path, output: Path) -> None:
    client, run_id = kept(finished)
    found = client.get_run(run_id)
    assert (found.info.run_name, found.info.status) == ("finished", "FINISHED")
    assert client.get_experiment(found.info.experiment_id).name == "demo"
    config = tiny_settings(finished, *RUN, "eval.zoom=[1,2]", f"output={output}").resolved
    told = {key: value for key, value in config.items() if key != "tracker"}  # addresses may hold passwords
    assert found.data.params == {key: str(value) for key, value in flattened(told).items()}
    assert found.data.params["iterations"] == "12"
    assert found.data.tags["gsx.folder"] == str(finished)
    files = {"config.yaml", "evaluation.json", "report.html", "zoom.csv", "pictures"}
    assert {file.path for file in client.list_artifacts(run_id)} == files
    copies = output / "mlflow_files" / "demo" / run_id / "artifacts"
    assert (copies / "report.html").read_bytes() == (finished / "report.html").read_bytes()
    assert (copies / "zoom.csv").read_text().splitlines()[1].startswith("x1,")
    crop = json.loads((finished / "renders" / "index.json").read_text())["zoom"][0]["files"]["render"]
    assert (copies / "pictures" / crop).read_bytes() == (finished / "renders" / crop).read_bytes()


def test_an_interrupted_run_is_killed_and_goes_on_as_the_same_run(output: Path) -> None:
    folder = output / "interrupted"
    tiny_run(folder, (*RUN, f"output={output}"), stop_after=5)
    before = kept(folder)[1]
    assert status(folder) == "KILLED"
    run, settings = open_run(folder, plugins())
    execute(run, settings, plugins())
    assert (kept(folder)[1], status(folder)) == (before, "FINISHED")
    assert curves(folder) == expected_curves(folder)


def test_a_killed_run_goes_on_without_doubled_points(output: Path) -> None:
    # checkpoints at 4 and 8: what a kill at step 10 leaves are points later than the checkpoint
    folder = output / "killed"
    tiny_run(folder, (*RUN, f"output={output}"), stop_after=10)
    for path in (folder / "checkpoints").glob("step_0000010.*"):
        path.unlink()
    assert curves(folder)["loss"][-1][0] == 10
    run, settings = open_run(folder, plugins())
    assert run.step == 8
    execute(run, settings, plugins())
    timed = {"seconds", "memory_mb"}  # of the first time for steps that were repeated
    found, expected = curves(folder), expected_curves(folder)
    assert {name: curve for name, curve in found.items() if name not in timed} == {
        name: curve for name, curve in expected.items() if name not in timed
    }
    assert all([step for step, _ in found[name]] == [step for step, _ in expected[name]] for name in timed)


def test_a_run_that_goes_on_elsewhere_is_begun_there_with_all_its_points(
    output: Path, empty: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    shutil.copy(empty, tmp_path / "other.db")
    folder = output / "moved"
    tiny_run(folder, (*RUN, f"output={output}"), stop_after=5)
    run, settings = open_run(folder, plugins(), [f"tracker.mlflow.uri=sqlite:///{tmp_path / 'other.db'}"])
    execute(run, settings, plugins())
    assert json.loads((folder / "mlflow.json").read_text())["uri"] == f"sqlite:///{tmp_path / 'other.db'}"
    assert curves(folder) == expected_curves(folder)
    assert {path.name for path in tmp_path.iterdir()} == {"other.db", "mlflow_files", ".mlflow.lock"}


@pytest.mark.parametrize(
    ("error", "expected"), [(TrainingError("not finite"), "FAILED"), (KeyboardInterrupt(), "KILLED")]
)
def test_a_run_that_fails_is_marked(error: BaseException, expected: str, output: Path) -> None:
    folder = output / expected
    settings, loaded = tiny_settings(folder, *RUN, f"output={output}"), plugins()
    run = start(settings, loaded)
    with pytest.raises(type(error)), loaded.listening([Raises(error)]):
        execute(run, settings, loaded)
    client, run_id = kept(folder)
    assert status(folder) == expected
    assert client.get_run(run_id).data.tags["gsx.reason"] == (str(error) or "KeyboardInterrupt: ")
    assert [step for step, _ in curves(folder)["loss"]] == [line["step"] for line in lines(folder)]


def test_points_wait_for_their_time(output: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """With an hour between requests there is one when training begins, one when it ends, one for the evaluation."""
    sent: list[int] = []
    log = MLflow.log
    monkeypatch.setattr(MLflow, "log", lambda self, points: (sent.append(len(points)), log(self, points))[1])
    folder = output / "waiting"
    tiny_run(folder, (*RUN, f"output={output}", "tracker.mlflow.seconds=3600", "tracker.mlflow.experiment=own name"))
    assert len(sent) == 3
    assert curves(folder) == expected_curves(folder)
    client, run_id = kept(folder)
    assert client.get_experiment(client.get_run(run_id).info.experiment_id).name == "own name"


def test_a_store_that_breaks_ends_no_run(empty: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    class Breaks:
        """Takes the table of metrics away at step 5."""

        @hookimpl
        def gsx_step_finished(self, run: Run) -> None:
            if run.step == 5:
                with closing(sqlite3.connect(tmp_path / "mlflow.db")) as connection, connection:
                    connection.execute("drop table metrics")

    shutil.copy(empty, tmp_path / "mlflow.db")
    settings, loaded = tiny_settings(tmp_path / "run", *RUN, f"output={tmp_path}"), plugins()
    run = start(settings, loaded)
    with loaded.listening([Breaks()]):
        execute(run, settings, loaded)
    assert run.complete
    assert len(re.findall(r"tracker mlflow failed at step \d+ \(", caplog.text)) == 1
    assert caplog.text.count("tracker mlflow is incomplete") == 1
    assert (tmp_path / "run" / "report.html").is_file()


def test_a_server_that_is_down_ends_no_run(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MLFLOW_HTTP_REQUEST_MAX_RETRIES", "0")
    tiny_run(tmp_path / "run", ("iterations=1", "tracker=[mlflow]", "tracker.mlflow.uri=http://127.0.0.1:9"))
    assert caplog.text.count("tracker mlflow failed at step 0") == 1
    assert (tmp_path / "run" / "report.html").is_file()


@pytest.mark.parametrize("uri", ["mlruns", "sqllite:///mlflow.db", "sqlite:////dev/null/mlflow.db"])
def test_a_store_that_mlflow_cannot_use_is_refused_before_anything_is_done(uri: str, tmp_path: Path) -> None:
    settings = tiny_settings(tmp_path / "run", "tracker=[mlflow]", f"tracker.mlflow.uri={uri}")
    with pytest.raises(ConfigError, match=rf"MLflow cannot use tracker\.mlflow\.uri={uri} \(.*give sqlite:///FILE"):
        start(settings, plugins())
    assert not (tmp_path / "run").exists()


def test_parameters_are_what_mlflow_accepts() -> None:
    found = {p.key: p.value for p in parameters({"a": {"b(c)": "x" * 600}, "k" * 300: 1, "tracker": {"mlflow": 1}})}
    assert found == {"a.b_c_": "x" * 500, "k" * 250: "1"}


def test_portions_hold_everything_once() -> None:
    assert [list(some) for some in chunks(range(5), 2)] == [[0, 1], [2, 3], [4]]
    assert list(chunks([], 2)) == []


def test_the_environment_of_the_user_is_respected_but_for_telemetry(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MLFLOW_HTTP_REQUEST_TIMEOUT", "77")
    monkeypatch.setenv("MLFLOW_DISABLE_TELEMETRY", "false")
    MLflow(MLflowOptions(name="mlflow", uri="", experiment="", seconds=1.0))
    from mlflow.environment_variables import MLFLOW_DISABLE_TELEMETRY, MLFLOW_HTTP_REQUEST_TIMEOUT

    assert (MLFLOW_HTTP_REQUEST_TIMEOUT.get(), MLFLOW_DISABLE_TELEMETRY.get()) == (77, True)


@pytest.mark.parametrize("uri", ["https://me:secret@host/x", "postgresql://me:secret@host/runs", "https://secret@host",
                                  "http://host/x?token=secret", "sqlite:///x.db?Password=secret",
                                  "mssql+pyodbc:///?odbc_connect=UID%3Dme%3BPWD%3Dsecret"])  # fmt: skip
def test_a_password_in_the_address_is_refused_and_not_repeated(uri: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="holds a password") as refused:
        tiny_settings(tmp_path / "run", "tracker=[mlflow]", f"tracker.mlflow.uri='{uri}'")
    assert "secret" not in str(refused.value)


def test_an_address_may_name_a_user_and_where_the_password_is(tmp_path: Path) -> None:
    told = "tracker.mlflow.uri='postgresql://me@host/x?passfile=/home/me/.pgpass'"
    assert tiny_settings(tmp_path / "run", "tracker=[mlflow]", told)
