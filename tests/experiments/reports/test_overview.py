"""One page over many runs made by hand: fronts worked out on paper, curves, pictures side by side, any damage."""

import csv
import json
import re
from html.parser import HTMLParser
from itertools import combinations
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import pytest
import torch
from tiny import leave_results

from gsx.cli.dispatch import main
from gsx.core.data.images import write_image
from gsx.core.errors import InputError
from gsx.experiments.reports.overview import write_overview
from gsx.experiments.reports.page import address
from gsx.experiments.reports.pictures import spread
from gsx.experiments.reports.report import report_on
from gsx.experiments.run_folder.files import read_run, runs_below

FILES = ("config.yaml", "environment.json", "metrics.jsonl", "evaluation.json", "renders/index.json", "status.json")
VOID = ("img", "meta", "br", "link")


def make_run(folder: Path, config: dict[str, Any] | None = None, **figures: Any) -> Path:
    """A complete run of 100 steps with two test views, each with a window at x4; `figures` go to evaluation.json."""
    (folder / "renders").mkdir(parents=True)
    settings = {"iterations": 100, "seed": 0, "scene": {"name": "garden"}, "backbone": {"name": "gs3d"}}
    (folder / "config.yaml").write_text(json.dumps(settings | (config or {})))  # JSON is YAML
    zoom = {"1": {"psnr": 30.0}, "2": {"psnr": 27.0, "enlarged_psnr": 26.0}, "4": {"psnr": 24.0, "enlarged_psnr": 25.0}}
    protocol = {"hash": "0123456789abcdef"}
    evaluation = {"protocol": protocol, "step": 100, "psnr": 30.0, "ssim": 0.9, "lpips": None, "primitives": 1000}
    evaluation |= {"megabytes": 10.0, "train_seconds": 50.0, "zoom": zoom, "views": []}
    (folder / "evaluation.json").write_text(json.dumps(evaluation | figures))
    (folder / "environment.json").write_text("{}")
    (folder / "status.json").write_text('{"state": "ok", "step": 100}')
    write_lines(folder, [(10.0, None), (20.0, 25.0), (50.0, 30.0)])
    make_pictures(folder / "renders")
    leave_results(folder, 100)
    return folder


