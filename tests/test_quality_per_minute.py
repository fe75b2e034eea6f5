"""PSNR over wall time: interpolation by hand, the scene that another program reads, and turns of runs by stand-ins."""

import json
import math
import os
import subprocess
import sys
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import pytest
import torch
from synthetic_colmap import colmap_options

import quality_per_minute as benchmark
from gsx.core.data.camera import Camera
from gsx.core.data.images import read_image
from gsx.core.data.scene import PointCloud, Scene, View
from gsx.scenes.colmap import load
from measuring.curves import psnr_at, seconds_to, steps_for
from measuring.opensplat import MODEL, run_opensplat, write_scene
from measuring.panels import panels
from measuring.quality_tables import reached
from measuring.results import read_sections
from measuring.runs import clock_of

CURVE = [(60.0, 20.0), (240.0, 24.0), (600.0, 25.0)]


# -- interpolation


def test_psnr_between_runs_is_linear_in_the_logarithm_of_seconds() -> None:
    assert psnr_at(CURVE, 60) == pytest.approx(20)
    assert psnr_at(CURVE, 120) == pytest.approx(22)  # half way from 60 to 240 by factors
    assert psnr_at(CURVE, 240 * math.sqrt(2.5)) == pytest.approx(24.5)
    assert psnr_at(CURVE[::-1], 120) == pytest.approx(22)


def test_a_curve_goes_on_for_a_tenth_of_its_seconds_and_no_further() -> None:
    slope = 1 / math.log(2.5)  # dB per factor e, from 240 s to 600 s
    assert psnr_at(CURVE, 630) == pytest.approx(25 + slope * math.log(1.05))
    assert psnr_at(CURVE, 661) is None
    assert psnr_at(CURVE, 54) is None
    assert psnr_at(CURVE[:1], 62) == 20
    assert psnr_at(CURVE[:1], 70) is None


def test_seconds_to_a_psnr_are_those_where_the_curve_first_has_it() -> None:
    assert seconds_to(CURVE, 22) == pytest.approx(120)
    assert seconds_to(CURVE, 24) == pytest.approx(240)
    assert seconds_to(CURVE, 19) == 60  # the shortest run has more
    assert seconds_to(CURVE, 25.1) is None
    assert seconds_to([], 20) is None
    falling = [(60.0, 20.0), (120.0, 19.0), (240.0, 21.0)]
    assert seconds_to(falling, 20.5) == pytest.approx(120 * 2**0.75)


def test_steps_are_interpolated_between_runs_and_go_on_beyond_them() -> None:
    runs = [(100, 20.0), (300, 40.0), (700, 120.0)]
    assert steps_for(30, runs) == 200
    assert steps_for(80, runs) == 500
    assert steps_for(160, runs) == 900  # 5 steps a second, as from 300 to 700
    assert steps_for(15, runs) == 50
    assert steps_for(30, [(100, 18.0), (100, 22.0), (300, 40.0)]) == 200  # two runs of one length: their mean
    with pytest.raises(ValueError, match="measure two lengths"):
        steps_for(30, [(100, 20.0), (100, 21.0)])
    with pytest.raises(ValueError, match="100 steps lasted 50 s, but 300 steps lasted 40 s"):
        steps_for(45, [(100, 50.0), (300, 40.0)])


def row(arm: str, minutes: float, seconds: float, psnr: float, seed: int = 0) -> dict[str, Any]:
    figures = {"x1": psnr, "x2": psnr - 1, "x4": psnr - 2}
    place = {"scene": "demo", "arm": arm, "minutes": minutes, "seed": seed}
    return place | figures | {"seconds": seconds, "steps": 10, "primitives": 5, "peak_mb": 100.0, "revision": "r"}


def test_the_table_has_the_seconds_in_which_each_arm_reaches_a_psnr() -> None:
    rows = [row("before", 2, 150, 22), row("before", 5, 300, 24), row("before", 10, 600, 26)]
    rows += [row("now", 1, 60, 22), row("now", 2, 120, 26, 0), row("now", 2, 120, 28, 1)]  # 27 dB at 120 s
    rows += [row("opensplat", 5, 300, 20), row("opensplat", 10, 590, 21)]
    lines = {(line["zoom"], line["minutes"]): line for line in reached(rows, benchmark.ARMS, (0.1, "this"))["rows"]}
    five, ten = lines["x1", 5], lines["x1", 10]
    assert five["before"] == 24
    assert five["now_seconds"] == round(60 * 2**0.4, 1)  # 2 dB of 5
    assert five["ratio"] == round(300 / (60 * 2**0.4), 2)
    assert five["opensplat_psnr"] == 20
    assert five["opensplat_seconds"] is None
    assert ten["ratio"] == round(600 / (60 * 2**0.8), 2)
    assert ten["opensplat_psnr"] == round(20 + math.log(2) / math.log(590 / 300), 2)
    assert lines["x4", 10]["before"] == 24
    assert ten["at_most"] is None


