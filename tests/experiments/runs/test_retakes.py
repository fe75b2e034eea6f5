"""What to photograph again: photos with known faults, photos without a pose, and the files of a run."""

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import torch
from small_scene import Grey
from synthetic_colmap import synthesize, write_scene

from gsx import api as gsx
from gsx.core.data.camera import Camera, look_at
from gsx.core.data.images import write_image
from gsx.core.data.scene import View
from gsx.core.files import read_json
from gsx.core.quality.sharpness import BLURRED
from gsx.experiments.evaluation.view_coverage import scene_coverage
from gsx.experiments.reports.report import write_report
from gsx.experiments.run_folder.files import read_run, state_of
from gsx.experiments.runs.retakes import Statistics, again_lines, between_words, fact_line, sharpness_of, write_retakes


def statistics(stops: list[float], sharpness: list[float]) -> Statistics:
    return Statistics(names=[f"{n}.jpg" for n in range(len(stops))], stops=stops, sharpness=sharpness)


def test_faults_are_ordered_by_how_far_they_pass_their_threshold() -> None:
    """2.7 stops are 2.7 times the limit, 0.2 of the fine contrast a third of it, 1.05 stops just above."""
    faults = statistics([1.05, 0.9, -2.7, math.nan], [1.0, 0.2, 0.9, math.nan]).faults()
    assert [(fault.name, fault.remarks) for fault in faults] == [
        ("1.jpg", ["blurred: it has 0.20 of its neighbours' fine contrast"]),
        ("2.jpg", ["2.70 stops darker than the others"]),
        ("0.jpg", ["1.05 stops brighter than the others"]),
    ]


def test_photos_without_measurements_have_no_fault() -> None:
    unknown = statistics([math.nan] * 2, [math.nan] * 2)
    assert unknown.faults() == []
    assert fact_line(unknown, [], []) == "photos: 2 of 2 placed; 0 blurred, 0 with a fault"


def test_facts_of_a_capture_stand_in_one_line() -> None:
    known = statistics([0.5, -0.25], [0.3, 1.0])
    line = fact_line(known, known.faults(), [Path("images/9.jpg")])
    assert line == (
        "photos: 2 of 3 placed; exposures differ by up to 0.75 stops (lock exposure and white balance); "
        "1 blurred, 1 with a fault"
    )


@pytest.mark.parametrize(
    ("name", "words"),
    [("b5.jpg", "between b4.jpg and sub/b7.jpg"), ("a.jpg", "before b4.jpg"), ("z.jpg", "after sub/b7.jpg")],
)
def test_unplaced_photos_are_located_by_name(name: str, words: str) -> None:
    assert between_words(Path("images") / name, ["b4.jpg", "sub/b7.jpg"]) == words
    assert between_words(Path(name), []) == ""


def test_blur_counts_only_if_the_file_has_it(tmp_path: Path) -> None:
    """Two of eight photos are flat at the training resolution; of these one is in its file as well."""
    generator = torch.Generator().manual_seed(0)

    def noise(blurred: bool) -> torch.Tensor:
        picture = torch.rand(3, 96, 96, generator=generator)
        return torch.nn.functional.avg_pool2d(picture, 5, stride=1, padding=2) if blurred else picture

    @dataclass(frozen=True)
    class Photo(Grey):
        path: Path
        blurred: bool

        def image(self, camera: Camera) -> torch.Tensor:
            return (255 * noise(self.blurred)).byte()

    views = []
    for number in range(8):
        path = tmp_path / f"{number}.png"
        write_image(path, noise(number == 3))
        camera = look_at([0, -4, 1], [0, 0, 0], fov_x=0.9, width=96, height=96)
        views.append(View(path.name, camera, Photo(path, number in (3, 5))))
    ratios = sharpness_of(views)
    assert [number for number, ratio in enumerate(ratios) if ratio < BLURRED] == [3]


