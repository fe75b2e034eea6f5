"""A model in a browser: viser shows pictures that gsx's rasterizer draws, and sends what to draw."""

import logging
import math
import socket
import threading
import time
from collections.abc import Callable
from contextlib import redirect_stdout
from functools import partial
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gsx.core.data.images import write_image
from gsx.core.data.resize import to_uint8
from gsx.core.data.scene import View
from gsx.core.errors import GsxError, InputError
from gsx.core.gaussians.quaternions import quaternions_of
from gsx.core.packages import require
from gsx.core.shapes import Float
from gsx.experiments.viewer.camera_path import CameraPath, Keyframe, write_camera_path
from gsx.experiments.viewer.pictures import COMPARED_WITH, FILTERS, Model, Pose, RunModel, picture
from gsx.experiments.viewer.screens import FrameServer, Screen
from gsx.experiments.viewer.up_direction import upright

logger = logging.getLogger(__name__)

LOCAL = "127.0.0.1"
JPEG_QUALITY = 90
FRUSTUM = 0.03
"""Size of camera frusta, of the scene's extent."""
COLOURS = {"training": (60, 110, 200), "test": (220, 120, 40)}
ARRIVAL = 20.0
"""Seconds within which a browser arrives at a view."""
KEYFRAME_SECONDS = 1.0
"""Seconds between two keyframes of a camera path."""
ABSENCE = 60.0
"""Seconds without any browser after which training that was paused goes on."""


class Viewer:
    """A server, its browsers, and the model that they show."""

    def __init__(self, model: Model, title: str, host: str = LOCAL, port: int = 8080, training: bool = False) -> None:
        require("gsx view", ("viser",), "gsx[viewer]")
        import viser

        self.frames, self.title, self.folder = FrameServer(model), title, Path.cwd()
        self.training, self.paused, self.keyframes = training, False, list[Keyframe]()
        self.status = ""
        self.alone_since: float | None = None
        """When the last browser left, s; None: one is there, or none ever came."""
        self.panels: dict[int, Panel] = {}
        refuse_port(host, port)
        with redirect_stdout(StringIO()):  # its banner; gsx prints the address
            self.server: Any = viser.ViserServer(host=host, port=port, label=f"gsx: {title}", verbose=False)
        self.server.gui.configure_theme(show_share_button=False)  # which would open it to the world
        self.address = f"http://{host}:{self.server.get_port()}"
        self.place_cameras()
        self.server.on_client_connect(self.connected)
        self.server.on_client_disconnect(self.left)

    def place_cameras(self) -> None:
        """Places training and test cameras, invisible at first."""
        model = self.frames.model
        if not isinstance(model, RunModel):
            self.server.scene.set_up_direction("-y")
            return
        scene = model.run.scene
        up = upright(torch.stack([view.camera.rotation for view in scene.train]).double())
        self.server.scene.set_up_direction(tuple(up.tolist()))
        for kind, views in (("training", scene.train), ("test", scene.test)):
            for view in views:
                self.place_camera(kind, view, FRUSTUM * scene.extent)

    def place_camera(self, kind: str, view: View, scale: float) -> None:
        """Places one camera; a click on it jumps there."""
        pose = pose_of(view, 100)
        frustum = self.server.scene.add_camera_frustum(
            f"/{kind}/{view.name}", fov=pose.fov, aspect=view.camera.width / view.camera.height, scale=scale,
            color=COLOURS[kind], wxyz=pose.wxyz, position=pose.position, visible=False,
        )  # fmt: skip
        frustum.on_click(lambda event: self.panels[event.client.client_id].jump(view.name))

    def connected(self, client: Any) -> None:
        """Adds a browser."""
        self.alone_since = None
        screen = Screen(partial(send, client))
        self.panels[client.client_id] = panel = Panel(self, client, screen)
        client.camera.on_update(lambda camera: panel.moved(camera))
        panel.begin()
        self.frames.screens[client.client_id] = screen

    def left(self, client: Any) -> None:
        """Removes a browser."""
        self.frames.screens.pop(client.client_id, None)
        self.panels.pop(client.client_id, None)
        if not self.panels:
            self.alone_since = time.monotonic()

    def pausing(self) -> bool:
        """Returns whether training waits; ends the pause once all browsers have been closed for a while."""
        away = 0.0 if self.alone_since is None else time.monotonic() - self.alone_since
        if self.paused and away > ABSENCE:
            self.paused = False
            logger.warning("training was paused at %s, and no browser is open: training continues", self.address)
        return self.paused

    def changed(self, status: str) -> None:
        """Redraws the model, which has changed, and shows its status."""
        self.frames.version += 1
        self.show_status(status)

    def show_status(self, status: str) -> None:
        """Shows the status of the model in all panels."""
        self.status = status
        for panel in list(self.panels.values()):
            panel.show_status()

    def stop(self) -> None:
        """Closes the server."""
        with redirect_stdout(StringIO()):
            self.server.stop()

    def serve(self, until: Callable[[], bool], poll: Callable[[], None] = lambda: None) -> None:
        """Draws pictures until a condition holds; `poll` is called between pictures."""
        while not until():
            poll()
            if not self.frames.show_next():
                time.sleep(0.01)


