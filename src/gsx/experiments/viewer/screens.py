"""Who looks, at what, and how sharp the next picture is to be: coarse while something changes, finer when it rests."""

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
"""Seconds that a picture should take while one moves."""
REST = 0.15
"""Seconds without change after which the picture is sharpened."""
SMALLEST, LARGEST = 96, 1920
"""Widths of pictures, px."""
FINER = 2.0
"""Each picture of what rests is so many times as wide as the one before."""


@contextmanager
def told(what: str) -> Iterator[None]:
    """Whatever a browser asks for, and however that fails, training and the viewer go on."""
    try:
        yield
    except Exception as error:
        logger.warning("%s (%s)", what, first_line(error))


@dataclass(eq=False)
class Screen:
    """What one browser shows."""

    show: Callable[[Float[Tensor, "3 H W"]], None]
    """Sends a picture there."""
    pose: Pose | None = None
    look: Look = Look()
    changed_at: float = 0.0
    drawn: tuple[Pose, Look, int] | None = None
    """What the last picture shows, and the version of the model."""
    width: int = 0
    """Of the last picture, px."""
    rate: float = 0.0
    """Pictures a second while one moved, lately."""

    def turn(self, pose: Pose) -> None:
        """The browser looks from elsewhere."""
        if pose != self.pose:
            self.pose, self.changed_at = pose, time.monotonic()

    def choose(self, **chosen: object) -> None:
        """The panel says something else."""
        self.look, self.changed_at = replace(self.look, **chosen), time.monotonic()  # type: ignore[arg-type]


@dataclass(eq=False)
class FrameServer:
    """All browsers, and the model that they see."""

    model: Model
    version: int = 0
    """Counts changes of the model."""
    jobs: list[Callable[[], None]] = field(default_factory=list)
    """What else is to be done where pictures are drawn."""
    screens: dict[int, Screen] = field(default_factory=dict)
    seconds_per_pixel: float = 1e-6
    spent: float = 0.0
    """Seconds of drawing, in all."""

    def show_next(self) -> bool:
        """Draw the most urgent picture, if there is one to be drawn; returns whether there was."""
        while self.jobs:
            with told("a wish of a browser was not met"):
                self.jobs.pop(0)()
        waiting = [(urgency, screen, width) for screen in list(self.screens.values())
                   for urgency, width in self.due(screen)]  # fmt: skip
        if not waiting:
            return False
        _, screen, width = min(waiting, key=lambda entry: entry[0])
        self.draw(screen, width)
        return True

    def due(self, screen: Screen) -> list[tuple[int, int]]:
        """[(urgency, width)] of the picture that a browser should have next; empty: it has the finest of what is."""
        if screen.pose is None:
            return []
        full = min(screen.pose.width, LARGEST, max(1, LARGEST * screen.pose.width // screen.pose.height))
        if screen.drawn != (screen.pose, screen.look, self.version):
            return [(0, min(full, self.quick_width(screen.pose)))]
        if screen.width < full and time.monotonic() - screen.changed_at > REST:
            finer = round(FINER * screen.width)
            return [(1, finer if FINER * finer < full else full)]
        return []

    def quick_width(self, pose: Pose) -> int:
        """The width at which a picture takes about FAST seconds."""
        pixels = FAST / self.seconds_per_pixel
        return max(SMALLEST, min(LARGEST, int((pixels * pose.width / pose.height) ** 0.5)))

    def draw(self, screen: Screen, width: int) -> None:
        """Draw and send one picture, and learn how long that takes."""
        assert screen.pose is not None
        wanted, begun = (screen.pose, screen.look, self.version), time.monotonic()
        moving = screen.drawn is not None and screen.drawn[0] != screen.pose
        with told("a picture for a browser was not drawn"), torch.no_grad():
            screen.show(picture(self.model, screen.pose, screen.look, width))
        taken = max(time.monotonic() - begun, 1e-6)
        self.spent += taken
        pixels = width * max(1, round(width * screen.pose.height / screen.pose.width))
        self.seconds_per_pixel += 0.3 * (taken / pixels - self.seconds_per_pixel)
        screen.rate = (0.7 * screen.rate + 0.3 / taken if screen.rate else 1 / taken) if moving else screen.rate
        screen.drawn, screen.width = wanted, width
