"""Rendering of splats by a camera: `rasterize`, and `rasterize_tiled` for large pictures in bounded memory."""

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
from gsx.core.rasterizer.composite import composite_eager
from gsx.core.rasterizer.grid import TileGrid
from gsx.core.rasterizer.intersections import cap_tiles, intersect_tiles
from gsx.core.rasterizer.projection import project
from gsx.core.rasterizer.settings import WINDOW_TILE, RasterSettings
from gsx.core.shapes import Bool, Float, Int

TILE_PIXELS = 1 << 20
"""Default size of a window, px."""


@dataclass(frozen=True, eq=False, kw_only=True)
class ScreenStatistics:
    """Screen values of M splats near the raster; their gradients exist after the backward pass."""

    ids: Int[Tensor, "M"]
    """Row of each splat in the input."""
    radii: Int[Tensor, "M"]
    """Published radius, px; 0: touches no tile."""
    means2d_offset: Float[Tensor, "M 2"]
    """Zeros added to the screen means; their gradient is that of the means by blending, px (3D-GS)."""
    absgrad: Float[Tensor, "M 2"] | None
    """Zeros whose gradient is the sum over pixels of absolute gradients, px; None: not computed."""
    max_weights: Float[Tensor, "M"] | None
    """Largest blending weight over all pixels; None: not computed."""
    size: tuple[int, int]
    """(width, height) of the raster."""

    @property
    def visible(self) -> Bool[Tensor, "M"]:
        """Splats that touch a tile, whether or not a pixel is shaded (3D-GS, forward.cu)."""
        return self.radii > 0

    def ndc_gradient(self, of: Tensor) -> Float[Tensor, "M 2"]:
        """Returns the gradient of `means2d_offset` or `absgrad` in NDC, px times half the raster (3D-GS)."""
        gradient = of.grad if of.grad is not None else torch.zeros_like(of)
        return torch.stack([along * side / 2 for along, side in zip(gradient.unbind(1), self.size, strict=True)], 1)


@dataclass(frozen=True, eq=False, kw_only=True)
class Rendering:
    """A rendered picture with screen statistics."""

    image: Float[Tensor, "C H W"]
    """Blended colours over the background; not clamped."""
    alpha: Float[Tensor, "H W"]
    """Coverage in [0, 1]."""
    depth: Float[Tensor, "H W"] | None
    """Blending-weighted sum of camera z, scene units (divide by alpha for a mean); None: not computed."""
    screen: ScreenStatistics
    intersections: int
    """Number of blended splat-tile pairs."""
    dropped: int
    """Number of splats left out because of values that are not finite."""


def rasterize(
    splats: Splats,
    camera: Camera,
    settings: RasterSettings,
    *,
    background: Float[Tensor, "C"] | None = None,
    intrinsics: Float[Tensor, "4"] | None = None,
    depth: bool = False,
    absolute_gradient: bool = False,
    max_weight: bool = False,
) -> Rendering:
    """Renders splats; differentiable in their fields, the background, intrinsics, and the camera's pose.

    Args:
        splats: N splats.
        camera: Camera; its rotation is differentiable as nine free numbers.
        settings: Rules of the rasterizer.
        background: Colour behind the splats; None: black.
        intrinsics: (fx, fy, cx, cy) in px that replace the camera's.
        depth: True: renders depth.
        absolute_gradient: True: collects absolute gradients (`ScreenStatistics.absgrad`).
        max_weight: True: returns largest blending weights (`ScreenStatistics.max_weights`).

    Raises:
        InputError: the camera cannot project.
        TooManyPairs: there are more splat-tile pairs than `settings.max_pairs`.
    """
    screen = project(splats, camera, settings, intrinsics)
    intersections = cap_tiles(intersect_tiles(screen, camera, settings), settings.tile_cap)
    learning = torch.is_grad_enabled() and any(value.requires_grad for value in vars(splats).values())
    zeros = [torch.zeros_like(screen.means, requires_grad=learning) for _ in range(1 + absolute_gradient)]
    offset, absgrad = zeros[0], zeros[1] if absolute_gradient else None
    channels = torch.cat([screen.channels, screen.depths[:, None]], 1) if depth else screen.channels
    screen = replace(screen, means=screen.means + offset, absgrad=absgrad, weigh=max_weight)
    composite = settings.compositors.get(settings.compositor_name, composite_eager)
    grid = TileGrid.of(camera, settings.tile_size)
    blended, max_weights = composite(screen, channels, intersections, grid, settings)
    count = splats.colours.shape[1]
    image, alpha = blended[:count], blended[-1]
    if background is not None:
        image = image + (1 - alpha) * background.to(image)[:, None, None]
    return Rendering(
        image=image,
        alpha=alpha,
        depth=blended[count] if depth else None,
        intersections=len(intersections.splats),
        dropped=screen.dropped,
        screen=ScreenStatistics(
            ids=screen.ids,
            radii=intersections.radii,
            means2d_offset=offset,
            absgrad=absgrad,
            max_weights=max_weights,
            size=camera.size,
        ),
    )


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
