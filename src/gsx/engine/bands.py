"""Training pictures of many splat-tile pairs on a CPU: blended in bands of tile rows, and again for their gradients.

From the forward to the backward pass a picture then keeps its lists of pairs alone, and one band at a time needs memory
for blending. Sums over bands round differently from sums over the picture.
"""

from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import torch
from torch import Tensor

from gsx.core.backend import EAGER, Backend
from gsx.core.rasterizer.compositor import Compositor
from gsx.core.rasterizer.grid import TileGrid
from gsx.core.rasterizer.intersections import TileIntersections
from gsx.core.rasterizer.projection import ScreenSplats
from gsx.core.rasterizer.settings import RasterSettings
from gsx.core.rasterizer.sorting import sorted_stably
from gsx.core.shapes import Float, Int
from gsx.engine.allocator import return_freed_memory

PAIRS = 1 << 22
"""Most pairs of a picture that is not cut: blending keeps about 150 B for each, in eager torch 440 B."""
SHARE = 4
"""Each band has about `pairs` / SHARE of them."""
FIELDS = "means", "conic_factors", "log_opacities", "absgrad", "channels"
"""Fields of screen splats with gradients."""


@dataclass(frozen=True)
class InBands:
    """A `Compositor` that blends training pictures of more than `pairs` pairs on a CPU in bands."""

    composite: Compositor
    backend: Backend = EAGER
    pairs: int = PAIRS

    def __call__(
        self,
        screen: ScreenSplats,
        channels: Float[Tensor, "M C"],
        intersections: TileIntersections,
        grid: TileGrid,
        settings: RasterSettings,
    ) -> tuple[Float[Tensor, "C_plus_1 H W"], Float[Tensor, "M"] | None]:
        few = len(intersections.splats) <= self.pairs
        if few or screen.weigh or screen.means.device.type != "cpu":
            return self.composite(screen, channels, intersections, grid, settings)
        fields = [channels if name == "channels" else getattr(screen, name) for name in FIELDS]
        if not torch.is_grad_enabled() or not any(field is not None and field.requires_grad for field in fields):
            return self.composite(screen, channels, intersections, grid, settings)
        nearness = nearness_of(intersections)

        def blend(rows: range, fields: list[Any]) -> Float[Tensor, "C_plus_1 h W"]:
            splats = replace(screen, **dict(zip(FIELDS, fields, strict=True)))
            pairs, raster = pairs_of(intersections, nearness, rows, grid), band_of(grid, rows)
            return self.composite(splats, splats.channels, pairs, raster, settings)[0]

        return Picture.apply(blend, band_rows(intersections.starts, grid, -(-self.pairs // SHARE)), *fields), None


class Picture(torch.autograd.Function):
    """Autograd function of a picture blended in bands by `blend(rows, fields)`, and again in the backward pass."""

    @staticmethod
    def forward(ctx, blend, bands, *fields):
        return_freed_memory()  # what earlier tensors, of other sizes, left
        ctx.blend, ctx.bands = blend, bands
        ctx.save_for_backward(*fields)
        held = [field if field is None else field.detach() for field in fields]
        return torch.cat([blend(rows, held) for rows in bands], 1)

    @staticmethod
    def backward(ctx, gradient):
        return_freed_memory()
        leaves = [field if field is None else field.detach().requires_grad_() for field in ctx.saved_tensors]
        top = 0
        for rows in ctx.bands:
            with torch.enable_grad():
                part = ctx.blend(rows, leaves)
            part.backward(gradient[:, top : top + part.shape[1]])
            top += part.shape[1]
        return None, None, *(leaf if leaf is None else leaf.grad for leaf in leaves)


def band_rows(starts: Int[Tensor, "T_plus_1"], grid: TileGrid, pairs: int) -> list[range]:
    """Cuts a picture with those first pairs of tiles into bands of whole tile rows, of about `pairs` pairs each."""
    columns, rows = grid.shape
    edges = torch.arange(pairs, int(starts[-1]), pairs, device=starts.device, dtype=starts.dtype)
    cuts = torch.searchsorted(starts[::columns].contiguous(), edges).tolist()
    limits = sorted({0, rows, *cuts})
    return [range(first, past) for first, past in pairwise(limits)]


def band_of(grid: TileGrid, rows: range) -> TileGrid:
    """Returns the grid of some tile rows of a picture."""
    above = grid.first[1]
    top, bottom = (
        min(max(grid.top, (above + row) * grid.tile), grid.top + grid.height) for row in (rows.start, rows.stop)
    )
    return replace(grid, top=top, height=bottom - top)


def nearness_of(every: TileIntersections) -> Int[Tensor, "M"]:
    """Returns the place of each splat in the order of blending."""
    nearness = torch.empty_like(every.order)
    nearness[every.order] = torch.arange(len(every.order))
    return nearness


def pairs_of(every: TileIntersections, nearness: Int[Tensor, "M"], rows: range, grid: TileGrid) -> TileIntersections:
    """Returns the intersections with some tile rows of a picture; `nearness`: of all splats."""
    first, past = (row * grid.shape[0] for row in (rows.start, rows.stop))
    begin, end = every.starts[[first, past]].tolist()
    splats = every.splats[begin:end]
    ranks, places = sorted_stably(nearness[splats])
    slots = torch.empty_like(places)
    slots[places] = torch.arange(len(places))
    return replace(
        every,
        splats=splats,
        tiles=every.tiles[begin:end] - first,
        starts=every.starts[first : past + 1] - begin,
        slots=slots,
        counts=ranks.bincount(minlength=len(every.order)),
    )
