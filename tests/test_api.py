"""gsx from Python: the same as from the command line, as values."""

import math
import re
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from tiny import OVERRIDES, same_ending, tiny_run

import gsx
import gsx.api
from gsx.api import words_of
from gsx.builtin import plugins
from gsx.core.errors import ConfigError, InputError
from gsx.core.files import read_json
from gsx.experiments.runs.compose import compose


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> gsx.TrainedRun:
    """A run of three steps, trained in a thread, where signals cannot be heard."""
    folder = tmp_path_factory.mktemp("api") / "it's a run"
    with ThreadPoolExecutor(1) as pool:
        return pool.submit(gsx.train, *OVERRIDES, iterations=3, folder=folder, eval={"zoom": [1, 2]}).result()


def test_training_is_that_of_the_command_line(run: gsx.TrainedRun, tmp_path: Path) -> None:
    tiny_run(tmp_path / "run", ["iterations=3"])
    same_ending(tmp_path / "run", run.folder)
    assert run.step == 3
    assert run.report.is_file()


def test_a_view_is_rendered_by_itself_its_name_and_its_camera(run: gsx.TrainedRun) -> None:
    view = run.scene.test[1]
    pictures = [run.render(seen, zoom=2) for seen in (view, view.name, view.camera)]
    assert pictures[0].shape == (3, 72, 96)
    assert all(torch.equal(pictures[0], other) for other in pictures[1:])
    assert torch.equal(pictures[0], run.render(view.camera.zoom(2)))
    with pytest.raises(InputError, match=f"Did you mean '{view.name}'"):
        run.render(view.name + "x")


def test_an_evaluation_is_that_of_the_folder(run: gsx.TrainedRun) -> None:
    told = run.evaluate(zoom=[1, 4])
    assert list(told["zoom"]) == ["1", "4"]
    assert read_json(run.folder / "evaluation.json")["psnr"] == told["psnr"]
    with pytest.raises(ConfigError, match=r"Did you mean 'eval\.zoom'"):
        run.evaluate(zom=[1])


def test_a_splat_file_draws_what_its_run_does(run: gsx.TrainedRun, tmp_path: Path) -> None:
    camera, background = run.scene.test[0].camera, tuple(run.scene.background.tolist())
    splats = gsx.load(run.export(tmp_path / "model.ply"))
    assert isinstance(splats, gsx.SplatFile)
    torch.testing.assert_close(splats.render(camera, background), run.render(camera), rtol=0, atol=1e-5)
    over = torch.tensor(background)
    assert torch.equal(splats.render(run.scene.test[0], over), splats.render(run.scene.test[0].camera, over))
    for wrong, told in (
        ((1, 1), "give three values"),
        ((0, 0, 255), r"in \[0, 1\]"),
        ((math.nan, 0, 0), r"in \[0, 1\]"),
    ):
        with pytest.raises(InputError, match=told):
            splats.render(camera, wrong)
    with pytest.raises(InputError, match="is not a camera: give one, a view"):
        splats.render("test_000")
    assert repr(splats) == f"<300 splats of {tmp_path / 'model.ply'}>"
    with pytest.raises(InputError, match=r"gsx writes .*\.ply"):
        run.export(tmp_path / "model.obj")


def test_a_folder_is_opened_as_it_was_left(run: gsx.TrainedRun) -> None:
    opened = gsx.load(run.folder)
    assert isinstance(opened, gsx.TrainedRun)
    assert torch.equal(opened.render(opened.scene.test[0]), run.render(run.scene.test[0]))
    with pytest.raises(InputError, match="does not exist"):
        gsx.load(run.folder / "nothing")
    with pytest.raises(InputError, match="rendered as it was trained: raster is for splat files"):
        gsx.load(run.folder, raster=run.run.raster)
    assert repr(opened) == f"<run of 3 steps in {run.folder}>"


def test_a_home_is_looked_for(run: gsx.TrainedRun, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", str(run.folder.parent))
    assert gsx.load(f"~/{run.folder.name}").folder == run.folder


@pytest.mark.parametrize("given", [Path("photos"), "photos", {"seed": 3}, 4])
def test_what_is_no_setting_is_refused(given: Any) -> None:
    with pytest.raises(ConfigError, match=r"give settings, for example 'scene=colmap'"):
        gsx.train(given)


@pytest.mark.parametrize("seen", [0, None, Path("test_000")])
def test_what_is_no_camera_is_refused(run: gsx.TrainedRun, seen: Any) -> None:
    with pytest.raises(InputError, match="is not a camera: give one, a view"):
        run.render(seen)


def test_what_a_camera_sees_is_exported(run: gsx.TrainedRun, tmp_path: Path) -> None:
    view = run.scene.test[0]
    files = [run.export(tmp_path / f"{n}.ply", seen) for n, seen in enumerate((view, view.camera, view.name))]
    assert files[0].read_bytes() == files[1].read_bytes() == files[2].read_bytes()


def test_a_zoom_that_is_none_is_refused(run: gsx.TrainedRun) -> None:
    for zoom in (0, -1, math.nan, 1e9, "2", None):
        with pytest.raises(InputError, match=r"give a number from 0\.015625 to 64"):
            run.render(run.scene.test[0], zoom)


def test_messages_of_a_run_are_kept(run: gsx.TrainedRun) -> None:
    assert "held-out PSNR" in (run.folder / "log.txt").read_text()


def test_an_option_of_any_text_is_judged_by(run: gsx.TrainedRun) -> None:
    run.evaluate(remedy="it's a \\ 'text'", zoom=np.array([1, 2]))
    with pytest.raises(ConfigError, match="zoom is a set; give a number"):
        run.evaluate(zoom={1})


def test_what_is_for_the_command_line_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="tables and torchrun are for the command line"):
        gsx.train("+experiment=table_frameworks", output=tmp_path)


