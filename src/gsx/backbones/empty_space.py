"""Empty space: a scene lies inside the visual hull of its cut-out photos (Laurentini 1994).

Most random initial points lie outside it (3D-GS starts NeRF-synthetic scenes from 100,000 in a cube).
"""

from collections.abc import Sequence

import torch
from torch import Tensor

from gsx.core.data.scene import View
from gsx.core.shapes import Bool, Float

WITNESSES = 2
"""Views that must agree: one alone may have a wrong pose."""


def in_empty_space(positions: Float[Tensor, "P 3"], views: Sequence[View]) -> Bool[Tensor, "P"]:
    """Marks world points that at least `WITNESSES` views show as transparent; none without alpha channels."""
    witnesses = torch.zeros(len(positions), dtype=torch.int64, device=positions.device)
    for view in views:
        empty = view.transparent()
        if empty is not None:
            pixels, depths = view.camera.project(positions)
            inside = view.camera.shows(pixels, depths)
            column, row = torch.where(inside[:, None], pixels, 0).long().unbind(1)
            witnesses += inside & empty.to(positions.device)[row, column]
    return witnesses >= WITNESSES
