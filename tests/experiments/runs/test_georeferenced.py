"""Runs on a scene in UTM coordinates: the model counts from an origin, what users see is in the scene's coordinates."""

import json
import logging
import math
import re
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import MagicMock

import numpy as np
import pycolmap
import pytest
import torch
from synthetic_colmap import synthesize, write_scene
from tiny import StopAfter, final_tensors

import gsx.api
from gsx.builtin import plugins
from gsx.cli.dispatch import main
from gsx.core.errors import InputError
from gsx.core.gaussians.quaternions import quaternions_of
from gsx.core.quality.metrics import psnr
from gsx.core.training.render import render
from gsx.core.training.run import Run
from gsx.experiments.runs.compose import compose
from gsx.experiments.runs.execute import execute
from gsx.experiments.runs.export import export
from gsx.experiments.runs.open import open_run, start
from gsx.experiments.runs.render_views import file_pictures, run_pictures
from gsx.experiments.runs.settings import Settings
from gsx.experiments.viewer.camera_path import CameraPath, Keyframe, posed, read_camera_path, write_camera_path
from gsx.experiments.viewer.pictures import RunModel
from gsx.formats.origin import in_words
from gsx.formats.ply import read_ply
from gsx.formats.splat_files import read_gaussians, write_gaussians
from gsx.formats.suffixes import suffix_of

UTM = torch.tensor([500_000.0, 5_400_000.0, 300.0], dtype=torch.float64)
WORDS = [
    "scene=colmap",
    "backbone=gs3d",
    "device=cpu",
    "eval.flight=false",
    "rasterizer=eager",
    "training.test_points=0",
]


@pytest.fixture(scope="module")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("GSX_CACHE", str(tmp_path_factory.mktemp("cache")))
        yield


def write(folder: Path, offset: torch.Tensor) -> list[str]:
    """A scene whose points lie within 1 of an offset, and the words that load it."""
    model = synthesize(frames=6)
    model.transform(pycolmap.Sim3d(1.0, pycolmap.Rotation3d(), offset.numpy()))
    write_scene(model, folder)
    return [*WORDS, f"scene.path={folder}"]


def trained(folder: Path, words: list[str], *more: str, stop: int | None = None) -> tuple[Run, Settings]:
    settings, loaded = compose([*words, f"folder={folder}", *more], plugins()), plugins()
    run = start(settings, loaded)
    with loaded.listening([] if stop is None else [StopAfter(stop)]):
        execute(run, settings, loaded)
    return run, settings


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory, cache: None) -> list[str]:
    return write(tmp_path_factory.mktemp("there"), UTM)


@pytest.fixture(scope="module")
def far(tmp_path_factory: pytest.TempPathFactory, scene: list[str]) -> tuple[Run, Settings]:
    return trained(tmp_path_factory.mktemp("runs") / "far", scene, "iterations=6")


def own_picture(run: Run) -> torch.Tensor:
    return render(run, run.scene.test[0].camera).image


def world(run: Run) -> torch.Tensor:
    """Means of the model in the scene's coordinates."""
    return run.backbone.explicit(None, 0).means.double() + torch.tensor(run.scene.origin, dtype=torch.float64)


def there(path: Path) -> torch.Tensor:
    """Positions of a PLY, as they are."""
    columns = read_ply(path)
    assert {str(columns[axis].dtype) for axis in "xyz"} == {"float64"}
    return torch.from_numpy(np.stack([columns[axis] for axis in "xyz"], 1))


def test_the_model_learns_what_the_unmoved_one_learns(far: tuple[Run, Settings], tmp_path: Path) -> None:
    run, _ = far
    (tmp_path / "here").mkdir()
    here, _ = trained(tmp_path / "run", write(tmp_path / "here", torch.zeros(3).double()), "iterations=6")
    assert all(
        abs(ours - theirs) < 5 and ours == round(ours)
        for ours, theirs in zip(run.scene.origin, UTM.tolist(), strict=True)
    )
    assert here.scene.origin == (0.0, 0.0, 0.0)
    assert psnr(own_picture(run), own_picture(here)) > 45
    facts = json.loads((run.folder / "environment.json").read_text())
    assert facts["scene"]["origin"] == list(run.scene.origin)


