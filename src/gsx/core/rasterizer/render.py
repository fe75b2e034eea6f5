"""Rendering of splats by a camera: `rasterize`."""

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from gsx.core.data.camera import Camera
from gsx.core.gaussians.splats import Splats
from gsx.core.rasterizer.composite import composite_eager
from gsx.core.rasterizer.grid import TileGrid
from gsx.core.rasterizer.intersections import capped, intersect_tiles
from gsx.core.rasterizer.projection import ScreenSplats, project
from gsx.core.rasterizer.settings import RasterSettings
from gsx.core.shapes import Bool, Float, Int


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

    @staticmethod
    def before_blending(
        screen: ScreenSplats, radii: Int[Tensor, "M"], size: tuple[int, int], learning: bool, absolute: bool
    ) -> "ScreenStatistics":
        """Returns the statistics before blending, with zeros for gradients."""
        zeros = [torch.zeros_like(screen.means, requires_grad=learning) for _ in range(1 + absolute)]
        return ScreenStatistics(
            ids=screen.ids,
            radii=radii,
            means2d_offset=zeros[0],
            absgrad=zeros[1] if absolute else None,
            max_weights=None,
            size=size,
        )

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
    intersections = capped(intersect_tiles(screen, camera, settings), settings.tile_cap)
    learning = torch.is_grad_enabled() and any(value.requires_grad for value in vars(splats).values())
    statistics = ScreenStatistics.before_blending(screen, intersections.radii, camera.size, learning, absolute_gradient)
    channels = torch.cat([screen.channels, screen.depths[:, None]], 1) if depth else screen.channels
    screen = replace(
        screen, means=screen.means + statistics.means2d_offset, absgrad=statistics.absgrad, weigh=max_weight
    )
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
        screen=replace(statistics, max_weights=max_weights),
    )
