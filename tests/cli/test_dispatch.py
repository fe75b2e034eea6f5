"""The command line as a user meets it: help, verbs, errors with exit code 2, Ctrl-C."""

import csv
import json
import logging
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from io import BytesIO, TextIOWrapper
from pathlib import Path

import pytest
import torch
from processes import Begin
from tiny import OVERRIDES, tiny_run, words

from gsx import __version__
from gsx.cli.dispatch import VERBS, main
from gsx.core.backend import EAGER
from gsx.core.data.images import write_image
from gsx.engine.compiling import available

GSX = [sys.executable, "-m", "gsx"]
FEW = ("scene.points=100", "scene.train_views=3")
Multirun = tuple[Path, subprocess.CompletedProcess[str]]


@pytest.fixture(scope="module")
def run_folder(tmp_path_factory) -> Path:
    """A finished tiny run."""
    folder = tmp_path_factory.mktemp("cli") / "run"
    tiny_run(folder, [*FEW, "iterations=2"])
    return folder


def test_help_is_short_says_what_to_type_and_does_not_import_torch() -> None:
    code = "import sys; from gsx.cli import main; main(['--help']); sys.exit('torch' in sys.modules)"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert result.returncode == 0
    assert len(result.stdout.splitlines()) <= 30
    assert "start here" in result.stdout
    assert re.search(r"without it photos take 10 minutes on a CPU;\s+length=published trains all 30,000", result.stdout)
    for verb in ("resume", "eval", "render", "export", "report", "scenes", "plugins"):
        assert f"gsx {verb}" in result.stdout


def test_version(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--version"]) == 0
    assert capsys.readouterr().out == f"gsx {__version__}\n"


def test_plugins_lists_builtins(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["plugins"]) == 0
    out = capsys.readouterr().out
    assert re.search(r"scene:.*colmap \(gsx\).*demo \(gsx\)", out)
    assert "gs3d (gsx)" in out


def test_datasets_are_listed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["datasets", f"data_root={tmp_path}"]) == 0
    out = capsys.readouterr().out
    assert "demo: built-in scene, 1 of 1 scenes found" in out
    assert "mipnerf360: Mip-NeRF360, 0 of 9 scenes found" in out


