"""What is planned for a table: which runs, which of them first, where states are left, what is finished."""

import json
import os
from functools import cache
from pathlib import Path
from typing import Any

import pytest
from tiny import leave_results

from gsx.builtin import plugins
from gsx.experiments.run_folder.files import read_run
from gsx.experiments.run_folder.run_key import (
    comparable,
    composition_key,
    evaluation_settings,
    finished,
    place_of,
    scene_stamp,
)
from gsx.experiments.runs.compose import Compositions, compose
from gsx.experiments.runs.logs import set_up_logging
from gsx.experiments.runs.saved_settings import write_config
from gsx.experiments.runs.settings import Settings
from gsx.experiments.tables.plan import Cell, Experiment, cells_of, plan_lines, planned
from gsx.experiments.tables.sweep import experiment_of, protocol_of, run_table

ROWS = {"control": "octree_gs", "UP": "octree_up", "UB": "octree_ub", "early": "octree_ub_start_10k",
        "same": "octree_ub_infer_1", "other": "3d_gs"}  # fmt: skip
DATASETS: dict[str, Any] = {"demo": {"title": "demo", "folder": "", "needs": [], "scenes": {"demo": "demo"}}}


def experiment(**more: Any) -> Experiment:
    return Experiment(name="t", title="T", published="", datasets=["demo"], baseline="control", rows=ROWS, **more)


@pytest.fixture(autouse=True)
def own_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


@cache
def composed(*words: str) -> Settings:
    """What several tests ask for and none changes; its output folder is relative to that of the test."""
    return compose(words, plugins())


def cells(table: Experiment, *words: str) -> list[Cell]:
    """As `gsx +experiment=... budget=quick` plans them."""
    return list(cells_of(table, DATASETS, lambda variant: ["budget=quick", *words], lambda given: composed(*given)))


def words_of(plan: Any) -> list[list[tuple[str, str]]]:
    """(variant, where states are left) of each run, phase by phase."""

    def short(job: list[str]) -> tuple[str, str]:
        given = dict(word.split("=", 1) for word in job)
        return given["variant"], given.get("warm_start_at", given["init"])

    return [sorted(map(short, phase)) for phase in plan.phases]


def finish(cell: Cell) -> None:
    """A run folder as a finished run leaves it."""
    cell.folder.mkdir(parents=True)
    leave_results(cell.folder)
    write_config(cell.folder / "config.yaml", cell.config)
    steps = cell.config["iterations"]
    (cell.folder / "evaluation.json").write_text(
        json.dumps({"step": steps, "psnr": 20.0, "views": [], "settings": evaluation_settings(cell.config)})
    )
    (cell.folder / "status.json").write_text(json.dumps({"state": "ok", "step": steps}))


def test_controls_go_first_and_leave_their_state_where_others_set_out() -> None:
    """Of 2,000 steps pseudo views begin at 10/40 = 500, 20/40 = 1,000 and 22/40 = 1,100."""
    table = experiment()
    every = cells(table)
    plan = planned(table, DATASETS, every, together=True)
    assert words_of(plan) == [
        [("3d_gs", "scratch"), ("octree_gs", "[500,1000,1100]")],
        [("octree_ub", "[500,1000,1100]"), ("octree_ub_start_10k", "[500,1000,1100]"),
         ("octree_up", "[500,1000,1100]")],
    ]  # fmt: skip
    assert (plan.done, plan.steps, plan.shared) == (0, 5 * 2000, 500 + 1000 + 1100)
    assert "2,600 of 10,000 steps are saved" in plan_lines(plan)[1]
    (alone,) = planned(table, DATASETS, every).phases  # one after the other: each leader right before its followers
    assert [job[1] for job in alone] == [f"variant={v}" for v in
            ("octree_gs", "octree_up", "octree_ub", "octree_ub_start_10k", "3d_gs")]  # fmt: skip