def test_lines_of_the_log() -> None:
    faults = statistics([1.5, 1.4, -1.6], [1.0, 1.0, 1.0]).faults()
    lines = again_lines([], "40 between 1.jpg and 2.jpg", faults, [Path("images/9.jpg"), Path("images/8.jpg")])
    assert lines == [
        "photograph more around the middle, in gaps of 40 between 1.jpg and 2.jpg (degrees)",
        "photograph again 2.jpg (1.60 stops darker than the others), 0.jpg (1.50 stops brighter than the others), "
        "and 1 more in the report",
        "2 photos have no place (9.jpg, 8.jpg): take photos between them and their neighbours",
    ]
    assert again_lines([], "", [], []) == ["photograph again: nothing stands out"]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run on five photos of noise around a sphere, with a sixth that has no pose."""
    place = tmp_path_factory.mktemp("retakes")
    write_scene(synthesize(frames=5), place / "scene")
    first = min((place / "scene" / "images").rglob("*.*"))
    write_image(first.parent / "unknown.png", torch.rand(3, 48, 64, generator=torch.Generator().manual_seed(1)))
    words = (
        "scene=colmap",
        "backbone=gs3d",
        "rasterizer.path=eager",
        "iterations=2",
        "device=cpu",
        "eval.flight=false",
    )
    run = gsx.train(*words, **{"scene.path": str(place / "scene"), "folder": str(place / "run")}).run
    write_retakes(run, scene_coverage(run.scene.train, run.scene.test, ball, 1e6), 1 << 20)
    write_report(place / "run")
    return place / "run"


def ball(camera: Camera) -> tuple[torch.Tensor, torch.Tensor]:
    """Depth and alpha of the unit sphere, which five photos from all sides show less than four times each."""
    y, x = torch.meshgrid(torch.arange(camera.height) + 0.5, torch.arange(camera.width) + 0.5, indexing="ij")
    slopes = torch.stack([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, torch.ones_like(x)], -1)
    middle = camera.translation.to(slopes)
    along, length = (slopes * middle).sum(-1), slopes.square().sum(-1)
    inside = along.square() - length * (middle.square().sum() - 1)
    depth, alpha = (along - inside.clamp(min=0).sqrt()) / length, (inside > 0).float()
    return depth * alpha, alpha


@pytest.fixture
def evaluation(folder: Path) -> dict[str, Any]:
    return read_json(folder / "evaluation.json")


def test_evaluations_hold_the_coverage_of_each_view(evaluation: dict[str, Any]) -> None:
    shares = [view["coverage"] for view in evaluation["views"]]
    assert all(0 <= share <= 1 for share in shares)
    assert evaluation["coverage"]["share"] == pytest.approx(sum(shares) / len(shares))
    assert sum(one["views"] for one in evaluation["coverage"]["classes"].values()) == len(shares)
    assert sum(evaluation["coverage"]["training"]["classes"].values()) == 4


def test_the_protocol_knows_nothing_of_coverage(evaluation: dict[str, Any]) -> None:
    assert "coverage" not in json.dumps(evaluation["protocol"])


def test_a_photo_without_a_pose_is_listed_with_its_picture(folder: Path) -> None:
    index = read_json(folder / "retakes" / "index.json")
    (missing,) = index["unplaced"]
    assert missing["name"] == "unknown.png"
    assert (folder / "retakes" / missing["files"]["photo"]).is_file()
    assert index["facts"].startswith("photos: 5 of 6 placed")


def test_places_have_pictures(folder: Path) -> None:
    index = read_json(folder / "retakes" / "index.json")
    assert index["places"]
    for place in index["places"]:
        assert {"photo", "render"} <= place["files"].keys()
        assert all((folder / "retakes" / file).is_file() for file in place["files"].values())


def test_the_report_says_what_to_photograph_again(folder: Path) -> None:
    page = (folder / "report.html").read_text()
    section = page[page.index('id="retakes"') : page.index('id="photographs"')]
    assert "What to photograph again" in section
    assert "unknown.png" in section
    assert section.count("data:image/jpeg") >= 3
    assert "picture missing" not in section
    assert 'id="coverage"' in page


def test_a_damaged_index_makes_no_run_unfinished(folder: Path) -> None:
    path = folder / "retakes" / "index.json"
    text = path.read_text()
    path.write_text('{"places": 3}')
    try:
        run = read_run(folder)
        assert run.retakes == {}
        assert "retakes/index.json" in run.problems
        assert state_of(run)[0] == "ok"
    finally:
        path.write_text(text)
