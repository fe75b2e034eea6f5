"""All that the benchmarks know of the rasterizer's inside. When pairing or blending change shape, mend it here."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor

from gsx.builtin import plugins
from gsx.core.data.camera import Camera
from gsx.core.rasterizer import RasterSettings
from gsx.core.rasterizer.grid import TileGrid
from gsx.core.rasterizer.intersections import TileIntersections, intersect_tiles
from gsx.core.rasterizer.projection import ScreenSplats
from gsx.core.shapes import Float
from gsx.engine import compiled
from gsx.engine.compositors import COMPOSITORS
from gsx.engine.kernels import Rules
from gsx.experiments.runs.compose import compose
from measuring.stages import StageClock

LOOPS = {"forward": ("transmit", "blend"), "backward": ("gradients",)}
"""The compiled loops over blocks of each phase, on a CPU."""


def settings_of(path: str, *overrides: str) -> RasterSettings:
    """The shipped settings of a path (eager, compiled), with overrides such as `rasterizer.tile_size=16`."""
    return compose([f"rasterizer={path}", *overrides], plugins()).raster


def missing(path: str, device: torch.device) -> str:
    """Why a path cannot be measured; empty when it can. Without a compiler the compiled path would be eager."""
    if path != "compiled":
        return ""
    try:
        torch.compile(torch.cos)(torch.ones(8, device=device))
    except Exception as error:  # whatever a broken compiler or a missing header raises
        return f"torch.compile fails here: {type(error).__name__}: {(str(error).splitlines() or [''])[0]}"
    return ""


def pair_screen(screen: ScreenSplats, camera: Camera, settings: RasterSettings) -> TileIntersections:
    """Which splats reach which tiles, sorted."""
    return intersect_tiles(screen, camera, settings)


def count_pairs(pairs: TileIntersections) -> int:
    """Splat-tile pairs."""
    return len(pairs.splats)


def blend_pairs(
    screen: ScreenSplats, pairs: TileIntersections, camera: Camera, settings: RasterSettings
) -> Float[Tensor, "C H W"]:
    """Blended channels, differentiable in means, factors, log-opacities and channels of the screen splats."""
    grid = TileGrid.of(camera, settings.tile_size)
    return COMPOSITORS[settings.path](screen, screen.channels, pairs, grid, settings)[0][:-1]


def blend_screen(
    screen: ScreenSplats, camera: Camera, settings: RasterSettings
) -> tuple[Float[Tensor, "C H W"], TileIntersections]:
    """Everything behind projection: pair, then blend."""
    pairs = pair_screen(screen, camera, settings)
    return blend_pairs(screen, pairs, camera, settings), pairs


@contextmanager
def loops_timed() -> Iterator[dict[str, float]]:
    """Yields the seconds spent in each compiled loop over blocks since the context began, by name."""
    clock, own = StageClock(), compiled.compiled_loop

    def clocked(loop: Callable[..., Any], rules: Rules) -> Callable[..., Any]:
        name, run = loop.__name__, own(loop, rules)
        return clock.clocked(name, run) if name in ("transmit", "blend", "gradients") else run

    compiled.compiled_loop = clocked
    try:
        yield clock.seconds
    finally:
        compiled.compiled_loop = own


def to_raster(tiles: Float[Tensor, "T P C"], camera: Camera, tile: int) -> Float[Tensor, "C H W"]:
    """Tiles laid out as a picture."""
    return TileGrid.of(camera, tile).to_raster(tiles)


def to_tiles(raster: Float[Tensor, "C H W"], camera: Camera, tile: int) -> Float[Tensor, "T P C"]:
    """A picture cut into tiles, zero beyond the raster."""
    return TileGrid.of(camera, tile).to_tiles(raster).mT.contiguous()


def learnable(screen: ScreenSplats) -> ScreenSplats:
    """The same splats with leaves that gather gradients."""
    leaves = ("means", "conic_factors", "log_opacities", "channels")
    made = {name: getattr(screen, name).detach().clone().requires_grad_() for name in leaves}
    return ScreenSplats(**(vars(screen) | made))


def leaves_of(screen: ScreenSplats) -> list[Tensor]:
    """The leaves that `learnable` made."""
    return [value for value in vars(screen).values() if isinstance(value, torch.Tensor) and value.requires_grad]