def write_lines(folder: Path, points: list[tuple[float, float | None]]) -> None:
    """metrics.jsonl with these seconds and held-out PSNRs."""
    lines = [{"step": 10 * i, "seconds": s, "psnr": 20.0} for i, (s, _) in enumerate(points, 1)]
    lines = [line | ({} if p is None else {"test_psnr": p}) for line, (_, p) in zip(lines, points, strict=True)]
    (folder / "metrics.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))


def make_pictures(folder: Path, window: tuple[int, ...] = (8, 16, 24, 12), psnr: float = 21.5) -> None:
    views, crops = [], []
    for name in ("one", "two"):
        for stem in (f"{name}.truth", f"{name}.render", f"{name}.x4.truth", f"{name}.x4.render"):
            write_image(folder / f"{stem}.png", torch.full((3, 12, 24), 0.5))
        files = {kind: f"{name}.{kind}.png" for kind in ("truth", "render")}
        views.append({"name": f"{name}.jpg", "psnr": psnr + 7, "size": [40, 30], "files": files})
        files = {kind: f"{name}.x4.{kind}.png" for kind in ("truth", "render")}
        crop = {"view": f"{name}.jpg", "factor": 4.0, "window": list(window), "psnr": psnr, "enlarged_psnr": 20.0}
        crops.append(crop | {"files": files})
    (folder / "index.json").write_text(json.dumps({"step": 100, "views": views, "zoom": crops}))


class Node:
    """An element of a page with its text."""

    def __init__(self, tag: str, values: dict[str, str | None], parent: "Node | None") -> None:
        self.tag, self.values, self.parent = tag, values, parent
        self.children: list[Node] = []
        self.words: list[str] = []

    def all(self, tag: str, **wanted: str) -> list["Node"]:
        """Elements inside with that tag, and these words among an attribute's (class_ for class)."""
        named = {key.strip("_").replace("_", "-"): word for key, word in wanted.items()}
        fits = self.tag == tag and all(word in str(self.values.get(key)).split() for key, word in named.items())
        return [*([self] if fits else []), *(found for child in self.children for found in child.all(tag, **wanted))]

    @property
    def text(self) -> str:
        """Text inside with single spaces."""
        return " ".join(" ".join(self.words).split())


class Page(HTMLParser):
    """A tree of elements."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.folder, self.source = path.parent, path.read_text(encoding="utf-8")
        self.root = self.at = Node("", {}, None)
        self.feed(self.source)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        node = Node(tag, dict(attrs), self.at)
        self.at.children.append(node)
        self.at = self.at if tag in VOID else node

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.at.children.append(Node(tag, dict(attrs), self.at))

    def handle_endtag(self, tag: str) -> None:
        assert self.at.tag == tag, f"</{tag}> closes <{self.at.tag}>"
        assert self.at.parent is not None
        self.at = self.at.parent

    def handle_data(self, data: str) -> None:
        node: Node | None = self.at
        while node is not None:
            node.words.append(data)
            node = node.parent

    def section(self, heading: str) -> Node:
        """The section with that heading."""
        return next(node for node in self.root.all("section") if node.all("h2") and node.all("h2")[0].text == heading)

    def row(self, run: str) -> list[str]:
        """Texts of a run's row in the first table."""
        table = self.section("Runs").all("tbody")[0]
        return next(texts for tr in table.all("tr") if (texts := [td.text for td in tr.all("td")])[0] == run)


def rows(folder: Path) -> dict[str, dict[str, str]]:
    """report.csv by run."""
    return {row["run"]: row for row in csv.DictReader((folder / "report.csv").read_text().splitlines())}


# -- quality against cost ------------------------------------------------------------------------------------------

PARETO = {
    # variant: PSNR, x2, x4, primitives, MB, seconds
    "a": (30, 26, 20, 1000, 10, 50),
    "b": (31, 25, 23, 2000, 5, 40),
    "c": (29, 27, 22, 3000, 20, 30),
    "d": (31, 28, 19, 4000, 2, 90),
    "e": (20, 20, None, 9000, 90, 900),
}
FRONTS = {
    "PSNR, dB, over primitives": "a, b",
    "PSNR, dB, over MB": "d",
    "PSNR, dB, over seconds of training": "c, b",
    "PSNR zoomed in ×2, dB, over primitives": "a, c, d",
    "PSNR zoomed in ×2, dB, over MB": "d",
    "PSNR zoomed in ×2, dB, over seconds of training": "c, d",
    "PSNR zoomed in ×4, dB, over primitives": "a, b",
    "PSNR zoomed in ×4, dB, over MB": "d, b",
    "PSNR zoomed in ×4, dB, over seconds of training": "c, b",
}


@pytest.fixture
def pareto(tmp_path: Path) -> Node:
    for name, (psnr, x2, x4, primitives, megabytes, seconds) in PARETO.items():
        zoom = {"0.5": {"psnr": 33.0}, "1": {"psnr": psnr}, "2": {"psnr": x2}, "4": {"psnr": x4}}
        costs = {"primitives": primitives, "megabytes": megabytes, "train_seconds": seconds}
        make_run(tmp_path / f"run_{name}", {"variant": name}, psnr=psnr, zoom=zoom, **costs)
    (tmp_path / "run_b" / "report.html").write_text("")
    return Page(write_overview(tmp_path)).section("garden: quality against its cost")


def test_every_front_is_the_one_worked_out_by_hand(pareto: Node) -> None:
    found = {
        figure.all("h3")[0].text: figure.all("figcaption")[0].text.replace(" , ", ", ")
        for figure in pareto.all("figure")
    }
    assert found == {title: f"On the front: {names}" for title, names in FRONTS.items()}


def test_points_of_the_front_are_marked_and_all_are_named_and_lead_to_their_runs(pareto: Node) -> None:
    for figure in pareto.all("figure"):
        front = FRONTS[figure.all("h3")[0].text].split(", ")
        dots = figure.all("circle")
        best = [dot for dot in dots if "best" in str(dot.values["class"])]
        assert sorted(dot.text.split()[0] for dot in best) == sorted(front)
        assert len(dots) == (4 if "×4" in figure.all("h3")[0].text else 5)
        assert [a.text.split(":")[0] for a in figure.all("svg")[0].all("a", href="run_b/report.html")] == ["b (run_b)"]
    title = next(dot.text for dot in pareto.all("circle") if dot.text.startswith("d "))
    assert title == "d (run_d): 31.00 dB, 4,000 primitives"


def test_one_quality_is_shown_at_a_time_and_the_first_without_a_script(pareto: Node) -> None:
    parts = [node for node in pareto.all("div") if "data-of" in node.values]
    assert [(part.values["data-of"], "hidden" in part.values) for part in parts] == [
        ("1", False), ("2", True), ("4", True)
    ]  # fmt: skip
    assert [(b.values["value"], b.text) for b in pareto.all("button")] == [
        ("1", "PSNR"), ("2", "zoom ×2"), ("4", "zoom ×4")
    ]  # fmt: skip


def test_perceptual_metrics_have_columns_and_fronts_towards_lower_figures(tmp_path: Path) -> None:
    """By hand: a costs least, b is closest, c costs more than a and is further."""
    for name, primitives, value in (("a", 10, 0.3), ("b", 30, 0.1), ("c", 20, 0.4)):
        zoom = {"4": {"psnr": 20.0, "enlarged_psnr": 19.0, "perceptual": {"st_lpips_alex": {"render": 2 * value}}}}
        figures = {"perceptual": {"st_lpips_alex": value}, "zoom": zoom, "primitives": primitives}
        make_run(tmp_path / f"run_{name}", {"variant": name}, **figures)
    page = Page(write_overview(tmp_path))
    assert "0.3000" in page.row("run_a")
    assert rows(tmp_path)["run_b"]["perceptual"] == "st_lpips_alex:0.1000"
    section = page.section("garden: quality against its cost")
    fronts = {f.all("h3")[0].text: f.all("figcaption")[0].text.replace(" , ", ", ") for f in section.all("figure")}
    for label in ("st_lpips_alex", "st_lpips_alex ×4"):
        assert fronts[f"{label}, lower is better, over primitives"] == "On the front: a, b"
    assert [b.text for b in section.all("button")] == ["PSNR", "zoom ×4", "st_lpips_alex", "st_lpips_alex ×4"]
    assert any(dot.text == "b (run_b): 0.1000, 30 primitives" for dot in section.all("circle"))


# -- over time -----------------------------------------------------------------------------------------------------


def chart_of(section: Node) -> dict[str, Any]:
    """What a chart says under the pointer."""
    return next(json.loads(str(svg.values["data-chart"])) for svg in section.all("svg") if "data-chart" in svg.values)


def test_held_out_psnr_over_seconds_of_every_run_that_has_any(tmp_path: Path) -> None:
    make_run(tmp_path / "plain", {"variant": "plain"})
    write_lines(make_run(tmp_path / "branched", {"variant": "branched"}), [(90.0, 26.0), (100.5, None), (120.0, 28.5)])
    write_lines(running := make_run(tmp_path / "running", {"variant": "half"}), [(5.0, 18.0), (9.0, 19.25)])
    (running / "evaluation.json").unlink()
    (running / "status.json").write_text('{"state": "running"}')
    write_lines(make_run(tmp_path / "silent", {"variant": "silent"}), [(5.0, None), (9.0, None)])
    section = Page(write_overview(tmp_path)).section("garden")
    chart = chart_of(section)
    assert chart["label"] == "seconds of training"
    assert {s["name"]: (s["x"], s["y"]) for s in chart["series"]} == {
        "branched": ([90.0, 120.0], [26.0, 28.5]),
        "plain": ([20.0, 50.0], [25.0, 30.0]),
        "half": ([5.0, 9.0], [18.0, 19.25]),
    }
    legend = [" ".join(tr.text.split()) for tr in section.all("tbody")[0].all("tr")]
    assert legend == [
        "branched 28.50 2 min 00 s",
        "plain 30.00 50 s",
        "half running 19.25 9.0 s",
        "silent no held-out points",
    ]


def test_curves_of_other_scenes_and_protocols_stay_apart(tmp_path: Path) -> None:
    for name in ("a", "b"):
        make_run(tmp_path / name, {"variant": name})
        make_run(tmp_path / f"other_{name}", {"variant": f"other {name}"}, protocol={"hash": "ffff"})
    make_run(tmp_path / "fox", {"variant": "fox", "scene": {"name": "fox"}})
    page = Page(write_overview(tmp_path))
    charts = [json.loads(str(svg.values["data-chart"])) for svg in page.root.all("svg") if "data-chart" in svg.values]
    assert [[s["name"] for s in chart["series"]] for chart in charts] == [["a", "b"], ["fox"], ["other a", "other b"]]
    rows_of_pictures = [node.text for node in page.root.all("div", class_="lenses")]
    assert len(rows_of_pictures) == 8  # two protocols, two views, x1 and x4
    assert not [text for text in rows_of_pictures if "other" in text and re.search(r"(?<!other )\b[ab]\b", text)]


def test_scenes_whose_folders_are_called_alike_are_told_apart_by_their_photographs(tmp_path: Path) -> None:
    for place, name in (("garden", "a"), ("garden", "b"), ("kitchen", "c"), ("copy_of_garden", "d")):
        folder = make_run(tmp_path / name, {"scene": {"name": "colmap", "path": f"/data/{place}/dense"}})
        if place == "kitchen":
            write_image(folder / "renders" / "one.truth.png", torch.full((3, 12, 24), 0.75))
    write_overview(tmp_path)
    with (tmp_path / "report.csv").open(newline="") as stream:
        scenes = {row["run"]: row["scene"] for row in csv.DictReader(stream)}
    assert scenes == {"a": "colmap dense", "b": "colmap dense", "c": "colmap dense (2)", "d": "colmap dense"}


def test_no_points_at_all_are_said_to_be_none(tmp_path: Path) -> None:
    write_lines(make_run(tmp_path / "a"), [(1.0, None)])
    section = Page(write_overview(tmp_path)).section("garden")
    assert "No curves: no run has two points" in section.text
    assert "no held-out points" in section.text


def test_more_runs_than_styles_are_coloured_by_variant(tmp_path: Path) -> None:
    for seed in range(20):
        make_run(tmp_path / f"{seed:02d}", {"seed": seed, "variant": "even" if seed % 2 == 0 else "odd"})
    section = Page(write_overview(tmp_path)).section("garden")
    styles = [str(circle.values["class"]) for circle in section.all("tbody")[0].all("circle")]
    assert styles == ["dot k0 v0", "dot k1 v0"] * 10


# -- side by side --------------------------------------------------------------------------------------------------


@pytest.fixture
def pair(tmp_path: Path) -> Path:
    make_run(tmp_path / "a b", {"variant": "first"})
    make_run(tmp_path / "c", {"variant": "second"}, zoom={"4": {"psnr": 25.5}})
    make_pictures(tmp_path / "c" / "renders", psnr=19.5)
    return tmp_path


def test_pictures_of_one_view_window_and_zoom_stand_in_a_row_after_the_truth(pair: Path) -> None:
    section = Page(write_overview(pair)).section("garden: side by side")
    shown = {}
    for part in (node for node in section.all("div") if "data-of" in node.values):
        images = [unquote(str(img.values["src"])) for img in part.all("img")]
        assert all((pair / image).is_file() for image in images)
        shown[part.all("p")[0].text] = images
    assert list(shown) == [
        "one.jpg, ×1, the whole view",
        "one.jpg, ×4, 24 × 12 px at (8, 16)",
        "two.jpg, ×1, the whole view",
        "two.jpg, ×4, 24 × 12 px at (8, 16)",
    ]
    for images, stem in zip(shown.values(), ("one", "one.x4", "two", "two.x4"), strict=True):
        assert images == [f"a b/renders/{stem}.truth.png"] + [
            f"{run}/renders/{stem}.render.png" for run in ("a b", "c")
        ]
    captions = [node.text for node in section.all("div", data_of="z4")[0].all("figcaption")]
    assert captions == [
        "truth",
        "first 21.50 dB, +1.50 over ×1 resized 24.00 dB over all views",
        "second 19.50 dB, −0.50 over ×1 resized 25.50 dB over all views",
    ]
    winners = section.all("div", data_of="z4")[0].all("figure", class_="winner")
    assert [figure.text.split()[0] for figure in winners] == ["first"]
    assert "28.50 dB 30.00 dB over all views" in section.all("div", data_of="z1")[0].text


def test_view_and_zoom_are_chosen_and_the_largest_zoom_of_the_first_view_comes_first(pair: Path) -> None:
    section = Page(write_overview(pair)).section("garden: side by side")
    parts = [node for node in section.all("div") if "data-of" in node.values]
    assert [part.values["data-of"] for part in parts if "hidden" not in part.values] == ["v0 z4"]
    assert [(option.values["value"], option.text) for option in section.all("option")] == [
        ("v0", "one.jpg"), ("v1", "two.jpg")
    ]  # fmt: skip
    pressed = {b.values["value"]: b.values["aria-pressed"] for b in section.all("button") if "aria-pressed" in b.values}
    assert pressed == {"z1": "false", "z4": "true"}


def test_other_windows_are_not_put_beside_each_other(pair: Path) -> None:
    make_pictures(pair / "c" / "renders", window=(0, 16, 24, 12))
    section = Page(write_overview(pair)).section("garden: side by side")
    assert [node.values["data-of"] for node in section.all("div") if "data-of" in node.values] == ["v0 z1", "v1 z1"]


def test_pictures_that_are_gone_cut_short_or_garbage_are_said_to_be(pair: Path) -> None:
    renders = pair / "a b" / "renders"
    (renders / "one.x4.truth.png").unlink()
    whole = (renders / "two.x4.render.png").read_bytes()
    (renders / "one.x4.render.png").write_bytes(b"\x00garbage\xff" + whole[-40:])
    (renders / "two.x4.render.png").write_bytes(whole[:-20])
    section = Page(write_overview(pair)).section("garden: side by side")
    for view, truth in (("v0", "c/renders/one.x4.truth.png"), ("v1", "a%20b/renders/two.x4.truth.png")):
        row = next(node for node in section.all("div", data_of="z4") if view in str(node.values["data-of"]))
        assert row.all("img")[0].values["src"] == truth
        assert [figure.text.startswith("picture missing or damaged") for figure in row.all("figure")] == [
            False, True, False
        ]  # fmt: skip


def test_runs_without_pictures_are_named_with_the_remedy(pair: Path) -> None:
    make_run(pair / "d", {"variant": "blind"})
    (pair / "d" / "renders" / "index.json").write_bytes(b"\xff\xfe{")
    text = Page(write_overview(pair)).section("garden: side by side").text
    assert "Without pictures: blind (renders/index.json cannot be read" in text
    assert f"gsx eval {pair / 'd'}" in text


def test_pictures_are_referred_to_from_wherever_the_page_is(pair: Path) -> None:
    page = Page(report_on([pair / "a b", pair / "c"], to=new_folder(pair / "else" / "where")))
    images = [unquote(str(img.values["src"])) for img in page.root.all("img")]
    assert images[0] == "../../a b/renders/one.truth.png"
    assert all((page.folder / image).is_file() for image in images)
    assert not re.search(r"https?://|url\(|@import", page.source)


@pytest.mark.parametrize("total", [7, 8, 13, 24, 150])
def test_any_two_runs_draw_at_least_four_views_in_common(total: int) -> None:
    ends = [frozenset(pair) for pair in combinations(range(min(total, 16)), 2)]
    shown = {frozenset(spread(total, 6, pair)) for pair in ends}
    assert min(len(a & b) for a, b in combinations(shown, 2)) >= 4


# -- names ---------------------------------------------------------------------------------------------------------


def test_runs_are_called_by_their_variant_or_backbone_and_augmenters(tmp_path: Path) -> None:
    upscale = {"augmenter": {"upscale": {"name": "upscale"}}}
    make_run(tmp_path / "1", {"variant": "octree_ub"} | upscale)
    make_run(tmp_path / "2", upscale)
    make_run(tmp_path / "3", {"variant": ""})
    make_run(tmp_path / "4", {"variant": ["no name"]})
    write_overview(tmp_path)
    assert rows(tmp_path)["1"]["differences"] == rows(tmp_path)["2"]["differences"] == ""  # the name says it
    assert [row["variant"] for row in rows(tmp_path).values()] == ["octree_ub", "gs3d + upscale", "gs3d", "gs3d"]
    assert [row["backbone"] for row in rows(tmp_path).values()] == ["gs3d + upscale"] * 2 + ["gs3d"] * 2


def test_runs_of_one_name_are_told_apart_by_what_differs_and_else_by_their_folders(tmp_path: Path) -> None:
    make_run(tmp_path / "x", {"variant": "v"})
    make_run(tmp_path / "y", {"variant": "v", "training": {"log_every": 5}})
    make_run(tmp_path / "z", {"variant": "v"})
    make_run(tmp_path / "fox", {"variant": "v", "scene": {"name": "fox"}})
    page = Page(write_overview(tmp_path))
    names = [tr.all("td")[0].text for tr in page.section("garden").all("tbody")[0].all("tr")]
    assert names == ["v · log_every=absent · x", "v · log_every=5", "v · log_every=absent · z"]
    assert page.section("fox").all("tbody")[0].all("td")[0].text == "v"


def test_a_name_cannot_break_out_of_the_page(tmp_path: Path) -> None:
    for name in ("a", "b"):
        make_run(tmp_path / f"{name} '\"&<i>", {"variant": f"<script>{name}'\""})
        (tmp_path / f"{name} '\"&<i>" / "report.html").write_text("")
    page = Page(write_overview(tmp_path))
    assert not [node for node in page.root.all("script") if node.text.startswith("a'")]
    assert not page.root.all("i")
    links = {unquote(str(a.values["href"])) for a in page.root.all("a") if not str(a.values["href"]).startswith("#")}
    assert links == {"a '\"&<i>/report.html", "b '\"&<i>/report.html"}


def test_a_variant_has_its_control_whatever_they_are_called(tmp_path: Path) -> None:
    make_run(tmp_path / "plain", {"variant": "gs3d_b"})
    upscale = {"augmenter": {"upscale": {"name": "upscale"}}}
    make_run(tmp_path / "up", {"variant": "gs3d_u"} | upscale, zoom={"2": {"psnr": 27.5}})
    assert "+0.50" in Page(write_overview(tmp_path)).section("Against the baseline").text


# -- any state -----------------------------------------------------------------------------------------------------

GARBAGE = {
    "bytes": b"\x80\xff\x00garbage{[\n\xfe",
    "empty": b"",
    "cut": b'{"step": 100, "psnr": 3',
    "number": b"17",
    "list": b"[1, 2]",
    "text": b'"words"',
    "deep": b"[" * 100_000,
    "step": b'{"step": "many", "state": ["ok"], "psnr": 3, "iterations": "all", "backbone": 3, "augmenter": {"1": 2}}',
    "lists": b'{"views": {"a": 1}, "zoom": [1, 2], "protocol": [3], "scene": {"path": [1]}, "backbone": {"name": 3}}',
    "rows": b'{"views": [1], "zoom": {"a": {}}, "groups": [], "scene": [], "seed": [1], "psnr": 1}',
    "entries": b'{"views": [{"size": ["a"], "files": [1]}, {"name": 3, "size": [0, 0]}, {"size": [4, 4]}], '
    b'"zoom": [{"factor": 4, "window": 3, "files": {"render": 3}}], "psnr": 1}',
    "windows": b'{"views": [], "zoom": [{"factor": 4, "window": [0, 0, 8, 8], "files": {"render": ["a"]}}]}',
}


@pytest.mark.parametrize("name", FILES)
@pytest.mark.parametrize("content", GARBAGE)
def test_the_page_is_written_whatever_one_file_of_a_run_holds(tmp_path: Path, name: str, content: str) -> None:
    for run in ("a", "b", "damaged", "damaged_too"):
        make_run(tmp_path / run, {"variant": run})
    for run in ("damaged", "damaged_too"):
        (tmp_path / run / name).write_bytes(GARBAGE[content])
    page = Page(write_overview(tmp_path))
    assert list(rows(tmp_path)) == ["a", "b", "damaged", "damaged_too"]
    assert page.row("a")[1:4] == ["ok", "garden", "a gs3d"]
    assert "aspect-ratio: 0" not in page.source
    reads = content not in ("step", "lists", "rows", "entries", "windows")
    if reads and not (name == "metrics.jsonl" and content == "empty"):
        assert name in rows(tmp_path)["damaged"]["reason"]
    if reads and name in ("config.yaml", "evaluation.json"):
        assert page.row("damaged")[1].startswith("corrupted")


@pytest.mark.parametrize(
    ("name", "content"),
    [
        *(("evaluation.json", {key: 1e308}) for key in ("psnr", "train_seconds", "megabytes", "primitives")),
        ("evaluation.json", {"psnr": 1e99, "views": [{"name": "one", "psnr": 1e99}, {"name": "two", "psnr": 1e99}]}),
        ("evaluation.json", {"train_seconds": 1e99, "megabytes": 5e-324, "primitives": 1e31}),
        ("evaluation.json", {"step": 10**400}),
        ("evaluation.json", {"views": [{"name": []}]}),
        ("evaluation.json", {"zoom": {"1e99": {"psnr": 20.0}, "1": {"psnr": 30.0}}}),
        ("evaluation.json", {"pseudo": {"upscale": {"dropped": {}, "warned": 5}}}),
        ("renders/index.json", {"views": [{"size": [10**400, 3]}]}),
        ("renders/index.json", {"zoom": [{"factor": 10**400}]}),
        ("status.json", {"step": 10**400}),
        ("metrics.jsonl", {"step": 10**400}),
        ("metrics.jsonl", {"seconds": 10**308, "test_psnr": 1e308}),
        ("environment.json", {"scene": {"notes": 5}}),
    ],
)
def test_figures_that_no_run_has_end_neither_page(tmp_path: Path, name: str, content: dict[str, Any]) -> None:
    for run in ("a", "b"):
        make_run(tmp_path / run, {"variant": run})
    path = tmp_path / "b" / name
    lines = path.read_text().splitlines() if name == "metrics.jsonl" else [path.read_text()]
    changed = [*lines[:-1], json.dumps(json.loads(lines[-1]) | content)]
    path.write_text("\n".join(changed))
    assert report_on([tmp_path / "b"]) == tmp_path / "b" / "report.html"
    write_overview(tmp_path)
    assert list(rows(tmp_path)) == ["a", "b"]


def test_every_state_is_shown_with_its_reason_beside_sound_runs(tmp_path: Path) -> None:
    for name in ("ok", "running", "interrupted", "failed", "corrupted"):
        make_run(tmp_path / name, {"variant": name})
    make_run(tmp_path / "ok_too", {"variant": "ok too"})
    for name in ("running", "interrupted", "failed"):
        (tmp_path / name / "evaluation.json").unlink()
        status = {"state": name, "step": 30, "reason": "three non-finite steps" if name == "failed" else ""}
        (tmp_path / name / "status.json").write_text(json.dumps(status))
    (tmp_path / "corrupted" / "evaluation.json").write_bytes(b"\xff")
    (tmp_path / "bare").mkdir()
    (tmp_path / "bare" / "config.yaml").write_text("iterations: 5")
    page = Page(write_overview(tmp_path))
    assert page.row("ok")[1] == "ok"
    assert page.row("running")[1] == "running running or killed: 30 of 100 steps, not evaluated"
    assert page.row("interrupted")[1] == "interrupted 30 of 100 steps, not evaluated"
    assert page.row("failed")[1] == "failed three non-finite steps"
    assert page.row("corrupted")[1].startswith("corrupted evaluation.json cannot be read")
    assert page.row("bare")[1] == "interrupted 0 of 5 steps, not evaluated"
    assert [s["name"] for s in chart_of(page.section("garden"))["series"]] == [
        "corrupted", "failed", "interrupted", "ok", "ok too", "running"
    ]  # fmt: skip
    badges = page.root.all("header")[0].text
    assert badges == "7 runs below " + f"{tmp_path.name} 2 ok 1 running 2 interrupted 1 failed 1 corrupted"


def test_every_anchor_of_the_page_exists(pair: Path) -> None:
    make_run(pair / "fox", {"scene": {"name": "fox"}})
    page = Page(write_overview(pair))
    anchors = [str(a.values["href"])[1:] for a in page.root.all("a") if str(a.values["href"]).startswith("#")]
    assert anchors == ["runs", "scene-1", "scene-2"]
    assert {node.values.get("id") for node in page.root.all("section")} >= set(anchors)


# -- which runs, and where the page goes ---------------------------------------------------------------------------


def new_folder(path: Path) -> Path:
    path.mkdir(parents=True)
    return path


@pytest.fixture
def folders(tmp_path: Path) -> Path:
    make_run(tmp_path / "work" / "mon" / "a")
    make_run(tmp_path / "work" / "mon" / "b")
    make_run(tmp_path / "work" / "tue" / "deep" / "c")
    return tmp_path / "work"


def test_one_run_gives_its_own_report(folders: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = folders / "mon" / "a"
    for words in ([str(run)], [str(run), f"{run.parent}/../mon/a"]):
        (run / "report.html").unlink(missing_ok=True)
        assert main(["report", *words]) == 0
        assert capsys.readouterr().out == f"{run / 'report.html'}\n"
    assert "Training curves" in (run / "report.html").read_text()
    assert not (run / "report.csv").exists()


def test_several_folders_give_one_page_in_what_they_share(folders: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["report", str(folders / "mon"), str(folders / "tue" / "deep" / "c"), str(folders / "mon" / "a")]) == 0
    assert capsys.readouterr().out == f"{folders / 'report.html'}\n"
    assert list(rows(folders)) == ["mon/a", "mon/b", "tue/deep/c"]


def test_a_folder_with_a_single_run_gets_a_page_of_its_own(folders: Path) -> None:
    assert report_on([folders / "tue"]) == folders / "tue" / "report.html"
    assert list(rows(folders / "tue")) == ["deep/c"]


def test_the_page_goes_where_it_is_told_to(folders: Path, capsys: pytest.CaptureFixture[str]) -> None:
    there = folders / "new" / "place"
    assert main(["report", str(folders / "mon" / "a"), "--to", str(there)]) == 0
    assert capsys.readouterr().out == f"{there / 'report.html'}\n"
    assert list(rows(there)) == ["../../mon/a"]
    assert (folders / "mon" / "a" / "report.html").read_text() == "", "its own is left as it was"


def test_no_overview_replaces_the_report_of_a_run(folders: Path) -> None:
    inner = make_run(folders / "mon" / "a" / "inner")
    assert report_on([folders / "mon" / "a", inner]) == folders / "mon" / "report.html"
    with pytest.raises(InputError, match=r"a is a run.*--to FOLDER"):
        report_on([folders / "mon"], to=folders / "mon" / "a")


def test_links_lead_to_no_run_twice_and_not_in_circles(folders: Path) -> None:
    (folders / "latest").symlink_to(folders / "mon" / "b")
    (folders / "mon" / "up").symlink_to(folders)
    assert len(list(runs_below(folders))) == 4
    report_on([folders])
    assert list(rows(folders)) == ["latest", "mon/a", "tue/deep/c"]


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["{}/nowhere"], "gsx: {}/nowhere is no folder: give a run, or a folder with runs below it"),
        (["{}/mon", "{}/empty"], "gsx: there is no run below {}/empty (no folder with a config.yaml): give a folder"),
        (["{}/mon/a", "{}/mon/a/config.yaml"], "gsx: {}/mon/a/config.yaml is no folder"),
        ([], "gsx report: the following arguments are required: DIR. See gsx report --help"),
        (["{}/mon", "--too", "x"], "gsx report: unrecognized arguments: --too"),
    ],
)
def test_errors_name_the_folder_and_the_remedy(
    folders: Path, words: list[str], sentence: str, capsys: pytest.CaptureFixture[str]
) -> None:
    (folders / "empty").mkdir()
    assert main(["report", *(word.format(folders) for word in words)]) == 2
    assert capsys.readouterr().err.startswith(sentence.format(folders))
    assert not (folders / "report.html").exists()


def test_folders_with_only_the_root_in_common_need_a_place(folders: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("os.path.commonpath", lambda paths: "/")
    with pytest.raises(InputError, match=r"mon and the others have no folder in common: say where with --to FOLDER"):
        report_on([folders / "mon", folders / "tue"])


def test_the_variant_of_a_run(tmp_path: Path) -> None:
    assert read_run(make_run(tmp_path / "a", {"variant": "octree_ub"})).variant == "octree_ub"
    assert read_run(make_run(tmp_path / "b")).variant == "gs3d"


def test_addresses_of_files_have_their_bytes() -> None:
    assert address("a b/l\udce4ufe.html") == "a%20b/l%E4ufe.html"  # a byte that is no text
    assert address("läufe") == "l%C3%A4ufe"