def test_the_runs_own_splat_file_is_in_the_coordinates_of_the_scene(far: tuple[Run, Settings]) -> None:
    run, _ = far
    assert torch.equal(there(run.folder / "point_cloud.ply"), world(run))
    again = read_gaussians(run.folder / "point_cloud.ply", origin=run.scene.origin)
    assert torch.equal(again.means, run.backbone.explicit(None, 0).means)


@pytest.mark.parametrize(
    ("suffix", "steps"), [(".ply", 1e-6), (".glb", 1e-6), (".compressed.ply", 0.5), (".local.compressed.ply", 0.01)]
)
def test_exports_hold_the_coordinates_of_the_scene(
    far: tuple[Run, Settings], tmp_path: Path, suffix: str, steps: float, caplog: pytest.LogCaptureFixture
) -> None:
    """Rows of compressed files come in another order."""
    run, _ = far
    path = tmp_path / f"model{suffix}"
    with caplog.at_level(logging.INFO):
        export(run, path, local="local" in suffix)
    gaussians, origin = gsx.api.read_around(path)
    found = gaussians.means.double() + torch.tensor(origin, dtype=torch.float64)
    distance = torch.cdist(found - UTM, world(run) - UTM)
    assert distance.min(1).values.max() < steps
    assert distance.min(0).values.max() < steps
    told = {
        ".ply": "read only floats round",
        ".glb": "node adds",
        ".compressed.ply": "floats, rounded to steps of 0.5 units",
    }
    words = "as its comment states" if "local" in suffix else told[suffix_of(path)]
    assert words in caplog.text
    assert in_words(run.scene.origin) in caplog.text


def test_spz_cannot_hold_them_and_says_what_can(far: tuple[Run, Settings], tmp_path: Path) -> None:
    run, _ = far
    with pytest.raises(
        InputError, match=rf"--local .* {re.escape(in_words(run.scene.origin))}, or export .ply or .glb"
    ):
        export(run, tmp_path / "model.spz")
    assert not (tmp_path / "model.spz").exists()
    export(run, tmp_path / "model.spz", local=True)
    assert read_gaussians(tmp_path / "model.spz").means.abs().max() < 50


