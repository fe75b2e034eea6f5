"""W&B's own reader of its offline folders finds what metrics.jsonl and evaluation.json hold."""

import json
import subprocess
from pathlib import Path
from typing import Any

import pytest
from tiny import Raises, tiny_run, tiny_settings

from gsx.builtin import plugins
from gsx.core.errors import ConfigError, TrainingError
from gsx.core.options import flattened
from gsx.experiments.runs.execute import execute
from gsx.experiments.runs.open import open_run, start
from gsx.trackers.figures import evaluation_figures, line_figures

wandb = pytest.importorskip("wandb", reason="wandb is not installed: pip install '.[wandb]'")

RUN = ("iterations=6", "scene.points=100", "scene.train_views=3", "training.checkpoint_every=4",
       "training.log_every=2", "tracker=[wandb]")  # fmt: skip


def records(folder: Path, kind: str) -> list[dict[str, Any]]:
    """The records of a kind in the newest offline folder of a run."""
    from wandb.util import get_core_path

    file = max((folder / "wandb").glob("offline-run-*/*.wandb"))
    command = [get_core_path(), "leet", "inspect", "-no-observability", "-json", "-run-file", str(file)]
    lines = subprocess.run(command, capture_output=True, text=True, check=True).stdout.splitlines()
    return [record[kind] for record in map(json.loads, lines) if record["type"] == kind]


def history(folder: Path) -> dict[int, dict[str, Any]]:
    """Its points by step, without W&B's own and without pictures."""
    rows = {record["step"]["num"]: record["item"] for record in records(folder, "history")}
    own = ("_", "zoom.", "test_")
    return {
        step: {name: value for name, value in row.items() if not name.startswith(own) or name == "test_psnr"}
        for step, row in rows.items()
    }


def expected_history(folder: Path) -> dict[int, dict[str, float]]:
    """What metrics.jsonl and evaluation.json hold."""
    lines = map(json.loads, (folder / "metrics.jsonl").read_text().splitlines())
    expected = {line["step"]: line_figures(line) for line in lines}
    evaluation = json.loads((folder / "evaluation.json").read_text())
    expected[evaluation["step"]] |= evaluation_figures(evaluation)
    return expected


def exit_code(folder: Path) -> int:
    (record,) = records(folder, "exit")
    return int(record["exit_code"])


def run_id(folder: Path) -> str:
    return str(json.loads((folder / "wandb.json").read_text())["run"])


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("wandb") / "run"
    tiny_run(folder, (*RUN, "eval.zoom=[1,2]", "tracker.wandb.pictures=1"))
    return folder


def test_points_are_those_of_the_files(finished: Path) -> None:
    found = history(finished)
    assert found == expected_history(finished)
    assert {"loss", "test_psnr", "evaluation/psnr", "evaluation/x2/psnr", "evaluation/x2/detail"} <= found[6].keys()


def test_the_run_has_its_name_configuration_and_end(finished: Path) -> None:
    (run,) = records(finished, "run")
    assert (run["run_id"], run["display_name"], run["project"]) == (run_id(finished), "run", "demo")
    config = tiny_settings(finished, *RUN, "eval.zoom=[1,2]").resolved
    expected = {key: value for key, value in config.items() if key != "tracker"}
    found = {key: value for key, value in run["config"]["update"].items() if key != "_wandb"}
    assert flattened(found) == flattened(expected)
    assert exit_code(finished) == 0


def test_zoom_table_pictures_and_files_are_there(finished: Path) -> None:
    folder = max((finished / "wandb").glob("offline-run-*")) / "files"
    (row,) = [record["item"] for record in records(finished, "history") if record["step"]["num"] == 6]
    name = json.loads((finished / "renders" / "index.json").read_text())["views"][0]["name"]
    for kind in ("render", "truth", "x2/render", "x2/enlarged", "x2/truth"):
        assert (folder / row[f"{name}/{kind}.path"]).is_file()
    assert (row[f"{name}/render.width"], row[f"{name}/render.height"]) == (48, 36)
    assert "<tr><td>x2</td>" in (folder / row["zoom.path"]).read_text()
    assert (folder / "report.html").read_bytes() == (finished / "report.html").read_bytes()


def test_an_interrupted_run_goes_on_as_the_same_run_with_all_points(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    tiny_run(folder, RUN, stop_after=5)
    before = run_id(folder)
    assert exit_code(folder) == 130
    run, settings = open_run(folder, plugins())
    execute(run, settings, plugins())
    assert (run_id(folder), records(folder, "run")[0]["run_id"]) == (before, before)
    assert history(folder) == expected_history(folder)
    assert len(list((folder / "wandb").glob("offline-run-*"))) == 2


def test_a_run_that_fails_is_marked(tmp_path: Path) -> None:
    settings, loaded = tiny_settings(tmp_path / "run", *RUN), plugins()
    run = start(settings, loaded)
    with pytest.raises(TrainingError), loaded.listening([Raises(TrainingError("not finite"))]):
        execute(run, settings, loaded)
    assert exit_code(tmp_path / "run") == 1
    assert {"reason": "not finite"} in [record["update"] for record in records(tmp_path / "run", "summary")]


def test_a_server_needs_a_key_before_training(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NETRC", str(tmp_path / "netrc"))
    monkeypatch.delenv("WANDB_API_KEY", raising=False)
    with pytest.raises(ConfigError, match="needs an API key: run `wandb login` once"):
        tiny_run(tmp_path / "run", (*RUN, "tracker.wandb.online=true"))
    assert not (tmp_path / "run").exists()


def test_a_server_receives_the_points_that_it_lacks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """W&B's server says which step comes next, and refuses earlier ones."""
    steps: list[int] = []

    class Record:
        id, url, starting_step = "abc", "http://host/abc", 3

        def log(self, content: dict[str, Any], step: int) -> None:
            steps.append(step)

        def finish(self, exit_code: int = 0) -> None: ...

    def init(**words: Any) -> Record:
        assert (words["mode"], words["resume"], words["id"]) == ("online", "allow", before)
        return Record()

    tiny_run(tmp_path / "run", RUN, stop_after=5)
    before = run_id(tmp_path / "run")
    monkeypatch.setattr("gsx.trackers.wandb.refuse_without_key", lambda: None)
    monkeypatch.setattr(wandb, "init", init)
    run, settings = open_run(tmp_path / "run", plugins(), ["tracker.wandb.online=true"])
    execute(run, settings, plugins())
    logged = [line["step"] for line in run.progress.curves]
    assert 1 in logged
    assert steps == [*(step for step in logged if step >= 3), 6]
