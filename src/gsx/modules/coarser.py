"""Views at a fraction of their size."""

from dataclasses import dataclass, field, replace

from torch import Tensor

from gsx.core.data.camera import Camera
from gsx.core.data.masks import grown
from gsx.core.data.reduction import Reduction
from gsx.core.data.scene import View
from gsx.core.shapes import Bool, UInt8


@dataclass(frozen=True, eq=False, kw_only=True)
class CoarseSource:
    """The picture of a view, reduced by the scene's filter (implements `gsx.core.data.scene.ImageSource`)."""

    view: View
    reduction: Reduction
    times: int
    kept: list[UInt8[Tensor, "3 h w"]] = field(default_factory=list)
    """The picture, once made."""
    masks: list[Bool[Tensor, "h w"] | None] = field(default_factory=list)
    """Which pixels count, once computed."""

    def image(self, camera: Camera) -> UInt8[Tensor, "3 h w"]:
        """Return the whole picture: training needs no other."""
        if not self.kept:
            width, height = (side * self.times for side in camera.size)
            fine = self.view.image()[:, :height, :width]
            self.kept.append((self.reduction.reduce(fine, self.times) * 255).round().byte())
        return self.kept[0]

    def max_zoom(self, camera: Camera) -> float:
        """Return 1: there is this picture alone."""
        return 1.0

    def of(self, view: View) -> "CoarseSource":
        """Return the same picture of a view of which other pixels count."""
        return replace(self, view=view, masks=[])

    def counted(self, camera: Camera) -> Bool[Tensor, "h w"] | None:
        """Return pixels that are made of nothing but pixels that count: the filter takes from neighbours, too."""
        if not self.masks:
            fine, (width, height), times = self.view.counted(), camera.size, self.times
            blocks = None if fine is None else fine[: height * times, : width * times]
            whole = None if blocks is None else blocks.reshape(height, times, width, times).all(3).all(1)
            self.masks.append(None if whole is None else ~grown(~whole[None], self.reduction.rim)[0])
        return self.masks[0]


LEAST = 32
"""Pixels that the shorter side of a picture keeps: smaller ones say little, and SSIM looks at windows of 11."""


def coarser(view: View, reduction: Reduction, times: int) -> View:
    """Return a view `times` as coarse, or the view itself where fewer than `LEAST` pixels would be left.

    What is left over at its right and lower borders does not show.
    """
    if times == 1 or min(view.camera.size) < LEAST * times:
        return view
    across, down = (side // times for side in view.camera.size)
    camera = replace(view.camera, width=across * times, height=down * times).resize(across, down)
    return replace(view, camera=camera, source=CoarseSource(view=view, reduction=reduction, times=times))
