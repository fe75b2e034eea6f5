"""What a browser is sent: the right picture, soon coarse and then fine, and nothing that changes training."""

import math
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import MagicMock

import pytest
import torch
from browser import CHROMIUM, browser
from tiny import final_tensors, tiny_run

from gsx.builtin import plugins
from gsx.core.data.images import read_image
from gsx.core.data.scene import View
from gsx.core.errors import InputError
from gsx.core.quality.metrics import bicubic, psnr
from gsx.core.training.render import render
from gsx.core.training.run import Run
from gsx.experiments.runs.open import open_run
from gsx.experiments.viewer import screens
from gsx.experiments.viewer.pictures import Look, Pose, RunModel, camera_of, picture, placed, split
from gsx.experiments.viewer.screens import FrameServer, Screen

needs_viser = pytest.mark.skipif(find_spec("viser") is None, reason="viser is not installed")


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Run:
    folder = tmp_path_factory.mktemp("viewer") / "run"
    tiny_run(folder, ["iterations=8", "rasterizer=eager"])
    return open_run(folder, plugins())[0]


def pose_at(run: Run, number: int = 0, width: int = 48) -> Pose:
    from gsx.experiments.viewer.server import pose_of

    return pose_of(run.scene.test[number], width)


def near(position: tuple[float, float, float], view: View) -> bool:
    return math.dist(position, view.camera.centre.tolist()) < 1e-3


def test_a_pose_is_the_camera_that_it_was_made_of(run: Run) -> None:
    camera = run.scene.test[0].camera
    again = camera_of(pose_at(run), camera.width)
    assert torch.allclose(again.rotation, camera.rotation.double(), atol=1e-12)
    assert torch.allclose(again.translation, camera.translation.double(), atol=1e-12)
    assert (again.size, again.fy) == (camera.size, pytest.approx(camera.fy))
    zoomed = camera_of(pose_at(run), camera.width, zoom=3)
    assert zoomed.fy == pytest.approx(3 * camera.fy)


def test_the_picture_is_that_of_the_run(run: Run) -> None:
    """The built-in scene's pixels are square."""
    shown = picture(RunModel(run), pose_at(run), Look(), 96)
    assert psnr(shown, render(run, run.scene.test[0].camera.zoom(2)).image) > 60


def test_the_photograph_lies_where_it_was_taken(run: Run) -> None:
    view = run.scene.test[0]
    photo, covered = placed(view.image(), view.camera, view.camera)
    assert bool(covered.all())
    assert torch.allclose(photo, view.image(), atol=1e-5)
    wider = replace(view.camera, width=view.camera.width + 20, cx=view.camera.cx + 10)
    photo, covered = placed(view.image(), view.camera, wider)
    assert torch.allclose(photo[:, :, 10:-10], view.image(), atol=1e-5)
    assert covered[:, 10:-10].all()
    assert not covered[:, :10].any()
    look = Look(compared_with="photograph", split=0.5, view=view.name)
    shown = picture(RunModel(run), pose_at(run), look, 48)
    assert torch.allclose(shown[:, :, 24:], view.image()[:, :, 24:], atol=1e-4)
    error = picture(RunModel(run), pose_at(run), replace(look, compared_with="error", split=0.0), 48)
    own = picture(RunModel(run), pose_at(run), Look(), 48)
    assert torch.allclose(error, (4 * (own - view.image()).abs()).clamp(0, 1), atol=1e-3)


def test_beside_a_zoomed_picture_stands_the_enlarged_one(run: Run) -> None:
    """At zoom 2 the other half is the middle of the x1 render at half the raster, enlarged."""
    look = Look(zoom=2.0, compared_with="x1, enlarged", split=0.0)
    shown = picture(RunModel(run), pose_at(run), look, 96)
    camera = camera_of(pose_at(run), 24, 2.0)
    assert camera.fy == pytest.approx(run.scene.test[0].camera.fy)
    assert torch.allclose(shown, bicubic(render(run, camera).image, 96, 72), atol=1e-5)


def test_two_pictures_meet_at_a_line() -> None:
    joined = split(torch.zeros(3, 2, 10), torch.full((3, 2, 10), 0.5), 0.4)
    assert joined[0, 0].tolist() == [0, 0, 0, 1, 0.5, 0.5, 0.5, 0.5, 0.5, 0.5]


def test_a_box_leaves_out_what_is_beyond_it(run: Run) -> None:
    whole, cut = (picture(RunModel(run), pose_at(run), Look(box=box), 48) for box in (1.0, 0.02))
    assert not torch.equal(whole, cut)
    assert psnr(cut, run.background[:, None, None].expand_as(cut)) > psnr(
        whole, run.background[:, None, None].expand_as(whole)
    )


class Still:
    """A model of one colour that takes its time."""

    def __init__(self, seconds_per_pixel: float, sleep: Callable[[float], None] = time.sleep) -> None:
        self.seconds_per_pixel, self.sleep = seconds_per_pixel, sleep

    def drawn(self, camera, look) -> torch.Tensor:
        self.sleep(self.seconds_per_pixel * camera.width * camera.height)
        return torch.zeros(3, camera.height, camera.width)

    def views(self) -> dict[str, object]:
        return {}