def test_names_are_those_of_the_api() -> None:
    assert list(gsx.OFFERED) == gsx.api.__all__
    assert {*gsx.OFFERED} <= {*dir(gsx)}


def test_values_become_words_of_the_command_line() -> None:
    given = {
        "seed": 3,
        "eval": {"zoom": [1, 2.5], "quantise": True},
        "augmenter": ["upscale"],
        "folder": None,
        "x": np.int64(3),
    }
    assert words_of(given) == [
        "seed=3",
        "eval.zoom=[1,2.5]",
        "eval.quantise=true",
        "augmenter=['upscale']",
        "folder=null",
        "x=3",
    ]


@pytest.mark.parametrize("name", ["it's", "a, b", "[x]", "back\\slash", "q\\'", 'two "', "é=ü", "end\\", "\\\\$a'\\\\"])
def test_texts_arrive_as_they_are(name: str) -> None:
    settings = compose([*OVERRIDES, *words_of({"folder": name})], plugins())
    assert settings.general.folder == name


@pytest.mark.parametrize("name", ["${oc.env:HOME}", "x\\${seed}", "\\\\${a}'"])
def test_texts_are_looked_up_nowhere(name: str) -> None:
    with pytest.raises(ConfigError, match=re.escape(f"folder is '{name}'; ")):
        compose([*OVERRIDES, *words_of({"folder": name})], plugins())


@pytest.mark.parametrize("wrong", [{"iteration": 3}, {"eval": {"zoom": "x"}}, {"backbone": "gs4d"}])
def test_what_is_wrong_is_told_before_there_is_a_folder(wrong: dict[str, Any], tmp_path: Path) -> None:
    with pytest.raises(ConfigError):
        gsx.train(*OVERRIDES, folder=tmp_path / "run", **wrong)
    assert not (tmp_path / "run").exists()


def test_names_are_there_before_torch_is() -> None:
    code = "import sys, gsx; assert 'torch' not in sys.modules; assert gsx.train; assert 'torch' in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True)
    with pytest.raises(AttributeError, match="it has SplatFile, TrainedRun, load"):
        gsx.trian  # type: ignore[attr-defined]  # noqa: B018


def test_the_page_does_what_it_says(
    run: gsx.TrainedRun, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    page = (Path(__file__).parents[1] / "docs" / "reference" / "python.md").read_text()
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(gsx, "train", lambda *_, **__: run, raising=False)  # trained above
    exec(page.split("```python\n")[1].split("```")[0], names := {})
    assert names["picture"].shape == (3, 144, 192)
    assert names["detail"].shape == (3, 16, 16)
    assert torch.equal(names["again"].render(names["view"], zoom=4), names["picture"])
    assert sorted(path.name for path in tmp_path.iterdir()) == ["four_times.png", "model.ply", "photo.png"]
    told = capsys.readouterr().out.splitlines()
    assert told[0] == f"{run.folder} 3 {run.folder / 'report.html'}"


def test_options_that_would_change_nothing_are_refused(run: gsx.TrainedRun, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"is a run, .*: origin is for splat files"):
        gsx.load(run.folder, origin=(1.0, 2.0, 3.0))
    with pytest.raises(InputError, match=r"axes and SPZ version are for \.spz files"):
        run.export(tmp_path / "a.ply", axes="rdf")
    assert not list(tmp_path.iterdir())


def test_zlib_is_loaded_before_the_copy_in_the_wheel_of_pycolmap() -> None:
    """In this order both compress; harmless input."""
    program = (
        "import gsx, sys; assert 'zlib' in sys.modules and 'pycolmap' not in sys.modules; import pycolmap, zlib; "
        "print(zlib.decompress(zlib.compress(bytes(1000))) == bytes(1000))"
    )
    assert (
        subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True).stdout == "True\n"
    )


def test_pycolmap_before_zlib_is_warned_of() -> None:
    program = "import sys; sys.modules.pop('zlib', None); sys.modules['pycolmap'] = sys; import gsx"
    found = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True).stderr
    assert "pycolmap was imported before zlib, which can crash Python: import gsx first" in found
