"""Reports of complete, interrupted, failed and damaged runs made by hand; overviews against hand-worked fronts."""

import base64
import csv
import json
import math
import re
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import pytest
import torch
from tiny import leave_results

from gsx.core.data.images import write_image
from gsx.core.errors import InputError
from gsx.experiments.reports.charts import (
    Axis,
    Series,
    line_chart,
    linear_ticks,
    pareto_front,
    smoothed,
    thinned,
)
from gsx.experiments.reports.overview import write_overview
from gsx.experiments.reports.page import compact, duration, fixed, signed
from gsx.experiments.reports.report import write_report
from gsx.experiments.run_folder.files import read_run, runs_below, state_of

CONFIG = """\
iterations: 1000
seed: 0
folder: ''
scene:
  name: colmap
  path: captures/garden
  downscale: 4
backbone:
  name: gs3d
  sh_degree: 3
"""


def zoom_entry(psnr: float, enlarged: float, ssim: float = 0.8, enlarged_ssim: float = 0.7) -> dict[str, Any]:
    return {
        "psnr": psnr,
        "ssim": ssim,
        "enlarged_psnr": enlarged,
        "enlarged_ssim": enlarged_ssim,
        "views": 3,
        "beats_enlarged": psnr > enlarged,
    }


def evaluation(**changes: Any) -> dict[str, Any]:
    names = ["b/one.png", "b/two.png", "b/three.png"]
    views = [
        {"name": name, "group": "near", "psnr": psnr, "ssim": 0.9, "lpips": None}
        for name, psnr in zip(names, (27.5, 21.25, 24.0), strict=True)
    ]
    return {
        "protocol": {"hash": "0123456789abcdef", "ssim": "inria", "test_views": names, "scene": {"format": "colmap"}},
        "step": 1000,
        "psnr": 24.25,
        "ssim": 0.9,
        "lpips": None,
        "primitives": 123456,
        "visible_primitives": 4321.0,
        "megabytes": 29.1,
        "render_fps": 12.5,
        "train_seconds": 734.2,
        "peak_memory_mb": 812.0,
        "groups": {"near": {"psnr": 24.25, "ssim": 0.9, "lpips": None}},
        "zoom": {
            "1": zoom_entry(24.25, 24.25),
            "2": zoom_entry(23.5, 23.0) | {"groups": {"near": zoom_entry(23.25, 23.0)}},
            "4": zoom_entry(20.0, 21.5),
            "8": {"unavailable": "the images hold no truth at x8"},
        },
        "views": views,
    } | changes


def curve_lines() -> list[dict[str, Any]]:
    lines: list[dict[str, Any]] = [
        {"step": s, "seconds": 0.75 * s, "loss": 0.3 / (1 + s / 100), "psnr": 12 + s / 80, "primitives": 1000 + s}
        for s in range(10, 1001, 10)
    ]
    lines[29] |= {"opacity_resets": 1}
    lines[39] |= {"steps_left_out": 150}
    lines[59] |= {"skipped": "loss is not finite"}
    lines[49] |= {"test_psnr": 17.0}
    lines[99] |= {"test_psnr": 24.0}
    return lines


def make_run(folder: Path, config: str = CONFIG, result: dict[str, Any] | None = None) -> Path:
    """A complete run."""
    (folder / "renders").mkdir(parents=True)
    (folder / "config.yaml").write_text(config)
    plan = {"densify": {"from": 100, "until": 500, "every": 10}, "sh_degree": {"every": 33, "up_to": 3}}
    notes = ["2 of 30 images are <missing>"]
    environment = {"gsx": "0.1.0", "device": "cpu", "plan": plan, "scene": {"train_views": 20, "notes": notes}}
    (folder / "environment.json").write_text(json.dumps(environment))
    (folder / "metrics.jsonl").write_text("".join(json.dumps(line) + "\n" for line in curve_lines()))
    (folder / "evaluation.json").write_text(json.dumps(result or evaluation()))
    (folder / "status.json").write_text(json.dumps({"state": "ok", "reason": "", "step": 1000}))
    make_pictures(folder / "renders")
    leave_results(folder, 1000)
    return folder


