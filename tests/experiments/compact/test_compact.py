"""gsx compact: what pictures do not need goes, what is promised is kept, a run folder comes out."""

import json
import math
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import torch
from tiny import tiny_run, tiny_settings
from torch import Tensor

from gsx.builtin import plugins
from gsx.cli.dispatch import main
from gsx.core.data.scene import Scene, View
from gsx.core.data.window import Window
from gsx.core.errors import InputError
from gsx.core.plugins import hookimpl
from gsx.core.quality.metrics import psnr
from gsx.core.training import importance
from gsx.core.training.parameter_table import append_rows, detached_rows, keep_rows
from gsx.core.training.render import render
from gsx.core.training.run import Run, StepResult
from gsx.core.training.trainer import train_step
from gsx.experiments.compact import compact as compacting
from gsx.experiments.compact import shrink
from gsx.experiments.compact.compact import compact
from gsx.experiments.compact.fine_tuning import copied_model, fine_tuned, split_views
from gsx.experiments.compact.quality import above_rounding, zoomed_psnr
from gsx.experiments.compact.shrink import Candidate, Search, ShrinkOptions, closer_window, importance_of, important
from gsx.experiments.run_folder.files import read_run, state_of
from gsx.experiments.runs.build import build
from gsx.experiments.runs.load_scene import load_scene
from gsx.experiments.runs.open import open_run
from gsx.experiments.runs.settings import Settings
from gsx.formats.ply import read_ply


@pytest.fixture(scope="module", autouse=True)
def scenes_loaded_once() -> Iterator[None]:
    """By their options."""
    loaded: dict[str, Scene] = {}

    def load(settings: Settings, *origin: Any) -> Scene:
        key = repr((settings.scene.options, *origin))
        if key not in loaded:
            loaded[key] = load_scene(settings, *origin)
        return loaded[key]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("gsx.experiments.runs.open.load_scene", load)
        yield


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of 24 steps."""
    path = tmp_path_factory.mktemp("runs") / "run"
    words = ("iterations=24", "backbone.sh_degree=2", "backbone.density.gradient=0.003", "rasterizer=eager")
    tiny_run(path, (*words, "eval.zoom=[1,2]"))
    return path


def opened(folder: Path) -> Run:
    return open_run(folder, plugins())[0]


def generator() -> torch.Generator:
    return torch.Generator().manual_seed(1)


@pytest.fixture(scope="module")
def prepared(folder: Path) -> Search:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(importance, "DRAWS", 6)
        return Search(opened(folder), ShrinkOptions(max_drop=0.0, steps=0, zooms=(1.0,)), plugins(), generator())


@pytest.fixture
def search(prepared: Search) -> Search:
    """Nothing has been tried, nothing is learnt, and quantised files lose nothing."""
    prepared.candidates, prepared.reserve = [], 0.0
    return prepared


@pytest.fixture
def few_tries(monkeypatch: pytest.MonkeyPatch) -> None:
    """The share that goes is found to a quarter; what rows are worth by fewer signs."""
    monkeypatch.setattr(importance, "DRAWS", 6)
    monkeypatch.setattr(compacting, "ShrinkOptions", partial(ShrinkOptions, tries=2))


def add_faint(run: Run) -> Tensor:
    """Copies of all rows with an opacity of 1e-6; which these are."""
    old = len(run.backbone.table)
    append_rows(run.backbone.table, detached_rows(run.backbone.table) | {"opacity_logits": torch.full((old,), -13.8)})
    return torch.arange(2 * old) >= old


def test_what_cannot_be_seen_is_worth_least(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(importance, "DRAWS", 6)
    run = opened(folder)
    faint = add_faint(run)
    worth = importance_of(run, run.scene.train, generator())
    assert float(worth[faint].max()) < 1e-9 * float(worth.max())
    pictures = [render(run, view.camera).image for view in run.scene.train]
    keep_rows(run.backbone.table, important(worth, 0.5))
    assert len(run.backbone.table) == len(faint) // 2
    for picture, view in zip(pictures, run.scene.train, strict=True):
        assert psnr(render(run, view.camera).image, picture) > 60


def test_worth_is_what_pictures_lose() -> None:
    """Renders without each of a few splats, at the views' own size; the mean over many signs."""
    run = opened_small()
    seeds, views = [torch.Generator().manual_seed(seed) for seed in range(10)], run.scene.train[:3]
    worth = torch.stack([importance_of(run, views, seed) for seed in seeds]).mean(0)
    whole, changes = [render(run, view.camera).image for view in views], []
    for row in range(len(worth)):
        less = opened_small(without=row)
        pairs = [(image, render(less, view.camera).image) for image, view in zip(whole, views, strict=True)]
        changes.append(sum(float((a - b).square().sum()) for a, b in pairs))
    seen = torch.tensor(changes) > 0.1
    assert int(seen.sum()) > 4
    logs = torch.stack([worth[seen].log(), torch.tensor(changes)[seen].log()])
    assert float(torch.corrcoef(logs)[0, 1]) > 0.9


