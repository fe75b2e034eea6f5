"""Rasterizer of all backbones, in plain torch: project, intersect with tiles, sort, composite."""

import torch

from gsx.core.rasterizer.intersections import on_screen, touches, without_colours
from gsx.core.rasterizer.projection import drawable, repeat_rows, take_rows
from gsx.core.rasterizer.render import (
    TILE_PIXELS,
    Rendering,
    ScreenStatistics,
    TiledRendering,
    rasterize,
    rasterize_tiled,
)
from gsx.core.rasterizer.settings import RasterOptions, RasterSettings

__all__ = [
    "TILE_PIXELS",
    "RasterOptions",
    "RasterSettings",
    "Rendering",
    "ScreenStatistics",
    "TiledRendering",
    "drawable",
    "on_screen",
    "rasterize",
    "rasterize_tiled",
    "repeat_rows",
    "take_rows",
    "touches",
    "without_colours",
]

torch.exp(torch.zeros(1))
"""MKL initialises its vector functions in the first call. If two threads make it at once, one may lose seven bits (exp,
log, sin; torch 2.13), so one thread makes it here."""
