"""Figures of a table, worked by hand, and its forms as text."""

import csv
import io
import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from tiny import leave_results

from gsx.engine.cache import source_revision
from gsx.experiments.run_folder.files import read_run, state_of
from gsx.experiments.tables.plan import Cell, Experiment
from gsx.experiments.tables.published import Published
from gsx.experiments.tables.sweep import protocol_differences
from gsx.experiments.tables.table import Table, measured, table_of
from gsx.experiments.tables.table_text import as_csv, as_latex, as_markdown, as_text

DATASET = {"title": "Set & Co", "folder": "set", "needs": [], "scenes": {"one": "Scene One", "two": "Scene Two"}}
PSNR = {
    ("base", "one", 0): 20.0, ("base", "one", 1): 22.0, ("base", "two", 0): 30.0, ("base", "two", 1): 30.0,
    ("more", "one", 0): 23.0, ("more", "one", 1): 23.0, ("more", "two", 0): 31.0,
}  # fmt: skip
"""By row, scene and seed; of `more` the second seed of the second scene is missing: it failed."""


def cell(row: str, scene: str, seed: int, folder: Path) -> Cell:
    place = folder / f"{row}_{scene}_{seed}"
    made: Any = SimpleNamespace(row=row, dataset="set", scene=scene, seed=seed, folder=place)
    return made


def write_run(place: Path, psnr: float | None) -> None:
    """A finished run, or one that failed."""
    place.mkdir(parents=True)
    (place / "config.yaml").write_text("iterations: 10\nscene: {name: colmap}\n")
    if psnr is None:
        (place / "status.json").write_text(json.dumps({"state": "failed", "reason": "out of memory", "step": 4}))
        return
    (place / "status.json").write_text(json.dumps({"state": "ok", "step": 10}))
    figures = {"psnr": psnr, "ssim": 0.5, "lpips": None, "visible_primitives": 1500.0, "megabytes": 2.25, "step": 10}
    groups = {"scale-1": {"psnr": psnr + 5, "ssim": 0.75, "lpips": None, "visible_primitives": 500.0}}
    closer = {"psnr": psnr - 1, "enlarged_psnr": 19.5, "upscaled_psnr": 20.25}
    closer |= {"detail": {"render": {"explained": psnr / 100}}}
    zoom = {"1": {"psnr": psnr}, "2": closer}
    evaluation = figures | {"train_seconds": 12.0, "groups": groups, "zoom": zoom}
    (place / "evaluation.json").write_text(json.dumps(evaluation))
    leave_results(place, 10)


@pytest.fixture
def table(tmp_path: Path) -> Table:
    """Two rows, two scenes, two seeds, one failure; beside a paper that calls the scenes and a group by name."""
    cells = [cell(r, s, n, tmp_path) for r in ("base", "more") for s in DATASET["scenes"] for n in (0, 1)]
    for c in cells:
        write_run(c.folder, PSNR.get((c.row, c.scene, c.seed)))
    partial = {"scene": {"notes": ["Skipped 1 of the 9 images of poses.json, not on disk: 4.png."]}}
    for row in ("base", "more"):
        (tmp_path / f"{row}_one_1" / "environment.json").write_text(json.dumps(partial))
    (tmp_path / "more_one_0" / "branch.json").write_text(json.dumps({"step": 5, "seconds": 4.0}))
    figures = {
        ("base", "Set & Co", "PSNR"): 25.0, ("more", "Set & Co", "PSNR"): 26.5, ("quoted", "Set & Co", "PSNR"): 24.0,
        ("base", "Scene One", "PSNR"): 20.5, ("more", "Scene One", "PSNR"): 21.0, ("base", "Set & Co", "kGS"): 1.0,
        ("base", "Scale-1", "PSNR"): 26.0,
    }  # fmt: skip
    experiment = Experiment(
        name="t", title="T: 100 %", published="p", datasets=["set"], baseline="base", seeds=[0, 1],
        rows={"base": "b", "more": "m"}, quoted={"quoted": "from its own paper"},
    )  # fmt: skip
    published = Published(name="p", figures=figures, notes=["a slip"])
    return table_of(experiment, {"set": DATASET}, cells, published, {}, ["iterations=10 (paper: 40000)"])


