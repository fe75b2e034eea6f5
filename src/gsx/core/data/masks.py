"""Masks of photos, black where something is not part of the scene, as in COLMAP and nerfstudio.

A pixel of a reduced photo counts if no pixel it was made from is masked.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor
from torch.nn.functional import adaptive_max_pool2d, max_pool2d

from gsx.core.data.images import read_image
from gsx.core.data.resize import REACH
from gsx.core.shapes import Bool, Float, UInt8

WHITE = 128
"""Least mask value that counts; lossy formats have no exact white."""
OPAQUE = 255
"""Alpha that counts; lower values show the background."""
INTERPOLATED = 2
"""Reach of undistortion's interpolation, px (Keys' cubic)."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Mask:
    """Mask of one photo."""

    path: Path
    """Mask image, black where the photo does not count, or the photo itself."""
    alpha: bool = False
    """True: `path` is the photo, and its alpha is the mask."""
    remap: Callable[[UInt8[Tensor, "C H W"]], UInt8[Tensor, "C h w"]] | None = None
    """Transformation of the photo, such as undistortion."""
    reach: int = INTERPOLATED
    """Reach of the interpolation in `remap`, px; 0 for rotations by 90 degrees."""

    def masked(self) -> Bool[Tensor, "1 H W"]:
        """Marks masked pixels of the transformed photo, with all that were interpolated from them."""
        picture = read_image(self.path)
        if self.alpha:
            picture = picture if self.remap is None else self.remap(picture)
            out = picture[3:] < OPAQUE if len(picture) == 4 else torch.zeros_like(picture[:1], dtype=torch.bool)
        else:
            out = picture[:1] < WHITE
            out = out if self.remap is None else self.remap((out * 255).to(torch.uint8).repeat(3, 1, 1))[:1] > 0
        return out if self.remap is None else grown(out, self.reach)

    def reduced(self, width: int, height: int, filter: str, whole: tuple[int, int]) -> Bool[Tensor, "1 height width"]:
        """Marks pixels that count in a photo of size `whole`, resized by a filter (`resize.FILTERS`)."""
        return untouched(self.masked(), width, height, filter, whole)


def untouched(
    marked: Bool[Tensor, "1 H W"], width: int, height: int, filter: str, whole: tuple[int, int]
) -> Bool[Tensor, "1 height width"]:
    """Marks pixels of a picture of size `whole`, resized by a filter, that no marked pixel contributes to."""
    touched = adaptive_max_pool2d(marked.float()[None], (height, width))[0] > 0
    return ~grown(touched, REACH.get(filter, 0) if (width, height) != whole else 0)


def grown(masked: Bool[Tensor, "1 H W"], reach: int) -> Bool[Tensor, "1 H W"]:
    """Extends a mask by `reach` px."""
    return max_pool2d(masked.float()[None], 2 * reach + 1, 1, reach)[0] > 0


def where_counted(
    image: Float[Tensor, "C H W"], other: Float[Tensor, "C H W"], counted: Bool[Tensor, "H W"] | None
) -> Float[Tensor, "C H W"]:
    """Returns the image where pixels count and the other elsewhere; None: the image."""
    return image if counted is None else torch.where(counted.to(image.device), image, other)


def black_out(image: Float[Tensor, "C H W"], counted: Bool[Tensor, "H W"] | None) -> Float[Tensor, "C H W"]:
    """Returns the image with masked pixels black."""
    return image if counted is None else torch.where(counted.to(image.device), image, 0)
