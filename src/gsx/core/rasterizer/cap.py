"""A bound on the work per tile: only the nearest splats of each list are kept."""

from dataclasses import replace

import torch

from gsx.core.rasterizer.pairs import Pairs


def capped(pairs: Pairs, cap: int) -> Pairs:
    """The first `cap` pairs of every tile, which are its nearest splats; all of them where `cap` is 0.

    Radii are kept: a splat that lost all its tiles still counts as visible, as it does behind opaque ones.
    """
    if not cap or not len(pairs.tiles):
        return pairs
    number = torch.arange(len(pairs.tiles), device=pairs.tiles.device) - pairs.starts[pairs.tiles.long()]
    kept = number < cap
    lengths = pairs.starts.diff().clamp(max=cap)
    kept_by_splat = torch.empty_like(kept).index_put_((pairs.slots,), kept)
    owner = torch.repeat_interleave(pairs.counts)
    return replace(
        pairs,
        splats=pairs.splats[kept],
        tiles=pairs.tiles[kept],
        starts=torch.cat([pairs.starts[:1], lengths.cumsum(0).to(pairs.starts)]),
        slots=(kept_by_splat.cumsum(0) - 1)[pairs.slots[kept]],
        counts=torch.bincount(owner[kept_by_splat], minlength=len(pairs.counts)),
    )
