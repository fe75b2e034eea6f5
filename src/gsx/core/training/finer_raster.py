"""Pictures reduced from finer renders by the photos' filter, since photos sample the scene between each other's pixels
(NeRF-SR, Wang et al. 2022; SRGS, Feng et al. 2024)."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from torch import Tensor

from gsx.core.data.camera import Camera
from gsx.core.data.reduction import Reduction
from gsx.core.data.scene import View
from gsx.core.data.window import Window
from gsx.core.shapes import Float

SAME = 1e-6
"""Relative difference of focal lengths from rounding."""


def render_scale(camera: Camera, photos: Sequence[View], supersample: int) -> int:
    """Returns the render scale of a camera: `supersample` up to the photos' focal length, less for finer cameras."""
    if supersample == 1:
        return 1
    finest = max(view.camera.focal for view in photos)
    return max(1, min(supersample, math.ceil(supersample * finest / camera.focal - SAME)))


def with_rim(camera: Camera, reduction: Reduction, scale: int) -> tuple[Camera, Window]:
    """Returns the camera with the rim of pixels that its reduced picture needs, and the camera's window in that raster.

    The rim ends at the frame. It makes a reduced crop the crop of the reduced picture.
    """
    whole = Window(0, 0, *camera.size)
    frame, rim = camera.frame, reduction.rim if scale > 1 else 0
    left, right = (min(rim, max(0, room)) for room in (frame.left, frame.width - frame.left - camera.width))
    top, below = (min(rim, max(0, room)) for room in (frame.top, frame.height - frame.top - camera.height))
    if not (left or right or top or below):
        return camera, whole
    wide = camera.crop(-left, -top, camera.width + left + right, camera.height + top + below)
    return wide, Window(left, top, *camera.size)


@dataclass(frozen=True, eq=False, kw_only=True)
class FinerRaster:
    """Raster that a camera's picture is rendered on, and its reduction."""

    drawn_for: Camera
    """The camera with its rim; splats are drawn for it."""
    camera: Camera
    """The same at the resolution of the render."""
    window: Window
    """Window of the picture in the reduced one."""
    reduction: Reduction
    scale: int

    def reduced(self, image: Float[Tensor, "C H W"]) -> Float[Tensor, "C h w"]:
        """Returns the picture reduced from its finer render; differentiable, not clamped."""
        return image if self.scale == 1 else self.window.cut(self.reduction.unclamped(image, self.scale))


def finer_raster(camera: Camera, reduction: Reduction, scale: int) -> FinerRaster:
    """Returns the raster of a camera at `scale` its resolution."""
    wide, window = with_rim(camera, reduction, scale)
    finer = wide if scale == 1 else wide.zoom(scale)
    return FinerRaster(drawn_for=wide, camera=finer, window=window, reduction=reduction, scale=scale)
