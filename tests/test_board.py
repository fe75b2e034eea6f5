"""The board: turns of runs by stand-ins, plans that miss their time, and tables from what `gsx judge` writes."""

import json
import os
import subprocess
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pytest

import board as benchmark
from measuring import runs
from measuring.board_tables import sections_of
from measuring.results import read_sections
from measuring.runs import clock_of

STEP = 0.05
"""Seconds of a step of a stand-in; a plan takes 1,000 steps and 10 s before them, start and report another 10 s."""
LATE = [401.0, 600.0]
"""Steps that a plan of Scaffold-GS skips."""


def judged_row(method: str, zoom: str, psnr: float, **further: float) -> dict[str, Any]:
    figures = {"psnr": psnr, "ssim": 0.9, "st_lpips_alex": 0.1}
    zoomed = {"explained_detail": 0.25, "consistency": 31.0} if zoom != "1" else {}
    return {"scene": "demo", "protocol": "", "zoom": zoom, "method": method, **figures, **zoomed, **further}


def found(methods: Mapping[str, float]) -> dict[str, Any]:
    """What `gsx judge` writes; methods: PSNR at x1 of each."""
    rows = [
        judged_row(name, zoom, level - int(zoom), difference_mean=level - 30, difference_over_views=0.5)
        for name, level in methods.items()
        for zoom in ("1", "2", "4")
    ]
    models = [{"name": name, "primitives": 70 + number} for number, name in enumerate(methods)]
    return {"rows": rows, "results": [{"methods": models}]}


@pytest.fixture
def calls(monkeypatch: pytest.MonkeyPatch) -> list[list[str]]:
    """Stands in for gsx and OpenSplat: name of the folder and words of each call."""
    made: list[list[str]] = []

    def run_gsx(words: Sequence[str], environment: Mapping[str, str], log: Path | None = None) -> None:
        assert log is not None
        log.write_text("compiled in 0 s\n")
        if words[0] == "judge":
            folder = Path(words[-1])
            made.append(["judge", *words[1:-1]])
            folder.mkdir()
            names = [word.partition("=")[0] for word in words if str(folder.parent) in word.partition("=")[2]]
            (folder / benchmark.COMPARISON).write_text(json.dumps(found(dict.fromkeys(names, 30.0))))
            return
        folder = Path(words[-1].removeprefix("folder="))
        if folder.name == "octree_scaffold_demo_1" and "seconds=72" in words:
            log.write_text("gsx: 60 s are left: give more minutes\n")
            raise subprocess.CalledProcessError(2, "gsx")
        made.append([folder.name, *words[:-1]])
        folder.mkdir(parents=True)
        values = dict(word.split("=", 1) for word in words)
        limit, steps = float(values.get("seconds", 0)), int(values.get("iterations", 1000))
        plan = {"before_s": 10, "repeat": [*words[1:-2], "iterations=1000"]}
        environment_file = {"gsx": "1.0", "source": "abcdef0123"} | ({"minutes": plan} if limit else {})
        late = {"late": LATE} if limit and "scaffold" in folder.name else {}
        trained = STEP * (steps - 200 if late else steps)
        evaluation = {"step": steps, "primitives": 7, "peak_memory_mb": 300.0, "train_seconds": trained}
        for name, content in {"environment": environment_file, "evaluation": evaluation | late}.items():
            (folder / f"{name}.json").write_text(json.dumps(content))

    def seconds(folder: Path) -> float:
        planned = "minutes" in json.loads((folder / "environment.json").read_text())
        return 10 + 10 * planned + float(json.loads((folder / "evaluation.json").read_text())["train_seconds"])

    def other(program: Path, data: Path, place: Path, words: Sequence[str], *further: Any) -> None:
        made.append([place.name, *words])
        clock_of(place).write_text(json.dumps({"wall_seconds": 5 + int(words[1]) / 10, "peak_mb": 99.0}))

    monkeypatch.setattr(benchmark, "gsx", run_gsx)
    monkeypatch.setattr(runs, "gsx", run_gsx)
    monkeypatch.setattr(benchmark, "wall_seconds", seconds)
    monkeypatch.setattr(benchmark, "run_opensplat", other)
    monkeypatch.setattr(benchmark, "kept_scene", lambda words, folder: folder)
    monkeypatch.setattr(benchmark.os, "environ", dict(os.environ))
    return made