def test_without_a_control_the_one_that_begins_last_leads() -> None:
    table = experiment(only=["UP", "early"])
    plan = planned(table, DATASETS, cells(table), together=True)
    assert words_of(plan) == [[("octree_up", "[500]")], [("octree_ub_start_10k", "[500]")]]


def test_what_is_finished_is_left_out_whoever_asked_for_it() -> None:
    """UB and `same` are one run, under whichever name it was trained."""
    table = experiment(only=["UB", "same", "UP"])
    every = cells(table)
    assert every[1].row == "UB"
    assert every[1].folder == every[2].folder
    finish(every[2])
    plan = planned(table, DATASETS, every)
    assert (plan.done, words_of(plan)) == (1, [[("octree_up", "scratch")]])


def test_a_run_judged_otherwise_is_due_again_and_a_failed_one_too() -> None:
    table = experiment(only=["other"])
    (cell,) = cells(table)
    finish(cell)
    assert planned(table, DATASETS, [cell]).done == 1
    assert planned(table, DATASETS, cells(table, "eval.zoom=[1,8]")).done == 0
    (cell.folder / "status.json").write_text(json.dumps({"state": "failed", "step": 5}))
    assert planned(table, DATASETS, [cell]).done == 0


def test_seeds_share_nothing() -> None:
    table = experiment(only=["control", "UP"], seeds=[0, 1])
    plan = planned(table, DATASETS, cells(table), together=True)
    assert [len(phase) for phase in plan.phases] == [2, 2]
    assert len({cell.folder for cell in plan.cells}) == 4


def test_a_composition_is_named_by_what_is_trained_alone() -> None:
    with Compositions(plugins()) as compositions:

        def key(*words: str) -> str:
            settings = compositions.settings(["scene=demo", *words])
            return composition_key(settings.resolved, "", settings.idle)

        plain = key()
        for words in (["output=elsewhere", "device=cpu", "init=warm_start", "warm_start_at=[3]", "eval.zoom=[1,2]"],
                      ["reuse=true", "training.log_every=3", "regenerator/upscale=lanczos", "length=900",
                       "scene.cache_gb=2"]):  # fmt: skip
            assert key(*words) == plain, words
        for word in ("seed=1", "iterations=901", "backbone=scaffold", "augmenter=upscale", "scene.samples=7",
                     "rasterizer.tile_size=16", "training.ssim_weight=0.1"):  # fmt: skip
            assert key(word) != plain, word
        upscaled = key("augmenter=upscale")
        assert key("augmenter=upscale", "regenerator/restore=identity") == upscaled  # nobody asks for it
        assert key("augmenter=upscale", "regenerator/upscale=lanczos") != upscaled
        assert key("augmenter=[upscale,bootstrap]") != key("augmenter=[bootstrap,upscale]")
        settings = compositions.settings(["scene=colmap", "scene.path=/data/my scene", "output=o"])
        newer = compositions.settings(["scene=colmap", "scene.path=a"]).resolved
        before = {name: value for name, value in newer["scene"].items() if name != "model"}
        assert comparable(newer) == comparable({**newer, "scene": before})
        demo = compositions.settings(["scene=demo"])
        older = {name: value for name, value in demo.resolved["scene"].items() if name != "distances"}
        assert composition_key({**demo.resolved, "scene": older}, "", demo.idle) == key("scene.distances=even") == plain
        assert key("scene.distances=mixed") != plain
        assert key("scene=colmap", "scene.path=a", "scene.model=auto") == key("scene=colmap", "scene.path=a")
        assert key("scene=colmap", "scene.path=a", "scene.model=sparse/1") != key("scene=colmap", "scene.path=a")
    config, idle = settings.resolved, settings.idle
    assert place_of(config, "s", idle) == Path("o/my_scene/gs3d_zoom") / composition_key(config, "s", idle)
    assert place_of(config, "s", idle) != place_of(config, "t", idle)