def test_train_prints_the_report(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(words(tmp_path / "run", *FEW, "iterations=2")) == 0
    captured = capsys.readouterr()
    assert captured.out.strip() == str(tmp_path / "run" / "report.html")
    assert captured.err.count("LPIPS is not measured without weights") == 1
    assert captured.err.index("evaluating") < captured.err.index("LPIPS")
    assert re.search(r"step 2/2 .* it/s .* ETA .* loss .* PSNR .* splats .* MB", captured.err)
    assert "schedule of densify" in (tmp_path / "run" / "log.txt").read_text() + captured.err


def test_eval_render_export_report(run_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["eval", str(run_folder), "eval.zoom=[1,2]"]) == 0
    assert main(["render", str(run_folder), "--to", str(tmp_path / "views"), "--zoom", "2"]) == 0
    assert len(list((tmp_path / "views").glob("*.png"))) == 2
    assert main(["render", str(run_folder), "--orbit", str(tmp_path / "o.gif"), "--frames", "3"]) == 0
    assert (tmp_path / "o.gif").read_bytes()[:4] == b"GIF8"
    assert main(["export", str(run_folder), str(tmp_path / "x.ply")]) == 0
    assert "identical" in capsys.readouterr().err
    assert main(["report", str(run_folder)]) == 0
    assert main(["report", str(run_folder.parent)]) == 0


@pytest.mark.skipif(not available(), reason="no working compiler")
def test_eval_draws_by_the_path_of_training_and_names_it(
    run_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = Path(shutil.copytree(run_folder, tmp_path / "run"))
    environment = json.loads((folder / "environment.json").read_text())
    assert environment["rasterizer"] == "eager"  # so short a run is not compiled for
    (folder / "environment.json").write_text(json.dumps(environment | {"rasterizer": "compiled"}))
    monkeypatch.setattr("gsx.engine.backend.available", lambda device: True)  # nothing is compiled all the same:
    monkeypatch.setattr("gsx.engine.backend.compiled_kernel", lambda kernel, last, _: EAGER.kernel(kernel, *last))
    monkeypatch.setattr("gsx.engine.compiled.available", lambda device: False)
    monkeypatch.setattr("gsx.experiments.runs.rasterizer_path.warm", lambda *_, **__: None)

    def evaluated(*overrides: str) -> tuple[str, str]:
        assert main(["eval", str(folder), *overrides]) == 0
        told = json.loads((folder / "evaluation.json").read_text())
        err = capsys.readouterr().err
        assert f"renders/s ({told['render_path']})" in err
        assert f"at training size, {told['render_path']} path" in (folder / "report.html").read_text()
        return told["render_path"], err

    path, told = evaluated()
    assert path == "compiled"
    assert "renders/s are measured with the compiled path; the" in told
    path, told = evaluated("eval.zoom=[1,2]")
    assert (path, "are measured with" in told) == ("compiled", False)
    path, told = evaluated("rasterizer.path=eager")
    assert path == "eager"
    assert re.search(r"renders/s are measured with the eager path; the [\d.]+ of .* before \(compiled path\)", told)


@pytest.mark.parametrize("verb", VERBS)
@pytest.mark.parametrize("asked", ["--help", "-h"])
def test_every_verb_prints_its_own_help(verb: str, asked: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as end:
        main([verb, asked])
    told = capsys.readouterr().out
    assert end.value.code == 0
    assert told.startswith(f"usage: gsx {verb}")
    assert "start here" not in told, "this is the help of gsx"


def test_help_of_a_verb_does_not_import_torch() -> None:
    code = "import sys; from gsx.cli import VERBS\nfor verb in VERBS:\n try: VERBS[verb](['--help'])\n"
    code += " except SystemExit: pass\nsys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, check=False).returncode == 0


@pytest.mark.parametrize("name", ["x.ksplat", "x.splat", "x", "x.ply.gz"])
def test_only_what_can_be_written_is_exported(name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["export", str(tmp_path), str(tmp_path / name)]) == 2
    told = capsys.readouterr().err
    assert f"{name} is not written: gsx writes .compressed.ply, .ply, .spz, .sog, .glb, .html alone" in told
    assert len(told.splitlines()) == 1


def test_config_can_be_printed(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["scene=colmap", "--cfg", "job"]) == 0
    assert "max_reprojection_px" in capsys.readouterr().out


def test_flags_and_words_come_in_any_order(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["scene=colmap", "--cfg", "job", "seed=7", "--resolve"]) == 0
    assert "seed: 7\n" in capsys.readouterr().out


def test_values_that_follow_from_others_can_be_printed(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["scene=colmap", "backbone=octree_scaffold", "budget=quick", "--cfg", "job", "--resolve"]) == 0
    printed = capsys.readouterr().out.splitlines()
    assert "length: 40000" in printed
    assert "iterations: 2000" in printed


def test_hydra_s_own_help_is_shown(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["--hydra-help"])
    assert "Hydra" in capsys.readouterr().out


def test_completion_can_be_installed(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["-sc", "install=bash"]) == 0
    assert "complete " in capsys.readouterr().out


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no device that is always full")
@pytest.mark.parametrize("unbuffered", ["", "1"])
def test_text_that_cannot_be_written_is_one_sentence(unbuffered: str) -> None:
    environment = os.environ | {"PYTHONUNBUFFERED": unbuffered}
    with Path("/dev/full").open("w") as full:
        ended = subprocess.run(
            [*GSX, "--help"], stdout=full, stderr=subprocess.PIPE, text=True, check=False, env=environment
        )
    assert ended.returncode == 2
    assert [line[:8] for line in ended.stderr.splitlines()] == ["gsx: No "], ended.stderr


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no device that is always full")
@pytest.mark.parametrize("asked", ["--cfg job", "plugins"])
def test_text_of_any_command_that_cannot_be_written_is_one_sentence(
    asked: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    with TextIOWrapper(Path("/dev/full").open("wb", buffering=0), write_through=True) as full:
        monkeypatch.setattr(sys, "stdout", full)
        assert main(asked.split()) == 2
    assert [line[:8] for line in capsys.readouterr().err.splitlines()] == ["gsx: No "]


def test_names_of_files_are_written_whatever_letters_there_are(monkeypatch: pytest.MonkeyPatch) -> None:
    cases = {"ascii": (b"l\\xe4ufe-\\u65e5\n", ""), "utf-8": ("l\xe4ufe-\u65e5".encode() + b"\xe4\n", "\udce4")}
    for encoding, (expected, no_text) in cases.items():  # a byte that is no text
        with TextIOWrapper(written := BytesIO(), encoding=encoding, write_through=True) as output:
            monkeypatch.setattr(sys, "stdout", output)
            assert main(["--version"]) == 0
            output.write(f"l\xe4ufe-\u65e5{no_text}\n")
            assert written.getvalue().endswith(expected)


def test_a_reader_that_has_seen_enough_is_no_error() -> None:
    read, write = os.pipe()
    os.close(read)
    ended = subprocess.run([*GSX, "--help"], stdout=write, stderr=subprocess.PIPE, text=True, check=False)
    os.close(write)
    assert (ended.returncode, ended.stderr) == (141, "")


def test_a_reader_that_has_seen_enough_of_a_configuration_is_no_error(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    read, write = os.pipe()
    os.close(read)
    with open(write, "w") as unread:
        monkeypatch.setattr(sys, "stdout", unread)
        assert main(["--cfg", "job"]) == 141
    assert capsys.readouterr().err == ""


@pytest.fixture(scope="module")
def multirun(tmp_path_factory: pytest.TempPathFactory) -> Multirun:
    """The outputs of a run and of a multirun over two more, started where modules have the names of libraries."""
    folder = tmp_path_factory.mktemp("multirun")
    for name in ("torch", "pluggy", "numpy"):
        (folder / f"{name}.py").write_text("raise SystemExit('mine')")
    few = [*OVERRIDES, *FEW, "iterations=1", f"output={folder / 'out'}"]
    sweep = [*GSX, "-m", *few, "backbone=gs3d,mip_splatting"]
    with pytest.MonkeyPatch.context() as patched:
        patched.setenv("GSX_CACHE", str(tmp_path_factory.mktemp("cache")))
        assert main(few) == 0
        return folder / "out", subprocess.run(sweep, capture_output=True, text=True, check=False, cwd=folder)


def test_multirun_makes_a_run_for_every_combination(multirun: Multirun) -> None:
    output, ended = multirun
    assert ended.returncode == 0, ended.stderr
    runs = sorted(path.parts[-3] for path in output.glob("*/*/*/evaluation.json"))
    assert runs == ["gs3d", "gs3d", "mip_splatting"]  # one of them is from before
    left = {path.name for path in output.parent.iterdir()}
    assert left == {"out", "torch.py", "pluggy.py", "numpy.py"}, "Hydra left files of its own"


def test_a_multirun_ends_with_one_report_over_its_runs(multirun: Multirun) -> None:
    output, ended = multirun
    report = Path(ended.stdout.splitlines()[-1])
    assert report.name == "report.html"
    assert output / "sweeps" in report.parents
    rows = list(csv.DictReader((report.parent / "report.csv").read_text().splitlines()))
    assert [row["backbone"] for row in rows] == ["gs3d", "mip_splatting"]  # not the earlier run
    assert all((report.parent / row["run"] / "config.yaml").is_file() for row in rows)
    assert 'href="../../demo/' in report.read_text()


def test_modules_in_the_current_folder_are_not_taken_for_libraries(multirun: Multirun) -> None:
    _, ended = multirun
    assert (ended.returncode, "mine" in ended.stderr) == (0, False)


def test_a_mistake_in_a_multirun_is_refused_before_it_starts(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["-m", "stpes=5", "seed=0,1"]) == 2
    assert "Unknown key 'stpes'" in capsys.readouterr().err


def test_a_wrong_value_in_a_multirun_is_kept_nowhere(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    address = "tracker.mlflow.uri='https://me:secret@host'"
    assert main(["-m", "seed=0,1", "tracker=[mlflow]", address, f"output={tmp_path / 'out'}"]) == 2
    assert "holds a password" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def one_image_scene(folder: Path) -> Path:
    import pycolmap

    options = pycolmap.SyntheticDatasetOptions()
    options.num_frames_per_rig, options.num_rigs, options.num_cameras_per_rig = 1, 1, 1
    reconstruction = pycolmap.synthesize_dataset(options)
    (folder / "sparse" / "0").mkdir(parents=True)
    reconstruction.write_binary(folder / "sparse" / "0")
    (folder / "images").mkdir()
    for image in reconstruction.images.values():
        camera = image.camera
        write_image(folder / "images" / image.name, torch.rand(3, camera.height, camera.width))
    return folder


def synthetic(folder: Path, points: int = 50) -> Path:
    """A COLMAP scene of four photographs."""
    import pycolmap

    options = pycolmap.SyntheticDatasetOptions()
    options.num_frames_per_rig, options.num_rigs, options.num_cameras_per_rig = 4, 1, 1
    options.num_points3D = points
    reconstruction = pycolmap.synthesize_dataset(options)
    (folder / "sparse" / "0").mkdir(parents=True)
    reconstruction.write_binary(folder / "sparse" / "0")
    for image in reconstruction.images.values():
        path = folder / "images" / image.name
        path.parent.mkdir(parents=True, exist_ok=True)
        write_image(path, torch.rand(3, image.camera.height // 8, image.camera.width // 8))
    return folder


def resized_photo(folder: Path) -> Path:
    """One photograph has another shape than its camera."""
    write_image(next((folder / "images").rglob("*.png")), torch.rand(3, 50, 50))
    return folder


def strange_camera(folder: Path) -> Path:
    """The first camera has a model number that no COLMAP knows."""
    path = folder / "sparse" / "0" / "cameras.bin"
    data = bytearray(path.read_bytes())
    data[12:16] = (77).to_bytes(4, "little")  # count u64, id i32, then the model i32
    path.write_bytes(bytes(data))
    return folder


def stopped_run(folder: Path) -> Path:
    """An interrupted tiny run."""
    logging.getLogger("gsx").handlers.clear()  # of an earlier test, on a stream that is closed by now
    tiny_run(folder, [*FEW, "iterations=2"], stop_after=1)
    return folder


def truncated(folder: Path) -> Path:
    """The only checkpoint is cut off."""
    path = next((folder / "checkpoints").glob("*.safetensors"))
    path.write_bytes(path.read_bytes()[:1000])
    return folder


def empty_folder(folder: Path) -> Path:
    folder.mkdir()
    return folder


def folder_of_text(folder: Path) -> Path:
    folder.mkdir()
    (folder / "a.txt").write_text("no picture")
    return folder


def broken_ply(path: Path) -> Path:
    path.write_bytes(b"ply\nformat binary_little_endian 1.0\n")
    return path


BAD = {
    "missing folder": lambda t: ["scene=colmap", f"scene.path={t / 'nowhere'}"],
    "no path": lambda t: ["scene=colmap"],
    "empty folder": lambda t: ["scene=colmap", f"scene.path={empty_folder(t / 'e')}"],
    "no photos": lambda t: ["scene=photos", f"scene.path={folder_of_text(t / 'p')}"],
    "one image": lambda t: ["scene=colmap", f"scene.path={one_image_scene(t / 's')}"],
    "no transforms": lambda t: ["scene=blender", f"scene.path={empty_folder(t / 'b')}"],
    "unknown split": lambda t: ["scene=colmap", "scene.split=sometimes", f"scene.path={one_image_scene(t / 's')}"],
    "unknown verb": lambda t: ["trian"],
    "unknown flag": lambda t: ["--zoom"],
    "typo in key": lambda t: ["iteratoins=5"],
    "not a run": lambda t: ["resume", str(empty_folder(t / "r"))],
    "resume a splat file": lambda t: ["resume", "point_cloud.ply"],
    "eval nothing": lambda t: ["eval"],
    "report of nothing": lambda t: ["report", str(t / "nowhere")],
    "scenes of nothing": lambda t: ["scenes"],
    "demo with a folder": lambda t: [f"scene.path={empty_folder(t / 'd')}"],
    "one weights file": lambda t: words(t / "run", "metrics.lpips.trunk=x.pth"),
    "unreadable weights": lambda t: words(t / "run", "metrics.lpips.trunk=x.pth", "metrics.lpips.head=y.pth"),
    "override cut off": lambda t: ["-m", "seed=0,1", "eval.zoom=[1"],
    "another group on resume": lambda t: ["resume", str(stopped_run(t / "run")), "scene=colmap"],
    "list cut off on eval": lambda t: ["eval", str(stopped_run(t / "run")), "eval.zoom=[1,2"],
    "truncated checkpoint": lambda t: ["resume", str(truncated(stopped_run(t / "run")))],
    "zero points": lambda t: ["scene=colmap", f"scene.path={synthetic(t / 's', points=0)}"],
    "empty split": lambda t: ["scene=colmap", "scene.split=every:1", f"scene.path={synthetic(t / 's')}"],
    "sizes disagree": lambda t: ["scene=colmap", f"scene.path={resized_photo(synthetic(t / 's'))}"],
    "unknown camera model": lambda t: ["scene=colmap", f"scene.path={strange_camera(synthetic(t / 's'))}"],
    "render at zoom 0": lambda t: ["render", str(t / "run"), "--zoom", "0"],
    "render at an endless zoom": lambda t: ["render", str(t / "run"), "--zoom", "1e308"],
    "render at no number": lambda t: ["render", str(t / "run"), "--zoom", "nan"],
    "render without end": lambda t: ["render", str(t / "run"), "--orbit", str(t / "o.gif"), "--frames", "9" * 400],
    "render at no speed": lambda t: ["render", str(t / "run"), "--orbit", str(t / "o.gif"), "--fps", "1e-300"],
    "export too closely": lambda t: ["export", str(t / "run"), "--bake", "1e308"],
    "compact without end": lambda t: ["compact", str(empty_folder(t / "run")), "--steps", "9" * 26],
    "bad device": lambda t: words(t / "run", "device=tpu"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_input_ends_in_one_sentence_and_exit_code_2(
    case: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = BAD[case](tmp_path)
    before = sorted(tmp_path.rglob("*"))
    assert main([*arguments]) == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert lines[-1].startswith(("gsx: ", "gsx "))
    assert "Traceback" not in "".join(lines)
    assert sorted(tmp_path.rglob("*")) == before, "something half-written is left"


def run_at_step(folder: Path, step: int) -> Path:
    """An interrupted tiny run of four steps."""
    logging.getLogger("gsx").handlers.clear()
    tiny_run(folder, [*FEW, "iterations=4"], stop_after=step)
    return folder


def without_checkpoints(folder: Path) -> Path:
    """As a run is that was killed before its first."""
    shutil.rmtree(folder / "checkpoints")
    return folder


def run_of_old(folder: Path) -> Path:
    """What makes a folder a run, and nothing else."""
    folder.mkdir()
    for name in ("config.yaml", "environment.json"):
        (folder / name).write_text("")
    return folder


TOLD: dict[str, tuple[Callable[[Path], list[str]], str]] = {
    "a value for a group": (
        lambda t: words(t / "run", "eval=3"),
        "eval is 3, but it is a group of settings",
    ),
    "nothing for a group": (lambda t: words(t / "run", "training=null"), "training is null, but it is a group"),
    "a value for a group in a group": (
        lambda t: words(t / "run", "training.exposure=3"),
        "training.exposure is 3, but it is a group of settings: give training.exposure.NAME=VALUE",
    ),
    "a word for a list": (lambda t: words(t / "run", "eval.zoom=abc"), "eval.zoom is 'abc'; give a list of numbers"),
    "a folder that is not first": (
        lambda t: ["preset=zoom_prior", str(empty_folder(t / "my photos"))],
        "/my photos' is a folder: put it first, `gsx '",
    ),
    "a folder after a flag": (lambda t: ["--cfg", "job", str(empty_folder(t / "one"))], "/one --cfg job`"),
    "a word that is nothing": (lambda t: ["minutes=10", "nothing"], "'nothing' is neither a setting (KEY=VALUE) nor a"),
    "a setting with dashes": (lambda t: ["--iterations=20"], "settings have no dashes, write iterations=20"),
    "dashes and a space": (lambda t: ["--iterations", "20"], "Settings have no dashes: iterations=VALUE."),
    "dashes with a folder": (lambda t: [str(t), "--minutes=10"], "settings have no dashes, write minutes=10"),
    "dashes in an evaluation": (
        lambda t: ["eval", str(t), "--eval.zoom=[1,2]"],
        "gsx eval: '--eval.zoom=[1,2]': settings have no dashes, write eval.zoom=[1,2]",
    ),
    "a table with a typo": (lambda t: ["+experimnt=x"], "Unknown key 'experimnt'. Did you mean 'experiment'?"),
    "a plus too many": (lambda t: ["+iterations=5"], "'+iterations': iterations has a value already, leave out the +"),
    "a typo that is printed": (lambda t: ["--cfg", "job", "backbone=gs3"], "Unknown backbone 'gs3'. Choose from"),
    "an unknown table that is printed": (
        lambda t: ["experiment=no", "--cfg", "job"],
        "Unknown experiment 'no'. Choose",
    ),
    "nothing near": (lambda t: ["explain", "nonsense"], "Unknown key 'nonsense'. `gsx --cfg job` lists all keys."),
    "a key of tables": (lambda t: ["explain", "experiment.seeds"], "is a setting of +experiment="),
    "a scene without a folder": (
        lambda t: ["scene=colmap", "iterations=10"],
        "scene.path is empty: give scene.path=FOLDER",
    ),
    "a dataset that is not there": (
        lambda t: ["dataset=bungeenerf", "dataset.scene=rome", f"data_root={t}"],
        "does not exist: check data_root; `gsx datasets bungeenerf data_root=FOLDER` lists the files",
    ),
    **{
        f"{verb} of nothing": (lambda t, verb=verb: [verb, "nowhere"], "'nowhere' does not exist: give a run folder")
        for verb in ("eval", "export", "render", "view", "compact", "resume", "photographs")
    },
    "a suffix with a typo": (
        lambda t: ["export", str(t), str(t / "model.htm")],
        "model.htm is not written: gsx writes .compressed.ply, .ply, .spz, .sog, .glb, .html alone. Did you mean",
    ),
    "a value for hydra": (lambda t: words(t / "run", "hydra=3"), "give hydra.NAME=VALUE or hydra/GROUP=NAME"),
    "several values for one run": (
        lambda t: words(t / "run", "scene.split=files:a.txt,b.txt"),
        "gsx -m trains once for each; 'scene.split=\"files:a.txt,b.txt\"' is one text",
    ),
    "a wrong choice among others": (
        lambda t: ["-m", "backbone=gs3d,nope", f"output={t / 'out'}"],
        "Unknown backbone 'nope'. Choose from",
    ),
    "a key that not all choices have": (
        lambda t: ["-m", "backbone=gs3d,scaffold", "backbone.sh_degree=2", f"output={t / 'out'}"],
        "Unknown key 'backbone.sh_degree'",
    ),
    "a report of nothing, elsewhere": (lambda t: ["report", str(t / "no"), "--to", str(t / "page")], "is no folder"),
    "fewer steps than taken": (
        lambda t: ["resume", str(run_at_step(t / "run", 3)), "iterations=2"],
        "is at step 3, iterations=2 is less",
    ),
    "a key without a value": (
        lambda t: ["resume", str(run_at_step(t / "run", 1)), "iterations"],
        "'iterations' has no value: write iterations=VALUE",
    ),
    "a run without a checkpoint": (
        lambda t: ["resume", str(without_checkpoints(run_at_step(t / "run", 1)))],
        "its run ended before the first one; train anew",
    ),
    "a folder that is a file": (
        lambda t: ["compact", str(run_at_step(t / "run", 1)), "--to", str(broken_ply(t / "x.ply"))],
        "is a file, not a folder for a run",
    ),
    "a sweep of nothing": (
        lambda t: ["-m", "seed=range(5,5)", f"output={t / 'out'}"],
        "seed=range(5,5) sweeps no value: give at least one",
    ),
    "a sweep over files": (
        lambda t: ["-m", "backbone=glob(gs*)", f"output={t / 'out'}"],
        "cannot be swept: glob chooses among files of the configuration: name them",
    ),
    "a sweep into one folder": (
        lambda t: ["-m", "seed=0,1", f"folder={t / 'out'}"],
        "is for one run, and these are several: give output=FOLDER",
    ),
    "a sweep with a record of its own": (
        lambda t: ["-m", "seed=0,1", f"hydra.sweep.dir={t / 'out'}"],
        "a multirun's record goes below output/sweeps; give output=FOLDER",
    ),
    "a sweep that is shown": (
        lambda t: ["-m", "--cfg", "job", "seed=0,1"],
        "-m trains several runs, --cfg trains none: leave one of them out",
    ),
    "a launcher of no processes": (
        lambda t: ["-m", "seed=0,1", "hydra/launcher=processes", "hydra.launcher.n_jobs=0", f"output={t / 'out'}"],
        "hydra.launcher.n_jobs is 0; give a number of processes",
    ),
    "a folder for a movie": (
        lambda t: ["render", str(t / "run"), "--orbit", str(t / "a.gif"), "--to", str(t / "to")],
        "--to FOLDER is for pictures",
    ),
    "frames of no orbit": (lambda t: ["render", str(t / "run"), "--frames", "3"], "go with --orbit FILE"),
    "axes of no spz": (lambda t: ["export", str(t), str(t / "x.ply"), "--axes", "rdf"], "are for .spz files"),
    "a choice that is there twice": (
        lambda t: words(t / "run", "iterations=1", "augmenter=[upscale,bootstrap,upscale]"),
        "augmenter=[upscale,bootstrap,upscale] names upscale twice: leave one out",
    ),
    "a word that no scene knows": (
        lambda t: words(t / "run", "iterations=1", "scene.masks=alpa"),
        "scene.masks is 'alpa', use one of auto, alpha, none. Did you mean 'alpha'?",
    ),
    "a filter that no scene knows": (
        lambda t: words(t / "run", "iterations=1", "scene.resize_filter=cubic"),
        "scene.resize_filter is 'cubic', use one of bicubic, area, lanczos. Did you mean 'bicubic'?",
    ),
    "datasets nowhere": (
        lambda t: ["datasets", f"data_root={t / 'no'}"],
        "is not a folder: give the folder that",
    ),
    "more steps of an evaluation": (
        lambda t: ["eval", str(run_of_old(t / "my run")), "iterations=40"],
        "/my run shows: leave it out; gsx resume '",
    ),
    "another seed for photographs": (
        lambda t: ["photographs", str(run_of_old(t / "run")), "seed=4"],
        "'seed=4' is for training",
    ),
    "training from a run": (lambda t: [str(run_of_old(t / "my run"))], "/my run', gsx eval '"),
    "a home in the folder": (
        lambda t: [*OVERRIDES, "iterations=1", "folder='~/x'"],
        f"folder is '~/x', which would be below this folder: give folder={Path.home() / 'x'}",
    ),
    "compact with a place of its own": (
        lambda t: ["compact", str(run_of_old(t / "run")), f"output={t / 'o'}"],
        "--to FOLDER names the folder of the smaller run",
    ),
    "a photograph of no run": (lambda t: ["photographs"], "the following arguments are required: RUN. See"),
    "an export of no run": (lambda t: ["export"], "the following arguments are required: RUN|FILE. See"),
}


@pytest.mark.parametrize("case", TOLD)
def test_what_is_wrong_is_told_with_what_to_do(case: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    given, told = TOLD[case]
    arguments = given(tmp_path)
    before = sorted(tmp_path.rglob("*"))
    assert main([*arguments]) == 2
    assert told in capsys.readouterr().err
    assert sorted(tmp_path.rglob("*")) == before, "something half-written is left"


def test_an_unwritable_output_is_one_sentence(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "file").write_text("")
    assert main([*OVERRIDES, "iterations=1", f"output={tmp_path / 'file'}"]) == 2
    assert "choose a writable place" in capsys.readouterr().err


def test_points_that_are_not_numbers_are_dropped_and_counted(tmp_path: Path) -> None:
    from gsx.builtin import plugins
    from gsx.experiments.runs.compose import compose
    from gsx.experiments.runs.load_scene import load_scene

    path = synthetic(tmp_path / "s") / "sparse" / "0" / "points3D.bin"
    data = bytearray(path.read_bytes())
    data[16:24] = b"\xff" * 8  # count u64, id u64, then x as f64: all ones is a NaN
    path.write_bytes(bytes(data))
    scene = load_scene(compose(["scene=colmap", f"scene.path={tmp_path / 's'}"], plugins()))
    assert len(scene.points) == 49
    assert any("1 " in note and "finite" in note for note in scene.notes)


def test_a_full_disk_is_one_sentence_and_leaves_no_partial_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def full(number: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    assert main(words(tmp_path / "run", *FEW, "iterations=1")) == 2
    assert "No space left on device" in capsys.readouterr().err
    assert not list(tmp_path.rglob("*partial*"))


def test_ctrl_c_saves_a_checkpoint_and_says_how_to_resume(begin: Begin, tmp_path: Path) -> None:
    command = [*GSX, *words(tmp_path / "run", *FEW, "iterations=100000", "rasterizer=eager", "training.log_every=1")]
    process = begin(command, stderr=subprocess.PIPE, text=True)
    metrics, deadline = tmp_path / "run" / "metrics.jsonl", time.monotonic() + 120
    while not (metrics.exists() and metrics.read_text().count("\n") >= 2):
        assert time.monotonic() < deadline, "training did not begin"
        time.sleep(0.1)
    process.send_signal(signal.SIGINT)
    _, err = process.communicate(timeout=120)
    assert process.returncode == 130
    found = re.search(r"stopped at step (\d+); continue with: gsx resume (\S+)", err)
    assert found
    assert found.group(2) == str(tmp_path / "run")
    assert list((tmp_path / "run" / "checkpoints").glob(f"step_{int(found.group(1)):07d}.safetensors"))


@pytest.mark.parametrize("words", [["-m", "seed=0,1"], ["+experiment=table_real_world", "dataset=demo"]])
def test_slurm_is_refused_where_there_is_none(
    words: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    assert main([*words, "hydra/launcher=slurm", f"output={tmp_path / 'out'}"]) == 2
    assert "hydra/launcher=slurm: this machine has no Slurm (srun is not on the PATH)" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_a_launcher_that_fails_is_one_sentence(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def failing(self: object, job_overrides: object, initial_job_idx: int) -> None:
        raise RuntimeError("no such partition\nand more")

    from hydra._internal.core_plugins.basic_launcher import BasicLauncher

    monkeypatch.setattr(BasicLauncher, "launch", failing)
    assert main(["-m", "seed=0,1", "iterations=1", f"output={tmp_path}"]) == 2
    assert capsys.readouterr().err == (
        "gsx: the launcher failed (RuntimeError: no such partition): correct its settings, or run "
        "one after the other here with hydra/launcher=basic\n"
    )
    assert os.environ.get("HYDRA_FULL_ERROR") != "1"  # what other errors of this process print stays as it was


def test_help_of_a_folder_is_that_of_gsx(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([str(tmp_path), "--help"]) == 0
    assert capsys.readouterr().out.startswith("gsx trains")
    assert main(["train", "--help"]) == 2
    assert "`gsx FOLDER` train" in capsys.readouterr().err


def test_flags_are_not_abbreviated(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """`--t` does not run code that a folder names."""
    assert main(["resume", str(tmp_path), "--t"]) == 2
    assert "unrecognized arguments: --t" in capsys.readouterr().err
