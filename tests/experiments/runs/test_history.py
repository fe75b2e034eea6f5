"""A run that goes on knows what changed: it says so, keeps it, and refuses what would make another run of it."""

import errno
import json
import logging
import shutil
from pathlib import Path
from typing import Any

import pytest
from tiny import tiny_run

from gsx.builtin import plugins
from gsx.cli.dispatch import main
from gsx.core.errors import InputError
from gsx.core.files import read_json
from gsx.experiments.run_folder.files import read_run
from gsx.experiments.runs.environment import camera_digest
from gsx.experiments.runs.history import record_changes
from gsx.experiments.runs.open import open_run


@pytest.fixture(scope="module")
def stopped(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of 4 steps, stopped after the first."""
    folder = tmp_path_factory.mktemp("history") / "run"
    tiny_run(folder, ("iterations=4",), stop_after=1)
    return folder


@pytest.fixture
def run(stopped: Path, tmp_path: Path) -> Path:
    shutil.copytree(stopped, tmp_path / "run")
    return tmp_path / "run"


def facts(run: Path) -> dict[str, Any]:
    return json.loads((run / "environment.json").read_text())


def alter(run: Path, **entries: Any) -> None:
    (run / "environment.json").write_text(json.dumps(facts(run) | entries))


def warned(caplog: pytest.LogCaptureFixture) -> list[str]:
    return [record.getMessage() for record in caplog.records if record.levelno >= logging.WARNING]


def resumed(run: Path, *overrides: str, changed: bool = False) -> None:
    """What `gsx resume` does before the first step."""
    opened, settings = open_run(run, plugins(), overrides, training=True)
    record_changes(opened, settings, plugins(), changed)


def test_nothing_changed_nothing_said(run: Path, caplog: pytest.LogCaptureFixture) -> None:
    before = facts(run)
    resumed(run)
    assert warned(caplog) == []
    assert facts(run) == before


def test_other_files_and_another_source_are_told_and_kept(run: Path, caplog: pytest.LogCaptureFixture) -> None:
    this, scene = facts(run)["source"], facts(run)["scene"]
    packages = facts(run)["packages"]
    alter(run, source="0123", scene=scene | {"stamp": "other"}, packages=packages | {"torch": "1.0"}, device="a GPU")
    resumed(run)
    assert "files of the scene have changed since the run started" in caplog.text
    assert f"started by another revision of gsx's source (0123, this is {this})" in caplog.text
    assert f"packages.torch={packages['torch']}, before it was 1.0" in caplog.text
    assert facts(run)["source"] == f"0123+{this}"
    (entry,) = facts(run)["history"]
    assert entry["step"] == 1
    assert entry["changed"].keys() == {"source", "scene.stamp", "packages.torch", "device"}
    assert entry["changed"]["device"][0] == "a GPU"
    caplog.clear()
    resumed(run)
    assert warned(caplog) == [], "compared with how it went on last, not with how it began"
    assert len(facts(run)["history"]) == 1


def test_other_cameras_are_refused_unless_they_are_meant(run: Path) -> None:
    alter(run, scene=facts(run)["scene"] | {"cameras": "0123456789abcdef"})
    with pytest.raises(InputError, match=r"trained to step 1 with other cameras .* gsx resume .* --changed"):
        resumed(run)
    assert "history" not in facts(run)
    assert main(["resume", str(run)]) == 2
    assert main(["resume", str(run), "--changed"]) == 0
    assert facts(run)["history"][0]["changed"].keys() == {"scene.cameras"}


def test_an_edited_config_is_refused_and_an_override_is_kept(run: Path, caplog: pytest.LogCaptureFixture) -> None:
    text = (run / "config.yaml").read_text()
    assert text.count("ssim_weight: 0.2") == 1
    (run / "config.yaml").write_text(text.replace("ssim_weight: 0.2", "ssim_weight: 0.3"))
    with pytest.raises(InputError, match=r"other options \(config.yaml was edited\)"):
        resumed(run)
    resumed(run, changed=True)
    (run / "config.yaml").write_text(text.replace("log_every: 10", "log_every: 3"))  # changes nothing that is trained
    caplog.clear()
    (run / "environment.json").write_text(json.dumps({k: v for k, v in facts(run).items() if k != "history"}))
    resumed(run, "iterations=6", "training.ssim_weight=0.1")
    assert "continuing with iterations=6, before it was 4" in caplog.text
    changed = facts(run)["history"][0]["changed"]
    assert changed["iterations"] == [4, 6]
    assert changed["training.ssim_weight"] == [0.2, 0.1]


def test_an_edited_config_is_refused_by_another_source_too(run: Path, caplog: pytest.LogCaptureFixture) -> None:
    alter(run, source="0123")
    text = (run / "config.yaml").read_text()
    (run / "config.yaml").write_text(text.replace("ssim_weight: 0.2", "ssim_weight: 0.3"))
    with pytest.raises(InputError, match=r"other options \(config.yaml was edited, or another rev.* --changed"):
        resumed(run)
    (run / "config.yaml").write_text(text.replace("  pixel: sample\n", ""))  # as of a gsx that had no such option
    with pytest.raises(InputError, match=r"this one reads differently: rasterizer\.pixel\)"):
        resumed(run)
    assert "history" not in facts(run)
    resumed(run, changed=True)
    assert "continuing with other options (config.yaml was edited" in caplog.text
    (entry,) = facts(run)["history"]
    assert {"source", "rasterizer.pixel"} <= entry["changed"].keys()


@pytest.mark.parametrize("content", [None, "{", '{"history": 3}'])
def test_without_what_it_began_with_a_run_says_so_and_goes_on(
    run: Path, content: str | None, caplog: pytest.LogCaptureFixture
) -> None:
    began = facts(run)
    path = run / "environment.json"
    if content is None:
        path.unlink()
    else:
        path.write_text(content)
    resumed(run)
    (said,) = warned(caplog)
    assert "environment.json is missing" in said if content is None else "environment.json" in said
    assert "are those of the start; the file is written anew" in said
    now = facts(run)
    assert now["source"] == f"unknown+{began['source']}"
    assert now["scene"] == began["scene"]
    assert [(entry["step"], list(entry["changed"])) for entry in now["history"]] == [(1, ["environment.json"])]
    assert content is None or (run / "environment.damaged_1").read_text() == content
    caplog.clear()
    resumed(run)
    assert warned(caplog) == [], "compared with what was written anew"


def test_what_cannot_be_read_now_is_not_taken_for_damaged(run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    sound = (run / "environment.json").read_bytes()

    def failing(path: Path) -> object:
        if path.name == "environment.json":
            raise OSError(errno.EIO, "Input/output error")
        return read_json(path)

    for module in ("run_folder.files", "runs.history"):
        monkeypatch.setattr(f"gsx.experiments.{module}.read_json", failing)
    with pytest.raises(OSError, match="Input/output error"):
        resumed(run)
    assert (run / "environment.json").read_bytes() == sound
    assert list(run.glob("environment.damaged*")) == []


def test_a_config_that_lags_behind_its_history_goes_on(run: Path) -> None:
    """Killed between both: the history has the digest of options that config.yaml has not got yet."""
    resumed(run, "iterations=6")
    resumed(run, "iterations=6")
    resumed(run)


def test_plugins_that_came_and_went_are_told(run: Path, caplog: pytest.LogCaptureFixture) -> None:
    alter(run, plugins=facts(run)["plugins"] | {"gone": "1.0"})
    resumed(run)
    assert "plugins.gone=None, before it was 1.0" in caplog.text


def test_a_run_of_an_older_gsx_goes_on(run: Path, caplog: pytest.LogCaptureFixture) -> None:
    old = {key: value for key, value in facts(run).items() if key not in ("options", "plugins", "scene")}
    (run / "environment.json").write_text(json.dumps(old))
    resumed(run)
    assert warned(caplog) == []
    (run / "environment.json").unlink()
    resumed(run)


@pytest.mark.parametrize("history", [3, [3], [{"changed": {"device": 3}}], [{"changed": {"device": [1, 2, 3]}}], [{}]])
def test_an_odd_history_is_one_sentence_or_none(run: Path, history: Any) -> None:
    alter(run, history=history)
    assert ("environment.json" in read_run(run).problems) == (history != [{}])
    resumed(run)


def test_cameras_are_told_apart_beyond_rounding(run: Path) -> None:
    from dataclasses import replace

    opened, _ = open_run(run, plugins())
    views = opened.scene.train

    def moved(distance: float) -> list[Any]:
        first = views[0]
        camera = replace(first.camera, translation=first.camera.translation + distance)
        return [replace(first, camera=camera), *views[1:]]

    assert camera_digest(moved(0.0)) == camera_digest(views)
    assert camera_digest(moved(1e-3)) != camera_digest(views)
    assert camera_digest(list(reversed(views))) != camera_digest(views)
