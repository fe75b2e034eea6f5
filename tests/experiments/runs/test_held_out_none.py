"""Runs with scene.split=none: all views are trained on, no figure is made up, and every page says so."""

import json
import math
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from small_scene import small_scene
from synthetic_colmap import synthesize, write_scene
from tiny import LIGHT, tiny_run

import gsx.api
from gsx.builtin import plugins
from gsx.cli.runs import evaluate_file
from gsx.core.errors import ConfigError, InputError
from gsx.experiments.compact.compact import log_result
from gsx.experiments.compact.fine_tuning import split_views
from gsx.experiments.evaluation.remarks import NOT_MEASURED
from gsx.experiments.reports.overview import write_overview
from gsx.experiments.run_folder.files import LOG, read_run, state_of
from gsx.experiments.runs.compose import compose
from gsx.experiments.runs.evaluate import summary
from gsx.experiments.runs.execute import evaluate_again
from gsx.experiments.runs.export import evaluation_views, export, losses
from gsx.experiments.runs.load_scene import held_out_none, load_scene
from gsx.experiments.runs.open import open_run
from gsx.experiments.runs.render_views import render_test_views
from gsx.experiments.tables.table import measured, problem_of
from gsx.trackers.figures import evaluation_figures

WORDS = ("iterations=4", "scene.split=none", "rasterizer=eager", "eval.zoom=[1,2]", "training.test_points=2")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run of four steps on 3 + 1 views."""
    path = tmp_path_factory.mktemp("none") / "run"
    tiny_run(path, (*LIGHT, *WORDS))
    (path / LOG).write_text("")  # which the command line writes
    return path


def evaluation_of(folder: Path) -> dict:
    return json.loads((folder / "evaluation.json").read_text())


def test_all_views_are_trained_on_and_no_figure_is_made_up(folder: Path) -> None:
    found = evaluation_of(folder)
    assert (found["protocol"]["train_views"], found["protocol"]["test_views"], found["views"]) == (4, [], [])
    for name in ("psnr", "ssim", "lpips", "visible_primitives", "left_out", "render_fps"):
        assert found[name] is None
    assert found["zoom"] == {zoom: {"unavailable": NOT_MEASURED} for zoom in ("1", "2")}
    assert found["protocol"]["size"] == [48, 36]
    assert found["primitives"] > 0
    assert state_of(read_run(folder)) == ("ok", "")
    assert "NaN" not in (folder / "evaluation.json").read_text()
    assert not any("test_psnr" in line for line in read_run(folder).lines)
    assert all(math.isfinite(value) for value in evaluation_figures(found).values())
    assert "evaluation/psnr" not in evaluation_figures(found)


def test_log_report_and_overview_say_so(folder: Path, tmp_path: Path) -> None:
    lines = summary(evaluation_of(folder) | {"evaluate_seconds": 0.0})
    assert lines[-1] == NOT_MEASURED
    assert not any("held-out PSNR" in line or "n/a" in line for line in lines)
    page = (folder / "report.html").read_text()
    assert page.count(NOT_MEASURED[1:]) >= 4  # beside the figures, crops, views, and the worst of them
    assert ">held-out<" not in page
    for word in ("nan dB", "no readable evaluation", "no weights</div>"):
        assert word not in page
    assert NOT_MEASURED in write_overview(tmp_path, [folder]).read_text()
    assert NOT_MEASURED in (tmp_path / "report.csv").read_text()


def test_it_can_be_evaluated_again_and_from_python(folder: Path) -> None:
    assert evaluate_again(folder, plugins(), ["eval.zoom=[1,4]"])["zoom"]["4"] == {"unavailable": NOT_MEASURED}
    run = gsx.api.load(folder)
    assert isinstance(run, gsx.api.TrainedRun)
    assert run.evaluate(zoom=[1, 2])["psnr"] is None
    assert run.scene.test == []


def test_what_needs_test_views_is_refused_with_the_remedy(folder: Path, tmp_path: Path) -> None:
    run, settings = open_run(folder, plugins())
    with pytest.raises(InputError, match=r"no test views, all are trained on .*--orbit FILE"):
        render_test_views(run, settings, tmp_path / "pictures", 1.0)
    assert not (tmp_path / "pictures").exists()
    with pytest.raises(ConfigError, match="choose another split than scene"):
        evaluate_file(folder / "point_cloud.ply", ["scene=demo", "scene.split=none"])


def test_files_are_compared_in_training_views(folder: Path, tmp_path: Path) -> None:
    run, settings = open_run(folder, plugins())
    written = export(run, tmp_path / "model.spz")
    assert written is not None
    (line,) = losses(run, settings, tmp_path / "model.spz", evaluation_views(run.scene), written)
    assert "at worst over 4 views" in line
    export(run, tmp_path / "page.html")
    assert (tmp_path / "page.html").stat().st_size > 1000


def test_a_smaller_model_is_judged_by_training_views(folder: Path, caplog: pytest.LogCaptureFixture) -> None:
    run, _ = open_run(folder, plugins())
    assert [len(views) for views in split_views(run)] == [2, 2]
    found = {"before": {"primitives": 120}, "chosen": {"drop": 0.05}, "formats": {}, "max_drop_db": 0.1}
    with caplog.at_level("INFO", "gsx.experiments.compact.compact"):
        log_result(folder, evaluation_of(folder), found)
    assert caplog.messages[-1] == "drop 0.05 dB <= 0.1 dB on validation views"


def test_a_table_says_why_there_is_no_figure(folder: Path) -> None:
    files = {folder: read_run(folder)}
    assert measured(files[folder], "PSNR", "") is None
    cell = SimpleNamespace(dataset="own", scene="demo", folder=folder)
    assert problem_of([cell], files, {}, "LPIPS") == NOT_MEASURED  # type: ignore[list-item]


def test_it_trains_on_where_it_ended(folder: Path) -> None:
    run, _ = open_run(folder, plugins(), ["iterations=5"], training=True)
    assert (run.step, run.iterations, len(run.scene.test)) == (4, 5, 0)


@pytest.mark.parametrize("kind", ["colmap", "bungee"])
def test_photographs_are_all_trained_on(tmp_path: Path, kind: str) -> None:
    write_scene(synthesize("SIMPLE_PINHOLE", [80.0, 32.0, 24.0], frames=5), tmp_path / "yard")
    scene = load_scene(compose([f"scene={kind}", f"scene.path={tmp_path / 'yard'}", "scene.split=none"], plugins()))
    assert (len(scene.train), scene.test) == (5, [])
    assert scene.notes[-1] == f"all 5 views are trained on: {NOT_MEASURED}"


def test_a_loader_that_leaves_no_test_views_unasked_is_refused() -> None:
    scene = small_scene(torch.zeros(1, 3))
    with pytest.raises(InputError, match=r"choose another scene\.split, or none to train on all views without figures"):
        held_out_none(scene, "json")
    assert held_out_none(scene, "none").notes == [f"all 4 views are trained on: {NOT_MEASURED}"]
