"""Which pixels of a photograph count: masks, black where it shows what is not part of the scene.

So COLMAP (`masks/NAME.png`) and nerfstudio (`mask_path`) have them. A pixel of a reduced picture counts where nothing
it was made from is masked.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor
from torch.nn.functional import max_pool2d

from gsx.core.data.images import read_image
from gsx.core.data.resize import REACH, resize
from gsx.core.shapes import Bool, Float, UInt8

WHITE = 128
"""Values of a mask from here on count: lossy formats leave no exact white."""
OPAQUE = 255
"""Alpha that counts: less shows what is behind."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Mask:
    """The mask of one photograph."""

    path: Path
    """A picture, black where the photograph does not count; or the photograph itself, whose alpha is meant."""
    alpha: bool = False
    remap: Callable[[UInt8[Tensor, "C H W"]], UInt8[Tensor, "C h w"]] | None = None
    """What is done to the photograph, undistortion for example."""

    def read(self) -> Bool[Tensor, "1 H W"]:
        """Which pixels count, on the mask's own raster, undistorted.

        Raises:
            InputError: the file cannot be read.
        """
        picture = read_image(self.path)
        if self.remap is not None:
            picture = self.remap(picture)
        if not self.alpha:
            return picture[:1] >= WHITE
        return picture[3:] >= OPAQUE if len(picture) == 4 else torch.ones_like(picture[:1], dtype=torch.bool)

    def reduced(self, width: int, height: int, filter: str) -> Bool[Tensor, "1 height width"]:
        """Which pixels of the photograph count once it is resized by a filter (`resize.FILTERS`)."""
        masked = ~self.read()
        smaller = masked.shape[2] > width or masked.shape[1] > height
        touched = resize(masked.to(torch.uint8) * 255, width, height, "area") > 0
        reach = REACH.get(filter, 0) if smaller else 0
        spread = max_pool2d(touched.float()[None], 2 * reach + 1, 1, reach)[0]
        return spread == 0


def where_counted(
    image: Float[Tensor, "C H W"], other: Float[Tensor, "C H W"], counted: Bool[Tensor, "H W"] | None
) -> Float[Tensor, "C H W"]:
    """The image where pixels count, the other elsewhere; the image itself where there is no mask."""
    return image if counted is None else torch.where(counted.to(image.device), image, other)


def blacked(image: Float[Tensor, "C H W"], counted: Bool[Tensor, "H W"] | None) -> Float[Tensor, "C H W"]:
    """The image, black where pixels do not count: pictures are compared so, whatever is there."""
    return image if counted is None else torch.where(counted.to(image.device), image, 0)