def test_figures_hold_when_checkpoints_were_deleted_and_not_when_results_were(tmp_path: Path) -> None:
    write_run(tmp_path / "run", 20.0)
    for path in (tmp_path / "run" / "checkpoints").iterdir():
        path.unlink()
    files = read_run(tmp_path / "run")
    assert state_of(files)[0] == "interrupted"
    assert measured(files, "PSNR", "") == 20.0
    (tmp_path / "run" / "point_cloud.ply").unlink()
    assert measured(read_run(tmp_path / "run"), "PSNR", "") is None


def test_means_over_scenes_of_means_over_seeds_and_half_their_range(table: Table) -> None:
    """base: seed 0 (20 + 30) / 2 = 25, seed 1 (22 + 30) / 2 = 26: mean 25.5, half of the range 0.5."""
    f = table.at("base", "Set & Co", "PSNR")
    assert (f.ours, f.spread, f.seeds, f.scenes, f.of_scenes) == (25.5, 0.5, 2, 2, 2)
    assert (f.paper, f.difference, f.gain) == (25.0, 0.5, None)
    one = table.at("more", "Scene One", "PSNR")
    assert (one.ours, one.spread, one.difference, one.gain, one.paper_gain) == (23.0, 0.0, 2.0, 2.0, 0.5)


def test_a_failed_run_leaves_the_rest_and_no_difference_that_would_mislead(table: Table) -> None:
    f = table.at("more", "Set & Co", "PSNR")
    assert (f.ours, f.scenes, f.of_scenes) == (23.0, 1, 2)  # the scene that is whole
    assert (f.difference, f.gain) == (None, None)
    assert f.problem == "failed: out of memory"
    assert table.states == {"ok": 7, "failed": 1}
    assert "(23.00 ± 0.00: 1 of 2)" in as_text(table)
    assert "failed: out of memory: more" in as_text(table)


def test_perceptual_metrics_have_columns_where_a_run_has_them(tmp_path: Path) -> None:
    cells = [cell("base", scene, 0, tmp_path) for scene in DATASET["scenes"]]
    for number, c in enumerate(cells):
        write_run(c.folder, 20.0)
        file = c.folder / "evaluation.json"
        content = json.loads(file.read_text())
        content["perceptual"] = {"st_lpips_alex": 0.25 + number / 4, "niqe": None}
        content["zoom"]["2"]["perceptual"] = {"st_lpips_alex": {"render": 0.75, "enlarged": 0.5}}
        file.write_text(json.dumps(content))
    experiment = Experiment(
        name="t", title="T", published="", datasets=["set"], baseline="base", seeds=[0], rows={"base": "b"}, quoted={}
    )
    found = table_of(experiment, {"set": DATASET}, cells, None, {}, [])
    assert found.metrics[:5] == ["PSNR", "SSIM", "LPIPS", "s", "st_lpips_alex"]
    assert found.at("base", DATASET["title"], "st_lpips_alex").ours == 0.375
    assert found.at("base", DATASET["title"], "st_lpips_alex x2").ours == 0.75
    assert "0.375" in as_text(found)


def test_other_measures_groups_zooms_and_quoted_rows(table: Table) -> None:
    assert table.at("base", "Set & Co", "kGS").ours == 1.5  # drawn per view, in thousands
    assert table.at("base", "Scale-1", "PSNR").ours == 30.5  # of the group
    assert table.at("base", "Scene Two", "PSNR").ours == 30.0  # not in the paper's table: beside its figures
    assert table.at("base", "Scene One", "PSNR x2").ours == 20.0
    assert table.at("base", "Scene One", "over enlarged x2").ours == 0.5
    assert table.at("base", "Scene One", "over upscaled x2").ours == -0.25
    assert table.at("base", "Scene One", "detail x2").ours == pytest.approx(0.21)
    assert "0.210 ± 0.010" in as_text(table)
    quoted = table.at("quoted", "Set & Co", "PSNR")
    assert (quoted.ours, quoted.paper, quoted.paper_gain) == (None, 24.0, -1.0)
    assert (table.seconds, table.saved) == (7 * 12 - 4, 4)
    assert table.notes == [
        "quoted: from its own paper",
        "corrected: a slip",
        "one: Skipped 1 of the 9 images of poses.json, not on disk: 4.png.",
    ]