def words_for(place: Path, *further: str) -> list[str]:
    return ["--only", "demo", "--runs", str(place / "runs"), "--to", str(place), *further]


def test_a_plan_that_misses_its_time_is_trained_without_a_clock(tmp_path: Path, calls: list[list[str]]) -> None:
    benchmark.main(words_for(tmp_path, "--methods", "gs3d_zoom,gs3d"))
    scene = ["scene=demo", "scene.downscale=2"]
    assert calls[:-1] == [
        ["warm_gs3d_zoom_demo", *scene, *benchmark.WARM, *benchmark.PLANNED],
        ["gs3d_zoom_demo_1", *scene, "seconds=120"],  # ends after 10 + 10 + 50 s
        ["gs3d_zoom_demo_2", "scene.downscale=2", "iterations=2200"],  # 10 + 110 s
        ["warm_gs3d_demo", *scene, "backbone=gs3d", *benchmark.WARM, *benchmark.PLANNED],
        ["gs3d_demo_1", *scene, "backbone=gs3d", "seconds=120"],
        ["gs3d_demo_2", "scene.downscale=2", "backbone=gs3d", "iterations=2200"],
    ]
    board = read_sections(tmp_path / "board_cpu.json")["board"]["rows"]
    assert [(row["method"], row["seconds"], row["steps"]) for row in board] == [
        ("gs3d_zoom", 120.0, 2200),
        ("gs3d", 120.0, 2200),
    ]
    models = [f"{name}={tmp_path}/runs/{name}_demo_2" for name in ("gs3d_zoom", "gs3d")]
    assert calls[-1] == ["judge", *models, *scene, *benchmark.JUDGED, "--against", "gs3d", "--to"]


def test_steps_that_a_plan_skips_do_not_count(tmp_path: Path, calls: list[list[str]]) -> None:
    benchmark.main(words_for(tmp_path, "--methods", "scaffold", "--minutes", "1.1"))  # 60 s of 66, 200 steps left out
    row = read_sections(tmp_path / "board_cpu.json")["board"]["rows"][0]
    assert (row["steps"], row["seconds"]) == (800, 60.0)
    assert row["program"] == "gsx 1.0, source abcdef01"


def test_finished_runs_and_judgements_are_not_repeated(tmp_path: Path, calls: list[list[str]]) -> None:
    benchmark.main(words_for(tmp_path, "--methods", "gs3d"))
    first = len(calls)
    benchmark.main(words_for(tmp_path, "--methods", "gs3d"))
    assert len(calls) == first
    benchmark.main(words_for(tmp_path, "--methods", "gs3d,scaffold"))
    assert [call[0] for call in calls[first:]] == ["warm_scaffold_demo", "scaffold_demo_1", "scaffold_demo_2", "judge"]


def test_a_run_that_compiled_does_not_count(tmp_path: Path, calls: list[list[str]]) -> None:
    bench = benchmark.Bench(benchmark.arguments(words_for(tmp_path, "--minutes", "1.2")))
    (tmp_path / "runs").mkdir()
    assert benchmark.trained(bench, "gs3d", "demo")["path"].name == "gs3d_demo_1"
    log = tmp_path / "runs" / "gs3d_demo_1.log"
    log.write_text(f"compiling gradients, {benchmark.COMPILED} ...\n")
    assert benchmark.trained(bench, "gs3d", "demo")["path"].name == "gs3d_demo_2"
    assert [call[-1] for call in calls if call[0].startswith("gs3d_demo")] == ["seconds=72", "seconds=72"]


