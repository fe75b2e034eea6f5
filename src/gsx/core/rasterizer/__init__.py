"""The one rasterizer every backbone renders through: project, pair with tiles, sort, composite. Needs only torch."""

from gsx.core.rasterizer.render import Rendering, ScreenStatistics, rasterize
from gsx.core.rasterizer.settings import RasterSettings

__all__ = ["RasterSettings", "Rendering", "ScreenStatistics", "rasterize"]
