"""A gsx plugin that builds on nothing but core: a backbone of round Gaussians, and a loader of a scene format."""

from gsx.core.plugins import Registry, hookimpl


@hookimpl
def gsx_register(registry: Registry) -> None:
    """Add both under the names that their configuration files use."""
    from gsx_spheres.backbone import Spheres, SpheresOptions
    from gsx_spheres.scene import FORMAT, SnapshotOptions, load

    registry.add("backbone", "spheres", Spheres, SpheresOptions)
    registry.add("scene", "snapshots", load, SnapshotOptions, FORMAT)


@hookimpl
def gsx_config_paths() -> list[str]:
    """Where Hydra finds the configuration of this plugin."""
    return ["pkg://gsx_spheres.conf"]