def opened_small(without: int | None = None) -> Run:
    """A model of 12 large splats."""
    settings = tiny_settings(Path("unused"), "scene.points=12")
    run = build(settings, load_scene(settings), Path())
    with torch.no_grad():
        run.backbone.table["log_scales"].fill_(-1.0)
        run.backbone.table["opacity_logits"].copy_(torch.linspace(-3, 3, 12))
    if without is not None:
        keep_rows(run.backbone.table, torch.arange(12) != without)
    return run


def test_views_that_judge_are_not_learnt_from(folder: Path) -> None:
    run = opened(folder)
    learnt, judging = split_views(run)
    assert [len(learnt), len(judging)] == [4, 2]
    assert not {view.name for view in learnt} & {view.name for view in judging}
    few = replace(run.scene, train=run.scene.train[:2])
    run.views = replace(run.views, scene=few)
    assert [len(part) for part in split_views(run)] == [2, 2]


def test_a_window_is_the_middle_at_twice_the_focal_length(folder: Path) -> None:
    camera = opened(folder).scene.train[0].camera
    closer, window = closer_window(camera)
    assert window == Window(24, 18, 48, 36)
    assert closer.fx == 2 * camera.fx
    assert closer.size == camera.size
    middle = torch.tensor([[24.0, 18.0]]).double()
    torch.testing.assert_close(closer.project(ahead(camera))[0], middle, atol=1e-6, rtol=0)


def ahead(camera) -> Tensor:
    return (camera.centre + camera.rotation[2])[None].double()


def test_fine_tuning_leaves_the_run_as_it_was(folder: Path) -> None:
    run = opened(folder)
    before, seconds = run.backbone.table["means"].detach().clone(), run.progress.seconds
    tuned = fine_tuned(run, split_views(run)[0], 1, 3, plugins())
    assert torch.equal(run.backbone.table["means"], before)
    assert (tuned.step, tuned.iterations, tuned.scene) == (run.step, run.iterations, run.scene)
    assert tuned.progress.seconds == seconds
    assert len(tuned.backbone.table) == len(before)
    assert not torch.equal(tuned.backbone.table["means"], before)
    assert not tuned.backbone.table["sh_rest"][:, 3:].any()  # bands above degree 1
    assert tuned.backbone.table["sh_rest"][:, :3].any()
    rates = run.backbone.options.rates
    assert tuned.backbone.table.group("means")["lr"] == pytest.approx(rates.means_last * run.scene.extent)


@pytest.mark.parametrize("backbone", ["gs3d", "octree_scaffold"])
def test_copies_of_a_model_draw_alike_and_learn_apart(backbone: str) -> None:
    settings = tiny_settings(Path("unused"), f"backbone={backbone}", "scene.points=100", "iterations=4")
    run = build(settings, load_scene(settings), Path())
    camera = run.scene.train[0].camera
    copied = replace(run, backbone=copied_model(run))
    before = render(run, camera).image
    assert torch.equal(render(copied, camera).image, before)
    train_step(copied, plugins())
    assert torch.equal(render(run, camera).image, before)
    assert not torch.equal(render(copied, camera).image, before)


def test_fine_tuning_learns_from_its_views_alone(folder: Path) -> None:
    run, learnt = opened(folder), list[str]()

    class Watching:
        @hookimpl
        def gsx_gradients_ready(self, run: Run, step: StepResult) -> None:
            learnt.append(step.view.name)

    training, validation = split_views(run)
    loaded = plugins()
    with loaded.listening([Watching()]):
        fine_tuned(run, training, 1, 2 * len(training), loaded)
    assert sorted(set(learnt)) == sorted(view.name for view in training)
    assert not set(learnt) & {view.name for view in validation}


def test_a_budget_that_nothing_meets_leaves_the_model_as_it_was(search: Search) -> None:
    search.options = replace(search.options, max_drop=-5.0, tries=2)
    best = search.smallest()
    assert best is search.untouched
    assert search.trained(best) is search.run


@pytest.mark.usefixtures("few_tries")
def test_a_candidate_knows_nothing_of_the_others_exposures(folder: Path) -> None:
    run = opened(folder)
    run.modules["exposure"].start(matrices=torch.eye(3, 4).repeat(len(run.train_views), 1, 1))
    search = Search(run, ShrinkOptions(max_drop=0.0, steps=2, zooms=(1.0,)), plugins(), generator())
    drops = []
    for share in (0.25, 0.5, 0.25):
        search.candidates.clear()  # or the third would be the first
        drops.append(search.evaluate(share, search.untouched.degree).drop)
    assert drops[0] == drops[2]
    assert torch.equal(
        run.modules["exposure"].state_dict()["matrices"], torch.eye(3, 4).repeat(len(run.train_views), 1, 1)
    )