def test_the_same_figures_in_every_form(table: Table) -> None:
    lines = list(csv.DictReader(io.StringIO(as_csv(table))))
    assert len(lines) == 3 * 4 * 6  # rows; the three scopes and the other scene; PSNR, #GS, and four figures at x2
    line = next(n for n in lines if (n["row"], n["scope"], n["metric"]) == ("base", "Set & Co", "PSNR"))
    assert (line["ours"], line["spread"], line["paper"], line["difference"]) == ("25.5", "0.5", "25.0", "0.5")
    assert next(n for n in lines if n["row"] == "quoted")["ours"] == ""
    markdown = as_markdown(table)
    assert "**NOT the paper's protocol: iterations=10 (paper: 40000)**" in markdown
    assert "| base | 25.50 ± 0.50 | 25.00 | +0.50 |" in markdown
    widths = {text.count("|") for text in markdown.splitlines() if text.startswith("|") and "25.0" in text}
    assert len(widths) == 1
    latex = as_latex(table)
    assert r"Set \& Co" in latex
    assert r"T: 100 \%" in latex
    assert r"base & 25.50 $\pm$ 0.50 & 25.00 & +0.50" in latex
    assert latex.count(r"\begin{tabular}") == latex.count(r"\end{tabular}") == 4
    assert "NOT the paper's protocol" in latex


def test_some_scenes_are_not_set_against_the_mean_of_all_nor_gains_taken_over_other_scenes(tmp_path: Path) -> None:
    """The baseline lacks `two`, the other row lacks `one`: each is a mean over one scene, but not over the same."""
    cells = [cell(r, s, 0, tmp_path) for r in ("base", "more") for s in DATASET["scenes"]]
    for c, psnr in zip(cells, (20.0, None, None, 31.0), strict=True):
        write_run(c.folder, psnr)
    published = Published(name="p", figures={("base", "Set & Co", "PSNR"): 25.0}, notes=[])
    experiment = Experiment(
        name="t", title="T", published="p", datasets=["set"], baseline="base", rows={"base": "b", "more": "m"}
    )
    both = table_of(experiment, {"set": DATASET}, cells, published, {}, [])
    assert both.at("more", "Set & Co", "PSNR").ours == 31.0
    assert both.at("more", "Set & Co", "PSNR").gain is None
    some = replace(experiment, scenes=["one"])
    table = table_of(some, {"set": DATASET}, [c for c in cells if c.scene == "one"], published, {}, [])
    (scope,) = table.scopes
    assert scope.title == "Set & Co (1 of 2 scenes)"
    assert table.at("base", scope.title, "PSNR").ours == 20.0
    assert table.at("base", scope.title, "PSNR").difference is None


@pytest.mark.parametrize("change", [{"only": ["more"]}, {"baseline": "quoted"}])
def test_a_baseline_that_is_not_run_is_told(table: Table, change: dict[str, Any]) -> None:
    assert "gains are over base\n" in as_text(table)
    other = replace(table, experiment=replace(table.experiment, **change))
    assert f"gains are over {other.experiment.baseline}, which is not run: there are none of ours" in as_text(other)


