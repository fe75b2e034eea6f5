"""Loads the scene of a run: in suitable units, with views to evaluate on."""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import torch

from gsx.core.data.camera import Camera, offsets_from
from gsx.core.data.scene import PointCloud, Scene, View, extent_of
from gsx.core.errors import ConfigError, InputError
from gsx.core.files import expand_home, file_count
from gsx.core.seeds import derived_seed
from gsx.core.training.module import PreparesScene
from gsx.core.training.run import Run
from gsx.experiments.evaluation.remarks import NOT_MEASURED
from gsx.experiments.runs.degraded import degrade
from gsx.experiments.runs.settings import Settings
from gsx.formats.origin import Origin
from gsx.scenes.blocks import BlockChoice, block_of, parsed_block
from gsx.scenes.depth_files import with_depth_maps
from gsx.scenes.filling import fill_gaps
from gsx.scenes.origin import around_origin, origin_of
from gsx.scenes.posed import SAME_PLACE
from gsx.scenes.stereo import add_stereo_points

CACHE_GB = 0.25
"""Memory for decoded photos that are used once, 10^9 bytes: some neighbours, for starting points by stereo."""
HIDDEN_SHARE, LARGEST_EXTENT = 0.02, 1e3
"""Largest share of points hidden by near planes, and extent, of units that 3D-GS expects."""


def load_scene(settings: Settings, origin: Origin | None = None) -> Scene:
    """Return the scene of a run, with test views unless scene.split=none trains on all.

    origin: of an existing model; None: the scene's own.

    Raises:
        InputError: it cannot be loaded, its loader returned something else, the split leaves no test views, or cameras
            and points are all in one place.
    """
    options = settings.scene.options
    refuse_absent_scene(settings)
    loaded = checked(settings.scene.component.factory(options), settings.scene.component.name)
    loaded = replace(loaded, notes=[*loaded.notes, *count_notes(settings)])
    unit = getattr(options, "unit", 1.0)
    if not 0 < unit < math.inf:  # options of a plugin may have any
        raise ConfigError(f"scene.unit is {unit}; give a positive number")
    scene = warned_of_units(measured(placed(loaded, unit, origin)))
    if not scene.test:
        scene = held_out_none(scene, getattr(options, "split", ""))
    if not scene.extent > 0:
        raise InputError(
            f"all {len(scene.train)} training cameras of scene '{scene.name}' stand at one place, and no points lie "
            "elsewhere, so depth and scale are unknown: use photos from different places"
        )
    scene = with_depth_maps(part_of(scene, options), options)
    if count := getattr(options, "fill", 0):
        generator = torch.Generator().manual_seed(derived_seed("fill", settings.general.seed))
        scene = fill_gaps(scene, count, generator)
    scene = degrade(scene, getattr(options, "disturb", {}))
    if (count := getattr(options, "stereo", 0)) and len(scene.points):
        generator = torch.Generator().manual_seed(derived_seed("stereo", settings.general.seed))
        scene = add_stereo_points(scene, count, generator)
    for name, chosen in settings.modules.items():
        if isinstance(chosen.options, PreparesScene):
            generator = torch.Generator().manual_seed(derived_seed(f"{name} points", settings.general.seed))
            scene = chosen.options.prepare_scene(scene, generator)
    return scene


def part_of(scene: Scene, options: Any) -> Scene:
    """Return the block of the scene that options choose, or all of it; ConfigError: it has too few cameras."""
    if not (word := getattr(options, "block", "")):
        return scene
    number, count = parsed_block(word)
    choice = BlockChoice(number=number, count=count, margin=options.block_margin, share=options.block_share)
    return block_of(scene, choice)


def with_small_cache(settings: Settings) -> Settings:
    """Return settings that keep few decoded photos: each is used once."""
    chosen = settings.scene
    if not hasattr(chosen.options, "cache_gb"):  # of a plugin
        return settings
    least = min(chosen.options.cache_gb, CACHE_GB)
    return replace(settings, scene=replace(chosen, options=replace(chosen.options, cache_gb=least)))


def refuse_absent_scene(settings: Settings) -> None:
    """Raise InputError for a scene of a folder that is not named or does not exist."""
    path, data = getattr(settings.scene.options, "path", None), settings.dataset
    if settings.scene.component.scene_format is None or path is None:
        return
    if not path:
        raise InputError("scene.path is empty: give scene.path=FOLDER")
    if not expand_home(path).exists():
        listing = f"; `gsx datasets {data.name} data_root=FOLDER` lists the files below it" if data else ""
        raise InputError(f"scene.path: '{path}' does not exist: check {'data_root' if data else 'its name'}{listing}")


def held_out_none(scene: Scene, rule: str) -> Scene:
    """Return a scene without test views, with a note; raise InputError if its split is not `none`."""
    if rule != "none":
        raise InputError(
            f"scene '{scene.name}' has no test views to evaluate on: choose another scene.split, or none to train on "
            "all views without figures"
        )
    return replace(scene, notes=[*scene.notes, f"all {len(scene.train)} views are trained on: {NOT_MEASURED}"])


