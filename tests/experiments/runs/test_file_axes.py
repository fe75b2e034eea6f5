"""Which axes a splat file is taken to hold: what it states, what is given, what fits the scene, what SPZ specifies."""

import logging
import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from tiny import tiny_settings

from gsx.builtin import plugins
from gsx.cli.dispatch import main
from gsx.core.data.camera import Camera, look_at
from gsx.core.data.scene import PointCloud, Scene, View
from gsx.core.errors import ConfigError
from gsx.core.gaussians.splats import Gaussians
from gsx.core.rasterizer import RasterSettings
from gsx.core.training.render import render_gaussians
from gsx.experiments.run_folder.run_key import composition_key, scene_stamp
from gsx.experiments.runs.file_axes import Fit, better, fit, in_axes_of
from gsx.experiments.runs.load_scene import load_scene
from gsx.experiments.runs.open import start
from gsx.formats.splat_files import SpzForm, read_splats, write_gaussians
from gsx.formats.turned import to_training_axes
from gsx.scenes.points import GREY


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    """The built-in scene, whose cameras stand around and above a table."""
    return load_scene(tiny_settings(tmp_path_factory.mktemp("scene") / "run"))


def at(means: torch.Tensor) -> Gaussians:
    """Small grey splats."""
    count = len(means)
    return Gaussians(
        means=means,
        log_scales=torch.full((count, 3), -4.0),
        quats=torch.tensor([[1.0, 0, 0, 0]]).repeat(count, 1),
        opacity_logits=torch.zeros(count),
        sh_dc=torch.zeros(count, 3),
        sh_rest=torch.zeros(count, 0, 3),
    )


@pytest.fixture
def model(scene: Scene) -> Gaussians:
    """Splats a little beside the scene's points."""
    return at(scene.points.positions + 0.01)


@pytest.mark.parametrize(("written", "other"), [("rdf", "rub"), ("rub", "rdf")])
def test_axes_that_fit_the_scene_are_taken_and_logged(
    scene: Scene, model: Gaussians, tmp_path: Path, caplog: pytest.LogCaptureFixture, written: str, other: str
) -> None:
    caplog.set_level(logging.INFO, "gsx")
    write_gaussians(tmp_path / "a.spz", model, spz=SpzForm(axes=written))
    read = in_axes_of(scene, read_splats(tmp_path / "a.spz"))
    torch.testing.assert_close(read.means.float(), model.means, atol=1 / 4096, rtol=0)
    assert f"axes {written} fit the scene (" in caplog.text
    assert f"axes={other} chooses the others" in caplog.text


@pytest.mark.parametrize(("given", "stated"), [("rub", 3), ("auto", 4)])
def test_given_and_stated_axes_are_not_put_to_the_scene(
    scene: Scene, model: Gaussians, tmp_path: Path, caplog: pytest.LogCaptureFixture, given: str, stated: int
) -> None:
    """The file is the model turned over, and says that it is in rub, or the user does."""
    caplog.set_level(logging.INFO, "gsx")
    turned = to_training_axes(model, "rub")
    write_gaussians(tmp_path / "a.spz", turned, spz=SpzForm(version=stated))
    read = in_axes_of(scene, read_splats(tmp_path / "a.spz", given))
    torch.testing.assert_close(read.means.float(), turned.means, atol=1 / 4096, rtol=0)
    assert f"a.spz: axes rub, as {'the settings say' if given == 'rub' else 'the file states'}" in caplog.text


