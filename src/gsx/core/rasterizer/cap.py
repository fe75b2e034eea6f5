"""A bound on the work per tile: only the nearest splats of each list are kept."""

from dataclasses import replace

import torch

from gsx.core.rasterizer.intersections import TileIntersections


def capped(every: TileIntersections, cap: int) -> TileIntersections:
    """The first `cap` intersections of every tile, with its nearest splats; all of them where `cap` is 0.

    Radii are kept: a splat that lost all its tiles still counts as visible, as it does behind opaque ones.
    """
    if not cap or not len(every.tiles):
        return every
    number = torch.arange(len(every.tiles), device=every.tiles.device) - every.starts[every.tiles.long()]
    kept = number < cap
    lengths = every.starts.diff().clamp(max=cap)
    kept_by_splat = torch.empty_like(kept).index_put_((every.slots,), kept)
    owner = torch.repeat_interleave(every.counts)
    return replace(
        every,
        splats=every.splats[kept],
        tiles=every.tiles[kept],
        starts=torch.cat([every.starts[:1], lengths.cumsum(0).to(every.starts)]),
        slots=(kept_by_splat.cumsum(0) - 1)[every.slots[kept]],
        counts=torch.bincount(owner[kept_by_splat], minlength=len(every.counts)),
    )