def test_gsx_export_reads_its_file_again(
    far: tuple[Run, Settings], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run, _ = far
    for name, words in (("a.ply", []), ("b.ply", ["--local"]), ("c.glb", []), ("d.spz", ["--local"])):
        assert main(["export", str(run.folder), str(tmp_path / name), *words]) == 0
        told = next(line for line in capsys.readouterr().err.splitlines() if "read back and rendered" in line)
        loss = float(told.split("rendered: ")[1].split()[0])
        assert loss > (30 if name == "d.spz" else 90), told


def test_files_are_converted_in_their_coordinates(far: tuple[Run, Settings], tmp_path: Path) -> None:
    run, _ = far
    assert main(["export", str(run.folder / "point_cloud.ply"), str(tmp_path / "model.glb")]) == 0
    assert main(["export", str(tmp_path / "model.glb"), str(tmp_path / "model.ply")]) == 0
    torch.testing.assert_close(there(tmp_path / "model.ply"), world(run), atol=1e-6, rtol=0)
    assert main(["export", str(tmp_path / "model.glb"), str(tmp_path / "model.spz")]) == 2


def keyframe(run: Run) -> Keyframe:
    """The test view in the coordinates of the scene."""
    camera = run.scene.test[0].camera
    position = camera.centre.double() + torch.tensor(run.scene.origin, dtype=torch.float64)
    wxyz = quaternions_of(camera.rotation.T.double()[None])[0]
    fov = 2 * math.atan(camera.height / (2 * camera.fy))
    return Keyframe(0.0, tuple(position.tolist()), tuple(wxyz.tolist()), fov)


def test_camera_paths_are_in_the_coordinates_of_the_scene(far: tuple[Run, Settings], tmp_path: Path) -> None:
    run, settings = far
    frame = keyframe(run)
    write_camera_path(tmp_path / "path.json", CameraPath((64, 48), 24.0, (frame,)))
    (camera,) = read_camera_path(tmp_path / "path.json").cameras()
    own = render(run, posed([a - b for a, b in zip(frame.position, run.scene.origin, strict=True)], frame.wxyz,
                            frame.fov, 64, 48)).image  # fmt: skip
    assert own.std() > 1e-4
    assert psnr(run_pictures(run, settings)(camera), own) > 90
    plain = file_pictures(run.folder / "point_cloud.ply")(camera)
    local = tmp_path / "local.ply"
    export(run, local, local=True)
    assert psnr(file_pictures(local)(camera), plain) > 90
    assert plain.std() > 1e-4


def test_the_viewer_saves_and_shows_coordinates_of_the_scene(far: tuple[Run, Settings], tmp_path: Path) -> None:
    pytest.importorskip("viser")
    from gsx.experiments.viewer.screens import Screen
    from gsx.experiments.viewer.server import Panel, pose_of

    run, _ = far
    viewer, screen = MagicMock(), Screen(lambda image: None)
    viewer.frames.model, viewer.folder, viewer.keyframes, viewer.status = RunModel(run), tmp_path, [], "now"
    panel, pose = Panel(viewer, MagicMock(), screen), pose_of(run.scene.test[0], 64)
    panel.moved(SimpleNamespace(position=pose.position, wxyz=pose.wxyz, fov=pose.fov, image_width=64, image_height=48))
    panel.add_keyframe()
    panel.save_path()
    (saved,) = read_camera_path(tmp_path / "camera_path_1.json").keyframes
    assert saved.position == pytest.approx(keyframe(run).position, abs=1e-6)
    assert f"at {saved.position[0]:.3f}, {saved.position[1]:.3f}" in panel.state.content


def test_a_file_of_the_scene_is_evaluated_where_it_is(
    far: tuple[Run, Settings], scene: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """In doubles, around the stated origin, and around (0, 0, 0) where another program has dropped the comment."""
    run, _ = far
    before = json.loads((run.folder / "evaluation.json").read_text())["psnr"]
    export(run, tmp_path / "local.ply", local=True)
    write_gaussians(tmp_path / "bare.ply", read_gaussians(tmp_path / "local.ply", origin=run.scene.origin))
    words = [word for word in scene if not word.startswith("backbone")]
    for name, warns in ((run.folder / "point_cloud.ply", False), ("local.ply", False), ("bare.ply", True)):
        folder = tmp_path / f"of {Path(name).stem}"
        assert main(["eval", str(tmp_path / name), *words, f"folder={folder}"]) == 0
        assert json.loads((folder / "evaluation.json").read_text())["psnr"] == pytest.approx(before, abs=0.01)
        assert ("reading positions relative to that" in capsys.readouterr().err) is warns


def test_python_draws_a_file_by_cameras_of_the_run(far: tuple[Run, Settings]) -> None:
    run, _ = far
    file = gsx.api.load(run.folder / "point_cloud.ply", origin=run.scene.origin)
    assert psnr(file.render(run.scene.test[0], run.scene.background), own_picture(run)) > 60


def test_a_run_goes_on_to_the_same_bits(scene: list[str], tmp_path: Path) -> None:
    whole, _ = trained(tmp_path / "whole", scene, "iterations=4", "scene.unit=0.7")
    trained(tmp_path / "parts", scene, "iterations=4", "scene.unit=0.7", stop=2)
    loaded = plugins()
    run, settings = open_run(tmp_path / "parts", loaded, training=True)
    assert run.step == 2
    execute(run, settings, loaded)
    ours, theirs = final_tensors(tmp_path / "parts"), final_tensors(whole.folder)
    assert all(torch.equal(ours[name], value) for name, value in theirs.items())
    assert run.scene.origin == whole.scene.origin


def test_a_run_of_before_origins_opens_as_it_was(far: tuple[Run, Settings], tmp_path: Path) -> None:
    """Its checkpoint states none, and its model is in the scene's coordinates."""
    run, _ = far
    sidecar = sorted((run.folder / "checkpoints").glob("*.json"))[-1]
    content = json.loads(sidecar.read_text())
    old = {key: value for key, value in content.items() if key != "origin"}
    try:
        sidecar.write_text(json.dumps(old))
        again, _ = open_run(run.folder, plugins())
    finally:
        sidecar.write_text(json.dumps(content))
    assert again.scene.origin == (0.0, 0.0, 0.0)
    assert float(again.scene.train[0].camera.centre[1]) > 5e6
    assert float(again.scene.points.positions[0, 1]) > 5e6
