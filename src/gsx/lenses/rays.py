"""Pixels that a lens shows: those beyond its fold have no ray and do not count."""

from collections.abc import Hashable
from functools import lru_cache

import torch
from torch import Tensor

from gsx.core.data.camera import Camera, LensModel
from gsx.core.data.masks import grown
from gsx.core.shapes import Bool, Float


def pixels_with_rays(camera: Camera, reach: int = 0) -> Bool[Tensor, "H W"] | None:
    """Return which pixels are at least `reach` px from one without a ray; None: all have one."""
    if camera.lens is None:
        return None
    assert isinstance(camera.lens, Hashable)
    return _pixels_with_rays(camera.lens, (camera.fx, camera.fy, camera.cx, camera.cy), camera.size, reach)


@lru_cache(maxsize=256)  # needed at each step
def _pixels_with_rays(
    lens: LensModel, intrinsics: tuple[float, float, float, float], size: tuple[int, int], reach: int
) -> Bool[Tensor, "H W"] | None:
    focal, centre = torch.tensor(intrinsics, dtype=torch.float64).view(2, 2)
    x, y = (torch.arange(-reach, side + reach, dtype=torch.float64) + 0.5 for side in size)

    def lost(pixels: Float[Tensor, "*N 2"]) -> Bool[Tensor, "*N"]:
        rays = lens.straighten(((pixels - centre) / focal).reshape(-1, 2))
        return ~rays.isfinite().all(1).view(pixels.shape[:-1])

    border = [torch.cartesian_prod(x, y[[0, -1]]), torch.cartesian_prod(x[[0, -1]], y)]
    if not bool(lost(torch.cat(border)).any()):  # pixels with a ray lie around the axis without a hole
        return None
    rows = [lost(torch.stack(torch.meshgrid(x, row, indexing="xy"), -1)) for row in y.split(64)]
    near = grown(torch.cat(rows)[None], reach)[0]
    return ~near[reach : len(y) - reach, reach : len(x) - reach]
