"""Branching from a common beginning: the same bits as from scratch, and only what is common."""

import json
import os
from pathlib import Path

import pytest
from tiny import LIGHT, same_ending, tiny_run

from gsx.builtin import plugins
from gsx.core.training.run import Run
from gsx.engine.cache import in_use
from gsx.experiments.runs.execute import execute
from gsx.experiments.runs.open import open_run
from gsx.experiments.runs.saved_settings import read_config
from gsx.experiments.runs.warm_start import warm_start_folder, without_augmenters

RUN = ("iterations=40", "regenerator/upscale=lanczos", "regenerator/restore=identity", "rasterizer=eager",
       "training.checkpoint_every=100", "training.log_every=2", "backbone.density.gradient=1e-3", *LIGHT)  # fmt: skip


@pytest.fixture(autouse=True)
def own_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("GSX_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr("gsx.experiments.runs.execute.finish", lambda *_: None)  # no figures are needed


def augmented(*names: str) -> tuple[str, ...]:
    """Few pseudo views of few events."""
    few = [(f"augmenter.{name}.first_cameras=2", f"augmenter.{name}.timing.every=8000") for name in names]
    files = {"upscale": "upscale_paper"}
    return (
        f"augmenter=[{','.join(files.get(name, name) for name in names)}]",
        *(word for words in few for word in words),
    )


def states_of(run: Run) -> Path:
    """Where the states of a run are kept."""
    return warm_start_folder(run, read_config(run.folder / "config.yaml", plugins()).idle, plugins().versions)


def lines(folder: Path) -> list[dict]:
    return [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]


def test_branches_equal_runs_from_scratch(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """The control trains all of it and leaves states at 10, 15, 20, 22, 30; bootstrap branches at 20, upscale at 22."""
    caplog.set_level("INFO")
    tiny_run(tmp_path / "control", (*RUN, "init=warm_start"))
    assert "no earlier run" in caplog.text
    for name, step in (("bootstrap", 20), ("upscale", 22)):
        caplog.clear()
        tiny_run(tmp_path / name, (*RUN, *augmented(name), "init=warm_start"))
        assert f"branching at step {step} from an earlier run" in caplog.text
        tiny_run(tmp_path / f"{name}_scratch", (*RUN, *augmented(name)))
        same_ending(tmp_path / name, tmp_path / f"{name}_scratch")
        assert [line["step"] for line in lines(tmp_path / name)] == [
            line["step"] for line in lines(tmp_path / f"{name}_scratch")
        ]


def test_a_branch_that_is_killed_while_it_begins_leaves_a_whole_checkpoint_or_none(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Files appear whole, and last the one without which the others are no checkpoint."""
    tiny_run(tmp_path / "first", (*RUN, "init=warm_start"), stop_after=12)
    appeared: list[str] = []
    replace = os.replace

    def noted(source: Path, place: Path) -> None:
        if Path(place).is_relative_to(tmp_path / "second"):
            appeared.append(Path(place).name)
        replace(source, place)

    monkeypatch.setattr(os, "replace", noted)
    tiny_run(tmp_path / "second", (*RUN, "init=warm_start"), stop_after=11)
    begun = appeared[: appeared.index("branch.json")]
    assert begun[-3:] == ["step_0000010.safetensors", "metrics.jsonl", "step_0000010.json"]


def test_nothing_is_taken_from_beyond_the_first_pseudo_views(tmp_path: Path) -> None:
    """upscale leaves its states up to 22; bootstrap, which begins at 20, must not take that of 22."""
    run = tiny_run(tmp_path / "upscale", (*RUN, *augmented("upscale"), "init=warm_start"))
    assert sorted(path.stem for path in states_of(run).glob("step_*.json")) == [
        f"step_{step:07d}" for step in (10, 15, 20, 22)
    ]
    tiny_run(tmp_path / "both", (*RUN, *augmented("upscale", "bootstrap"), "init=warm_start"))
    tiny_run(tmp_path / "scratch", (*RUN, *augmented("upscale", "bootstrap")))
    same_ending(tmp_path / "both", tmp_path / "scratch")


def test_other_compositions_have_other_trunks(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """How a run is watched makes no other."""
    caplog.set_level("INFO")
    tiny_run(tmp_path / "first", (*RUN, "init=warm_start"), stop_after=12)
    others = ("seed=1", "backbone.density.gradient=1e-5", "iterations=41", "training.ssim_weight=0")
    for number, other in enumerate(others):
        caplog.clear()
        tiny_run(tmp_path / f"other{number}", (*RUN, other, "init=warm_start"), stop_after=1)
        assert "no earlier run" in caplog.text
    tiny_run(tmp_path / "same", (*RUN, "training.log_every=5", "eval.zoom=[1,2]", "init=warm_start"), stop_after=11)
    assert "branching at step 10" in caplog.text


def test_resumed_runs_leave_nothing_behind(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """Their first steps may have followed another schedule."""
    caplog.set_level("INFO")
    tiny_run(tmp_path / "first", (*RUN, "init=warm_start"), stop_after=5)
    run, settings = open_run(tmp_path / "first", plugins(), ["iterations=44"])
    execute(run, settings, plugins())
    caplog.clear()
    tiny_run(tmp_path / "second", (*RUN, "iterations=44", "init=warm_start"), stop_after=1)
    assert "no earlier run" in caplog.text


def test_a_damaged_state_gives_way_to_an_older_one(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level("INFO")
    run = tiny_run(tmp_path / "first", (*RUN, "init=warm_start"), stop_after=16)
    (states_of(run) / "step_0000015.safetensors").write_bytes(b"cut short")
    tiny_run(tmp_path / "second", (*RUN, "init=warm_start"), stop_after=17)
    assert "truncated or altered" in caplog.text
    assert "branching at step 10" in caplog.text
    tiny_run(tmp_path / "third", (*RUN, "init=warm_start"), stop_after=17)
    assert "branching at step 15" in caplog.text, "it was kept again"
    (states_of(run) / "lines_step_0000015.json").write_text("{}")
    caplog.clear()
    tiny_run(tmp_path / "fourth", (*RUN, "init=warm_start"), stop_after=17)
    assert "branching at step 10" in caplog.text, "what it would have told of its beginning is damaged"


def test_a_cache_that_cannot_be_written_ends_no_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / "blocked").write_text("a file where a folder should be")
    tiny_run(tmp_path / "demo", (*RUN,), stop_after=1)  # pictures of the scene are kept
    monkeypatch.setattr("gsx.experiments.runs.warm_start.cache_folder", lambda kind, key: tmp_path / "blocked" / key)
    tiny_run(tmp_path / "first", (*RUN, "init=warm_start"), stop_after=12)
    assert "the state of step 10 is not kept" in caplog.text


def test_states_are_kept_within_a_budget(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Room for one composition: the second makes the first go; a run's own states stay whatever their size."""
    monkeypatch.setenv("GSX_CACHE", str(tmp_path / "cache"))
    first = tiny_run(tmp_path / "first", (*RUN, "init=warm_start"), stop_after=12)
    with in_use():
        second = tiny_run(tmp_path / "second", (*RUN, "seed=1", "init=warm_start", "disk_cache_gb=0"), stop_after=12)
    folders = [states_of(run) for run in (first, second)]
    assert [folder.is_dir() for folder in folders] == [False, True]


def test_the_control_of_an_augmenter_that_takes_the_checks_of_its_role_is_that_of_the_others() -> None:
    """Such a composition keeps `checks`, which nothing without augmenters asks for."""
    whole = {"seed": 0, "augmenter": {"own": {}}, "regenerator": {"upscale": {}}, "checks": {"upscale": {}}}
    assert without_augmenters(whole) == {"seed": 0}
