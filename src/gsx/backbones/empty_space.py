"""Space that photos show to be empty: where a cut-out picture is transparent, nothing lies before the camera.

Random points (3D-GS starts NeRF-synthetic scenes from 100,000 in a cube) are mostly there: of all that a scene is made
of nothing lies outside its visual hull (Laurentini 1994).
"""

from collections.abc import Sequence

import torch
from torch import Tensor

from gsx.core.data.scene import View
from gsx.core.shapes import Bool, Float

WITNESSES = 2
"""Views that have to show it: one alone may have a wrong pose."""


def in_empty_space(positions: Float[Tensor, "P 3"], views: Sequence[View]) -> Bool[Tensor, "P"]:
    """Marks world points where at least `WITNESSES` views are transparent; none where pictures have no alpha."""
    witnesses = torch.zeros(len(positions), dtype=torch.int64, device=positions.device)
    for view in views:
        empty = view.transparent()
        if empty is not None:
            witnesses += in_empty_pixel(positions, view, empty)
    return witnesses >= WITNESSES


def in_empty_pixel(positions: Float[Tensor, "P 3"], view: View, empty: Bool[Tensor, "H W"]) -> Bool[Tensor, "P"]:
    """Marks points that a view has in an empty pixel."""
    pixels, depths = view.camera.project(positions)
    inside = view.camera.shows(pixels, depths)
    column, row = torch.where(inside[:, None], pixels, 0).long().unbind(1)
    return inside & empty.to(positions.device)[row, column]