def test_a_refused_plan_is_that_of_the_method_before(tmp_path: Path, calls: list[list[str]]) -> None:
    bench = benchmark.Bench(benchmark.arguments(words_for(tmp_path, "--minutes", "1.2")))
    (tmp_path / "runs").mkdir()
    row = benchmark.trained(bench, "octree_scaffold", "demo")
    made = {call[0]: call[1:] for call in calls}
    assert made["octree_scaffold_demo_1"] == ["scene.downscale=2", "backbone=octree_scaffold", "iterations=200"]
    assert made["octree_scaffold_demo_2"][-1] == f"iterations={row['steps']}" == "iterations=1240"  # 62 s of 72


def test_opensplat_takes_the_steps_that_last_the_minutes(tmp_path: Path, calls: list[list[str]]) -> None:
    program = tmp_path / "program"
    program.write_text("#!/bin/sh\necho 1.1.5\n")
    program.chmod(0o755)
    benchmark.main(words_for(tmp_path, "--methods", "gs3d,opensplat", "--opensplat", str(program)))
    steps = [call for call in calls if call[0].startswith("opensplat")]
    assert [call[0] for call in steps] == ["opensplat_demo_200", "opensplat_demo_800", "opensplat_demo_1150"]
    assert steps[2][3:5] == ["--resolution-schedule", "115"]  # of 3,000 in 30,000 steps
    row = read_sections(tmp_path / "board_cpu.json")["board"]["rows"][1]
    assert (row["seconds"], row["steps"], row["primitives"], row["program"]) == (120, 1150, 71, "OpenSplat 1.1.5")


def test_a_run_that_fails_is_reported_and_opensplat_left_out(
    tmp_path: Path, calls: list[list[str]], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def fails(*words: Any) -> None:
        raise subprocess.CalledProcessError(2, "gsx")

    monkeypatch.setattr(benchmark, "train", fails)
    benchmark.main(words_for(tmp_path, "--methods", "gs3d,opensplat"))
    err = capsys.readouterr().err
    assert "gs3d, demo failed" in err
    assert "opensplat is left out: give its program by --opensplat" in err
    assert not (tmp_path / "board_cpu.json").exists()


def test_the_tables_have_each_method_and_means_over_scenes_that_all_have() -> None:
    runs = [
        {"scene": scene, "method": method, "seconds": 100.0 + number, "steps": 5, "peak_mb": 1.0, "path": Path("run")}
        for number, (method, scene) in enumerate([("gs3d", "fox"), ("gs3d", "demo"), ("scaffold", "fox")])
    ]
    judged = {"fox": found({"gs3d": 30.0, "scaffold": 28.0}), "demo": found({"gs3d": 33.0})}
    sections = sections_of(runs, judged, "gs3d", 2, (0.1, "this"))
    board = sections["board"]["rows"]
    assert [(row["scene"], row["method"]) for row in board] == [("demo", "gs3d"), ("fox", "gs3d"), ("fox", "scaffold")]
    figures = {"ssim": 0.9, "st_lpips": 0.1}
    assert board[2] == {
        "scene": "fox",
        "method": "scaffold",
        "seconds": 102.0,
        "steps": 5,
        "peak_mb": 1.0,
        "primitives": 71,
        **{f"{name}{zoom}": value for name, value in figures.items() for zoom in (1, 2, 4)},
        "x1": 27.0,
        "x2": 26.0,
        "x4": 24.0,
        "detail2": 0.25,
        "detail4": 0.25,
        "agree2": 31.0,
        "agree4": 31.0,
        "over": -2.0,
        "half": 0.5,
    }
    (mean,) = sections["means"]["rows"]  # scaffold has no run on demo
    assert (mean["method"], mean["scenes"], mean["seconds"]) == ("gs3d", 2, 100.5)
    assert (mean["x1"], mean["x4"]) == (30.5, 27.5)
    assert ["over", "x4 over gs3d, dB"] in sections["board"]["columns"]