class Panel:
    """The controls of one browser."""

    def __init__(self, viewer: Viewer, client: Any, screen: Screen) -> None:
        self.viewer, self.client, self.screen, gui = viewer, client, screen, client.gui
        self.lock, self.patience = threading.Lock(), 0.0
        self.target: tuple[str, tuple[float, float, float]] | None = None
        names = list(viewer.frames.model.views())
        self.state = gui.add_markdown("")
        pause = gui.add_checkbox("pause training", viewer.paused, visible=viewer.training)
        pause.on_update(lambda _: setattr(viewer, "paused", pause.value))
        with gui.add_folder("view"):
            self.view = gui.add_dropdown("camera", ["-", *names], visible=bool(names))
            self.view.on_update(lambda _: self.chosen())
            cameras = gui.add_checkbox("show cameras", False, visible=bool(names))
            cameras.on_update(lambda _: self.show_cameras(cameras.value))
            self.slider("zoom", "zoom", 1.0, 8.0, 0.1, 1.0)
            choices = COMPARED_WITH if names else (COMPARED_WITH[0], COMPARED_WITH[3])
            compared = gui.add_dropdown("compare with", choices)
            compared.on_update(lambda _: self.choose(compared_with=compared.value))
            self.slider("begins at", "split", 0.0, 1.0, 0.01, 0.5)
        with gui.add_folder("model", expand_by_default=False):
            filters = gui.add_dropdown("filter", FILTERS)
            filters.on_update(lambda _: self.choose(filter=filters.value))
            self.slider("finer levels", "finer_levels", -4.0, 4.0, 0.5, 0.0)
            self.slider("crop box", "box", 0.02, 1.0, 0.02, 1.0)
        with gui.add_folder("path and pictures", expand_by_default=False):
            gui.add_button("add keyframe").on_click(lambda _: self.add_keyframe())
            gui.add_button("save path").on_click(lambda _: self.saving(self.save_path))
            snapshot = gui.add_button("snapshot")
            snapshot.on_click(lambda _: viewer.frames.jobs.append(lambda: self.saving(self.snapshot)))
        self.show_status()

    def slider(self, label: str, key: str, least: float, most: float, step: float, value: float) -> None:
        """Adds a slider for a number of the look."""
        handle = self.client.gui.add_slider(label, least, most, step, value)
        handle.on_update(lambda _: self.choose(**{key: handle.value}))

    def choose(self, **chosen: object) -> None:
        """Changes settings of the picture."""
        self.screen.choose(**chosen)

    def show_status(self) -> None:
        """Shows the status of the model and the rate of pictures."""
        rate = f", {self.screen.rate:.1f} pictures/s while moving" if self.screen.rate else ""
        self.state.content = f"**{self.viewer.title}**  \n{self.viewer.status}{rate}{self.place()}"

    def place(self) -> str:
        """Returns the position in the coordinates of the files, where these have another origin."""
        origin, pose = self.viewer.frames.model.origin, self.screen.pose
        if pose is None or not any(origin):
            return ""
        return f"  \nat {', '.join(f'{value + by:.3f}' for value, by in zip(pose.position, origin, strict=True))}"

    def begin(self) -> None:
        """Starts at the first test view, or in front of the splats."""
        model = self.viewer.frames.model
        names = list(model.views())
        if names:
            self.jump(names[0])
            return
        middle = model.middle()
        self.client.camera.position = tuple((middle + torch.tensor([0.0, 0.0, -3.0])).tolist())
        self.client.camera.look_at = tuple(middle.tolist())

    def chosen(self) -> None:
        """Jumps to a view that was chosen in the panel."""
        if self.view.value not in ("-", self.screen.look.view):
            self.jump(self.view.value)

    def jump(self, name: str) -> None:
        """Moves the browser's camera to a view."""
        view = self.viewer.frames.model.views()[name]
        pose, camera = pose_of(view, 100), self.client.camera
        with self.lock:
            self.target, self.patience = (name, pose.position), time.monotonic() + ARRIVAL
            with self.client.atomic():
                camera.wxyz, camera.position, camera.fov = pose.wxyz, pose.position, pose.fov
            self.choose(view=name)
        self.view.value = name

    def moved(self, camera: Any) -> None:
        """Draws from the browser's new camera."""
        x, y, z = map(float, camera.position)
        w, i, j, k = map(float, camera.wxyz)
        size = int(camera.image_width) or 640, int(camera.image_height) or 480
        pose = Pose((x, y, z), (w, i, j, k), float(camera.fov), *size)
        with self.lock:
            if self.on_its_way(pose):
                return
            self.screen.turn(pose)
        self.show_status()

    def on_its_way(self, pose: Pose) -> bool:
        """Returns whether the browser has yet to arrive at its target; after that, any movement leaves the view.

        A browser that arrives after the patience ended is at the view all the same.
        """
        if self.target is None:
            return False
        name, position = self.target
        arrived = math.dist(pose.position, position) <= 1e-4 * (1 + math.hypot(*position))
        if not arrived and time.monotonic() < self.patience:
            return True
        self.patience = 0.0
        if self.screen.look.view != (name if arrived else ""):
            self.choose(view=name if arrived else "")
            self.view.value = name if arrived else "-"
        return False

    def show_cameras(self, visible: bool) -> None:
        """Shows the frusta of all cameras, or hides them."""
        for name in COLOURS:
            for view in self.viewer.frames.model.views():
                handle = self.viewer.server.scene.get_handle_by_name(f"/{name}/{view}")
                if handle is not None:
                    handle.visible = visible

    def add_keyframe(self) -> None:
        """Adds the current camera to the path."""
        if self.screen.pose is None:
            return
        frames, pose = self.viewer.keyframes, self.screen.pose
        at = frames[-1].time + KEYFRAME_SECONDS if frames else 0.0
        fov = 2 * math.atan(math.tan(pose.fov / 2) / self.screen.look.zoom)
        x, y, z = (v + by for v, by in zip(pose.position, self.viewer.frames.model.origin, strict=True))
        frames.append(Keyframe(time=at, position=(x, y, z), wxyz=pose.wxyz, fov=fov))
        self.notify("keyframe", f"{len(frames)} so far; the path takes {at:g} s")

    def saving(self, save: Callable[[], None]) -> None:
        """Writes a file where gsx was started, or shows in the browser why that fails."""
        try:
            save()
        except (OSError, GsxError) as error:
            self.notify("nothing is saved", f"{error}; gsx was started in {self.viewer.folder}")

    def save_path(self) -> None:
        """Writes the keyframes as a file for `gsx render`."""
        if self.screen.pose is None or not self.viewer.keyframes:
            self.notify("no path", "add keyframes first")
            return
        path = free(self.viewer.folder, "camera_path", ".json")
        size = (self.screen.pose.width, self.screen.pose.height)
        write_camera_path(path, CameraPath(size=size, fps=24.0, keyframes=tuple(self.viewer.keyframes)))
        self.notify("path saved", f"{path}: gsx render RUN --path {path.name} --movie FILE.mp4")

    def snapshot(self) -> None:
        """Writes the picture as large as the canvas."""
        if self.screen.pose is None:
            return
        path = free(self.viewer.folder, "snapshot", ".png")
        with torch.no_grad():
            image = picture(self.viewer.frames.model, self.screen.pose, self.screen.look, self.screen.pose.width)
        write_image(path, image)
        self.notify("snapshot", str(path))

    def notify(self, title: str, body: str) -> None:
        """Shows a notification in the browser."""
        self.client.add_notification(title, body, auto_close_seconds=5.0)