def make_pictures(folder: Path) -> None:
    generator = torch.Generator().manual_seed(0)
    files = ["one.truth", "one.render", "one.error", "one.x4.truth", "one.x4.render", "one.x4.enlarged"]
    for file in files:
        write_image(folder / f"{file}.png", torch.rand(3, 12, 16, generator=generator))
    view = {"name": "b/one.png", "group": "near", "psnr": 27.5, "ssim": 0.9, "lpips": None, "size": [16, 12]}
    view |= {"role": "best", "files": {kind: f"one.{kind}.png" for kind in ("truth", "render", "error")}}
    crop = {"view": "b/one.png", "factor": 4, "window": [0, 0, 16, 12], "psnr": 20.5, "enlarged_psnr": 19.25}
    crop |= {"files": {kind: f"one.x4.{kind}.png" for kind in ("truth", "render", "enlarged")}}
    (folder / "index.json").write_text(json.dumps({"error_full": 0.2, "views": [view], "zoom": [crop]}))


LOADING = ("src", "href", "xlink:href", "srcset", "data", "action")
"""Attributes that make a browser load something."""


class Page(HTMLParser):
    """Sections with their texts, and everything that could load something."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.source = path.read_text(encoding="utf-8")
        self.open: list[str] = []
        self.section = ""
        self.texts: dict[str, str] = {}
        self.links: list[tuple[str, str]] = []
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.feed(self.source)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        values = dict(attrs)
        self.tags.append((tag, values))
        if tag in ("section", "header", "div", "table", "ul") and values.get("id"):
            self.section = str(values["id"])
        self.links += [(tag, str(value)) for key, value in attrs if key in LOADING]
        self.handle_data(" ")

    def handle_data(self, data: str) -> None:
        self.texts[self.section] = self.texts.get(self.section, "") + data

    def text(self, section: str) -> str:
        """Text of a section with single spaces."""
        return " ".join(self.texts.get(section, "").split())


@pytest.fixture
def page(tmp_path: Path) -> Page:
    return Page(write_report(make_run(tmp_path / "run")))


def test_the_page_refers_to_nothing_outside_itself(page: Page) -> None:
    assert not re.search(r"https?://|url\(|@import", page.source)
    assert {tag for tag, _ in page.links} == {"a", "img"}
    assert all(link.startswith("#") for tag, link in page.links if tag == "a")
    assert all(link.startswith("data:image/png;base64,") for tag, link in page.links if tag == "img")


def test_every_anchor_exists(page: Page) -> None:
    ids = {values.get("id") for _, values in page.tags}
    assert {link[1:] for tag, link in page.links if tag == "a"} <= ids


def test_headline_figures(page: Page) -> None:
    text = page.text("figures")
    for words in ("24.25 dB", "0.9000 inria", "n/a no weights", "123,456", "29.1 MB", "12.5 fps", "12 min", "812 MB"):
        assert words in text


def test_steps_that_were_skipped_are_counted(page: Page) -> None:
    assert "steps 1,000 of 1,000, 150 steps skipped" in " ".join(page.texts[""].split())


def test_zoom_verdicts_say_what_they_mean(page: Page) -> None:
    text = page.text("zoom")
    assert "×2 23.50 23.00 +0.50 +0.1000 win Real detail: 0.50 dB closer to the truth" in text
    assert "×4 20.00 21.50 −1.50 +0.1000 loss Artefacts, not detail: 1.50 dB further" in text
    assert text.count("SSIM says the opposite") == 1
    assert "×8 n/a n/a" in text
    assert "the images hold no truth at x8" in text


def test_detail_stands_beside_that_of_its_competitors(tmp_path: Path) -> None:
    shares = {"render": 0.125, "enlarged": -0.004, "photograph": 0.05}
    detail = {"detail": {kind: {"explained": share} for kind, share in shares.items()}}
    result = evaluation(zoom={"2": zoom_entry(23.5, 23.0) | detail, "4": zoom_entry(20.0, 21.5) | {"detail": [1]}})
    text = Page(write_report(make_run(tmp_path / "run", result=result))).text("zoom")
    assert "×2 23.50 23.00 +0.50 +0.1000 +0.125 −0.004 +0.050 win" in text
    assert "×4 20.00 21.50 −1.50 +0.1000 loss" in text


def test_both_competitors_and_neighbouring_views_are_in_the_report(tmp_path: Path) -> None:
    upscaled = {"upscaled_psnr": 23.75, "upscaled_ssim": 0.8, "beats_upscaled": False}
    agreement = {"consistency": {"render": 33.0, "enlarged": 35.5, "upscaled": 32.0, "truth": 30.25, "pixels": 0.5}}
    agreement["consistency"]["detail"] = {"render": 0.75, "enlarged": 0.8, "upscaled": 0.625, "truth": 0.5}
    zoom = {"2": zoom_entry(23.5, 23.0) | upscaled | agreement, "4": zoom_entry(20.0, 21.5)}
    zoom["3"] = zoom_entry(22.0, 21.0) | upscaled | {"upscaled_psnr": 22.03}
    folder = make_run(tmp_path / "run", result=evaluation(zoom=zoom, competitor={"name": "span"}))
    index = json.loads((folder / "renders" / "index.json").read_text())
    crop = index["zoom"][0]
    crop["upscaled_psnr"], crop["files"]["upscaled"] = 21.0, "one.x4.upscaled.png"
    write_image(folder / "renders" / "one.x4.upscaled.png", torch.rand(3, 12, 16))
    (folder / "renders" / "index.json").write_text(json.dumps(index))
    page = Page(write_report(folder))
    text = page.text("zoom")
    assert "×2 23.50 23.00 +0.50 23.75 −0.25 +0.1000 win loss Real detail: 0.50 dB closer" in text
    assert "It loses by 0.25 dB to the ×1 render enlarged by span, which guesses better than the model knows." in text
    assert "From the ×1 render enlarged by span it hardly differs: 0.03 dB." in text
    assert "×4 20.00 21.50 −1.50 +0.1000 loss" in text
    assert "×2 PSNR, dB 33.00 35.50 32.00 30.25 50 %" in page.text("agreement")
    assert "correlation of detail 0.75 0.80 0.62 0.50" in page.text("agreement")
    assert "×1 render by span, 21.00 dB" in page.text("crops")
    assert page.source.count('<figure class="winner">') == 1
    assert "lose to the x1 render enlarged by span at x2 (0.25 dB), x3 (0.03 dB)" in page.text("remarks")


def test_perceptual_figures_stand_in_cards_zooms_and_views(tmp_path: Path) -> None:
    """The zoomed render is closer than its competitor at x2, further at x4; an entry of another shape is left out."""
    depth = {"absolute": 0.2, "relative": 0.0723, "within": 0.61}
    result = evaluation(perceptual={"st_lpips_alex": 0.125, "niqe": None}, depth=depth)
    result["views"][1]["perceptual"] = {"st_lpips_alex": 0.4567}
    pairs = {"2": {"render": 0.2, "enlarged": 0.3}, "4": {"render": 0.5, "enlarged": 0.4}, "8": [1]}
    for factor, pair in pairs.items():
        result["zoom"][factor]["perceptual"] = {"st_lpips_alex": pair}
    page = Page(write_report(make_run(tmp_path / "run", result=result)))
    assert "st_lpips_alex 0.1250 lower is better" in page.text("figures")
    assert "niqe n/a not measured" in page.text("figures")
    assert "Depth error 7.2 % 61 % of the pixels within 5 %" in page.text("figures")
    assert "×2 23.50 23.00 +0.50 +0.1000 0.2000 0.3000 win" in page.text("zoom")
    assert "×4 20.00 21.50 −1.50 +0.1000 0.5000 0.4000 loss" in page.text("zoom")
    assert 'class="n good" data-name="st_lpips_alex">0.2000' in page.source
    assert 'class="n bad" data-name="st_lpips_alex">0.5000' in page.source
    assert "21.25 0.9000 n/a 0.4567" in page.text("worst")


def test_zooming_out_is_told_in_its_own_words(tmp_path: Path) -> None:
    result = evaluation(zoom={"0.25": zoom_entry(20.0, 26.0), "0.5": zoom_entry(26.5, 26.0), "2": zoom_entry(25, 24)})
    text = Page(write_report(make_run(tmp_path / "run", result=result))).text("zoom")
    assert (
        "×0.25 20.00 26.00 −6.00 +0.1000 loss Wrong from afar: 6.00 dB further from the truth than simply reducing"
        in text
    )
    assert "×0.5 26.50 26.00 +0.50 +0.1000 win True from afar: 0.50 dB closer to the truth than reducing" in text
    assert text.index("×0.25") < text.index("×0.5") < text.index("×2")


def test_gains_nobody_can_see_are_no_detail(tmp_path: Path) -> None:
    result = evaluation(zoom={"2": zoom_entry(23.04, 23.0), "4": zoom_entry(21.0, 21.06, 0.6, 0.7)})
    text = Page(write_report(make_run(tmp_path / "run", result=result))).text("zoom")
    assert "win Hardly a difference: 0.04 dB closer to" in text
    assert "loss Hardly a difference: 0.06 dB further from" in text
    assert "SSIM says" not in text


def test_pictures_are_embedded_byte_for_byte(tmp_path: Path) -> None:
    folder = make_run(tmp_path / "run")
    images = [link for tag, link in Page(write_report(folder)).links if tag == "img"]
    stored = sorted(path.read_bytes() for path in (folder / "renders").glob("*.png"))
    assert sorted(base64.b64decode(link.split(",")[1]) for link in images) == stored


def test_curves_over_steps_and_seconds_with_marks(page: Page) -> None:
    charts = [
        json.loads(str(values["data-chart"])) for tag, values in page.tags if tag == "svg" and "data-chart" in values
    ]
    labels = [chart["label"] for chart in charts]
    assert labels.count("training step") == labels.count("minutes of training") == 4
    psnr = next(chart for chart in charts if chart["label"] == "training step")
    held_out = next(s for s in psnr["series"] if s["name"] == "held-out")
    assert held_out == {"name": "held-out", "x": [500, 1000], "y": [17, 24]}
    minutes = next(chart for chart in charts if chart["label"] == "minutes of training")
    assert next(s for s in minutes["series"] if s["name"] == "held-out")["x"] == [6.25, 12.5]
    assert page.text("curves").count("opacity reset skipped step") == 4
    assert page.source.count("opacity reset at step 300") == 8
    assert page.source.count("step 600 skipped: loss is not finite") == 8


def test_worst_views_come_first_and_link_to_their_pictures(page: Page) -> None:
    text = page.text("worst")
    assert text.index("b/two.png 21.25") < text.index("b/three.png 24.00") < text.index("b/one.png 27.50")
    assert page.links.count(("a", "#view-1")) == 1
    assert "from 21.25 to 27.50 dB" in text


def test_schedule_notes_protocol_and_configuration(page: Page) -> None:
    assert "densify from 100 · until 500 · every 10" in page.text("schedule")
    assert "left: 10.0%; right: 50.0%" in page.source
    assert "2 of 30 images are <missing>" in page.text("schedule")
    assert "<missing>" not in page.source
    assert "0123456789abcdef" in page.text("protocol")
    assert "sh_degree: 3" in page.texts["settings"]
    assert "near 24.25" in page.text("worst") + page.text("groups")
    assert "PSNR at ×2, dB" in page.source
    assert "near 24.25 0.9000 n/a 23.25" in page.text("groups") + page.text("worst")


def test_an_interrupted_run_says_what_is_missing_and_how_to_go_on(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    folder.mkdir()
    (folder / "config.yaml").write_text(CONFIG)
    (folder / "metrics.jsonl").write_text(
        "".join(json.dumps(line) + "\n" for line in curve_lines()[:20]) + '{"step": 2'
    )
    page = Page(write_report(folder))
    notice = page.text("notice")
    assert "200 of 1,000 steps, not evaluated" in notice
    assert "evaluation.json renders/index.json" in notice
    assert "1 lines of metrics.jsonl are damaged" in notice
    for section in ("notice", "zoom", "crops", "views", "worst", "protocol"):
        assert f"gsx resume {folder}" in page.text(section)
    assert any("data-chart" in values for _, values in page.tags)


@pytest.mark.parametrize(
    "name", ["environment.json", "metrics.jsonl", "evaluation.json", "renders/index.json", "status.json"]
)
@pytest.mark.parametrize("content", [None, "", "{", "[]", "{}"])
def test_any_file_may_be_missing_or_damaged(tmp_path: Path, name: str, content: str | None) -> None:
    folder = make_run(tmp_path / "run")
    if content is None:
        (folder / name).unlink()
    else:
        (folder / name).write_text(content)
    assert Page(write_report(folder)).text("settings").startswith("Settings")


def test_a_picture_without_a_name_is_no_picture(tmp_path: Path) -> None:
    folder = make_run(tmp_path / "run")
    index = json.loads((folder / "renders" / "index.json").read_text())
    index["views"][0]["files"]["render"] = None
    (folder / "renders" / "index.json").write_text(json.dumps(index))
    assert "index.json is not what gsx writes" in Page(write_report(folder)).text("notice")


def test_pictures_that_are_gone_are_said_to_be(tmp_path: Path) -> None:
    folder = make_run(tmp_path / "run")
    (folder / "renders" / "one.render.png").unlink()
    (folder / "renders" / "one.x4.enlarged.png").unlink()
    page = Page(write_report(folder))
    assert (page.text("views") + page.text("view-1") + page.text("crops")).count("picture missing") == 2


def test_a_folder_that_is_no_run_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"no run folder.*config\.yaml"):
        write_report(tmp_path)
    assert not list(tmp_path.iterdir())


# -- states --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("status", "result", "state", "reason"),
    [
        ({"state": "ok"}, "{...", "corrupted", "evaluation.json cannot be read"),
        ({"state": "ok"}, "{}", "interrupted", "not evaluated"),
        ({"state": "ok"}, '{"step": 1000}', "corrupted", "holds no figures"),
        ({"state": "failed", "reason": "loss is NaN at step 7"}, None, "failed", "loss is NaN at step 7"),
        ({"state": "running", "step": 20}, None, "running", "killed: 1,000 of 1,000 steps"),
        ({"state": "interrupted", "step": 500}, None, "interrupted", "1,000 of 1,000 steps, not evaluated"),
        ({"state": "running"}, evaluation(), "ok", ""),
        ({"state": "ok"}, evaluation(step=500), "interrupted", "1,000 of 1,000 steps, evaluated at step 500"),
        ({"state": "interrupted"}, evaluation(step=999), "interrupted", "evaluated at step 999"),
        ({"state": "running"}, evaluation(step=999), "running", "killed: 1,000 of 1,000 steps, evaluated at step 999"),
        ({}, evaluation(), "ok", ""),
    ],
)
def test_states(tmp_path: Path, status: dict[str, Any], result: Any, state: str, reason: str) -> None:
    folder = make_run(tmp_path / "run")
    (folder / "status.json").write_text(json.dumps(status))
    if result is None:
        (folder / "evaluation.json").unlink()
    else:
        (folder / "evaluation.json").write_text(result if isinstance(result, str) else json.dumps(result))
    found, why = state_of(read_run(folder))
    assert found == state
    assert reason in why
    assert (why == "") == (state == "ok")


# -- overview ------------------------------------------------------------------------------------------------------


def table(folder: Path) -> dict[str, dict[str, str]]:
    """report.csv by run."""
    rows = csv.DictReader((folder / "report.csv").read_text().splitlines())
    return {row["run"]: row for row in rows}


def make_sweep(folder: Path) -> Path:
    """Six runs: four of the garden (one by another protocol), one failed, one damaged."""
    results = {"a": (24.0, 1000, 50.0), "b": (25.0, 3000, 40.0), "c": (23.0, 2000, 90.0), "d": (26.0, 500, 10.0)}
    for seed, (name, (psnr, primitives, seconds)) in enumerate(results.items()):
        hashed = {"hash": "ffff" if name == "d" else "eeee"}
        result = evaluation(psnr=psnr, primitives=primitives, train_seconds=seconds, protocol=hashed)
        make_run(folder / "garden" / name, CONFIG.replace("seed: 0", f"seed: {seed}"), result)
    failed = make_run(folder / "failed", CONFIG.replace("garden", "fox"))
    (failed / "evaluation.json").unlink()
    (failed / "status.json").write_text(json.dumps({"state": "failed", "reason": "three non-finite steps"}))
    (make_run(folder / "damaged", CONFIG.replace("garden", "fox")) / "evaluation.json").write_text("{")
    write_report(folder / "garden" / "a")
    return folder


@pytest.fixture
def sweep(tmp_path: Path) -> Path:
    return make_sweep(tmp_path)


def test_the_table_of_a_sweep(sweep: Path) -> None:
    write_overview(sweep)
    rows = table(sweep)
    assert list(rows) == ["damaged", "failed", "garden/a", "garden/b", "garden/c", "garden/d"]
    assert [row["state"] for row in rows.values()] == ["corrupted", "failed", "ok", "ok", "ok", "ok"]
    assert rows["failed"]["reason"] == "three non-finite steps"
    assert rows["garden/b"]["differences"] == "seed=1"
    assert rows["garden/b"]["zoom_gains"] == "x2:+0.500 x4:-1.500"
    assert rows["garden/b"]["zoom_upscaled_gains"] == ""
    assert float(rows["garden/c"]["psnr"]) == 23.0
    assert rows["damaged"]["psnr"] == ""


def test_an_overview_has_the_gain_over_the_upscaler(tmp_path: Path) -> None:
    zoom = {"2": zoom_entry(23.5, 23.0) | {"upscaled_psnr": 23.75}, "4": zoom_entry(20.0, 21.5)}
    make_run(tmp_path / "a", result=evaluation(zoom=zoom))
    make_run(tmp_path / "b")
    text = Page(write_overview(tmp_path)).text("runs")
    assert "×2 over upscaler" in text
    assert "×4 over upscaler" not in text
    assert "+0.50 −1.50 −0.25" in text
    assert [row["zoom_upscaled_gains"] for row in table(tmp_path).values()] == ["x2:-0.250", ""]


def test_runs_of_one_scene_by_other_protocols_are_flagged(sweep: Path) -> None:
    page = Page(write_overview(sweep))
    assert {name: row["comparable"] for name, row in table(sweep).items() if row["protocol"]} == dict.fromkeys(
        ("garden/a", "garden/b", "garden/c", "garden/d"), "no"
    )
    assert "colmap garden: eeee 3 runs, ffff 1 run" in page.text("mixed")


def test_runs_of_one_protocol_are_not_flagged(tmp_path: Path) -> None:
    for name in ("a", "b"):
        make_run(tmp_path / name)
    page = Page(write_overview(tmp_path))
    assert "mixed" not in page.texts
    assert {row["comparable"] for row in table(tmp_path).values()} == {"yes"}


def test_the_overview_links_to_the_reports_there_are(sweep: Path) -> None:
    for name in ("damaged", "failed", "garden/b", "garden/c", "garden/d"):
        (sweep / name / "report.html").unlink()
    page = Page(write_overview(sweep))
    reports = [link for tag, link in page.links if tag == "a" and not link.startswith("#")]
    assert set(reports) == {"garden/a/report.html"}
    assert not re.search(r"https?://|url\(|@import", page.source)


def test_a_folder_without_runs_is_refused(tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match="no run below"):
        write_overview(tmp_path)


def test_nothing_inside_a_run_or_a_hidden_folder_is_a_run(tmp_path: Path) -> None:
    for name in ("a", "a/renders/b", ".cache/c", "d/e"):
        (tmp_path / name).mkdir(parents=True)
        (tmp_path / name / "config.yaml").write_text("")
    assert [path.relative_to(tmp_path).as_posix() for path in runs_below(tmp_path)] == ["a", "d/e"]


# -- charts --------------------------------------------------------------------------------------------------------


def test_the_pareto_front_on_hand_data() -> None:
    costs, gains = [1, 2, 3, 3, 4, 2, 5], [10, 12, 12, 15, 14, 11, 15]
    assert pareto_front(costs, gains) == [0, 1, 3]
    assert pareto_front([1, 1], [5, 5]) == [0, 1]
    assert pareto_front([], []) == []


def test_ticks_are_round_and_inside() -> None:
    assert linear_ticks(0, 1) == pytest.approx([0, 0.2, 0.4, 0.6, 0.8, 1.0])
    assert linear_ticks(17.3, 31.9) == [20, 25, 30]
    assert linear_ticks(-3, 997) == [0, 200, 400, 600, 800]
    assert Axis(0.04, 0.6, log=True).ticks() == pytest.approx([0.05, 0.1, 0.2, 0.5])


def test_axes_map_their_ends_to_0_and_1() -> None:
    assert [Axis(2, 6).at(x) for x in (2, 3, 6)] == [0, 0.25, 1]
    assert [Axis(1, 100, log=True).at(x) for x in (1, 10, 100)] == pytest.approx([0, 0.5, 1])


def test_smoothing_takes_the_neighbours_there_are() -> None:
    assert smoothed([0, 3, 0, 9, 0], 1) == pytest.approx([1.5, 1, 4, 3, 4.5])
    assert smoothed([0, 3, 0, 9, 0], 0) == [0, 3, 0, 9, 0]


def test_thinning_averages_groups() -> None:
    assert thinned([0, 1, 2, 3, 4], [0, 2, 4, 6, 8], most=3) == ([0.5, 2.5, 4], [1, 5, 8])
    assert thinned([1, 2], [3, 4], most=3) == ([1, 2], [3, 4])


def test_charts_of_constant_and_single_values() -> None:
    flat = line_chart([Series(name="flat", x=[0, 1], y=[5, 5])], x_label="x")
    assert "polyline" in flat
    assert "nan" not in flat
    assert line_chart([Series(name="one", x=[1], y=[2])], x_label="x") == ""


@pytest.mark.parametrize("far", [1e308, 1e31, 5e-324, 0.0])
def test_axes_have_room_for_any_number(far: float) -> None:
    for log in (False, True):
        for values in ([far, 3.0], [far, far], [-far, 3.0]):
            chart = line_chart([Series(name="far", x=[1, 2], y=values)], x_label="x", log=log)
            assert "polyline" in chart


def test_names_cannot_break_out_of_a_chart() -> None:
    chart = line_chart([Series(name="'><script>", x=[0, 1], y=[1, 2])], x_label="<b>'")
    assert "<script>" not in chart
    assert "<b>" not in chart
    assert "'>&" not in chart.split("data-chart=")[0]


def test_numbers_in_words() -> None:
    assert [duration(s) for s in (4.25, 42.4, 59.7, 305, 2520, 12000, None)] == [
        "4.2 s", "42 s", "1 min 00 s", "5 min 05 s", "42 min", "3 h 20 min", "n/a",
    ]  # fmt: skip
    assert [fixed(1234.5, 1), fixed(None), fixed(math.nan), fixed(True)] == ["1,234.5", "n/a", "n/a", "n/a"]
    assert [signed(0.5), signed(-1.25, 1)] == ["+0.50", "−1.2"]
    assert [compact(v) for v in (0.05, 12.5, 2000, 30000, 1.25e6)] == ["0.05", "12.5", "2000", "30k", "1.25M"]
