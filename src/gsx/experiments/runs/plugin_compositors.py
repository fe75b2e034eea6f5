"""Compositors of the registry, for settings of the rasterizer."""

from collections.abc import Iterator, Mapping

from gsx.core.errors import ConfigError
from gsx.core.plugins import Component, Plugins
from gsx.core.rasterizer import RasterOptions, RasterSettings
from gsx.core.rasterizer.compositor import Compositor


class Compositors(Mapping[str, Compositor]):
    """Compositors by name; each is made when it is first used."""

    def __init__(self, components: Mapping[str, Component]) -> None:
        self.components = components
        self.made: dict[str, Compositor] = {}

    def __getitem__(self, name: str) -> Compositor:
        if name not in self.made:
            component = self.components[name]
            self.made[name] = component.factory(component.options())
        return self.made[name]

    def __contains__(self, name: object) -> bool:
        return name in self.components

    def __iter__(self) -> Iterator[str]:
        return iter(self.components)

    def __len__(self) -> int:
        return len(self.components)


def with_compositors(options: RasterOptions, plugins: Plugins) -> RasterSettings:
    """Returns settings whose path may name any registered compositor.

    Raises:
        ConfigError: the path names none.
    """
    try:
        return RasterSettings(**vars(options), compositors=Compositors(plugins.registry.of("compositor")))
    except ValueError as error:
        raise ConfigError(str(error)) from error
