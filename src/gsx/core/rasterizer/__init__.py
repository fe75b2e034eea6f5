"""The one rasterizer every backbone renders through: project, pair with tiles, sort, composite. Needs only torch."""

import torch

from gsx.core.rasterizer.projection import drawable, repeat_rows, take_rows
from gsx.core.rasterizer.render import Rendering, ScreenStatistics, rasterize
from gsx.core.rasterizer.settings import RasterOptions, RasterSettings
from gsx.core.rasterizer.tiled import TILE_PIXELS, TiledRendering, rasterize_tiled
from gsx.core.rasterizer.visibility import on_screen, touches, without_colours

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
"""MKL sets its vector functions up in the first call. Where two threads make that call at once, the second now and then
computes its half with seven bits fewer (exp, log, sin; torch 2.13): so the first call is made here, by one thread."""