def refuse_port(host: str, port: int) -> None:
    """Raises InputError if nothing can listen there: viser would wait for ever, or take another port."""
    with socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((host, port))
        except (OSError, OverflowError) as error:
            raise InputError(
                f"a viewer cannot listen at {host}, port {port} ({error}): choose another port, 0 for any that is "
                "free, and an address of this machine"
            ) from error


def send(client: Any, image: Float[Tensor, "3 H W"]) -> None:
    """Sends a picture to a browser."""
    pixels = np.ascontiguousarray(to_uint8(image.cpu()).permute(1, 2, 0).numpy())
    client.scene.set_background_image(pixels, format="jpeg", jpeg_quality=JPEG_QUALITY)


def pose_of(view: View, width: int) -> Pose:
    """Returns the pose of a view's camera, with the principal point in the middle."""
    camera = view.camera
    wxyz = quaternions_of(camera.rotation.T.double()[None])[0]
    fov = 2 * float(np.arctan(camera.height / (2 * camera.fy)))
    height = max(1, round(width * camera.height / camera.width))
    return Pose(tuple(camera.centre.tolist()), tuple(wxyz.tolist()), fov, width, height)


def free(folder: Path, stem: str, suffix: str) -> Path:
    """Returns a free name in a folder."""
    return next(path for n in range(1, 10**6) if not (path := folder / f"{stem}_{n}{suffix}").exists())
