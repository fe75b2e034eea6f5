"""Pictures of any size under a memory cap: rendered window by window, without gradient, gathered on the CPU."""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from gsx.core.data.camera import Camera
from gsx.core.data.window import Window
from gsx.core.device import clock
from gsx.core.errors import InputError, TooManyPairs
from gsx.core.gaussians.splats import Splats
from gsx.core.rasterizer.render import Rendering, rasterize
from gsx.core.rasterizer.settings import WINDOW_TILE, RasterSettings
from gsx.core.shapes import Bool, Float

TILE_PIXELS = 1 << 20
"""Pixels rendered at a time where nothing else is said."""


def covering(width: int, height: int, pixels: int, unit: int) -> Iterator[Window]:
    """Squares of at most `pixels` px (but at least one unit) that cover a raster, edges at multiples of `unit` px."""
    edge = max(1, math.isqrt(pixels) // unit) * unit
    for top in range(0, height, edge):
        for left in range(0, width, edge):
            yield Window(left=left, top=top, width=min(edge, width - left), height=min(edge, height - top))


@dataclass(frozen=True, eq=False, kw_only=True)
class TiledRendering:
    """A picture gathered from pieces; its tensors are on the CPU and have no gradient."""

    image: Float[Tensor, "C H W"]
    """Blended colours over the background; not clamped."""
    alpha: Float[Tensor, "H W"]
    """Coverage in [0, 1]."""
    depth: Float[Tensor, "H W"] | None
    """Blending-weighted sum of camera z, scene units; None unless asked for."""
    visible: Bool[Tensor, "N"]
    """Splats with a radius on the whole raster."""
    dropped: int
    """Splats left out because a value of theirs is not finite."""
    windows: int
    """How many were rendered."""
    gathering: float
    """Seconds that it took to copy them to the CPU."""

    @staticmethod
    def empty(splats: Splats, camera: Camera, depth: bool) -> "TiledRendering":
        """Room for the picture."""
        raster, like = (camera.height, camera.width), splats.colours.new_empty(0, device="cpu")
        return TiledRendering(
            image=like.new_empty(splats.colours.shape[1], *raster),
            alpha=like.new_empty(raster),
            depth=like.new_empty(raster) if depth else None,
            visible=torch.zeros(len(splats), dtype=torch.bool),
            dropped=0,
            windows=0,
            gathering=0.0,
        )

    def put(self, window: Window, part: Rendering) -> None:
        """Write one piece into its place."""
        rows, columns = window.pixels
        self.image[:, rows, columns] = part.image.cpu()
        self.alpha[rows, columns] = part.alpha.cpu()
        if self.depth is not None and part.depth is not None:
            self.depth[rows, columns] = part.depth.cpu()
        self.visible[part.screen.ids[part.screen.visible].cpu()] = True


def renderings(
    splats: Splats,
    camera: Camera,
    settings: RasterSettings,
    window: Window,
    background: Float[Tensor, "C"] | None,
    depth: bool,
) -> Iterator[tuple[Window, Rendering]]:
    """The window's rendering, or those of its halves where it has too many intersections or a GPU too little memory,
    and so on to one tile."""
    unit = max(WINDOW_TILE, settings.tile_size)
    try:
        part = rasterize(splats, window.of(camera), settings, background=background, depth=depth)
    except (TooManyPairs, torch.OutOfMemoryError):  # what a GPU cannot hold
        if max(window.width, window.height) <= unit:
            raise
    else:
        yield window, part
        return
    for half in window.halves(unit):
        yield from renderings(splats, camera, settings, half, background, depth)


@torch.no_grad()
def rasterize_tiled(
    splats: Splats,
    camera: Camera,
    settings: RasterSettings,
    *,
    background: Float[Tensor, "C"] | None = None,
    depth: bool = False,
    pixels: int = TILE_PIXELS,
) -> TiledRendering:
    """What `rasterize` draws without gradients, bit for bit, in windows of at most `pixels` px (but at least a tile).

    Beyond the result, memory grows with `pixels` and with the pairs of one window, not with the raster. Windows that
    need more than `settings.max_pairs` pairs, or more memory than a GPU has, are halved until they do not.

    Raises:
        InputError: a single tile needs more pairs than `settings.max_pairs`, or `pixels` is not positive.
    """
    if pixels < 1:
        raise InputError(f"pieces of {pixels} px hold no picture: give 1 or more, such as {TILE_PIXELS}")
    tiled, count, dropped, gathering = TiledRendering.empty(splats, camera, depth), 0, 0, 0.0
    device = splats.means.device
    for window in covering(camera.width, camera.height, pixels, max(WINDOW_TILE, settings.tile_size)):
        for place, part in renderings(splats, camera, settings, window, background, depth):
            begun = clock(device)
            tiled.put(place, part)
            gathering += clock(device) - begun
            count, dropped = count + 1, part.dropped
    return replace(tiled, windows=count, dropped=dropped, gathering=gathering)
