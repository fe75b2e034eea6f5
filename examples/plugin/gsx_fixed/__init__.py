"""A complete gsx plugin: the backbone `gs3d_fixed`, which is 3D-GS without density control."""

from dataclasses import replace

from gsx.core.plugins import Registry, hookimpl


@hookimpl
def gsx_register(registry: Registry) -> None:
    """Add the backbone under the name that conf/backbone/gs3d_fixed.yaml uses."""
    from gsx.backbones.gs3d import GS3D, gs3d
    from gsx.backbones.gs3d_options import GS3DOptions

    def fixed(options: GS3DOptions, context) -> GS3D:
        return gs3d(replace(options, density=replace(options.density, stop=0)), context)

    registry.add("backbone", "gs3d_fixed", fixed, GS3DOptions)


@hookimpl
def gsx_config_paths() -> list[str]:
    """Where Hydra finds the configuration of this plugin."""
    return ["pkg://gsx_fixed.conf"]
