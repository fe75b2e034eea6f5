"""A yardstick: one tile after another, all its splats at all its pixels, gradients by autograd.

This is how the equations read and how most plain torch rasterizers are written. It has no lists of pairs: every tile
looks at every splat's box. Draws what `cull=tight` draws.
"""

import math

import torch
from torch import Tensor

from gsx.core.data.camera import Camera
from gsx.core.rasterizer import RasterSettings
from gsx.core.rasterizer.projection import ScreenSplats
from gsx.core.shapes import Float, Int


def render(screen: ScreenSplats, camera: Camera, settings: RasterSettings) -> Float[Tensor, "C H W"]:
    """Blended channels of an uncropped camera; differentiable by autograd."""
    order = torch.argsort(screen.depths.detach(), stable=True)
    reach = 2 * (screen.log_opacities.detach() - math.log(settings.alpha_min)).clamp_min(0)
    half = (reach[:, None] * screen.covariances.detach()[:, ::2]).sqrt()
    low, high = (screen.means.detach() - half)[order], (screen.means.detach() + half)[order]
    edge = settings.tile_size
    strips = []
    for top in range(0, camera.height, edge):
        bottom = min(top + edge, camera.height)
        on_strip = (high[:, 1] > top) & (low[:, 1] < bottom)
        pieces = []
        for left in range(0, camera.width, edge):
            right = min(left + edge, camera.width)
            rows = order[on_strip & (high[:, 0] > left) & (low[:, 0] < right)]
            pieces.append(blend_tile(screen, rows, pixels(left, right, top, bottom, screen.means), settings))
        strips.append(torch.cat(pieces, 2))
    return torch.cat(strips, 1)


def pixels(left: int, right: int, top: int, bottom: int, like: Tensor) -> Float[Tensor, "h w 2"]:
    """(x, y) of the pixel centres of a rectangle."""
    y = torch.arange(top, bottom, device=like.device, dtype=like.dtype) + 0.5
    x = torch.arange(left, right, device=like.device, dtype=like.dtype) + 0.5
    return torch.stack(torch.meshgrid(y, x, indexing="ij")[::-1], -1)


def blend_tile(
    screen: ScreenSplats, rows: Int[Tensor, "n"], places: Float[Tensor, "h w 2"], settings: RasterSettings
) -> Float[Tensor, "C h w"]:
    """Splats `rows`, nearest first, blended at `places`."""
    x, y = (places - screen.means[rows, None, None]).unbind(-1)
    u0, u1, u2 = screen.conic_factors[rows, :, None, None].unbind(1)
    full = torch.exp(screen.log_opacities[rows, None, None] - (u0 * x + u1 * y) ** 2 - (u2 * y) ** 2)
    clamped = full + (full.clamp(max=settings.alpha_max) - full).detach()
    alpha = torch.where(clamped >= settings.alpha_min, clamped, 0.0)
    after = torch.cumprod(1 - alpha, 0)
    before = torch.cat([torch.ones_like(after[:1]), after])[:-1]
    weight = alpha * before * (after >= settings.transmittance_stop)
    return torch.einsum("nhw,nc->chw", weight, screen.channels[rows])