def test_a_psnr_that_the_shortest_run_has_is_marked() -> None:
    rows = [row("before", 2, 150, 22), row("before", 5, 300, 24), row("now", 1, 61, 25), row("now", 2, 120, 26)]
    (line,) = [line for line in reached(rows, benchmark.ARMS, (0.1, "this"))["rows"] if line["zoom"] == "x1"]
    assert (line["now_seconds"], line["at_most"], line["ratio"]) == (61, "now", round(300 / 61, 2))


def test_the_picture_has_a_panel_for_each_scene_with_a_curve() -> None:
    curves = {("before", "x1"): CURVE, ("now", "x1"): CURVE[1:], ("now", "x4"): CURVE[:1]}
    picture = panels({"fox": curves, "demo": curves, "room": {("now", "x1"): CURVE[:1]}})
    assert picture.count("<g transform=") == 2
    assert picture.count("<polyline") == 6
    assert picture.count(">60<") == 2  # s, on each axis
    assert "fox: PSNR" in picture
    assert "room" not in picture
    assert panels({"room": {("now", "x1"): CURVE[:1]}}) == ""


# -- a scene for OpenSplat


class Painted:
    """Pictures of one colour each."""

    def __init__(self, value: int) -> None:
        self.value = value

    def image(self, camera: Camera) -> torch.Tensor:
        return torch.full((3, camera.height, camera.width), self.value, dtype=torch.uint8)

    def max_zoom(self, camera: Camera) -> float:
        return 1.0


def turned(angle: float) -> torch.Tensor:
    c, s = math.cos(angle), math.sin(angle)
    return torch.tensor([[c, 0, s], [0, 1, 0], [-s, 0, c]], dtype=torch.float64)


def a_scene(cx: float = 20.0, origin: tuple[float, float, float] = (1000.0, -2000.0, 30.0)) -> Scene:
    """Six views in front of twenty points, around an origin; the third is held out."""
    views = [
        View(
            f"photo {number}.jpg",
            Camera(
                rotation=turned(0.1 * number),
                translation=torch.tensor([0.1 * number, -0.2, 3.0], dtype=torch.float64),
                fx=41.0,
                fy=43.0,
                cx=cx,
                cy=15.0,
                width=40,
                height=30,
            ),
            Painted(10 * number),
        )
        for number in range(6)
    ]
    positions = torch.rand(20, 3, generator=torch.Generator().manual_seed(0)) - 0.5
    return Scene(
        name="small",
        train=[view for number, view in enumerate(views) if number != 2],
        test=[views[2]],
        points=PointCloud(positions, torch.arange(60, dtype=torch.uint8).reshape(20, 3)),
        background=torch.zeros(3),
        extent=1.0,
        origin=origin,
    )


def test_a_scene_for_opensplat_comes_back_through_the_colmap_reader(tmp_path: Path) -> None:
    scene = a_scene()
    read = load(colmap_options(write_scene(scene, tmp_path), split="none", max_reprojection_px=1.0))
    assert [view.name for view in read.train] == [f"{number:04d}.png" for number in range(1, 6)]
    origin = torch.tensor(scene.origin, dtype=torch.float64)
    for own, other in zip(scene.train, read.train, strict=True):
        camera, theirs = own.camera, other.camera
        assert [theirs.fx, theirs.fy, theirs.cx, theirs.cy, *theirs.size] == [41.0, 43.0, 20.0, 15.0, 40, 30]
        assert torch.equal(own.picture(), other.picture())
        place = torch.tensor([[0.2, -0.1, 0.3]], dtype=torch.float64)
        pixels, depths = camera.project(place)
        there = place + origin - torch.tensor(read.origin, dtype=torch.float64)
        expected, far = theirs.project(there)
        assert torch.allclose(pixels, expected, atol=1e-6)
        assert torch.allclose(depths, far, atol=1e-6)
    places = read.points.positions.double() + torch.tensor(read.origin, dtype=torch.float64)
    assert torch.allclose(places, scene.points.positions.double() + origin, atol=1e-6)
    assert torch.equal(read.points.colours, scene.points.colours)