def own_scene(root: Path, content: str) -> Path:
    """Not a scene that could be trained, but photos below a data_root, of a known time."""
    photo = root / "yard" / "images" / "a.png"
    photo.parent.mkdir(parents=True)
    photo.write_text(content)
    os.utime(photo, ns=(0, 10**9))
    return photo


def test_a_scene_is_what_its_folder_holds(tmp_path: Path) -> None:
    """Not what the folder is called: by `dataset=own` two roots may have different scenes of one name."""

    def place(root: str, *words: str) -> Path:
        given = ["dataset=own", "+dataset.scenes.yard=Yard", "dataset.scene=yard", f"data_root={tmp_path / root}"]
        settings = composed(*given, *words)
        return place_of(settings.resolved, scene_stamp(settings.resolved), settings.idle)

    own_scene(tmp_path / "a", "one")
    photo = own_scene(tmp_path / "b", "another")
    first, second = place("a"), place("b")
    assert first != second
    assert first == place("a", f"scene.path={tmp_path / 'a' / 'yard'}")
    (tmp_path / "a").rename(tmp_path / "c")
    assert place("c") == first
    absent = place("a")
    assert absent not in (first, second, place("nowhere"))
    os.utime(photo, ns=(0, 10**9))
    assert place("b") == second
    content = photo.read_bytes()
    photo.write_bytes(bytes(len(content)))
    assert place("b") != second
    photo.write_bytes(content)
    assert place("b") == second
    (tmp_path / "points.ply").write_text("1")
    named = [place("b", "scene.images=../../points.ply")]
    (tmp_path / "points.ply").write_text("22")
    assert place("b", "scene.images=../../points.ply") not in named


def test_a_run_is_compared_with_what_it_was_trained_on() -> None:
    table = experiment(only=["other"])
    (cell,) = cells(table)
    finish(cell)
    files = read_run(cell.folder)
    idle = cell.settings.idle
    assert finished(files, cell.config, "", idle)
    (cell.folder / "environment.json").write_text(json.dumps({"scene": {"stamp": "earlier"}}))
    assert not finished(read_run(cell.folder), cell.config, "", idle)
    assert finished(read_run(cell.folder), cell.config, "earlier", idle)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["seed=0,1"], "experiment.seeds="),
        (["seed=3"], "experiment.seeds="),
        (["dataset.scene=demo"], "experiment.scenes="),
        (["variant=octree_ub"], "experiment.only="),
        (
            ["regenerator.upscale.modl=x", "experiment.only=[3D-GS,3D-GS-UP]"],
            "Did you mean 'regenerator.upscale.model'",
        ),
        (["experiment.seeds=[1,1]"], "different ones"),
        (["experiment.only=[3DGS]"], "Did you mean '3D-GS'"),
        (["experiment.scenes=[demmo]"], "Did you mean 'demo'"),
        (["experiment.seeds=[]"], "different ones"),
        (["backbone.voxxel=1", "experiment.only=[3D-GS,Octree-3D-GS]"], "no configuration key"),
        (["hydra/launcher=slurrm"], "slurrm"),
        (["experiment.baseline=3D-GS-Up"], "Did you mean '3D-GS-UP'"),
        (["experiment.published=frameworkss"], "no table of the paper"),
    ],
)
def test_mistakes_are_named_before_anything_runs(words: list[str], message: str, tmp_path: Path) -> None:
    def job(config: Any) -> None:
        raise AssertionError("nothing must run")

    from gsx.core.errors import ConfigError

    with pytest.raises(ConfigError, match=message):
        run_table(["+experiment=table_frameworks", "dataset=demo", f"output={tmp_path}", *words], plugins(), job)
    assert not list(tmp_path.iterdir())


