"""The built-in plugin: the components of gsx use the same hooks as third parties."""

import sys
from functools import partial

from gsx.core.plugins import Plugins, Registry, hookimpl, load_plugins


@hookimpl
def gsx_register(registry: Registry) -> None:
    """Register the components of gsx itself."""
    for add in (add_scenes, add_backbones, add_modules, add_augmenters, add_regenerators, add_diffusion, add_trackers):
        add(registry)
    add_compositors(registry)


def add_scenes(registry: Registry) -> None:
    """Register loaders by format; of two that can read a folder the later is the more specific."""
    from gsx.scenes import blender, bungee, colmap, demo, photos, room, transforms

    registry.add("scene", "demo", demo.load, demo.DemoOptions)
    registry.add("scene", "room", room.load, room.RoomOptions)
    registry.add("scene", "photos", photos.load, photos.PhotosOptions, photos.FORMAT)
    registry.add("scene", "transforms", transforms.load, transforms.TransformsOptions, transforms.FORMAT)
    registry.add("scene", "colmap", colmap.load, colmap.ColmapOptions, colmap.FORMAT)
    registry.add("scene", "blender", blender.load, blender.BlenderOptions, blender.FORMAT)
    registry.add("scene", "bungee", bungee.load, bungee.BungeeOptions, bungee.FORMAT)


def add_backbones(registry: Registry) -> None:
    """Register free Gaussians and anchors, with and without levels and filters."""
    from gsx.backbones.anchor_options import NeuralOptions
    from gsx.backbones.anchors import neural_anchors
    from gsx.backbones.gs3d import gs3d
    from gsx.backbones.gs3d_options import GS3DOptions
    from gsx.backbones.octree_gs3d import OctreeGS3DOptions, octree_gs3d

    for name in ("gs3d", "mip_splatting", "gs3d_zoom"):
        registry.add("backbone", name, gs3d, GS3DOptions)
    for name in ("scaffold", "octree_scaffold"):
        registry.add("backbone", name, neural_anchors, NeuralOptions)
    registry.add("backbone", "octree_gs3d", octree_gs3d, OctreeGS3DOptions)


def add_modules(registry: Registry) -> None:
    """Register schedules, stopping rules and corrections of photos, in the order of a run's modules."""
    from gsx.modules.catalogue import MODULES

    for name, (factory, options) in MODULES.items():
        registry.add("module", name, factory, options)


def add_augmenters(registry: Registry) -> None:
    """Register one procedure under five names with different numbers."""
    from gsx.augmenters.pseudo_details import PseudoDetails
    from gsx.augmenters.pseudo_options import PseudoOptions

    for name in ("upscale", "super_resolved", "bootstrap", "mipmap", "bootstrap_original"):
        registry.add("augmenter", name, PseudoDetails, PseudoOptions)


def add_regenerators(registry: Registry) -> None:
    """Register filters, networks that learn from the scene itself, functions, and pretrained networks."""
    from gsx.regenerators.classical import Called, CalledOptions, Oracle, PlainOptions, Resampled, Unchanged
    from gsx.regenerators.pretrained.model_files import PretrainedOptions
    from gsx.regenerators.pretrained.upscaler import Pretrained
    from gsx.regenerators.scene_restorer import RestorerOptions, SceneRestorer
    from gsx.regenerators.scene_sr import SceneSR, SceneSROptions

    registry.add("regenerator", "lanczos", Resampled, PlainOptions)
    registry.add("regenerator", "oracle", Oracle, PlainOptions)
    registry.add("regenerator", "identity", Unchanged, PlainOptions)
    registry.add("regenerator", "scene_sr", SceneSR, SceneSROptions)
    registry.add("regenerator", "scene_restorer", SceneRestorer, RestorerOptions)
    registry.add("regenerator", "callable", Called, CalledOptions)
    for name in ("span", "real_esrgan", "ncnn"):
        registry.add("regenerator", name, Pretrained, PretrainedOptions)


def add_diffusion(registry: Registry) -> None:
    """Register diffusion models; their packages are imported at first use."""
    from gsx.regenerators.diffusion.model_specs import SD_X2_LATENT, SD_X4, SDXL_TURBO
    from gsx.regenerators.diffusion.options import PipelineOptions, RestorerOptions, UpscalerOptions
    from gsx.regenerators.diffusion.redraw import Cascade, CascadeOptions, Diffusion, any_pipeline

    registry.add("regenerator", "diffusers_pipeline", any_pipeline, PipelineOptions)
    registry.add("regenerator", "sd_by_scale", Cascade, CascadeOptions)
    registry.add("regenerator", "sd_x2_latent", partial(Diffusion, SD_X2_LATENT), UpscalerOptions)
    registry.add("regenerator", "sd_x4", partial(Diffusion, SD_X4), UpscalerOptions)
    registry.add("regenerator", "sdxl_turbo", partial(Diffusion, SDXL_TURBO), RestorerOptions)


def add_trackers(registry: Registry) -> None:
    """Register listeners that report a run to other programs."""
    from gsx.trackers.mlflow import MLflow, MLflowOptions
    from gsx.trackers.rerun import Rerun, RerunOptions
    from gsx.trackers.tensorboard import TensorBoard, TensorBoardOptions
    from gsx.trackers.wandb import WandB, WandBOptions

    registry.add("tracker", "tensorboard", TensorBoard, TensorBoardOptions)
    registry.add("tracker", "mlflow", MLflow, MLflowOptions)
    registry.add("tracker", "wandb", WandB, WandBOptions)
    registry.add("tracker", "rerun", Rerun, RerunOptions)


def add_compositors(registry: Registry) -> None:
    """Register blending of splats: eager torch, compiled loops, pixel windows, gsplat."""
    from gsx.core.rasterizer.compositor import NoOptions
    from gsx.engine.compositors import COMPOSITORS

    for name, compositor in COMPOSITORS.items():
        registry.add("compositor", name, lambda options, made=compositor: made, NoOptions)


def plugins() -> Plugins:
    """Load built-in and installed plugins."""
    return load_plugins([("gsx", sys.modules[__name__])])