def test_held_out_views_are_no_part_of_what_opensplat_reads(tmp_path: Path) -> None:
    write_scene(a_scene(), tmp_path)
    images = sorted((tmp_path / "images").iterdir())
    assert [int(read_image(path).float().mean()) for path in images] == [0, 10, 30, 40, 50]
    assert {path.name for path in (tmp_path / MODEL).iterdir()} >= {"cameras.bin", "images.bin", "points3D.bin"}


def test_a_principal_point_that_opensplat_would_ignore_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"0\.50 px off the centre"):
        write_scene(a_scene(cx=20.5), tmp_path)
    assert not (tmp_path / MODEL).exists()


STAND_IN = """#!{python}
import sys
words = sys.argv[1:]
if "--version" in words:
    print("stand-in 1")
    raise SystemExit
print(words)
if "fail" in words:
    raise SystemExit(3)
memory = bytearray(50_000_000)
memory[::4096] = b"1" * len(memory[::4096])
open(words[words.index("--output") + 1], "w").write(" ".join(words))
"""


@pytest.fixture
def program(tmp_path: Path) -> Path:
    """Return a program in OpenSplat's place that writes its words as the model."""
    path = tmp_path / "opensplat"
    path.write_text(STAND_IN.format(python=sys.executable))
    path.chmod(0o755)
    return path


def test_a_run_of_opensplat_is_timed_with_its_peak_memory(tmp_path: Path, program: Path) -> None:
    place, log = tmp_path / "runs" / "demo_0.5_minutes", tmp_path / "log.txt"
    to = tmp_path / "runs" / "demo_0.5_minutes.ply"
    facts = run_opensplat(program, tmp_path, place, ["--num-iters", "7"], {}, log)
    assert to.read_text() == f"{tmp_path} --keep-crs --output {to} --num-iters 7"
    assert 0 < facts["wall_seconds"] < 60
    assert 50 < facts["peak_mb"] < 500
    assert json.loads(clock_of(place).read_text()) == facts
    with pytest.raises(Exception, match="non-zero exit status 3"):
        run_opensplat(program, tmp_path, tmp_path / "other", ["fail"], {}, log)
    assert not clock_of(tmp_path / "other").exists()


def test_schedules_of_opensplat_are_compressed_to_the_steps() -> None:
    assert benchmark.opensplat_words("opensplat", 600) == ["--num-iters", "600"]
    words = benchmark.opensplat_words("opensplat_short", 600)
    assert words[words.index("--resolution-schedule") + 1] == "60"
    assert words[words.index("--warmup-length") + 1] == "10"


# -- turns of runs


@pytest.fixture
def calls(monkeypatch: pytest.MonkeyPatch) -> list[list[str]]:
    """Return the commands of a benchmark whose runs are stand-ins: 10 s, and 0.1 s a step."""
    made: list[list[str]] = []

    def train(folder: Path, words: list[str], environment: dict[str, str], log: Path) -> dict[str, Any]:
        if not folder.exists():
            made.append([folder.name, *words, f"threads={environment['OMP_NUM_THREADS']}"])
        values = dict(word.split("=", 1) for word in words)
        steps = int(values.get("iterations", 0)) or round(900 * float(values.get("minutes", 0)))
        seconds = 10 + 0.1 * steps if "iterations" in values else 60 * float(values["minutes"])
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "seconds").write_text(str(seconds))
        return {"step": steps, "peak_memory_mb": 300.0, "psnr": 29.004}

    def gsx(words: list[str], environment: dict[str, str], log: Path) -> None:
        made.append(words)
        place = [word.partition("=")[2] for word in words if word.startswith("folder=")]
        folder = Path(place[0] if place else words[1])
        folder.mkdir(exist_ok=True)
        zooms = {zoom: {"psnr": 30.0 - int(zoom)} for zoom in benchmark.ZOOMS}
        (folder / "evaluation.json").write_text(json.dumps({"zoom": zooms, "primitives": 7}))

    def other(program: Path, scene: Path, place: Path, words: list[str], environment: object, log: Path) -> None:
        made.append(["opensplat", *words])
        facts = {"wall_seconds": 5 + int(words[1]), "peak_mb": 99.0}
        clock_of(place).write_text(json.dumps(facts))

    for name, stand_in in {"train": train, "gsx": gsx, "run_opensplat": other}.items():
        monkeypatch.setattr(benchmark, name, stand_in)
    monkeypatch.setattr(benchmark, "wall_seconds", lambda folder: float((folder / "seconds").read_text()))
    monkeypatch.setattr(benchmark, "opensplat_scene", lambda bench, scene: bench.folder("scene", scene))
    monkeypatch.setattr(benchmark, "checked_out", lambda revision: nullcontext(Path("old")))
    monkeypatch.setattr(benchmark.os, "environ", dict(os.environ))
    return made


