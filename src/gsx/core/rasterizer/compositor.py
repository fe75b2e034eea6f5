"""What a compositor is: it blends the splats of each tile into a picture. Plugins may add some."""

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
    """Options of a compositor that has none."""


@runtime_checkable
class Compositor(Protocol):
    """Blends splats front to back; differentiable in the means, factors, opacities and channels."""

    def __call__(
        self,
        screen: "ScreenSplats",
        channels: Float[Tensor, "M C"],
        intersections: "TileIntersections",
        grid: "TileGrid",
        settings: "RasterSettings",
    ) -> tuple[Float[Tensor, "C_plus_1 H W"], Float[Tensor, "M"] | None]:
        """Returns blended channels and, last, coverage; and the largest weight of every splat if `screen.weigh`.

        If `screen.absgrad` is not None, its gradient becomes the sum of absolute gradients of the mean, px.
        """
        ...


@runtime_checkable
class WithBackend(Protocol):
    """A compositor whose other kernels, and those of the loss, run by a backend of its choice; else by eager torch."""

    backend: Backend


@runtime_checkable
class Restricted(Protocol):
    """A compositor that does not run everywhere."""

    def refuse(self, settings: "RasterSettings", device: torch.device) -> None:
        """Raises ConfigError, with a remedy, where it cannot draw by these settings on a device."""
        ...