def test_rows_of_another_revision_of_the_source_are_named(tmp_path: Path) -> None:
    """One run of `base` and both of `more` are of others; `more` was begun by one and finished by another."""
    cells = [cell(r, s, 0, tmp_path) for r in ("base", "more") for s in DATASET["scenes"]]
    sources = [source_revision(), "0123456789abcdef", "0123456789abcdef", f"0123456789abcdef+{source_revision()}"]
    for c, source in zip(cells, sources, strict=True):
        write_run(c.folder, 20.0)
        (c.folder / "environment.json").write_text(json.dumps({"source": source}))
    experiment = Experiment(
        name="t", title="T", published="", datasets=["set"], baseline="base", rows={"base": "b", "more": "m"}
    )
    said = as_markdown(table_of(experiment, {"set": DATASET}, cells, None, {}, []))
    this = source_revision()
    assert f"(0123456789abcdef, this is {this}): base (1 of 2 runs), more (1 of 2 runs)" in said
    assert f"(0123456789abcdef+{this}, this is {this}): more (1 of 2 runs)" in said
    (tmp_path / "base_two_0" / "environment.json").write_text(json.dumps({"source": this}))
    assert "base (" not in as_text(table_of(experiment, {"set": DATASET}, cells[:2], None, {}, []))


def test_the_protocol_differs_by_what_is_trained_and_judged_not_by_where(table: Table) -> None:
    paper = {"iterations": 40, "eval": {"zoom": [1], "ssim": "inria"}, "augmenter": {"u": {"role": "upscale"}},
             "regenerator": {"upscale": {"name": "sd", "steps": 15}, "restore": {"name": "turbo"}},
             "scene": {"name": "colmap", "path": "/a", "max_width": 1600}, "training": {"log_every": 10},
             "dataset": {"title": "A"}, "output": "x", "seed": 0}  # fmt: skip
    own = {**paper, "iterations": 4, "eval": {"zoom": [1, 2], "ssim": "inria"}, "output": "y", "seed": 3,
           "regenerator": {"upscale": {"name": "lanczos"}, "restore": {"name": "other"}},
           "scene": {"name": "colmap", "path": "/b", "max_width": 400}, "training": {"log_every": 1}}  # fmt: skip
    idle = frozenset({"scene.path", "training.log_every"})
    assert protocol_differences([(paper, paper, idle)]) == []
    longer = ({**own, "iterations": 5}, {**paper, "iterations": 50}, idle)
    assert "iterations=4, 5 (paper: 40, 50)" in protocol_differences([(own, paper, idle), longer])
    assert sorted(protocol_differences([(own, paper, idle), (own, paper, idle)])) == [
        "iterations=4 (paper: 40)",
        "regenerator.upscale.name=lanczos (paper: sd)",  # of another component only its name; restore is not used
        "scene.max_width=400 (paper: 1600)",
    ]


def test_what_happened_to_a_run_stands_beside_its_figures(tmp_path: Path) -> None:
    cells = [cell("base", scene, 0, tmp_path) for scene in DATASET["scenes"]]
    for c in cells:
        write_run(c.folder, 20.0)
    place = tmp_path / "base_two_0" / "evaluation.json"
    incident = {
        "withheld": {"step": 6, "primitives": 3},
        "pseudo": {"up": {"asked": {"2": 8}, "dropped": {"2": 0.25}, "warned": {"agreement": {"2": 0.5}}}},
        "left_out": 1.5,
    }
    place.write_text(json.dumps(json.loads(place.read_text()) | incident))
    experiment = Experiment(name="t", title="T", published="p", datasets=["set"], baseline="base", rows={"base": "b"})
    table = table_of(experiment, {"set": DATASET}, cells, None, {}, [])
    told = [
        "base, two: growth is held at backbone.max_primitives from step 6 on: the model may be too small",
        "base, two: up lost 25.0% of its x2 pictures",
        "base, two: 50.0% of up's x2 pictures disagree with their input",
        "base, two: renders leave out 1.5 splats a view, whose values cannot be drawn",
    ]
    assert table.notes == [f"* {text}" for text in told]
    assert table.at("base", "Scene Two", "PSNR").remarks == tuple(told)
    assert table.at("base", "Scene One", "PSNR").remarks == ()
    assert "20.00 *" in as_text(table).split("Scene Two")[1]
    assert "20.00 *" not in as_text(table).split("Scene One")[1].split("Scene Two")[0]
    line = next(n for n in csv.DictReader(io.StringIO(as_csv(table))) if n["scope"] == "Scene Two")
    assert line["remarks"] == "; ".join(told)