def test_what_the_scene_leaves_open_is_taken_as_specified(
    scene: Scene, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Splats and points on the x axis, about which the two systems are turned."""
    line = torch.linspace(-0.5, 0.5, 50)[:, None] * torch.tensor([1.0, 0.0, 0.0])
    along = replace(scene, points=PointCloud(positions=line, colours=torch.zeros(50, 3, dtype=torch.uint8)))
    write_gaussians(tmp_path / "a.spz", at(line))
    in_axes_of(along, read_splats(tmp_path / "a.spz"))
    assert "axes rub (SPZ standard); file and scene do not decide" in caplog.text
    assert "compare with axes=rdf" in caplog.text


def test_the_measures_by_hand(scene: Scene) -> None:
    camera = scene.train[0].camera
    forward, right = camera.rotation[2], camera.rotation[0]
    ahead = camera.centre + 2 * forward
    spots = torch.stack([ahead, camera.centre - 2 * forward, ahead + 50 * right, ahead]).float()
    points = PointCloud((ahead + 0.25 * right)[None].repeat(10, 1).float(), torch.zeros(10, 3, dtype=torch.uint8))
    one = replace(scene, train=scene.train[:1], test=[], points=points)
    found = fit(at(spots), one)
    assert (found.in_view, found.distance) == (0.5, pytest.approx(0.25, abs=1e-5))


def test_random_points_say_nothing_and_views_decide(scene: Scene) -> None:
    camera = scene.train[0].camera
    spots = (camera.centre + 2 * camera.rotation[2])[None].float()
    grey = PointCloud(scene.points.positions, torch.full_like(scene.points.colours, GREY))
    one = replace(scene, train=scene.train[:1], test=[], points=grey)
    fits = {"rub": fit(at(spots), one), "rdf": fit(at(spots + 100), one)}
    assert math.isnan(fits["rub"].distance)
    assert better(fits) == "rub"


@pytest.mark.parametrize(
    ("first", "second", "best"),
    [
        ((0.6, 0.1), (0.6, 0.2), "rub"),
        ((0.6, 0.2), (0.6, 0.1), "rdf"),
        ((0.2, 0.1), (0.6, 0.2), "rub"),  # points say more than views
        ((0.2, 0.1), (0.6, 0.12), "rdf"),
        ((0.5, 0.1), (0.55, 0.12), None),
        ((0.04, 0.1), (0.01, 9.0), None),
    ],
)
def test_points_decide_before_views(first: tuple[float, float], second: tuple[float, float], best: str | None) -> None:
    fits = {name: Fit(in_view=a, distance=b) for name, (a, b) in {"rub": first, "rdf": second}.items()}
    assert better(fits) == best


def test_photos_decide_where_points_and_views_do_not(
    scene: Scene, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """A wall of splats before each camera has the colour of the photo in axes rdf; turned over it stays in view."""
    caplog.set_level(logging.INFO, "gsx")
    camera = look_at((0.0, 0.0, -4.0), (0.0, 0.0, 0.0), up=(0.0, -1.0, 0.0), fov_x=0.6, width=40, height=40)
    two = replace(at(torch.tensor([[0.0, 0.4, 0.0], [0.0, -0.4, 0.0]])), log_scales=torch.full((2, 3), -1.0))
    bright = replace(two, sh_dc=torch.tensor([[3.0] * 3, [-3.0] * 3]), opacity_logits=torch.full((2,), 6.0))
    picture = render_gaussians(bright, camera, RasterSettings(path="eager"), torch.zeros(3)).mul(255).to(torch.uint8)

    class Photo:
        def image(self, camera: Camera) -> torch.Tensor:
            return picture

        def max_zoom(self, camera: Camera) -> float:
            return 1.0

    none = PointCloud(torch.zeros(0, 3), torch.zeros(0, 3, dtype=torch.uint8))
    one = replace(scene, train=[View("a", camera, Photo())], test=[], points=none, background=torch.zeros(3))
    write_gaussians(tmp_path / "a.spz", bright, spz=SpzForm(axes="rdf"))
    read = in_axes_of(one, read_splats(tmp_path / "a.spz"))
    assert read.means[0, 1].item() == pytest.approx(0.4, abs=1 / 4096)
    assert "axes rdf fit the scene (rub: 100.0% in view, thumbnails" in caplog.text


def test_a_glb_that_would_fit_turned_over_is_named_with_a_remedy_that_works(
    scene: Scene, model: Gaussians, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    write_gaussians(tmp_path / "a.glb", to_training_axes(model, "rub"))
    in_axes_of(scene, read_splats(tmp_path / "a.glb"))
    assert "a.glb: the splats would fit the scene better in axes rub" in caplog.text
    assert "export it with y up" in caplog.text
    assert "axes=" not in caplog.text  # which glTF refuses


def test_a_ply_that_would_fit_turned_over_is_named_and_left(
    scene: Scene, model: Gaussians, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    turned = to_training_axes(model, "rub")
    write_gaussians(tmp_path / "a.ply", turned)
    assert torch.equal(in_axes_of(scene, read_splats(tmp_path / "a.ply")).means, turned.means)
    assert "a.ply: the splats would fit the scene better in axes rub" in caplog.text
    assert "try axes=rub" in caplog.text
    caplog.clear()
    write_gaussians(tmp_path / "a.ply", model)
    in_axes_of(scene, read_splats(tmp_path / "a.ply"))
    assert not caplog.text


@pytest.mark.parametrize("words", [[], ["axes=rub"]])
def test_a_run_begins_with_the_file_in_the_axes_that_fit_or_are_given(
    scene: Scene, model: Gaussians, tmp_path: Path, words: list[str]
) -> None:
    write_gaussians(tmp_path / "a.spz", model, spz=SpzForm(axes="rdf"))
    settings = tiny_settings(tmp_path / "run", f"init={tmp_path / 'a.spz'}", "iterations=2", "rasterizer=eager", *words)
    means = start(settings, plugins()).backbone.table["means"].detach()
    expected = to_training_axes(model, "rub" if words else "rdf").means
    torch.testing.assert_close(means, expected, atol=1 / 4096, rtol=0)


def test_given_axes_count_for_what_is_trained(model: Gaussians, tmp_path: Path) -> None:
    write_gaussians(tmp_path / "a.spz", model)

    def key(*more: str) -> str:
        config = tiny_settings(tmp_path / "run", f"init={tmp_path / 'a.spz'}", *more).resolved
        return composition_key(config, scene_stamp(config), ())

    assert len({key(), key("axes=rub"), key("axes=rdf")}) == 3
    assert key() == key("axes=auto")


def test_wrong_axes_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"axes is 'up'; choose auto, rub"):
        tiny_settings(tmp_path / "run", "axes=up")
    with pytest.raises(ConfigError, match="axes=rdf needs a splat file: give init=FILE"):
        start(tiny_settings(tmp_path / "run", "axes=rdf"), plugins())


@pytest.mark.parametrize("verb", ["render", "view"])
def test_axes_of_a_run_folder_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str], verb: str) -> None:
    (tmp_path / "run").mkdir()
    assert main([verb, str(tmp_path / "run"), "--axes", "rdf"]) == 2
    assert f"gsx {verb}: --axes rdf is for splat files" in capsys.readouterr().err


def test_a_file_is_converted_from_given_axes_into_version_4(
    model: Gaussians, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO, "gsx")
    write_gaussians(tmp_path / "a.spz", model, spz=SpzForm(axes="rdf"))
    words = ["--from-axes", "rdf", "--axes", "rdf", "--spz-version", "4"]
    assert main(["export", str(tmp_path / "a.spz"), str(tmp_path / "b.spz"), *words]) == 0
    content = read_splats(tmp_path / "b.spz")
    assert (content.axes, content.by) == ("rdf", "stated")
    torch.testing.assert_close(content.gaussians.means.float(), model.means, atol=1 / 4096, rtol=0)


def test_flags_of_spz_for_another_file_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "run").mkdir()
    assert main(["export", str(tmp_path / "run"), str(tmp_path / "a.ply"), "--spz-version", "4"]) == 2
    assert "SPZ version are for .spz files" in capsys.readouterr().err
