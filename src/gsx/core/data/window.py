"""Parts of rasters."""

from dataclasses import dataclass

from torch import Tensor

from gsx.core.data.camera import Camera
from gsx.core.shapes import Shaped


@dataclass(frozen=True)
class Window:
    """A rectangle of a raster, px."""

    left: int
    top: int
    width: int
    height: int

    def cut(self, image: Shaped[Tensor, "C H W"]) -> Shaped[Tensor, "C h w"]:
        """The part of an image inside the window."""
        return image[:, *self.pixels]

    @property
    def pixels(self) -> tuple[slice, slice]:
        """Rows and columns of the raster."""
        return slice(self.top, self.top + self.height), slice(self.left, self.left + self.width)

    def of(self, camera: Camera) -> Camera:
        """The camera through this window."""
        return camera.crop(self.left, self.top, self.width, self.height)

    def shares(self, width: int, height: int) -> tuple[float, float, float, float]:
        """Left, top, right and bottom edge, as shares of a raster of that size."""
        right, bottom = self.left + self.width, self.top + self.height
        return self.left / width, self.top / height, right / width, bottom / height

    def grown(self, margin: int, width: int, height: int) -> "Window":
        """With up to `margin` more on each side, as far as a raster of that size reaches."""
        left, top = max(0, self.left - margin), max(0, self.top - margin)
        right, bottom = min(width, self.left + self.width + margin), min(height, self.top + self.height + margin)
        return Window(left, top, right - left, bottom - top)

    def halves(self, unit: int) -> tuple["Window", "Window"]:
        """Two windows, cut across the longer side at the multiple of `unit` px nearest its middle, inside it."""
        cut = max(1, round(max(self.width, self.height) / 2 / unit)) * unit
        if self.width >= self.height:
            beyond = Window(self.left + cut, self.top, self.width - cut, self.height)
            return Window(self.left, self.top, cut, self.height), beyond
        below = Window(self.left, self.top + cut, self.width, self.height - cut)
        return Window(self.left, self.top, self.width, cut), below
