"""Photographs as the truth of views: decoded, undistorted and reduced on demand."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from torch import Tensor

from gsx.core.data.camera import Camera
from gsx.core.data.images import ImageCache, composite, has_alpha, read_image, refuse_other_size
from gsx.core.data.masks import Mask, untouched
from gsx.core.data.resize import REACH, ResizeRule, Size, resize
from gsx.core.data.window import Window
from gsx.core.errors import InputError
from gsx.core.shapes import Bool, UInt8
from gsx.lenses.rays import pixels_with_rays

ZOOM_SLACK = 1.01  # sizes are rounded to whole pixels, so four times a quarter can be a little more than all


@dataclass(frozen=True, eq=False, kw_only=True)
class PhotoSource:
    """A photograph as the truth of one view (implements `gsx.core.data.scene.ImageSource`)."""

    path: Path
    rule: ResizeRule
    cache: ImageCache
    whole: Camera
    """The camera of the whole photograph, after `remap`, at its own resolution: the finest truth there is."""
    expected_size: Size | None = None
    """(width, height) that the camera model states for the stored file; None: any."""
    remap: Callable[[UInt8[Tensor, "C H W"]], UInt8[Tensor, "C height width"]] | None = None
    """Undistortion or reduction of the decoded file; equal ones compare equal."""
    mask: Mask | None = None
    """Mask of the photograph; None: all pixels count."""
    depth: Path | None = None
    """Its depth map, if there is one; it has the photograph's raster, or a reduction of it."""

    def image(self, camera: Camera) -> UInt8[Tensor, "3 H W"]:
        """Return the photograph on the raster of `camera`, which is `whole` on any raster, or a crop of that.

        Raises:
            InputError: the file cannot be read or has another size than the camera model states.
            ValueError: `camera` reaches past the photograph.
        """
        window, width, height = self.window_of(camera)
        key = str(self.path), self.rule, self.remap, width, height  # all that decides the pixels
        return window.cut(self.cache.get(key, lambda: self._resized(width, height)))

    def counted(self, camera: Camera) -> Bool[Tensor, "h w"] | None:
        """Return which pixels of `image(camera)` count; None: all. InputError: the mask leaves none, or is damaged.

        Those of the mask, and pixels made from some without a ray, do not count.
        """
        rays = pixels_with_rays(camera, REACH.get(self.rule.filter, 0))
        if self.mask is None:
            return rays
        window, width, height = self.window_of(camera)
        mask, key = self.mask, (str(self.mask.path), "mask", self.rule, self.remap, width, height)
        counted = window.cut(self.cache.get(key, lambda: self._counted(mask, width, height)))[0]
        return counted if rays is None else counted & rays

    def transparent(self, camera: Camera) -> Bool[Tensor, "h w"] | None:
        """Return which pixels of `image(camera)` are made from transparent ones alone, and hold nothing of the scene.

        None: the photograph is opaque, or has a mask, outside of which nothing is known. Decodes the file anew.
        """
        if self.mask is not None or not has_alpha(self.path):
            return None
        window, width, height = self.window_of(camera)
        return window.cut(untouched(self._decoded()[3:] > 0, width, height, self.rule.filter, self.whole.size))[0]

    def window_of(self, camera: Camera) -> tuple[Window, int, int]:
        """Return the camera's window, and width and height of the whole photograph; ValueError: it reaches past."""
        across, down = camera.fx / self.whole.fx, camera.fy / self.whole.fy
        width, height = round(self.whole.width * across), round(self.whole.height * down)
        left = round(self.whole.cx * across - camera.cx)
        top = round(self.whole.cy * down - camera.cy)
        if left < 0 or top < 0 or left + camera.width > width or top + camera.height > height:
            raise ValueError(f"a {camera.size} window at {left, top} reaches past '{self.path}' at {width, height}")
        return Window(left=left, top=top, width=camera.width, height=camera.height), width, height

    def max_zoom(self, camera: Camera) -> float:
        """Return how many times finer than `camera` the photograph is, with 1% for rounded sizes."""
        return ZOOM_SLACK * self.whole.fx / camera.fx

    def _counted(self, mask: Mask, width: int, height: int) -> Bool[Tensor, "1 height width"]:
        counted = mask.reduced(width, height, self.rule.filter, self.whole.size)
        if not counted.any():
            raise InputError(f"The mask '{mask.path}' leaves nothing of '{self.path}': remove the photograph.")
        return counted

    def _decoded(self) -> UInt8[Tensor, "C h w"]:
        image = read_image(self.path)
        if self.expected_size is not None:
            refuse_other_size(self.path, (image.shape[2], image.shape[1]), self.expected_size)
        return image if self.remap is None else self.remap(image)

    def _resized(self, width: int, height: int) -> UInt8[Tensor, "3 height width"]:
        image = self._decoded()
        if image.shape[0] == 4:
            image = composite(image, self.rule.background)
        return resize(image, width, height, self.rule.filter, self.rule.light)