def test_words_of_a_component_go_to_the_rows_that_have_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["experiment=table_frameworks", "dataset=demo", f"output={tmp_path}", "experiment.dry=true",
             "regenerator.upscale.model=models/x2", "experiment.only=[3D-GS,3D-GS-UP]"]  # fmt: skip
    set_up_logging()
    commands, _ = run_table(words, plugins(), lambda config: None)
    assert capsys.readouterr().err.startswith("composing the runs of +experiment=table_frameworks ...\n")
    control, upscaled = commands.splitlines()
    assert "variant=3d_gs " in control
    assert "model=" not in control
    assert "regenerator.upscale.model=models/x2" in upscaled


def test_a_row_may_be_overrides_instead_of_a_variant(tmp_path: Path) -> None:
    words = ["+experiment=zoom_truth", "dataset=demo", f"output={tmp_path}", "experiment.dry=true", "iterations=400",
             "experiment.seeds=[0]", "experiment.only=[zoom,zoom lanczos]"]  # fmt: skip
    commands, _ = run_table([*words, "augmenter.upscale.weight_split=run"], plugins(), lambda config: None)
    baseline, lanczos = sorted(commands.splitlines(), key=len)
    for command in (baseline, lanczos):
        assert command.startswith("gsx dataset=demo backbone=mip_splatting preset=zoom ")
        assert "variant=" not in command
    assert "augmenter=upscale regenerator/upscale=lanczos" in lanczos
    assert "init=warm_start" in lanczos
    assert "weight_split=run" in lanczos
    assert "weight_split=run" not in baseline


def test_a_row_may_be_added_and_is_told_to_be_none_of_the_papers(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    words = ["+experiment=table_frameworks", "dataset=demo", f"output={tmp_path}", "experiment.dry=true",
             "+experiment.rows.mine=3d_gs", "experiment.only=[3D-GS,mine]"]  # fmt: skip
    with Compositions(plugins()) as compositions:
        table, plain = (experiment_of(some, compositions) for some in ([words[0], *words[4:]], words[:1]))
        cells = list(cells_of(table, DATASETS, lambda row: [f"output={tmp_path}"], compositions.settings))
        assert "mine is no row of its table" in protocol_of(plain, cells, compositions)
    assert run_table(words, plugins(), lambda config: None)[1] == 0


def test_every_row_of_overrides_composes(tmp_path: Path) -> None:
    chosen, common = ["+experiment=zoom_truth", "experiment.seeds=[0]"], [f"output={tmp_path}", "budget=smoke"]
    with Compositions(plugins()) as compositions:
        table = experiment_of(chosen, compositions)
        every = list(cells_of(table, DATASETS, lambda row: common, compositions.settings))
    assert len({cell.folder for cell in every}) == len(table.rows) == 20


def test_a_changed_experiment_is_another_table_and_says_so(tmp_path: Path) -> None:
    words = ["+experiment=table_frameworks", "dataset=own", "+dataset.scenes.yard=Yard", f"output={tmp_path}",
             f"data_root={tmp_path}", "experiment.only=[3D-GS]"]  # fmt: skip
    plain, _ = run_table(words, plugins(), lambda config: None)
    changed, _ = run_table([*words, "experiment.overrides=['iterations=100']"], plugins(), lambda config: None)
    assert "iterations=100 (paper: 40000)" in changed
    assert "iterations=" not in plain
    assert "yard is not there" in plain
    assert plain.splitlines()[-1] != changed.splitlines()[-1]


def test_a_launcher_that_gives_up_does_not_cost_the_table(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    def job(config: Any) -> None:
        raise RuntimeError("a process was killed")

    words = ["+experiment=table_frameworks", "dataset=demo", f"output={tmp_path}/a (1)", "experiment.only=[3D-GS]"]
    text, code = run_table([words[0], words[1], f"output='{tmp_path}/a (1)'", words[3]], plugins(), job)
    assert code == 2
    assert "not run yet" in text
    assert "the launcher failed (RuntimeError: a process was killed)" in caplog.text
