"""The built-in plugin: what ships with gsx enters through the same hooks as third parties."""

from gsx.core.plugins import Registry, hookimpl


@hookimpl
def gsx_register(registry: Registry) -> None:
    """Scenes and backbones of gsx itself."""
    from gsx.backbones.anchors import NeuralOptions, neural_anchors
    from gsx.backbones.gs3d import GS3D, GS3DOptions
    from gsx.backbones.octree_gs3d import OctreeGS3DOptions, octree_gs3d
    from gsx.core.scenes import blender, bungee, colmap, demo, photos, transforms

    registry.add("scene", "demo", demo.load, demo.DemoOptions)
    registry.add("scene", "colmap", colmap.load, colmap.ColmapOptions)
    registry.add("scene", "photos", photos.load, photos.PhotosOptions)
    registry.add("scene", "blender", blender.load, blender.BlenderOptions)
    registry.add("scene", "transforms", transforms.load, transforms.TransformsOptions)
    registry.add("scene", "bungee", bungee.load, bungee.BungeeOptions)
    registry.add("backbone", "gs3d", GS3D, GS3DOptions)
    registry.add("backbone", "mip_splatting", GS3D, GS3DOptions)
    registry.add("backbone", "scaffold", neural_anchors, NeuralOptions)
    registry.add("backbone", "octree_scaffold", neural_anchors, NeuralOptions)
    registry.add("backbone", "octree_gs3d", octree_gs3d, OctreeGS3DOptions)
