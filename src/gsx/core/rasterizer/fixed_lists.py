"""Lists whose sizes are given beforehand, so that the host need not wait for a device to hear them."""

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from gsx.core.shapes import Float, Int


@dataclass(frozen=True, kw_only=True)
class ListSizes:
    """Room in lists. Whether it was enough is told by `Needed`; if not, the picture is wrong."""

    rows: int
    """Rows of tiles that splats reach, in all."""
    pairs: int
    blocks: int
    """Of entries that are blended at once; one more than are needed."""
    longest: int
    """Blocks of a tile."""

    def hold(self, needed: "Needed") -> bool:
        """Whether a picture that needs so much is right."""
        fits = needed.rows <= self.rows and needed.pairs <= self.pairs
        return fits and needed.blocks < self.blocks and needed.longest <= self.longest


@dataclass(frozen=True, eq=False, kw_only=True)
class FixedLists(ListSizes):
    """Room for what the picture of a camera needs."""

    lens: Float[Tensor, "16"]
    """`Lens` of the camera, whose pose lies where the splats do; its numbers have been checked."""
    raster: Int[Tensor, "2 5"]
    """`raster_numbers` of the camera."""


class Needed(NamedTuple):
    """What a picture needed."""

    dropped: int
    """Splats left out because a value of theirs is not finite."""
    rows: int
    pairs: int
    blocks: int
    longest: int


def owners(counts: Int[Tensor, "N"], size: int, fixed: bool) -> Int[Tensor, "R"]:
    """Whose each entry of a list is, in which row n has counts[n] entries and follows row n - 1; `size` are their sum,
    or fixed: then entries that are nobody's are the last one's."""
    if not fixed:
        return torch.repeat_interleave(counts, output_size=size)
    place = torch.arange(size, device=counts.device)
    return torch.searchsorted(counts.cumsum(0), place, right=True).clamp_max(len(counts) - 1)
