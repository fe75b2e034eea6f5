"""Masks of photographs, black where these show what is not part of the scene, as COLMAP and nerfstudio have them.

A pixel of a reduced picture counts where nothing it was made from is masked.
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
"""Values of a mask from here on count: lossy formats leave no exact white."""
OPAQUE = 255
"""Alpha that counts: less shows what is behind."""
INTERPOLATED = 2
"""Pixels that undistortion takes from on each side (Keys' cubic)."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Mask:
    """The mask of one photograph."""

    path: Path
    """A picture, black where the photograph does not count; or the photograph itself, whose alpha is meant."""
    alpha: bool = False
    remap: Callable[[UInt8[Tensor, "C H W"]], UInt8[Tensor, "C h w"]] | None = None
    """What is done to the photograph, undistortion for example."""
    reach: int = INTERPOLATED
    """Pixels that `remap` takes from on each side; 0 where it only turns pictures."""

    def masked(self) -> Bool[Tensor, "1 H W"]:
        """Return which pixels of the undistorted mask do not count, with all that interpolation took from them."""
        picture = read_image(self.path)
        if self.alpha:
            picture = picture if self.remap is None else self.remap(picture)
            out = picture[3:] < OPAQUE if len(picture) == 4 else torch.zeros_like(picture[:1], dtype=torch.bool)
        else:
            out = picture[:1] < WHITE
            out = out if self.remap is None else self.remap((out * 255).to(torch.uint8).repeat(3, 1, 1))[:1] > 0
        return out if self.remap is None else grown(out, self.reach)

    def reduced(self, width: int, height: int, filter: str, whole: tuple[int, int]) -> Bool[Tensor, "1 height width"]:
        """Return which pixels count of a photograph of the size `whole`, resized by a filter (`resize.FILTERS`)."""
        return untouched(self.masked(), width, height, filter, whole)


def untouched(
    marked: Bool[Tensor, "1 H W"], width: int, height: int, filter: str, whole: tuple[int, int]
) -> Bool[Tensor, "1 height width"]:
    """Return which pixels of a picture of the size `whole`, resized by a filter, are made from no marked one."""
    touched = adaptive_max_pool2d(marked.float()[None], (height, width))[0] > 0
    return ~grown(touched, REACH.get(filter, 0) if (width, height) != whole else 0)


def grown(masked: Bool[Tensor, "1 H W"], reach: int) -> Bool[Tensor, "1 H W"]:
    """Grow a mask by all pixels within `reach` of it."""
    return max_pool2d(masked.float()[None], 2 * reach + 1, 1, reach)[0] > 0


def where_counted(
    image: Float[Tensor, "C H W"], other: Float[Tensor, "C H W"], counted: Bool[Tensor, "H W"] | None
) -> Float[Tensor, "C H W"]:
    """Return the image where pixels count, the other elsewhere; the image itself where there is no mask."""
    return image if counted is None else torch.where(counted.to(image.device), image, other)


def blacked(image: Float[Tensor, "C H W"], counted: Bool[Tensor, "H W"] | None) -> Float[Tensor, "C H W"]:
    """Blacken an image where pixels do not count, so that pictures can be compared whatever is there."""
    return image if counted is None else torch.where(counted.to(image.device), image, 0)
