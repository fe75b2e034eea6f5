"""Steps that are left out: when steps are judged, by which numbers, what is learnt from meanwhile, resume."""

import json
import math
from pathlib import Path

import pytest
import torch
from tiny import final_tensors, tiny_run, tiny_settings
from torch import Tensor

from gsx.builtin import plugins
from gsx.core.data.scene import View
from gsx.core.data.window import Window
from gsx.core.errors import ConfigError
from gsx.core.training.photographs import Photographs
from gsx.core.training.plateau import Plateau, PlateauOptions
from gsx.experiments.runs.execute import execute
from gsx.experiments.runs.open import open_run

WORDS = (
    "iterations=40",
    "training.plateau.start=0.25",
    "rasterizer=eager",
    "training.log_every=1",
    "training.test_points=0",
)
"""Six views: windows begin after step 10, are judged after step 16, then after 22 and 28; the last part is from 32."""
LEAVES_OUT = (*WORDS, "training.plateau.price=100")


def steps_of(folder: Path) -> list[int]:
    """Steps that a run took."""
    return [json.loads(line)["step"] for line in (folder / "metrics.jsonl").read_text().splitlines()]


def test_when_steps_are_judged() -> None:
    """A tenth of the steps so far or a pass over the views, whatever is more; while there are steps to leave out."""
    plateau = Plateau(PlateauOptions(price=1.0), iterations=1000, passing=52)
    assert [step for step in range(1000) if plateau.begins_after(step)] == [500]
    plateau.begin(500)
    assert [step for step in range(1000) if plateau.judged_after(step)] == [552]
    assert plateau.begins_after(552)
    plateau.begin(552)
    assert plateau.ends(552) == 608
    plateau.begin(700)
    assert not plateau.begins_after(770)  # its windows would be judged after step 847
    assert Plateau(PlateauOptions(), iterations=1000, passing=52).begins_after(500) is False


def test_gain_by_hand() -> None:
    """Half the error by a quarter more steps: 3.01 dB by 0.32 doublings."""
    plateau = Plateau(PlateauOptions(price=9.5), iterations=1000, passing=125)
    plateau.begin(500)
    plateau.before = torch.tensor([6e6, 2e6], dtype=torch.float64)
    windows = [Window(0, 0, 10, 10)] * 2
    told = plateau.judge(windows, torch.tensor([3e6, 1e6], dtype=torch.float64), 625)
    assert told["step_gain"] == pytest.approx(10 * math.log10(2) / math.log2(1.25))
    assert plateau.reached  # 9.35 dB
    plateau.options = PlateauOptions(price=9.0)
    assert not plateau.reached


def test_errors_below_the_rounding_of_photographs_are_no_gain() -> None:
    plateau = Plateau(PlateauOptions(price=0.1), iterations=1000, passing=125)
    plateau.begin(500)
    plateau.before = torch.tensor([1e-9], dtype=torch.float64)
    plateau.judge([Window(0, 0, 100, 100)], torch.tensor([1e-12], dtype=torch.float64), 1000)
    assert plateau.reached


def test_steps_that_gain_too_little_are_left_out(tmp_path: Path) -> None:
    run = tiny_run(tmp_path / "run", LEAVES_OUT)
    assert steps_of(tmp_path / "run") == [*range(1, 17), *range(32, 41)]
    assert run.plateau.found[:, 0].tolist() == [16]
    assert run.curves[16]["steps_left_out"] == 15


def test_every_step_is_taken_that_gains_enough(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gsx.core.training.plateau.decibels", lambda has, had: (1.0, 0.0))
    run = tiny_run(tmp_path / "run", (*WORDS, "training.plateau.price=0.1"))
    assert steps_of(tmp_path / "run") == list(range(1, 41))
    assert run.plateau.found[:, 0].tolist() == [16, 22, 28]


def test_training_does_not_see_the_windows(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Photographs white in them train to the same bits as long as they stay; where they are seen again, to others."""
    words, photograph = (*WORDS, "training.plateau.price=1e-6"), Photographs.of
    plain = tiny_run(tmp_path / "plain", words, stop_after=16)
    own = {view.name: window for view, window in plain.plateau.windows(plain.scene.train).items()}
    assert len(own) == 6
    taken = list[int]()

    def disturbed(self: Photographs, view: View) -> Tensor:
        taken.append(0)
        out = photograph(self, view).clone()
        if len(taken) > 10:
            out[:, *own[view.name].pixels] = 1
        return out

    monkeypatch.setattr(Photographs, "of", disturbed)
    tiny_run(tmp_path / "white", words, stop_after=16)
    taken.clear()
    tiny_run(tmp_path / "later", words, stop_after=18)
    monkeypatch.undo()
    tiny_run(tmp_path / "whole", words, stop_after=18)
    plain_end, white, later, whole = (final_tensors(tmp_path / name) for name in ("plain", "white", "later", "whole"))
    parameters = [name for name in plain_end if name.startswith("parameters.")]
    assert all(torch.equal(plain_end[name], white[name]) for name in parameters)
    assert not all(torch.equal(later[name], whole[name]) for name in parameters)


@pytest.mark.parametrize("stop", [12, 15, 16, 33])
def test_resuming_equals_never_having_stopped(stop: int, tmp_path: Path) -> None:
    """Before the windows are judged, just then, and after steps were left out."""
    tiny_run(tmp_path / "whole", LEAVES_OUT)
    tiny_run(tmp_path / "parts", LEAVES_OUT, stop_after=stop)
    again, settings = open_run(tmp_path / "parts", plugins(), ())
    execute(again, settings, plugins())
    expected, found = final_tensors(tmp_path / "whole"), final_tensors(tmp_path / "parts")
    assert expected.keys() == found.keys()
    assert all(torch.equal(expected[name], found[name]) for name in expected)
    assert steps_of(tmp_path / "parts") == steps_of(tmp_path / "whole")


def test_options_are_checked_together(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"training.plateau.start is 0.9 and training.plateau.to 0.8"):
        tiny_settings(tmp_path, "training.plateau.price=0.1", "training.plateau.start=0.9")
