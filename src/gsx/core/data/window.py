"""Parts of rasters."""

from dataclasses import dataclass

from torch import Tensor

from gsx.core.data.camera import Camera
from gsx.core.shapes import Float, UInt8


@dataclass(frozen=True)
class Window:
    """A rectangle of a raster, px."""

    left: int
    top: int
    width: int
    height: int

    def cut(
        self, image: Float[Tensor, "C H W"] | UInt8[Tensor, "C H W"]
    ) -> Float[Tensor, "C h w"] | UInt8[Tensor, "C h w"]:
        """The part of an image inside the window."""
        return image[:, self.top : self.top + self.height, self.left : self.left + self.width]

    def of(self, camera: Camera) -> Camera:
        """The camera through this window."""
        return camera.crop(self.left, self.top, self.width, self.height)

    def grown(self, margin: int, width: int, height: int) -> "Window":
        """With up to `margin` more on each side, as far as a raster of that size reaches."""
        left, top = max(0, self.left - margin), max(0, self.top - margin)
        right, bottom = min(width, self.left + self.width + margin), min(height, self.top + self.height + margin)
        return Window(left, top, right - left, bottom - top)