def with_drops(search: Search, drops: dict[int, float], monkeypatch: pytest.MonkeyPatch) -> None:
    """Candidates lose half a dB of the share of their rows, and `drops` by degree; nothing is learnt."""
    rows = len(search.importance)

    def evaluate(share: float, degree: int) -> Candidate:
        left = round((1 - share) * rows)
        size = left * search.untouched.megabytes / rows * (14 + 3 * (degree + 1) ** 2 - 3) / (14 + 3 * 9 - 3)
        drop = 0.5 * share + drops[degree]
        made = replace(search.untouched, removed=share, degree=degree, megabytes=size, drop=drop)
        search.candidates.append(made)
        return made

    monkeypatch.setattr(search, "evaluate", evaluate)


@pytest.mark.parametrize(
    ("drops", "degree", "most"),
    [
        ({2: 0.0, 1: 0.4, 0: 0.4}, 2, 0.6),  # no lower degree is within the budget
        ({2: 0.0, 1: 0.01, 0: 0.4}, 1, 0.58),  # smaller than with all bands beyond a third of the rows
        ({2: 0.0, 1: 0.0, 0: 0.1}, 0, 0.4),  # 14 numbers of 60 % of the rows, not 23 of 40 %
    ],
)
@pytest.mark.parametrize("reserve", [0.0, 0.1])
def test_the_smallest_within_the_budget_is_found(
    search: Search, monkeypatch: pytest.MonkeyPatch, drops: dict[int, float], degree: int, most: float, reserve: float
) -> None:
    """By drops that grow with the share, of which 0.3 dB are allowed beside what a quantised file loses."""
    search.options, search.reserve = replace(search.options, max_drop=0.3 + reserve, tries=5), reserve
    with_drops(search, drops, monkeypatch)
    best = search.smallest()
    assert [made.removed for made in search.candidates[:5]] == [0.5, 0.75, 0.625, 0.5625, 0.59375]
    assert best.degree == degree
    assert most - 1 / 32 < best.removed <= most
    assert all(best.megabytes <= made.megabytes or made.drop > 0.3 for made in search.candidates)


@pytest.mark.parametrize(("lost", "reserve"), [(0.04, 0.04), (0.2, 0.0)])
def test_the_budget_reserves_what_a_quantised_file_loses_unless_that_is_most_of_it(
    folder: Path, monkeypatch: pytest.MonkeyPatch, lost: float, reserve: float
) -> None:
    monkeypatch.setattr(importance, "DRAWS", 6)
    monkeypatch.setattr(shrink, "least_file_loss", lambda *args: lost)
    options = ShrinkOptions(max_drop=0.1, steps=0, zooms=(1.0,))
    assert Search(opened(folder), options, plugins(), generator()).reserve == reserve


@pytest.mark.parametrize(("found", "told"), [(30.0, 29.994), (math.inf, 58.923), (58.923, 55.912)])
def test_figures_tell_nothing_that_photographs_cannot(found: float, told: float) -> None:
    """Rounding to 8 bits is off by 1/255/sqrt(12) in the mean."""
    assert above_rounding(found) == pytest.approx(told, abs=0.002)


@pytest.mark.usefixtures("few_tries")
def test_a_run_folder_comes_out(folder: Path, tmp_path: Path) -> None:
    """With a checkpoint that opens, figures, files within the promise, and a page with both."""
    to = tmp_path / "small"
    page = compact(folder, to, 0.5, 4, ["eval.zoom=[1,2]"], plugins())
    assert page == to / "compared" / "report.html"
    assert page.is_file()
    assert state_of(read_run(to)) == ("ok", "")
    found = json.loads((to / "compact.json").read_text())
    small, big = opened(to), opened(folder)
    assert len(small.backbone.table) == found["chosen"]["primitives"] < len(big.backbone.table)
    assert found["chosen"]["drop"] <= 0.5
    assert read_run(to).evaluation["primitives"] == len(small.backbone.table)
    for suffix, facts in found["formats"].items():
        path = to / f"point_cloud{suffix}"
        assert path.exists() == facts["kept"]
        assert facts["kept"] is False or path.stat().st_size == facts["bytes"]
        assert facts["drop"] <= 0.5 or not facts["kept"] or suffix == ".ply"
    columns = read_ply(to / "point_cloud.ply")
    assert len(columns["x"]) == len(small.backbone.table)
    learnt = zoomed_psnr(small, split_views(big)[1], [1.0])["1"]
    assert learnt == pytest.approx(zoomed_psnr(big, split_views(big)[1], [1.0])["1"], abs=1.0)