def test_arms_take_turns_and_finished_runs_are_not_repeated(
    tmp_path: Path, program: Path, calls: list[list[str]], capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["--only", "demo", "--minutes", "1,2", "--opensplat", str(program)]
    words += ["--runs", str(tmp_path / "runs"), "--to", str(tmp_path)]
    benchmark.main(words)
    trained = [call[0] for call in calls if not call[0].startswith(("warm", "eval", "opensplat"))]
    assert trained == [
        *("before_demo_probe_300_0", "before_demo_probe_500_0", "before_demo_1_minutes_0", "now_demo_1_minutes_0"),
        *("before_demo_2_minutes_0", "now_demo_2_minutes_0"),
    ]
    assert [call[2] for call in calls if call[0] == "opensplat"] == ["200", "800", "55", "115"]
    timed = {call[0]: call for call in calls}
    assert timed["before_demo_2_minutes_0"][1:] == ["scene=demo", "iterations=1100", "seed=0", "threads=2"]
    assert timed["now_demo_1_minutes_0"][1:] == ["scene=demo", "minutes=1", "seed=0", "threads=2"]
    sections = read_sections(tmp_path / "quality_per_minute_cpu.json")
    rows = sections["runs"]["rows"]
    assert [(row["arm"], row["minutes"], row["steps"], row["seconds"]) for row in rows] == [
        *(("before", 1, 500, 60.0), ("before", 2, 1100, 120.0), ("now", 1, 900, 60.0), ("now", 2, 1800, 120.0)),
        *(("opensplat", 1, 55, 60), ("opensplat", 2, 115, 120)),
    ]
    assert rows[0].items() >= {"x1": 29.0, "x2": 28.0, "x4": 26.0, "primitives": 7, "peak_mb": 300.0}.items()
    assert (rows[0]["revision"], rows[-1]["revision"]) == (benchmark.REVISION, "opensplat stand-in 1")
    assert "![PSNR over seconds](quality_per_minute_cpu.svg)" in (tmp_path / "quality_per_minute_cpu.md").read_text()
    assert (tmp_path / "quality_per_minute_cpu.svg").is_file()
    before = len(calls)
    benchmark.main([*words, "--arms", "before,now"])
    assert len(calls) == before
    benchmark.main([*words, "--seeds", "1", "--minutes", "2", "--arms", "before"])
    assert calls[before][1:4] == ["scene=demo", "iterations=1100", "seed=1"]  # the steps of the other seed
    assert "Seconds to the same PSNR" in capsys.readouterr().out


def test_opensplat_is_left_out_with_a_sentence(
    tmp_path: Path, calls: list[list[str]], capsys: pytest.CaptureFixture[str]
) -> None:
    places = ["--runs", str(tmp_path / "runs"), "--to", str(tmp_path)]
    benchmark.main(["--only", "demo", "--minutes", "1", "--arms", "now,opensplat", *places])
    assert "OpenSplat is left out: give its program by --opensplat" in capsys.readouterr().err
    assert [call[0] for call in calls][:2] == ["warm_demo_now", "now_demo_1_minutes_0"]


def test_a_run_that_fails_is_reported_and_left_out(
    tmp_path: Path, calls: list[list[str]], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def fails(*words: Any) -> None:
        raise subprocess.CalledProcessError(2, "gsx")

    monkeypatch.setattr(benchmark, "gsx", fails)
    benchmark.main(
        ["--only", "demo", "--minutes", "1", "--arms", "now", "--to", str(tmp_path), "--runs", str(tmp_path)]
    )
    assert "now, demo, 1 minutes, seed 0 failed" in capsys.readouterr().err
    assert not (tmp_path / "quality_per_minute_cpu.json").exists()


def test_an_evaluation_that_differs_from_the_run_s_own_is_refused() -> None:
    benchmark.refuse_disagreement(29.004, {"x1": 29.0}, Path("run"))
    benchmark.refuse_disagreement(None, {"x1": 29.0}, Path("run"))
    with pytest.raises(ValueError, match=r"run has 29\.020 dB by its own evaluation, 29\.000 dB"):
        benchmark.refuse_disagreement(29.02, {"x1": 29.0}, Path("run"))


def test_captures_need_their_folder() -> None:
    with pytest.raises(SystemExit, match="fox_4 needs --scenes FOLDER"):
        benchmark.main(["--only", "fox_4,demo"])
