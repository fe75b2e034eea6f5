"""minutes=N from words to a trained run: measured, planned, repeated to the same bits; refused combinations."""

import json
import logging
import re
from pathlib import Path

import pytest
import torch
from tiny import OVERRIDES, final_tensors

from gsx.builtin import plugins
from gsx.core.errors import CompilerError, ConfigError, InputError
from gsx.core.training.run import Run
from gsx.experiments.minutes.cost import plan_options
from gsx.experiments.minutes.planned import (
    keys_of,
    planned,
    refuse_resumed,
    untimed_because,
    with_default_time,
    without_length,
)
from gsx.experiments.minutes.probe import measure, quiet
from gsx.experiments.runs import job, rasterizer_path
from gsx.experiments.runs.compose import compose

WORDS = (*OVERRIDES, "backbone.published_iterations=12", "rasterizer=eager", "scene.points=120", "eval.zoom=[1]")
"""However fast the machine, 12 steps are the most."""


def test_a_planned_run_and_its_repetition(tmp_path: Path) -> None:
    words, loaded = [*WORDS, "minutes=30", f"folder={tmp_path / 'planned'}"], plugins()
    settings = planned(compose(words, loaded), words, loaded)
    assert settings.general.iterations == 12
    assert settings.general.minutes == 0
    job.train(settings, loaded, [])
    facts = json.loads((tmp_path / "planned" / "environment.json").read_text())["minutes"]
    assert facts["limit_s"] == 1800
    assert facts["steps"] == 12
    assert 0 < facts["training_s"] < 1800
    assert facts["measurement"]["primitives"] <= 120
    late = json.loads((tmp_path / "planned" / "evaluation.json").read_text()).get("late", [])
    again = facts["repeat"]
    skip = [f"training.deadline.skip=[{','.join(str(round(step)) for step in late)}]"]
    repeated = compose([*again, *skip, f"folder={tmp_path / 'repeated'}"], loaded)
    job.train(repeated, loaded, [])
    one, other = final_tensors(tmp_path / "planned"), final_tensors(tmp_path / "repeated")
    page = (tmp_path / "planned" / "report.html").read_text()
    assert "Planned for 30.0 minutes: 12 steps" in page
    assert "backbone.published_iterations=12" in page
    model = [name for name in other if "deadline" not in name]
    assert model
    assert all(torch.equal(one[name], other[name]) for name in model)


def test_settings_without_minutes_stay() -> None:
    settings = compose(WORDS, loaded := plugins())
    assert planned(settings, WORDS, loaded) is settings


@pytest.mark.parametrize(
    ("more", "message"),
    [
        (["minutes=5", "iterations=100"], "minutes=N chooses the number of steps, and iterations does, too"),
        (["seconds=90", "budget=quick"], "seconds=N chooses the number of steps, and budget does, too"),
        (["minutes=5", "scene.iterations=9"], "minutes=N chooses the number of steps, and scene.iterations does, too"),
        (["minutes=5", "init=model.ply"], "minutes=N plans models that begin with the scene"),
        (["minutes=5", "reuse=true"], "reuse=true names the folder by the settings"),
        (["minutes=5", "seconds=5"], "minutes is 5 and seconds 5: give one of them"),
        (["minutes=-1"], "minutes is -1"),
    ],
)
def test_what_minutes_cannot_be_combined_with(more: list[str], message: str) -> None:
    words, loaded = [*WORDS, *more], plugins()
    with pytest.raises(ConfigError, match=re.escape(message)):
        planned(compose(words, loaded), words, loaded)


@pytest.mark.parametrize(
    ("more", "because"),
    [
        ("preset=zoom_prior", "preset=zoom_prior"),
        ("augmenter=[upscale] regenerator/upscale=span", "augmenter=[upscale]"),
        ("-m seed=0,1", "-m"),
        ("preset=zoom minutes=3", ""),
        ("variant=3dgs length=published", ""),
        ("backbone=gs3d", ""),
    ],
)
def test_reasons_for_no_default_minutes(more: str, because: str) -> None:
    words = ["scene=photos", "device=cpu", *more.split()]
    assert untimed_because(words) == because
    assert because in ("", "-m") or with_default_time(words) == words


def test_no_time_is_refused_at_once() -> None:
    words, loaded = [*WORDS, "minutes=0.01"], plugins()
    with pytest.raises(ConfigError, match=r"minutes=0\.01 leaves nothing after start-up .* give at least minutes=1$"):
        planned(compose(words, loaded), words, loaded)


def test_too_few_seconds_are_refused(tmp_path: Path) -> None:
    words, loaded = [*WORDS, "seconds=0.5", f"folder={tmp_path / 'run'}"], plugins()
    with pytest.raises(ConfigError, match=r"seconds=0\.5 leaves nothing after start-up \(\d+ s here\) .* seconds=60$"):
        planned(compose(words, loaded), words, loaded)
    assert not (tmp_path / "run").exists()


def test_a_run_that_exists_is_not_planned() -> None:
    with pytest.raises(ConfigError, match="gsx resume: minutes plans new runs only; give iterations=N"):
        refuse_resumed(["seed=1", "minutes=5"])
    refuse_resumed(["iterations=5"])


def test_a_used_folder_is_refused_before_anything_is_measured(tmp_path: Path) -> None:
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "mine.txt").touch()
    words, loaded = [*WORDS, "minutes=5", f"folder={tmp_path / 'run'}"], plugins()
    with pytest.raises(InputError, match="is not empty"):
        planned(compose(words, loaded), words, loaded)


def test_a_failing_compiler_leaves_the_eager_path(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(run: Run) -> None:
        raise CompilerError("no compiler")

    monkeypatch.setattr(rasterizer_path, "warm", fail)
    words, loaded = [word for word in WORDS if word != "rasterizer=eager"], plugins()
    settings = compose([*words, f"folder={tmp_path}"], loaded)
    measurement, _ = measure(settings, {}, plan_options().probe, loaded)
    assert measurement.path == "eager"


def test_messages_come_back_as_they_were() -> None:
    logging.disable(logging.WARNING)
    try:
        with quiet():
            assert logging.root.manager.disable == logging.WARNING
        assert logging.root.manager.disable == logging.WARNING
    finally:
        logging.disable(logging.NOTSET)


def test_keys_of_words() -> None:
    assert keys_of(["a.b=1", "+c=2", "scene=demo"]) == {"a.b", "c", "scene"}


@pytest.mark.parametrize("more", [[], ["backbone=gs3d"], ["scene.downscale=4"]])
def test_photos_have_a_default_time_on_a_cpu(more: list[str]) -> None:
    words = ["device=cpu", "scene=photos", *more]
    assert with_default_time(words) == [*words, "minutes=10"]


@pytest.mark.parametrize(
    "word",
    [
        *("length=published", "iterations=5", "minutes=3", "seconds=9", "variant=mip_ub"),
        *("preset=zoom_prior", "augmenter=[upscale]", "protocol=zoom_in", "reuse=true", "scene.iterations=5"),
    ],
)
def test_a_chosen_length_stays(word: str) -> None:
    words = ["device=cpu", "scene=photos", word]
    assert with_default_time(words) == words
    assert without_length(words) == [one for one in words if one != "length=published"]