@pytest.mark.usefixtures("few_tries")
def test_bands_that_go_are_not_in_the_files(folder: Path, tmp_path: Path) -> None:
    """Everything may be lost, so that only the constant colours are left: 17 numbers and three normals a splat."""
    compact(folder, tmp_path / "small", 50.0, 1, [], plugins())
    found, run = json.loads((tmp_path / "small" / "compact.json").read_text()), opened(tmp_path / "small")
    assert found["chosen"]["degree"] == 0
    assert run.backbone.table["sh_rest"].shape[1] == 0
    columns = read_ply(tmp_path / "small" / "point_cloud.ply")
    assert len(columns) == 17
    assert read_run(tmp_path / "small").evaluation["megabytes"] == pytest.approx(found["chosen"]["megabytes"], rel=1e-6)


@pytest.mark.usefixtures("few_tries")
def test_anchors_are_made_smaller(tmp_path: Path) -> None:
    words = ("backbone=scaffold", "iterations=6", "rasterizer=eager", "training.batch=2", "eval.zoom=[1]")
    tiny_run(tmp_path / "run", words)
    compact(tmp_path / "run", tmp_path / "small", 50.0, 1, [], plugins())
    found = json.loads((tmp_path / "small" / "compact.json").read_text())
    assert found["chosen"]["degree"] == -1
    assert found["formats"] == {}
    assert len(opened(tmp_path / "small").backbone.table) == found["chosen"]["primitives"]
    assert found["chosen"]["primitives"] < found["before"]["primitives"]


def test_what_cannot_be_made_smaller_is_told_and_leaves_nothing(folder: Path, tmp_path: Path) -> None:
    tiny_run(tmp_path / "stopped", ("iterations=2", "rasterizer=eager"), stop_after=1)
    tiny_run(tmp_path / "judged", ("iterations=0", f"init={folder / 'point_cloud.ply'}", "rasterizer=eager"))
    with pytest.raises(InputError, match="is at step 1 of 2"):
        compact(tmp_path / "stopped", tmp_path / "a", 0.1, 1, [], plugins())
    with pytest.raises(InputError, match=r"trained nothing\. Give that file"):
        compact(tmp_path / "judged", tmp_path / "b", 0.1, 1, [], plugins())
    assert not (tmp_path / "a").exists()
    assert not (tmp_path / "b").exists()


def test_an_error_leaves_no_folder(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*given: object) -> Search:
        raise MemoryError

    monkeypatch.setattr(compacting, "Search", fail)
    with pytest.raises(MemoryError):
        compact(folder, tmp_path / "small", 0.1, 1, [], plugins())
    assert not (tmp_path / "small").exists()


def test_masked_pixels_make_no_row_worth_anything(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(importance, "DRAWS", 6)
    run = opened(folder)
    assert float(importance_of(run, run.scene.train, generator()).max()) > 0
    monkeypatch.setattr(View, "counted", lambda view: torch.zeros(36, 48, dtype=torch.bool))
    assert float(importance_of(run, run.scene.train, generator()).max()) == 0


@pytest.mark.usefixtures("few_tries")
def test_a_splat_file_is_made_smaller(folder: Path, tmp_path: Path) -> None:
    scene = [f"scene.{key}" for key in ("width=48", "height=36", "train_views=4", "test_views=1", "samples=1")]
    words = ["compact", str(folder / "point_cloud.ply"), "scene=demo", *scene, "rasterizer=eager", "device=cpu"]
    assert main([*words, "eval.zoom=[1]", "--max-drop-db", "1", "--steps", "1", "--to", str(tmp_path / "small")]) == 0
    found = json.loads((tmp_path / "small" / "compact.json").read_text())
    assert found["chosen"]["primitives"] < found["before"]["primitives"]
    assert (tmp_path / "small" / "report.html").is_file()


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        (["nowhere"], "does not exist: give a run folder or a splat file"),
        (["{folder}", "--max-drop-db", "0"], "give a number above 0"),
        (["{folder}", "--to", "{folder}"], "is not empty: give another with --to FOLDER"),
        (["{folder}/point_cloud.ply"], "needs photos to compare with"),
    ],
)
def test_mistakes_are_told(
    words: list[str], complaint: str, folder: Path, capsys: pytest.CaptureFixture, caplog: pytest.LogCaptureFixture
) -> None:
    assert main(["compact", *(word.format(folder=folder) for word in words)]) == 2
    assert complaint in capsys.readouterr().err + caplog.text
