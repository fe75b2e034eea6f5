"""Rendering of large pictures in windows, without gradients, with bounded memory; the result is on the CPU."""

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
"""Default size of a window, px."""


def covering(width: int, height: int, pixels: int, unit: int) -> Iterator[Window]:
    """Yields squares that cover a raster, of at most `pixels` px but at least one unit, at multiples of `unit` px."""
    edge = max(1, math.isqrt(pixels) // unit) * unit
    for top in range(0, height, edge):
        for left in range(0, width, edge):
            yield Window(left=left, top=top, width=min(edge, width - left), height=min(edge, height - top))


@dataclass(frozen=True, eq=False, kw_only=True)
class TiledRendering:
    """Picture assembled from windows, on the CPU and without gradients."""

    image: Float[Tensor, "C H W"]
    """Blended colours over the background; not clamped."""
    alpha: Float[Tensor, "H W"]
    """Coverage in [0, 1]."""
    depth: Float[Tensor, "H W"] | None
    """Blending-weighted sum of camera z, scene units; None: not computed."""
    visible: Bool[Tensor, "N"]
    """Splats that touch a tile of the raster."""
    dropped: int
    """Number of splats left out because of values that are not finite."""
    windows: int
    """Number of rendered windows."""
    gathering: float
    """Time of copies to the CPU, s."""

    @staticmethod
    def empty(splats: Splats, camera: Camera, depth: bool) -> "TiledRendering":
        """Returns an empty picture."""
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
        """Copies the render of a window to its place."""
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
    """Yields the render of a window, or of its halves, down to one tile, if pairs exceed the limit or GPU memory."""
    unit = max(WINDOW_TILE, settings.tile_size)
    try:
        part = rasterize(splats, window.of(camera), settings, background=background, depth=depth)
    except (TooManyPairs, torch.OutOfMemoryError):
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
    """Renders the same bits as `rasterize`, without gradients, in windows of at most `pixels` px (but at least a tile).

    Windows with too many pairs for `settings.max_pairs` or the GPU's memory are halved.

    Raises:
        InputError: a single tile needs more pairs than `settings.max_pairs`, or `pixels` is not positive.
    """
    if pixels < 1:
        raise InputError(f"windows of {pixels} px hold no picture: give 1 or more, such as {TILE_PIXELS}")
    tiled, count, dropped, gathering = TiledRendering.empty(splats, camera, depth), 0, 0, 0.0
    device = splats.means.device
    for window in covering(camera.width, camera.height, pixels, max(WINDOW_TILE, settings.tile_size)):
        for place, part in renderings(splats, camera, settings, window, background, depth):
            start = clock(device)
            tiled.put(place, part)
            gathering += clock(device) - start
            count, dropped = count + 1, part.dropped
    return replace(tiled, windows=count, dropped=dropped, gathering=gathering)
