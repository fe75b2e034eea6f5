"""Compositors: they blend the splats of each tile into a picture. Plugins may add some."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol, runtime_checkable

import torch
from torch import Tensor

from gsx.core.backend import Backend
from gsx.core.shapes import Float

if TYPE_CHECKING:
    from gsx.core.rasterizer.grid import TileGrid
    from gsx.core.rasterizer.intersections import TileIntersections
    from gsx.core.rasterizer.projection import ScreenSplats
    from gsx.core.rasterizer.settings import RasterSettings


@dataclass(frozen=True)
class NoOptions:
    """Options of a compositor without options."""


@runtime_checkable
class Compositor(Protocol):
    """Front-to-back blending, differentiable in means, factors, opacities and channels."""

    def __call__(
        self,
        screen: "ScreenSplats",
        channels: Float[Tensor, "M C"],
        intersections: "TileIntersections",
        grid: "TileGrid",
        settings: "RasterSettings",
    ) -> tuple[Float[Tensor, "C_plus_1 H W"], Float[Tensor, "M"] | None]:
        """Returns blended channels with coverage last, and the largest weight of each splat if `screen.weigh`.

        If `screen.absgrad` is not None, its gradient becomes the sum of absolute gradients of the mean, px.
        """


@runtime_checkable
class WithBackend(Protocol):
    """A compositor with a backend for all other kernels and the loss; the default is eager torch."""

    backend: Backend


@runtime_checkable
class Restricted(Protocol):
    """A compositor that does not work with all settings or devices."""

    def refuse(self, settings: "RasterSettings", device: torch.device) -> None:
        """Raises ConfigError, with a remedy, if it does not work with these settings on a device."""