def checked(scene: Any, loader: str) -> Scene:
    """Return the scene of a loader, maybe a plugin's.

    Raises:
        InputError: it is not a scene, or cannot be trained on and evaluated.
    """
    if not isinstance(scene, Scene):
        raise InputError(
            f"scene={loader} returned {type(scene).__name__}: a loader returns a gsx.core.data.scene.Scene"
        )
    named, source = {view.name: view.camera for view in scene.train}, f"scene={loader} returned a scene"
    odd = [view.name for view in [*scene.train, *scene.test] if not finite(view.camera)]
    both = [view.name for view in scene.test if view.name in named and view.camera.has_pose_of(named[view.name])]
    background = scene.background
    if not scene.train:
        raise InputError(f"{source} without training views: check the folder, or scene.split")
    if odd:
        raise InputError(f"{source} with a camera value that is not finite, of '{odd[0]}': correct it, or leave it out")
    if both:
        raise InputError(f"{source} with '{both[0]}' among training and test views: use it for one of them")
    if not bool(torch.isfinite(scene.points.positions).all()):
        raise InputError(f"{source} with points that are not finite: leave them out")
    if background.shape != (3,) or not bool(((background >= 0) & (background <= 1)).all()):
        raise InputError(f"{source} with a background of {background.tolist()}: give red, green and blue in [0, 1]")
    return scene


def finite(camera: Camera) -> bool:
    """Return True if all numbers of a camera are finite."""
    numbers = torch.tensor([camera.fx, camera.fy, camera.cx, camera.cy], dtype=torch.float64)
    return all(bool(torch.isfinite(values).all()) for values in (numbers, camera.rotation, camera.translation))


def count_notes(settings: Settings) -> list[str]:
    """Return a note if the folder of a published scene holds another number of images than was published."""
    dataset, path = settings.dataset, getattr(settings.scene.options, "path", "")
    published = dataset.images.get(dataset.scene) if dataset else None
    if not (published and path):
        return []
    images = getattr(settings.scene.options, "images", "") or "images"
    count, compared = file_count(expand_home(path) / images), "figures cannot be compared with published ones"
    return [] if count == published else [f"{images}/ holds {count} files, published are {published}: {compared}."]


def placed(scene: Scene, unit: float, origin: Origin | None) -> Scene:
    """Return the scene around an origin, in units; origin: in these units, None: chosen by the scene."""
    origin = scaled(origin_of(scene), unit) if origin is None else origin
    return replace(in_units(around_origin(scene, scaled(origin, 1 / unit)), unit), origin=origin)


def scaled(origin: Origin, factor: float) -> Origin:
    """Return an origin in other units."""
    x, y, z = (value * factor for value in origin)
    return x, y, z


def in_units(scene: Scene, unit: float) -> Scene:
    """Return the scene with positions of cameras and points multiplied by `unit`."""
    if unit == 1:
        return scene

    def rescaled(view: View) -> View:
        sparse = view.sparse and replace(view.sparse, z=view.sparse.z * unit)
        return replace(view, camera=replace(view.camera, translation=view.camera.translation * unit), sparse=sparse)

    return replace(
        scene,
        train=[rescaled(view) for view in scene.train],
        test=[rescaled(view) for view in scene.test],
        points=replace(scene.points, positions=scene.points.positions * unit),
        extent=scene.extent * unit,
        notes=[*scene.notes, f"positions are multiplied by scene.unit={unit:g}"],
    )


def hidden_share(scene: Scene) -> float:
    """Return the share of the points in front of training cameras that their near planes hide."""
    front = hidden = 0
    for view in scene.train:
        depth = view.camera.project(scene.points.positions)[1]
        front += int((depth > 0).sum())
        hidden += int(((depth > 0) & (depth <= view.camera.near)).sum())
    return hidden / max(1, front)


def warned_of_units(scene: Scene) -> Scene:
    """Return the scene, with a note if its units are far from those that published constants expect."""
    share = hidden_share(scene)
    if share <= HIDDEN_SHARE and scene.extent <= LARGEST_EXTENT:
        return scene
    odd = f"the extent is {scene.extent:.3g} scene units, and near planes hide {share:.0%} of the points before cameras"
    better = 10.0 ** -math.floor(math.log10(scene.extent)) if scene.extent > 0 else 1.0
    note = f"{odd}: published constants expect a few units, try scene.unit={better:g}"
    return replace(scene, notes=[*scene.notes, note])


def unit_of(run: Run) -> float:
    """Return the factor of the scene's positions."""
    return float(run.config["scene"].get("unit", 1.0))


ONE_PLACE = 3e-5
"""Largest extent of cameras that is rounding, as a share of the points' median distance: at a focal length of 3,000 px
points then move by 0.1 px, which no reconstruction measures. Rounded poses are at 1e-6, close-ups above 1e-3."""


def point_distance(cameras: Sequence[Camera], points: PointCloud) -> float:
    """Return the median distance of the points from the first camera, scene units; 0 without points."""
    if len(points) == 0:
        return 0.0
    return float(offsets_from(points.positions, cameras[0].centre).norm(dim=1).median())


def rounding_extent(cameras: Sequence[Camera], points: PointCloud) -> float:
    """Return the largest extent that is rounding: by the points' distances, or without points in scene units."""
    return ONE_PLACE * point_distance(cameras, points) if len(points) else SAME_PLACE


def in_one_place(cameras: Sequence[Camera], points: PointCloud) -> bool:
    """Return True if distances between cameras are rounding."""
    return extent_of(cameras) <= rounding_extent(cameras, points)


def measured(scene: Scene) -> Scene:
    """Return the scene; if its training cameras stand in one place, its extent is 1.1 x the points' median distance.

    Without points, such a scene has the extent 0.
    """
    cameras = [view.camera for view in scene.train]
    if scene.extent > rounding_extent(cameras, scene.points):
        return scene
    extent = 1.1 * point_distance(cameras, scene.points)
    note = (
        f"all training cameras stand at one place: the extent {extent:.3g} is 1.1 x the points' median distance, and "
        "photos show no depth; take them from different places"
    )
    return replace(scene, extent=extent, notes=[*scene.notes, note])
