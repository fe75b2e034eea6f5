"""A complete gsx plugin: a regenerator, an augmenter that uses it, and their configuration files."""

from gsx.core.plugins import Registry, hookimpl


@hookimpl
def gsx_register(registry: Registry) -> None:
    """Add both under the names that their configuration files use."""
    from gsx_sharp.augmenter import SteadyOptions, SteadyZoom
    from gsx_sharp.regenerator import Sharpened, SharpOptions

    registry.add("regenerator", "sharpened", Sharpened, SharpOptions)
    registry.add("augmenter", "steady_zoom", SteadyZoom, SteadyOptions)


@hookimpl
def gsx_config_paths() -> list[str]:
    """Where Hydra finds the configuration of this plugin."""
    return ["pkg://gsx_sharp.conf"]
