"""The browsers and the width of their next pictures: coarse while something changes, finer at rest."""

import logging
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from gsx.core.errors import first_line
from gsx.core.shapes import Float
from gsx.experiments.viewer.pictures import Look, Model, Pose, picture

logger = logging.getLogger(__name__)

FAST = 0.1
"""Seconds that a picture should take while the camera moves."""
REST = 0.15
"""Seconds without change after which the picture is sharpened."""
SMALLEST, LARGEST = 96, 1920
"""Widths of pictures, px."""
FINER = 2.0
"""Factor on the width of each further picture at rest."""


@contextmanager
def logged_errors(what: str) -> Iterator[None]:
    """Logs any error of a browser's request: training and the viewer continue."""
    try:
        yield
    except Exception as error:
        logger.warning("%s (%s)", what, first_line(error))


@dataclass(eq=False)
class Screen:
    """The screen of one browser."""

    show: Callable[[Float[Tensor, "3 H W"]], None]
    """Sends a picture there."""
    pose: Pose | None = None
    look: Look = Look()
    changed_at: float = 0.0
    drawn: tuple[Pose, Look, int] | None = None
    """Pose, look and version of the model of the last picture."""
    width: int = 0
    """Width of the last picture, px."""
    rate: float = 0.0
    """Pictures a second while one moved, lately."""

    def turn(self, pose: Pose) -> None:
        """Sets the camera."""
        if pose != self.pose:
            self.pose, self.changed_at = pose, time.monotonic()

    def choose(self, **chosen: object) -> None:
        """Changes settings of the picture."""
        self.look, self.changed_at = replace(self.look, **chosen), time.monotonic()  # type: ignore[arg-type]


@dataclass(eq=False)
class FrameServer:
    """All browsers, and the model that they show."""

    model: Model
    version: int = 0
    """Counts changes of the model."""
    jobs: list[Callable[[], None]] = field(default_factory=list)
    """Other work for the thread that draws pictures."""
    screens: dict[int, Screen] = field(default_factory=dict)
    seconds_per_pixel: float = 1e-6
    spent: float = 0.0
    """Seconds of drawing, in all."""

    def show_next(self) -> bool:
        """Draws the most urgent picture, if one is due; returns whether one was."""
        while self.jobs:
            with logged_errors("a request of a browser failed"):
                self.jobs.pop(0)()
        waiting = [(urgency, screen, width) for screen in list(self.screens.values())
                   for urgency, width in self.due(screen)]  # fmt: skip
        if not waiting:
            return False
        _, screen, width = min(waiting, key=lambda entry: entry[0])
        self.draw(screen, width)
        return True

    def due(self, screen: Screen) -> list[tuple[int, int]]:
        """Returns [(urgency, width)] of the next picture of a browser; empty: it has the finest one."""
        if screen.pose is None:
            return []
        full = min(screen.pose.width, LARGEST, max(1, LARGEST * screen.pose.width // screen.pose.height))
        if screen.drawn != (screen.pose, screen.look, self.version):
            pixels = FAST / self.seconds_per_pixel
            quick = int((pixels * screen.pose.width / screen.pose.height) ** 0.5)
            return [(0, min(full, max(SMALLEST, min(LARGEST, quick))))]
        if screen.width < full and time.monotonic() - screen.changed_at > REST:
            finer = round(FINER * screen.width)
            return [(1, finer if FINER * finer < full else full)]
        return []

    def draw(self, screen: Screen, width: int) -> None:
        """Draws and sends one picture, and updates the estimate of its time."""
        assert screen.pose is not None
        state, start = (screen.pose, screen.look, self.version), time.monotonic()
        moving = screen.drawn is not None and screen.drawn[0] != screen.pose
        with logged_errors("a picture for a browser failed"), torch.no_grad():
            screen.show(picture(self.model, screen.pose, screen.look, width))
        taken = max(time.monotonic() - start, 1e-6)
        self.spent += taken
        pixels = width * max(1, round(width * screen.pose.height / screen.pose.width))
        self.seconds_per_pixel += 0.3 * (taken / pixels - self.seconds_per_pixel)
        screen.rate = (0.7 * screen.rate + 0.3 / taken if screen.rate else 1 / taken) if moving else screen.rate
        screen.drawn, screen.width = state, width
