"""Tables and multiruns from the command line, with real training: shared beginnings, failures, kill -9, processes."""

import csv
import json
import math
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch
from processes import Begin
from tiny import final_tensors

from gsx.cli.dispatch import main
from gsx.core.data.images import write_image

SMALL = ["scene.width=48", "scene.height=36", "scene.train_views=3", "scene.test_views=1", "scene.points=100",
         "scene.samples=1", "training.test_points=0", "eval.zoom=[1]", "eval.flight=false", "device=cpu",
         "rasterizer=eager"]  # fmt: skip
CHEAP = ["regenerator/upscale=lanczos", "regenerator/restore=identity"]
TABLE = ["+experiment=table_frameworks", "dataset=demo", "budget=smoke", "iterations=12", *SMALL, *CHEAP]


@pytest.fixture(autouse=True)
def own_places(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("GSX_CACHE", str(tmp_path / "cache"))
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    monkeypatch.chdir(tmp_path)


def rows(folder: Path) -> list[dict[str, str]]:
    """Lines of the table's CSV with a PSNR."""
    (path,) = folder.glob("outputs/experiments/*/table.csv")
    return [line for line in csv.DictReader(path.read_text().splitlines()) if line["metric"] == "PSNR"]


def run_of(folder: Path, variant: str) -> Path:
    """The run folder of a variant."""
    configs = folder.glob("outputs/demo/*/*/config.yaml")
    return next(path.parent for path in configs if f"variant: {variant}\n" in path.read_text())


def test_a_table_shares_beginnings_survives_a_failure_and_redoes_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    from gsx.augmenters.pseudo_details import PseudoDetails

    only = "experiment.only=[3D-GS,3D-GS-UP,3D-GS-UB]"
    term = PseudoDetails.term

    def failing(self: PseudoDetails, run: object, step: int, view: int) -> object:
        if self.context.name == "bootstrap" and step > 9:
            raise MemoryError("no room for another picture")
        return term(self, run, step, view)  # type: ignore[arg-type]

    monkeypatch.setattr(PseudoDetails, "term", failing)
    assert main([*TABLE, only]) == 2
    out = capsys.readouterr().out
    assert "NOT the paper's protocol" in out
    assert "no room for another picture" in out
    found = {line["row"]: line for line in rows(tmp_path)}
    assert found["3D-GS-UB"]["ours"] == ""
    assert found["3D-GS-UP"]["paper"] == "27.76"
    assert float(found["3D-GS-UP"]["difference"]) == pytest.approx(float(found["3D-GS-UP"]["ours"]) - 27.76)
    branched = json.loads((run_of(tmp_path, "3d_gs_up") / "branch.json").read_text())
    assert branched["step"] == 7  # 22,000 of 40,000
    assert branched["seconds"] > 0
    assert "saved by common beginnings" in out
    monkeypatch.setattr(PseudoDetails, "term", term)
    stamps = {path: path.stat().st_mtime_ns for path in tmp_path.glob("outputs/demo/gs3d/*/evaluation.json")}
    assert len(stamps) == 2
    assert main([*TABLE, only]) == 0
    assert "2 runs finished, 1 to train" in capsys.readouterr().err
    assert all(path.stat().st_mtime_ns == stamp for path, stamp in stamps.items())
    assert {line["row"]: bool(line["ours"]) for line in rows(tmp_path)}["3D-GS-UB"]
    with monkeypatch.context() as elsewhere:
        (tmp_path / "scratch").mkdir()
        elsewhere.chdir(tmp_path / "scratch")
        elsewhere.setenv("GSX_CACHE", str(tmp_path / "scratch" / "cache"))
        for variant in ("3d_gs_up", "3d_gs_ub"):
            words = [word for word in TABLE if "experiment" not in word]
            assert main([f"variant={variant}", *words, "reuse=true"]) == 0
            branch, scratch = (final_tensors(run_of(place, variant)) for place in (tmp_path, tmp_path / "scratch"))
            assert branch.keys() == scratch.keys()
            assert all(torch.equal(branch[name], scratch[name]) for name in branch)


def test_killed_and_started_again_a_table_goes_on_where_it_was(
    begin: Begin, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = [*TABLE, "experiment.only=[3D-GS,3D-GS-UP]", "training.checkpoint_every=3", "iterations=40"]
    command = [sys.executable, "-m", "gsx", *words]
    begun = begin(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    second = "outputs/demo/gs3d/*/branch.json"  # of the run that branched: the first one is finished
    until = time.monotonic() + 120
    while not list(tmp_path.glob(second)) and begun.poll() is None and time.monotonic() < until:
        time.sleep(0.05)
    begun.send_signal(signal.SIGKILL)
    assert begun.wait() == -signal.SIGKILL
    assert main(words) == 0
    said = capsys.readouterr().err
    assert "1 runs finished, 1 to train" in said
    assert "continuing" in said
    assert len(list(tmp_path.glob("outputs/demo/gs3d/*/evaluation.json"))) == 2
    assert not list(tmp_path.glob("outputs/demo/gs3d/*/**/*partial*"))


def test_a_multirun_over_processes_reports_its_failure_and_divides_the_threads(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The fourth run fails: windows of its pseudo views would be too small."""
    monkeypatch.delenv("OMP_NUM_THREADS")
    words = ["hydra/launcher=processes", "hydra.launcher.n_jobs=2", "iterations=2", *SMALL, *CHEAP, "budget=smoke"]
    assert main(["-m", "seed=0,1", "variant=3d_gs,up_3dgs", *words, "scene.width=20", "scene.height=16"]) == 2
    (report,) = (Path(line) for line in capsys.readouterr().out.splitlines() if line.endswith("report.html"))
    records = [json.loads(path.read_text()) for path in sorted((report.parent / "jobs").glob("*.json"))]
    assert [record["code"] for record in records] == [0, 2, 0, 2]
    listed = list(csv.DictReader((report.parent / "report.csv").read_text().splitlines()))
    assert [line["state"] for line in listed] == ["ok", "ok"]
    assert {line["variant"] for line in listed} == {"3d_gs"}
    for record in records[::2]:
        environment = json.loads((Path(record["folder"]) / "environment.json").read_text())
        assert environment["threads"] == max(1, (os.cpu_count() or 1) // 2)


def test_a_run_by_its_composition_is_finished_resumed_or_judged_anew(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["reuse=true", "backbone=gs3d", "iterations=4", *SMALL, "training.checkpoint_every=2"]
    assert main(words) == 0
    (run,) = tmp_path.glob("outputs/demo/gs3d/*/")
    state, stamp = final_tensors(run), (run / "checkpoints" / "step_0000004.safetensors").stat().st_mtime_ns
    capsys.readouterr()
    assert main(words) == 0
    assert "finished earlier" in capsys.readouterr().err
    assert main([*words, "eval.zoom=[1,2]"]) == 0
    assert "2" in json.loads((run / "evaluation.json").read_text())["zoom"]
    for path in (run / "checkpoints").glob("step_0000004.*"):
        path.unlink()
    (run / "evaluation.json").unlink()
    assert main(words) == 0
    assert "continuing" in capsys.readouterr().err
    assert all(torch.equal(value, state[name]) for name, value in final_tensors(run).items())
    for path in (run / "checkpoints").glob("step_*.safetensors"):
        path.write_bytes(b"damaged")
    (run / "evaluation.json").unlink()
    assert main(words) == 0
    assert "training anew" in capsys.readouterr().err
    assert all(torch.equal(value, state[name]) for name, value in final_tensors(run).items())
    assert list(run.parent.glob(".*_set_aside_1/config.yaml"))
    assert stamp
    assert main([*words, f"folder={tmp_path / 'x'}"]) == 2
    assert "leave out folder=" in capsys.readouterr().err


def photographs(folder: Path, seed: int) -> None:
    """A NeRF-synthetic scene of noise: two training views and a test view, all from the same distance."""
    generator = torch.Generator().manual_seed(seed)
    for split, angles in (("train", (0.0, 1.0)), ("test", (0.5,))):
        frames = []
        for i, angle in enumerate(angles):
            c, s = math.cos(angle), math.sin(angle)
            pose = [[c, 0, s, 4 * s], [s, 0, -c, -4 * c], [0, 1, 0, 0], [0, 0, 0, 1]]
            frames.append({"file_path": f"{split}/{i}", "transform_matrix": pose})
            (folder / split).mkdir(parents=True, exist_ok=True)
            write_image(folder / split / f"{i}.png", torch.rand(3, 30, 40, generator=generator))
        (folder / f"transforms_{split}.json").write_text(json.dumps({"camera_angle_x": 0.9, "frames": frames}))


def test_a_table_shows_the_scene_that_is_there_and_names_results_of_another_source(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Two data roots with other photographs under one name; then one of them is moved, and a photo replaced."""
    table = ["+experiment=table_frameworks", "dataset=own", "+dataset.scenes.yard=Yard", "scene=blender",
             "experiment.only=[3D-GS]", "budget=smoke", "iterations=3", "scene.random_points=60", "device=cpu",
             "rasterizer=eager", "training.test_points=0", "eval.zoom=[1]"]  # fmt: skip

    def shown(root: str) -> tuple[str, bool]:
        """PSNR in the table, and whether nothing was trained for it."""
        main([*table, f"data_root={tmp_path / root}"])
        (line,) = [line for line in rows(tmp_path) if line["row"] == "3D-GS"]
        return line["ours"], "1 runs finished, 0 to train" in capsys.readouterr().err

    photographs(tmp_path / "a" / "yard", 0)
    photographs(tmp_path / "b" / "yard", 1)
    (first, _), (second, found) = shown("a"), shown("b")
    assert first != second
    assert not found
    (tmp_path / "a").rename(tmp_path / "moved")
    for path in tmp_path.glob("outputs/yard/gs3d/*/environment.json"):
        path.write_text(json.dumps(json.loads(path.read_text()) | {"source": "0123456789abcdef"}))
    assert shown("moved") == (first, True)
    (markdown,) = tmp_path.glob("outputs/experiments/*/table.md")
    assert "another revision of gsx's source (0123456789abcdef" in markdown.read_text()
    run = [f"data_root={tmp_path / 'moved'}", "variant=3d_gs", "dataset.scene=yard", "reuse=true"]
    assert main([*run, *(word for word in table if "experiment" not in word)]) == 0
    assert "finished earlier by another revision of gsx's source (0123456789abcdef" in capsys.readouterr().err
    write_image(tmp_path / "b" / "yard" / "test" / "0.png", torch.zeros(3, 30, 40))
    assert shown("b")[1] is False


def test_sigterm_leaves_a_checkpoint_and_its_own_exit_code(begin: Begin, tmp_path: Path) -> None:
    command = [sys.executable, "-m", "gsx", *SMALL, "iterations=5000", "folder=run", "training.log_every=1"]
    begun = begin(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
    until = time.monotonic() + 60
    while not (tmp_path / "run" / "metrics.jsonl").exists() and time.monotonic() < until:
        time.sleep(0.05)
    begun.send_signal(signal.SIGTERM)
    said = begun.communicate(timeout=60)[1]
    assert begun.returncode == -signal.SIGTERM, said
    assert re.search(r"stopped at step \d+ by SIGTERM; continue with: gsx resume run\n", said), said
    assert list((tmp_path / "run" / "checkpoints").glob("step_*.json"))
    assert json.loads((tmp_path / "run" / "status.json").read_text())["state"] == "interrupted"
