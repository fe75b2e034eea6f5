"""Compositors of the registry, for settings of the rasterizer."""

from collections.abc import Iterator, Mapping

from gsx.core.errors import ConfigError
from gsx.core.plugins import Component, Plugins
from gsx.core.rasterizer import RasterOptions, RasterSettings
from gsx.core.rasterizer.compositor import Compositor


class Compositors(Mapping[str, Compositor]):
    """Compositors by name, each built at its first use."""

    def __init__(self, components: Mapping[str, Component]) -> None:
        self.components = components
        self.built: dict[str, Compositor] = {}

    def __getitem__(self, name: str) -> Compositor:
        if name not in self.built:
            component = self.components[name]
            self.built[name] = component.factory(component.options())
        return self.built[name]

    def __contains__(self, name: object) -> bool:
        return name in self.components

    def __iter__(self) -> Iterator[str]:
        return iter(self.components)

    def __len__(self) -> int:
        return len(self.components)


def with_compositors(options: RasterOptions, plugins: Plugins) -> RasterSettings:
    """Return settings whose path may name any registered compositor; raise ConfigError if it names none."""
    try:
        return RasterSettings(**vars(options), compositors=Compositors(plugins.registry.of("compositor")))
    except ValueError as error:
        raise ConfigError(str(error)) from error
