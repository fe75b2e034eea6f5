"""Blending by the CUDA kernels of the package gsplat, where it is installed (`rasterizer=gsplat`)."""

import math
from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from gsx.core.errors import ConfigError
from gsx.core.rasterizer.composite import composite_eager
from gsx.core.rasterizer.grid import TileGrid
from gsx.core.rasterizer.intersections import TileIntersections
from gsx.core.rasterizer.projection import ScreenSplats
from gsx.core.rasterizer.settings import RasterSettings
from gsx.core.shapes import Float
from gsx.engine.backend import COMPILED

RULES = {"alpha_min": 1 / 255, "alpha_max": 0.999, "transmittance_stop": 1e-4}
"""Constants of its kernels (gsplat, RasterizeToPixels3DGSFwd.cu)."""
OTHERWISE = "or set rasterizer=auto"


def rasterize_to_pixels() -> Callable[..., tuple[Tensor, Tensor]]:
    """Returns the function of that name in gsplat.

    Raises:
        ConfigError: gsplat cannot be imported.
    """
    try:
        import gsplat
    except ImportError as error:
        raise ConfigError(
            f"rasterizer=gsplat needs the package gsplat ({error}): pip install 'gsx[gsplat]', {OTHERWISE}"
        ) from error
    return gsplat.rasterize_to_pixels


class GsplatCompositor:
    """A `Compositor` by gsplat; the eager compositor for largest weights, float64 and empty pictures."""

    backend = COMPILED

    def __init__(self, devices: Sequence[str] = ("cuda",)) -> None:
        self.devices = devices

    def refuse(self, settings: RasterSettings, device: torch.device) -> None:
        """Raises ConfigError if the package or a device is missing, or rules differ from its kernels' constants."""
        rasterize_to_pixels()
        if device.type not in self.devices:
            raise ConfigError(
                f"rasterizer=gsplat draws on a CUDA device, not on {device}: set device=cuda, {OTHERWISE}"
            )
        for name, value in RULES.items():
            if not math.isclose(setting := getattr(settings, name), value):
                raise ConfigError(f"rasterizer.{name} is {setting}, but gsplat has {value:.6g}: set that, {OTHERWISE}")

    def __call__(
        self,
        screen: ScreenSplats,
        channels: Float[Tensor, "M C"],
        intersections: TileIntersections,
        grid: TileGrid,
        settings: RasterSettings,
    ) -> tuple[Float[Tensor, "C_plus_1 H W"], Float[Tensor, "M"] | None]:
        self.refuse(settings, screen.means.device)
        if screen.weigh or not len(intersections.splats) or screen.means.dtype != torch.float32:
            return composite_eager(screen, channels, intersections, grid, settings)
        (columns, rows), (left, top) = grid.shape, (first * grid.tile for first in grid.first)
        u0, u1, u2 = screen.conic_factors.unbind(1)
        means = (screen.means - screen.means.new_tensor([left, top]))[None]
        gather_absolute(means, screen.absgrad)
        colours, alphas = rasterize_to_pixels()(
            means,
            2 * torch.stack([u0 * u0, u0 * u1, u1 * u1 + u2 * u2], 1)[None],
            channels[None],
            screen.log_opacities.exp()[None],
            columns * grid.tile,
            rows * grid.tile,
            grid.tile,
            intersections.starts[:-1].int().view(1, rows, columns),
            intersections.splats.int(),
            absgrad=screen.absgrad is not None,
        )
        x, y = grid.left - left, grid.top - top
        picture = torch.cat([colours, alphas], 3)[0].permute(2, 0, 1)
        return picture[:, y : y + grid.height, x : x + grid.width], None


def gather_absolute(means: Float[Tensor, "1 M 2"], absgrad: Float[Tensor, "M 2"] | None) -> None:
    """Copies absolute gradients, which gsplat leaves in `means.absgrad`, into the gradient of `absgrad`."""
    if absgrad is None or not means.requires_grad:
        return

    def copy(_: Tensor) -> None:
        absgrad.grad = means.absgrad[0]  # type: ignore[attr-defined]

    means.register_hook(copy)
