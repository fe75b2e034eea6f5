"""The compositors that ship with gsx, by name."""

from collections.abc import Mapping
from types import MappingProxyType

from gsx.core.rasterizer.composite import composite_eager
from gsx.core.rasterizer.compositor import Compositor
from gsx.engine.backend import COMPILED
from gsx.engine.bands import InBands
from gsx.engine.compiled import CompiledCompositor
from gsx.engine.gsplat import GsplatCompositor
from gsx.engine.pixel_windows import composite_windows

COMPOSITORS: Mapping[str, Compositor] = MappingProxyType(
    {
        "eager": InBands(composite_eager),
        "compiled": InBands(CompiledCompositor(), COMPILED),
        "window": InBands(composite_windows),
        "gsplat": GsplatCompositor(),
    }
)
