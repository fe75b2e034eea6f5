"""Training views derived from others: at a fraction of their size, with another pose, or masked."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from gsx.core.data.camera import Camera
from gsx.core.data.masks import grown
from gsx.core.data.reduction import Reduction
from gsx.core.data.scene import CutOut, DerivedSource, ImageSource, View
from gsx.core.shapes import Bool, Int, UInt8

MIN_SIDE = 32
"""Fewest pixels of an image's shorter side: smaller ones show little, and SSIM needs windows of 11."""


@dataclass(frozen=True, eq=False, kw_only=True)
class CoarseSource:
    """The image of a view, reduced by the scene's filter; an `ImageSource`."""

    view: View
    reduction: Reduction
    times: int
    images: list[UInt8[Tensor, "3 h w"]] = field(default_factory=list)
    """The reduced image, once computed."""
    masks: list[Bool[Tensor, "h w"] | None] = field(default_factory=list)
    """Mask of the pixels that count, once computed."""

    def image(self, camera: Camera) -> UInt8[Tensor, "3 h w"]:
        """Returns the whole image: training needs no other."""
        if not self.images:
            width, height = (side * self.times for side in camera.size)
            fine = self.view.image()[:, :height, :width]
            self.images.append((self.reduction.reduce(fine, self.times) * 255).round().byte())
        return self.images[0]

    def max_zoom(self, camera: Camera) -> float:
        """Returns 1: there is only this image."""
        return 1.0

    def of(self, view: View) -> "CoarseSource":
        """Returns the same image for a view with another mask."""
        return replace(self, view=view, masks=[])

    def counted(self, camera: Camera) -> Bool[Tensor, "h w"] | None:
        """Returns pixels made only of pixels that count, including the neighbours that the filter reads."""
        if not self.masks:
            fine, (width, height), times = self.view.counted(), camera.size, self.times
            blocks = None if fine is None else fine[: height * times, : width * times]
            whole = None if blocks is None else blocks.reshape(height, times, width, times).all(3).all(1)
            self.masks.append(None if whole is None else ~grown(~whole[None], self.reduction.rim)[0])
        return self.masks[0]


def reduce_view(view: View, reduction: Reduction, times: int) -> View:
    """Returns a view `times` as coarse, without incomplete pixels at its right and lower borders.

    Returns the view itself where fewer than MIN_SIDE pixels would be left.
    """
    if times == 1 or min(view.camera.size) < MIN_SIDE * times:
        return view
    across, down = (side // times for side in view.camera.size)
    camera = replace(view.camera, width=across * times, height=down * times).resize(across, down)
    return replace(view, camera=camera, source=CoarseSource(view=view, reduction=reduction, times=times))


@dataclass(frozen=True, eq=False, kw_only=True)
class FixedPoseSource(DerivedSource):
    """Images from one pose, whatever the pose of the view."""

    fixed: Camera
    """Camera of that pose."""

    def image(self, camera: Camera) -> UInt8[Tensor, "3 H W"]:
        """Returns the image from the fixed pose."""
        return super().image(camera.with_pose_of(self.fixed))

    def max_zoom(self, camera: Camera) -> float:
        """Returns the source's largest zoom from the fixed pose."""
        return super().max_zoom(camera.with_pose_of(self.fixed))

    def counted(self, camera: Camera) -> Bool[Tensor, "H W"] | None:
        """Returns which pixels count from the fixed pose."""
        return super().counted(camera.with_pose_of(self.fixed))


def fixed_source(view: View) -> ImageSource:
    """Returns the source of a view for views of other poses: computed images keep this pose, files have none."""
    fixed = view.file is not None or isinstance(view.source, FixedPoseSource)
    return view.source if fixed else FixedPoseSource(source=view.source, fixed=view.camera)


def change_pose(view: View, camera: Camera) -> View:
    """Returns the view with the pose of a camera and its present photo."""
    return replace(view, camera=view.camera.with_pose_of(camera), source=fixed_source(view))


@dataclass(frozen=True, eq=False, kw_only=True)
class MaskedSource(DerivedSource):
    """A photo with masked blocks."""

    masked: Bool[Tensor, "h w"]
    """Masked blocks of whole pixels of the photo; the last row and column include the remaining pixels."""
    size: tuple[int, int]
    """(width, height) of the photo, px."""

    def counted(self, camera: Camera) -> Bool[Tensor, "H W"]:
        """Returns the pixels that count in the other source and are not masked."""
        (height, width), frame = self.masked.shape, camera.frame
        down = block_of(frame.top, camera.height, frame.height, self.size[1], height)
        across = block_of(frame.left, camera.width, frame.width, self.size[0], width)
        clear, counted = ~self.masked[down[:, None], across], super().counted(camera)
        return clear if counted is None else clear & counted

    def transparent(self, camera: Camera) -> Bool[Tensor, "H W"] | None:
        """Returns the pixels of the other source that show only the background."""
        return self.source.transparent(camera) if isinstance(self.source, CutOut) else None


def block_of(first: int, count: int, frame: int, size: int, blocks: int) -> Int[Tensor, "P"]:
    """Returns the block of each of `count` pixels from `first` on along an axis.

    frame: pixels of the whole photo at their scale. size: px of the photo. blocks: of the photo.
    """
    places = (torch.arange(count) + 0.5 + first) / frame * size
    return (places / max(1, size // blocks)).long().clamp(0, blocks - 1)


def mask_views(views: Sequence[View], masks: Sequence[Bool[Tensor, "h w"]]) -> list[View]:
    """Returns views with masked photos."""
    return [mask_view(view, mask) for view, mask in zip(views, masks, strict=True)]


def mask_view(view: View, mask: Bool[Tensor, "h w"]) -> View:
    """Returns the view with a masked photo; a coarse pixel counts if no part of it is masked."""
    if not bool(mask.any()):
        return view
    if isinstance(view.source, CoarseSource):
        return replace(view, source=view.source.of(mask_view(view.source.view, mask)))
    frame = view.camera.frame
    return replace(view, source=MaskedSource(source=view.source, masked=mask, size=(frame.width, frame.height)))
