"""gsx trade training: settings tried on a scene, fronts, and advice that keeps its word."""

import json
import shlex
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from tiny import OVERRIDES

from gsx.builtin import plugins
from gsx.cli.dispatch import main
from gsx.core.errors import ConfigError, TrainingError
from gsx.core.files import read_json
from gsx.experiments.runs.compose import Compositions
from gsx.experiments.trade.training.measure import (
    Outcome,
    Row,
    Trial,
    combinations,
    different,
    expected,
    measured,
)
from gsx.experiments.trade.training.settings import GIVEN, Setting, settings_of, together
from gsx.experiments.trade.training.wishes import Wish, advice, advice_lines, front, table

LISTED = {
    "primitives": {"few": {"words": ["backbone.capacity=adaptive"]}, "more": {"words": ["a=1", "b=2"]}},
    "steps": {"half": {"steps": 0.5}},
}


def row(name: str, trade: str, *runs: tuple[float, float, float, float], words: tuple[str, ...] = ()) -> Row:
    """runs: dB at x1, dB at x4, MB, seconds, of each seed."""
    outcomes = [
        Outcome(folder=f"{name}{seed}", psnr={"1": one, "4": four}, primitives=100, megabytes=mb, seconds=seconds)
        for seed, (one, four, mb, seconds) in enumerate(runs)
    ]
    setting = Setting(name=name, trades=(trade,) if trade else (), words=words)
    return Row(setting=setting, overrides=list(words), outcomes=outcomes)


ROWS = [
    row("as given", "", (30.0, 26.0, 20.0, 100.0), (30.4, 26.2, 20.0, 100.0)),
    row("small", "primitives", (29.9, 26.3, 5.0, 60.0), (30.1, 26.5, 6.0, 80.0), words=("capacity=adaptive",)),
    row("short", "steps", (29.0, 25.0, 20.0, 50.0), (29.0, 25.0, 20.0, 50.0), words=("iterations=5",)),
    row("long", "steps", (30.5, 26.6, 20.0, 200.0), (30.9, 26.8, 20.0, 200.0), words=("iterations=20",)),
]


def test_settings_are_those_of_the_trades_wanted_and_scale_steps() -> None:
    few, more, half = settings_of(LISTED)
    assert [few.name, more.name, half.name] == ["few", "more", "half"]
    assert settings_of(LISTED, ["steps"]) == [half]
    assert half.overrides(900) == ["iterations=450"]
    assert GIVEN.overrides(900) == []
    both = together([more, half, half])
    assert (both.name, both.trades) == ("more + half + half", ("primitives", "steps", "steps"))
    assert both.overrides(900) == ["a=1", "b=2", "iterations=225"]
    with pytest.raises(ConfigError, match=r"'step' is no trade: choose from primitives, steps\. Did you mean"):
        settings_of(LISTED, ["step"])
    with pytest.raises(ConfigError, match=r"steps"):
        settings_of({"steps": {"none": {"steps": 0}}})


def test_every_setting_of_ours_goes_with_3d_gs() -> None:
    with Compositions(plugins()) as compositions:
        for setting in settings_of(compositions.node(["+trade=settings"], "trade")):
            settings = compositions.settings(["backbone=gs3d", *setting.overrides(900)])
            assert settings.general.iterations == round(900 * setting.steps), setting.name


def test_fronts_and_drops_worked_by_hand() -> None:
    given, small, _, long = ROWS
    assert (given.quality("1"), given.quality("4")) == pytest.approx((30.2, 26.1))
    assert small.drop(given) == pytest.approx(0.3)  # x1 of the second seed: 30.4 to 30.1
    assert long.drop(given) == pytest.approx(-0.5)
    assert [found.setting.name for found in front(ROWS, "seconds", "1")] == ["short", "small", "as given", "long"]
    assert [found.setting.name for found in front(ROWS, "seconds", "4")] == ["short", "small", "long"]
    assert [found.setting.name for found in front(ROWS, "megabytes", "1")] == ["small", "long"]


def test_the_time_to_come_worked_by_hand() -> None:
    """Two seeds, of 100 s of training each; 30 and 50 s of evaluation."""
    outcomes = [replace(one, evaluate_seconds=spent) for one, spent in zip(ROWS[0].outcomes, (30.0, 50.0), strict=True)]
    given = replace(ROWS[0], outcomes=outcomes)
    assert expected(given, [GIVEN, Setting(name="long", steps=2.0)]) == 2 * (3 * 100 + 2 * 40)


WISHES: Mapping[str, tuple[Wish, list[str]]] = {
    "MB": (Wish(budget_mb=6.0), ["small"]),
    "MB of the worst seed": (Wish(budget_mb=5.5), [""]),
    "seconds": (Wish(target_seconds=100.0), ["small"]),  # the best at x4
    "seconds and loss": (Wish(target_seconds=100.0, max_drop_db=0.1), ["as given"]),
    "loss": (Wish(max_drop_db=0.35), ["small", "small"]),
    "little loss": (Wish(max_drop_db=0.1), ["as given", "as given"]),
    "nothing": (Wish(), ["as given", "as given"]),
}


@pytest.mark.parametrize("case", WISHES)
def test_advice_keeps_the_bounds_for_every_seed(case: str) -> None:
    wish, names = WISHES[case]
    found = advice(ROWS, wish, "4")
    assert [one.row.setting.name if one.row else "" for one in found] == names


