"""The competitor of zoomed renders in settings: chosen like a regenerator, without effect on a run's identity."""

import json
import shutil
from pathlib import Path
from typing import Any

import pytest
from tiny import LIGHT, tiny_run

from gsx.builtin import plugins
from gsx.cli.dispatch import main
from gsx.core.errors import ConfigError
from gsx.experiments.run_folder.run_key import comparable, composition_key, evaluated_alike, evaluation_settings
from gsx.experiments.runs.compose import Compositions
from gsx.experiments.runs.evaluate import zoom_lines
from gsx.experiments.runs.explain import explain
from gsx.experiments.runs.saved_settings import read_config
from gsx.experiments.runs.settings import Settings

OLD = Path(__file__).parents[2] / "old_run"
LANCZOS = "regenerator/upscale@eval.competitor=lanczos"
CALLABLE = "regenerator/upscale@eval.competitor=callable"


@pytest.fixture(scope="module")
def composed() -> dict[str, Settings]:
    """By word of the command line."""
    words = ("seed=0", LANCZOS, CALLABLE, "eval.competitor=null")
    with Compositions(plugins()) as compositions:
        return {word: compositions.settings(["augmenter=upscale", word]) for word in words}


def test_it_is_chosen_like_any_regenerator(composed: dict[str, Settings]) -> None:
    names = [one.competitor and one.competitor.component.name for one in composed.values()]
    assert names == ["span", "lanczos", "callable", None]
    assert composed[LANCZOS].regenerators["upscale"].component.name == "scene_sr"
    assert composed[LANCZOS].resolved["eval"]["competitor"] == {"name": "lanczos"}


def test_it_changes_nothing_else(composed: dict[str, Settings]) -> None:
    """callable as a role loosens the checks of that role; as a competitor it does not."""
    first, *others = composed.values()
    for other in others:
        assert other.checks == first.checks
        assert composition_key(other.resolved, "", other.idle) == composition_key(first.resolved, "", first.idle)
        assert comparable(other.resolved) == comparable(first.resolved)


def test_a_name_without_its_group_is_refused_with_the_remedy() -> None:
    with (
        Compositions(plugins()) as compositions,
        pytest.raises(ConfigError, match=r"'lanczos': choose one with regenerator/upscale@eval.competitor=NAME"),
    ):
        compositions.settings(["eval.competitor=lanczos"])


def test_an_old_run_has_none_until_one_is_chosen() -> None:
    loaded, path = plugins(), OLD / "config.yaml"
    assert read_config(path, loaded).competitor is None
    chosen = read_config(path, loaded, [LANCZOS]).competitor
    assert chosen is not None
    assert chosen.component.name == "lanczos"
    tiles = read_config(path, loaded, ["regenerator/upscale@eval.competitor=span", "eval.competitor.tile=64"])
    assert tiles.competitor is not None
    assert tiles.competitor.options.tile == 64
    assert read_config(path, loaded, [LANCZOS, "eval.competitor=null"]).competitor is None
    with pytest.raises(ConfigError, match="Unknown regenerator/upscale 'lanczo'"):
        read_config(path, loaded, ["regenerator/upscale@eval.competitor=lanczo"])


def test_evaluations_from_before_it_stay_valid(composed: dict[str, Settings]) -> None:
    now, other = (evaluation_settings(composed[word].resolved) for word in ("seed=0", LANCZOS))
    before = json.loads(json.dumps(now))
    del before["eval"]["competitor"], before["eval"]["pairs"]
    assert evaluated_alike(before, now)
    assert evaluated_alike(before | {"metrics": {"lpips": before["metrics"]["lpips"]}}, now)
    assert evaluated_alike(now, now)
    assert not evaluated_alike(now, other)
    assert not evaluated_alike(now, evaluation_settings(composed["eval.competitor=null"].resolved))
    assert not evaluated_alike(before | {"eval": before["eval"] | {"quantise": False}}, now)


def test_a_key_of_it_is_explained() -> None:
    assert any("whole number from 16" in line for line in explain("eval.competitor.tile", [], plugins()))


def test_code_that_it_names_runs_only_if_the_command_line_names_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """gsx eval of a folder from elsewhere."""
    (tmp_path / "their_upscaler.py").write_text(
        "from pathlib import Path\n"
        "Path('was_here').touch()\n"
        "def blocks(image, scale, **more): return image.repeat_interleave(scale, 1).repeat_interleave(scale, 2)\n"
    )
    monkeypatch.chdir(tmp_path)
    folder = tiny_run(tmp_path / "run", [*LIGHT, "iterations=1", CALLABLE]).folder
    config = folder / "config.yaml"
    config.write_text(config.read_text().replace("function: ''", "function: their_upscaler:blocks"))
    zoomed = "eval.zoom=[1,2]"
    assert main(["eval", str(folder), zoomed]) == 2
    assert "runs code with your permissions, eval.competitor: 'their_upscaler:blocks'" in capsys.readouterr().err
    assert not (tmp_path / "was_here").exists()
    shutil.copytree(folder, tmp_path / "other")
    assert main(["eval", str(tmp_path / "other"), zoomed, "eval.competitor=null"]) == 0
    assert "competitor" not in evaluation_of(tmp_path / "other")
    assert main(["eval", str(folder), zoomed, "eval.competitor.function='their_upscaler:blocks'"]) == 0
    evaluation = evaluation_of(folder)
    assert evaluation["competitor"] == {"name": "callable"}
    assert evaluation["zoom"]["2"].keys() >= {"upscaled_psnr", "upscaled_ssim", "beats_upscaled"}
    page = (folder / "report.html").read_text()
    assert "enlarged by callable" in page
    assert (tmp_path / "was_here").exists()


def evaluation_of(folder: Path) -> dict[str, Any]:
    return json.loads((folder / "evaluation.json").read_text())


def test_the_log_says_win_or_loss_against_both() -> None:
    entry = {"psnr": 29.4, "enlarged_psnr": 28.7, "beats_enlarged": True, "upscaled_psnr": 29.55}
    agreement = {"render": 33.0, "enlarged": 35.5, "truth": 30.25, "pixels": 0.5}
    agreement |= {"detail": {"render": 0.75, "enlarged": 0.8, "truth": 0.5}}
    entry |= {"beats_upscaled": False, "consistency": agreement}
    kinds = {"render": 0.2, "enlarged": -0.01, "upscaled": 0.05, "photograph": 0.1}
    entry |= {"detail": {kind: {"explained": share} for kind, share in kinds.items()}}
    assert zoom_lines("4", entry, "span") == [
        "zoom x4: 29.40 dB, wins against the enlarged x1 render (28.70 dB), loses to the x1 render enlarged by span "
        "(29.55 dB); detail +0.200 (x1 enlarged: -0.010, by span: +0.050, photo: +0.100)",
        "zoom x4: neighbouring views agree to 33.00 dB, detail 0.75 (x1 enlarged: 35.50 dB, detail 0.80; "
        "photos: 30.25 dB, detail 0.50)",
    ]
    masked = {"consistency": {"render": 33.0, "enlarged": 35.5, "truth": 30.25, "pixels": 0.5}}
    assert zoom_lines("4", entry | masked, "span")[1:] == [
        "zoom x4: neighbouring views agree to 33.00 dB (x1 enlarged: 35.50 dB; photos: 30.25 dB)"
    ]
    bare = {"psnr": 29.4, "enlarged_psnr": 28.7, "beats_enlarged": True}
    assert zoom_lines("4", bare, "span") == ["zoom x4: 29.40 dB, wins against the enlarged x1 render (28.70 dB)"]
