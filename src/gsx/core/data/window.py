"""Windows of rasters."""

import math
from dataclasses import dataclass

from torch import Tensor

from gsx.core.data.camera import Camera
from gsx.core.shapes import Shaped


@dataclass(frozen=True)
class Window:
    """Rectangle of a raster, px."""

    left: int
    top: int
    width: int
    height: int

    def cut(self, image: Shaped[Tensor, "C H W"]) -> Shaped[Tensor, "C h w"]:
        """Returns the part of an image inside the window."""
        return image[:, *self.pixels]

    @property
    def pixels(self) -> tuple[slice, slice]:
        """Slices of rows and columns."""
        return slice(self.top, self.top + self.height), slice(self.left, self.left + self.width)

    def of(self, camera: Camera) -> Camera:
        """Returns the camera of the window."""
        return camera.crop(self.left, self.top, self.width, self.height)

    def mapped_to(self, other: Camera, camera: Camera) -> "Window":
        """Returns the pixels of `other` that show a part of this window of `camera`, at the same pose; maybe none."""
        left, right = (
            (edge - camera.cx) / camera.fx * other.fx + other.cx for edge in (self.left, self.left + self.width)
        )
        top, bottom = (
            (edge - camera.cy) / camera.fy * other.fy + other.cy for edge in (self.top, self.top + self.height)
        )
        columns, rows = overlapped(left, right, other.width), overlapped(top, bottom, other.height)
        return Window(columns.start, rows.start, len(columns), len(rows))

    def shares(self, width: int, height: int) -> tuple[float, float, float, float]:
        """Returns the left, top, right and bottom edge as shares of a raster of that size."""
        right, bottom = self.left + self.width, self.top + self.height
        return self.left / width, self.top / height, right / width, bottom / height

    def grown(self, margin: int, width: int, height: int) -> "Window":
        """Returns the window extended by `margin` on each side, inside a raster of that size."""
        left, top = max(0, self.left - margin), max(0, self.top - margin)
        right, bottom = min(width, self.left + self.width + margin), min(height, self.top + self.height + margin)
        return Window(left, top, right - left, bottom - top)

    def halves(self, unit: int) -> tuple["Window", "Window"]:
        """Splits the window across its longer side at the multiple of `unit` px nearest the middle."""
        cut = max(1, round(max(self.width, self.height) / 2 / unit)) * unit
        if self.width >= self.height:
            beyond = Window(self.left + cut, self.top, self.width - cut, self.height)
            return Window(self.left, self.top, cut, self.height), beyond
        below = Window(self.left, self.top + cut, self.width, self.height - cut)
        return Window(self.left, self.top, self.width, cut), below


ROUNDING = 1e-6
"""Tolerance of a window's edge from a pixel boundary, px."""


def overlapped(begin: float, end: float, size: int) -> range:
    """Returns the pixels, of `size` in a row, that overlap the interval."""
    first, last = math.floor(begin + ROUNDING), math.ceil(end - ROUNDING)
    return range(min(max(first, 0), size), min(max(last, 0), size))