def test_advice_is_a_command_or_says_what_comes_nearest() -> None:
    words = ["scene=colmap", "scene.path=my scene"]
    told, call = advice_lines(advice(ROWS, Wish(budget_mb=6.0), "4"), ROWS[0], words)
    assert told.startswith("best at x4, at most 6 MB: small, x1 30.00 dB (-0.20), x4 26.40 dB (+0.30), 5.5 MB, 70 s")
    assert call == "gsx scene=colmap 'scene.path=my scene' capacity=adaptive"
    (none,) = advice_lines(advice(ROWS, Wish(target_seconds=10.0), "4"), ROWS[0], words)
    assert "nothing that was tried; nearest is 'short'" in none


def test_what_is_best_in_several_trades_is_tried_together() -> None:
    names = [setting.name for setting in combinations(ROWS, 2)]
    assert names == ["long + small"]  # by what they bring at x4
    assert not list(combinations(ROWS[:3], 2)), "one trade alone has been tried"
    fast = row("fast", "resolution", (30.0, 26.0, 20.0, 70.0), (30.4, 26.2, 20.0, 70.0))
    cheap = row("cheap", "colour", (30.0, 26.0, 9.0, 90.0), (30.4, 26.2, 9.0, 90.0))
    assert [setting.name for setting in combinations([*ROWS, fast, cheap], 2)] == ["long + small", "fast + cheap"]
    assert len(list(combinations([*ROWS, fast, cheap], 1))) == 1


def test_settings_that_train_the_same_are_told_once() -> None:
    assert [found.setting.name for found in different([ROWS[0], ROWS[1], ROWS[0]])] == ["as given", "small"]
    failed = Row(setting=GIVEN, overrides=[], failure="why")
    assert len(different([failed, failed])) == 2


def test_the_table_marks_what_nothing_beats_and_tells_what_does_not_go() -> None:
    lines = table([*ROWS, Row(setting=Setting(name="odd"), overrides=[], failure="no such key")])
    assert [line.count("*") for line in lines[1:5]] == [0, 2, 1, 2]
    assert lines[-1] == "does not go here: odd: no such key"


def test_a_setting_that_cannot_be_trained_does_not_cost_the_others(tmp_path: Path) -> None:
    """Of three the middle one ends with an error, after its first seed."""
    tried = []

    def job(settings: Any) -> Path:
        tried.append((settings.general.iterations, settings.general.seed))
        if tried[-1] == (20, 1):
            raise TrainingError("it was lost\nwith words")
        folder = tmp_path / f"{len(tried)}"
        folder.mkdir()
        facts = {"psnr": 20.0, "zoom": {}, "primitives": 9, "megabytes": 1, "train_seconds": 1, "evaluate_seconds": 1}
        (folder / "evaluation.json").write_text(json.dumps(facts))
        return folder

    given = ["backbone=gs3d", "iterations=10"]
    trial = Trial(given=given, seeds=[0, 1], folder=tmp_path, job=job, plugins=plugins())
    settings = [Setting(name=f"{n} steps", trades=["steps"], words=[f"iterations={n}"]) for n in (20, 30)]
    rows = measured(trial, settings, 1)
    assert tried == [(10, 0), (10, 1), (20, 0), (20, 1), (30, 0), (30, 1)]
    assert [row.failure for row in rows] == ["", "it was lost", ""]
    assert [len(row.outcomes) for row in rows] == [2, 0, 2]


def evaluation(folder: Path) -> dict[str, float]:
    found = read_json(folder / "evaluation.json")
    return {"psnr": found["psnr"], "megabytes": found["megabytes"]}


def test_the_command_advised_gives_what_was_promised(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """And what is there is not trained again; what cannot be composed says why."""
    words = [*OVERRIDES, "scene.points=100", "scene.train_views=3", "iterations=4", "rasterizer=eager"]
    asked = ["--trades", "colour,levels", "--budget-mb", "0.015", "--to", str(tmp_path / "t"), "--combinations", "0"]
    assert main(["trade", "training", *words, "backbone.sh_judged=0", *asked]) == 0
    out = capsys.readouterr().out.splitlines()
    content = json.loads((tmp_path / "t" / "trade.json").read_text())
    assert str(tmp_path) not in (tmp_path / "t" / "trade.html").read_text(), "it could not be moved"
    assert "does not go here: octree" in " ".join(out)
    page, call = out[-1], shlex.split(out[-2])
    assert page == str(tmp_path / "t" / "trade.html")
    chosen = content["advice"][0]
    assert call == shlex.split(chosen["command"])
    assert main([*call[1:], f"folder={tmp_path / 'again'}"]) == 0
    found = evaluation(tmp_path / "again")
    assert (
        found["megabytes"]
        <= 0.015
        < evaluation(tmp_path / "t" / content["rows"][0]["outcomes"][0]["folder"])["megabytes"]
    )
    promised = next(one for one in content["rows"] if one["overrides"] and set(one["overrides"]) <= set(call))
    assert promised["outcomes"][0]["psnr"]["1"] == found["psnr"]
    stamps = {path: path.stat().st_mtime_ns for path in (tmp_path / "t").rglob("evaluation.json")}
    assert main(["trade", "training", *words, "backbone.sh_judged=0", *asked]) == 0
    assert {path: path.stat().st_mtime_ns for path in (tmp_path / "t").rglob("evaluation.json")} == stamps
