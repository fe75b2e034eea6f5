"""Pictures reduced from finer renders, by the filter that made the photographs: the loss knows how a pixel came about.

Neighbouring photographs sample a scene between each other's pixels. A loss that compares photographs with reduced
renders lets them (NeRF-SR, Wang et al. 2022; SRGS, Feng et al. 2024).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from torch import Tensor

from gsx.core.data.camera import Camera
from gsx.core.data.reduction import Reduction
from gsx.core.data.scene import Scene, View
from gsx.core.data.window import Window
from gsx.core.shapes import Float

SAME = 1e-6
"""Relative difference of focal lengths that rounding may make."""


def times_as_fine(camera: Camera, photographs: Sequence[View], supersample: int) -> int:
    """How many times as fine as its raster a camera is rendered: `supersample` at the focal length of the photographs
    and below, less for cameras that are finer themselves."""
    if supersample == 1:
        return 1
    finest = max(view.camera.focal for view in photographs)
    return max(1, min(supersample, math.ceil(supersample * finest / camera.focal - SAME)))


def with_rim(camera: Camera, reduction: Reduction, times: int) -> tuple[Camera, Window]:
    """(the camera, with the pixels beside it that its reduced picture takes from as far as its frame has any; where the
    camera lies in that raster). A reduced crop is then the crop of the reduced picture."""
    whole = Window(0, 0, *camera.size)
    frame, rim = camera.frame, reduction.rim if times > 1 else 0
    left, right = (min(rim, max(0, room)) for room in (frame.left, frame.width - frame.left - camera.width))
    top, below = (min(rim, max(0, room)) for room in (frame.top, frame.height - frame.top - camera.height))
    if not (left or right or top or below):
        return camera, whole
    wide = camera.crop(-left, -top, camera.width + left + right, camera.height + top + below)
    return wide, Window(left, top, *camera.size)


@dataclass(frozen=True, eq=False, kw_only=True)
class FinerRaster:
    """Where a camera's picture is rendered, and how it comes from there."""

    drawn_for: Camera
    """Whose splats are drawn: the camera, with its rim."""
    camera: Camera
    """The same, as fine as it is rendered."""
    window: Window
    """Where the picture lies in the reduced one."""
    reduction: Reduction
    times: int

    def reduced(self, image: Float[Tensor, "C H W"]) -> Float[Tensor, "C h w"]:
        """The picture from its finer render, differentiable and not clamped."""
        return image if self.times == 1 else self.window.cut(self.reduction.formed(image, self.times))


def finer_raster(camera: Camera, reduction: Reduction, times: int) -> FinerRaster:
    """Of a camera that is rendered `times` as fine as its raster."""
    wide, window = with_rim(camera, reduction, times)
    finer = wide if times == 1 else wide.zoom(times)
    return FinerRaster(drawn_for=wide, camera=finer, window=window, reduction=reduction, times=times)


def raster_at(camera: Camera, scene: Scene, supersample: int) -> FinerRaster:
    """Of a camera at a step at which photographs of the scene are rendered `supersample` times as fine."""
    return finer_raster(camera, scene.reduction, times_as_fine(camera, scene.train, supersample))