def test_pictures_are_coarse_at_first_and_sharpen_at_rest(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(screens, "REST", 0.0)
    widths: list[int] = []
    server = FrameServer(Still(0.0), seconds_per_pixel=1e-5)  # type: ignore[arg-type]
    screen = Screen(lambda image: widths.append(image.shape[2]))
    server.screens[0] = screen
    assert not server.show_next()  # nobody has said from where
    pose = Pose((0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), 1.0, 1000, 500)
    screen.turn(pose)
    while server.show_next():
        pass
    assert widths[0] == int((0.1 / 1e-5 * 2) ** 0.5)
    assert widths == sorted(widths)
    assert widths[-1] == 1000
    widths.clear()
    screen.turn(pose)  # the same
    assert not server.show_next()
    screen.choose(zoom=2.0)
    assert server.show_next()
    assert widths[0] < 1000
    server.version += 1  # another model
    assert server.show_next()


def test_moving_goes_before_sharpening(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(screens, "REST", 0.0)
    shown: list[str] = []
    server = FrameServer(Still(0.0))  # type: ignore[arg-type]
    for name in ("a", "b"):
        server.screens[len(server.screens)] = Screen(lambda image, name=name: shown.append(name))
    pose = Pose((0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), 1.0, 1000, 500)
    server.screens[0].turn(pose)
    server.show_next()
    server.screens[1].turn(pose)
    server.show_next()
    assert shown == ["a", "b"]  # not the second, finer one of a


@needs_viser
def test_training_is_the_same_bits_with_somebody_looking(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from gsx.experiments.viewer import training

    drawn = []

    class Scripted:
        """A viewer with a screen that moves all the time, and no server."""

        def __init__(self, model, title, host, port, training) -> None:
            self.frames, self.paused = FrameServer(model), False
            self.frames.screens[0] = Screen(lambda image: drawn.append(image.shape))
            self.address, self.turns = "nowhere", 0

        def changed(self, told: str) -> None:
            assert "held-out" in told or "step" in told
            self.frames.version += 1
            self.turns += 1
            self.frames.screens[0].turn(Pose((0.1 * self.turns, -2.0, 1.0), (0.7, -0.7, 0.0, 0.0), 1.0, 64, 48))

        def stop(self) -> None:
            drawn.append(None)

    monkeypatch.setattr(training, "Viewer", Scripted)
    more = ["iterations=8", "rasterizer=eager", "training.test_points=2"]
    tiny_run(tmp_path / "alone", more)
    tiny_run(tmp_path / "render_probe", [*more, "viewer=true", "viewer_share=1.0"])
    assert len(drawn) > 3
    assert drawn[-1] is None
    expected, found = final_tensors(tmp_path / "alone"), final_tensors(tmp_path / "render_probe")
    assert all(torch.equal(value, found[name]) for name, value in expected.items())


class Clock:
    """Seconds that pass when somebody sleeps."""

    def __init__(self) -> None:
        self.now = 0.0

    def monotonic(self) -> float:
        return self.now

    def sleep(self, seconds: float) -> None:
        self.now += seconds


@needs_viser
def test_a_share_of_the_time_is_not_exceeded(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    from gsx.experiments.viewer import training
    from gsx.experiments.viewer.training import TrainingViewer

    time = Clock()
    monkeypatch.setattr(screens, "time", time)
    monkeypatch.setattr(training, "time", time)
    shown = TrainingViewer(run, "127.0.0.1", 0, share=0.5)
    try:
        server = shown.viewer.frames
        server.model = Still(1e-5, time.sleep)  # type: ignore[assignment]
        server.screens[0] = Screen(lambda image: None)
        begun = time.monotonic()
        for turn in range(20):
            server.screens[0].turn(Pose((float(turn), 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), 1.0, 200, 100))
            shown.gsx_step_finished(run, None)  # type: ignore[arg-type]
            time.sleep(0.02)
        elapsed = time.monotonic() - begun
        assert 0 < server.spent < 0.5 * elapsed + 0.2  # by one picture at most
        time.sleep(0.1)
        shown.before -= 3600  # an hour in which nobody looked is not made up for
        shown.gsx_step_finished(run, None)  # type: ignore[arg-type]
        assert shown.credit <= 1
    finally:
        shown.stop()


@needs_viser
def test_where_nothing_can_listen_is_told(run: Run) -> None:
    from gsx.experiments.viewer.server import Viewer

    first = Viewer(RunModel(run), "first", "127.0.0.1", 0)
    try:
        port = first.server.get_port()
        for host, number in (("127.0.0.1", port), ("no such host", 0), ("127.0.0.1", 99_999)):
            with pytest.raises(InputError, match="a viewer cannot listen"):
                Viewer(RunModel(run), "second", host, number)
    finally:
        first.stop()


@needs_viser
def test_paused_training_does_not_wait_for_a_browser_that_was_closed(
    run: Run, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    from gsx.experiments.viewer import server
    from gsx.experiments.viewer.training import TrainingViewer

    shown, client = TrainingViewer(run, "127.0.0.1", 0, share=0.5), MagicMock(client_id=3)
    try:
        viewer = shown.viewer
        viewer.connected(client)
        viewer.paused = True
        monkeypatch.setattr(server, "ABSENCE", 0.0)
        assert viewer.pausing(), "somebody looks"
        viewer.left(client)
        viewer.connected(client)  # the page was loaded again
        assert viewer.pausing()
        viewer.left(client)
        shown.gsx_step_finished(run, None)  # type: ignore[arg-type]
        assert not viewer.paused
        assert "training continues" in caplog.text
    finally:
        shown.stop()


@needs_viser
def test_a_browser_hears_of_a_path_that_cannot_be_saved(run: Run, tmp_path: Path) -> None:
    from gsx.experiments.viewer.server import Panel

    viewer, screen, client = MagicMock(), Screen(lambda image: None), MagicMock()
    viewer.frames.model, viewer.folder, viewer.keyframes = RunModel(run), tmp_path / "gone", []
    panel = Panel(viewer, client, screen)
    screen.turn(pose_at(run))
    panel.add_keyframe()
    panel.saving(panel.save_path)
    (title, reason), _ = client.add_notification.call_args
    assert title == "nothing is saved"
    assert str(tmp_path / "gone") in reason


def test_what_fails_for_a_browser_ends_nothing(run: Run, caplog: pytest.LogCaptureFixture) -> None:
    server = FrameServer(RunModel(run))

    def refuse(image: torch.Tensor) -> None:
        raise OSError("gone")

    server.screens[0] = Screen(refuse)
    server.screens[0].turn(pose_at(run))
    server.jobs.append(lambda: refuse(torch.zeros(1)))
    assert server.show_next()
    assert server.screens[0].width  # not tried again and again
    assert caplog.text.count("gone") >= 2


@needs_viser
def test_who_arrives_later_than_awaited_is_at_the_view(run: Run) -> None:
    from gsx.experiments.viewer.server import Panel, pose_of

    viewer, screen = MagicMock(), Screen(lambda image: None)
    viewer.frames.model = RunModel(run)
    panel, view = Panel(viewer, MagicMock(), screen), run.scene.test[1]

    def move(x: float) -> str:
        """The view that the browser looks from, once it has told where it is."""
        pose = pose_of(view, 48)
        position = (pose.position[0] + x, *pose.position[1:])
        panel.moved(SimpleNamespace(position=position, wxyz=pose.wxyz, fov=pose.fov, image_width=48, image_height=36))
        return screen.look.view

    panel.jump(view.name)
    assert move(1) == view.name  # still on its way
    assert screen.pose is None
    panel.patience = 0.0
    assert move(1) == ""
    assert move(0) == view.name
    assert move(2) == ""


@needs_viser
@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium")
def test_a_browser_shows_the_model_and_its_panel(run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from gsx.experiments.viewer.server import Viewer

    monkeypatch.chdir(tmp_path)
    done = threading.Event()
    viewer = Viewer(RunModel(run), "a title", "127.0.0.1", 0)
    loop = threading.Thread(target=viewer.serve, args=(done.is_set,), daemon=True)
    loop.start()
    try:
        with browser(640, 480) as page:
            page.open(viewer.address)
            until, first = time.monotonic() + 90, run.scene.test[0]

            def stands_at_first_view() -> bool:
                """Whether the browser has answered with the place it was sent to, after its own first one."""
                screens = [screen for screen in viewer.frames.screens.values() if screen.width]
                return any(at.look.view == first.name and near(at.pose.position, first) for at in screens)

            while not stands_at_first_view():
                page.value("1")  # so that its events are heard
                assert time.monotonic() < until, page.said
                time.sleep(0.2)
            (screen,) = viewer.frames.screens.values()
            (panel,) = viewer.panels.values()
            screen.choose(zoom=2.0)
            while screen.drawn is None or screen.drawn[1].zoom != 2.0 or screen.width < 640:
                page.value("1")
                assert time.monotonic() < until
                time.sleep(0.1)
            page.value("new Promise(done => setTimeout(done, 2000))")
            shown = read_image(page.picture(tmp_path / "shown.png"))[:3].float() / 255
            expected = picture(viewer.frames.model, screen.pose, screen.look, 640)
            free_part = (slice(None), slice(200, 470), slice(0, 300))  # beside panel and notices
            assert psnr(shown[free_part], expected[free_part]) > 30
            panel.add_keyframe()
            panel.add_keyframe()
            panel.save_path()
            viewer.frames.jobs.append(panel.snapshot)
            while not (tmp_path / "snapshot_1.png").exists():
                time.sleep(0.1)
            assert (tmp_path / "camera_path_1.json").exists()
            assert [said for said in page.said if "deprecated" not in said] == []
    finally:
        done.set()
        loop.join(10)
        viewer.stop()
