"""Runs that start from a splat file (`init=FILE`) instead of a scene's points."""

import logging
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, TypeVar

import torch
from torch import Tensor

from gsx.core.data.camera import Camera
from gsx.core.data.scene import PointCloud, Scene
from gsx.core.errors import ConfigError, InputError
from gsx.core.gaussians.sh import constant_from_colour
from gsx.core.gaussians.splats import Gaussians
from gsx.core.rasterizer import RasterSettings
from gsx.core.shapes import Bool, Float
from gsx.core.training.backbone import Backbone, FromGaussians
from gsx.experiments.run_folder.general_options import splat_file
from gsx.experiments.runs.overrides import key_of, quoted
from gsx.experiments.runs.settings import Settings
from gsx.formats.axis_names import AUTO
from gsx.formats.origin import NO_ORIGIN, Origin, around, in_words, rounding_at, stored_in_single
from gsx.formats.splat_files import SplatContent, compensated, is_linear, read_splats
from gsx.formats.standard_ply import activated_words
from gsx.scenes.points import GREY

logger = logging.getLogger(__name__)
Rows = TypeVar("Rows", Tensor, Sequence[Any])

OWN_KEYS = (
    *("backbone", "augmenter", "init", "iterations", "minutes", "seconds"),
    *("variant", "preset", "budget", "experiment"),
)
"""Keys that `gsx eval FILE` sets or that only training uses: they cannot be overridden."""
BLENDS = (
    "its colours were converted from linear light to sRGB, in which gsx blends: figures differ from those of programs "
    "that blend in linear light"
)
"""Remark of evaluations on files with linear colours."""
MIP_KERNEL = 0.1
"""Screen dilation of Mip-Splatting with compensated opacities, px^2 (Yu et al. 2024)."""


def starting_splats(settings: Settings) -> SplatContent | None:
    """Read the splat file of `init`, means in float64; None: the run starts from points.

    Raises:
        ConfigError: axes are set without a file.
        InputError: the file cannot be read or is empty.
    """
    path, axes = splat_file(settings.general.init), settings.general.axes
    if path is None and axes != AUTO:
        raise ConfigError(f"axes={axes} needs a splat file: give init=FILE, or leave axes out")
    if path is None:
        return None
    content = read_splats(path, axes)
    if not len(content.gaussians.means):
        raise InputError(f"init: {path} holds no splats: choose another file")
    logger.info("starting from the %d splats of %s", len(content.gaussians.means), path)
    return content


def in_scene(gaussians: Gaussians, scene: Scene) -> Gaussians:
    """Return Gaussians of a file relative to the scene's origin; other programs may have subtracted it already."""
    origin = origin_of_file(gaussians, scene)
    if origin != scene.origin:
        logger.warning(
            "init: the splats lie around (0, 0, 0), the scene around %s: reading positions relative to that",
            in_words(scene.origin),
        )
    elif any(origin) and stored_in_single(gaussians.means):
        step = rounding_at(gaussians.means)
        logger.warning("init: positions are stored in single precision, in steps of %.2g scene units there", step)
    return around(gaussians, origin)


def origin_of_file(gaussians: Gaussians, scene: Scene) -> Origin:
    """Return the offset to subtract from a file's positions: the scene's origin, or 0 if it was subtracted before.

    It was if most positions are nearer to (0, 0, 0) than to the origin.
    """
    if not any(scene.origin):
        return scene.origin
    offsets = gaussians.means - torch.tensor(scene.origin, dtype=torch.float64)
    nearer = (gaussians.means.norm(dim=1) < offsets.norm(dim=1)).double()
    return NO_ORIGIN if float(nearer.mean()) > 0.5 else scene.origin


def start_doubts(settings: Settings, scene: Scene, start: Gaussians | None) -> list[str]:
    """Return doubts that the start file belongs to its scene; raise InputError if no splat is in view."""
    path = splat_file(settings.general.init)
    if start is None or path is None:
        return []
    doubts = doubts_about(start, scene, path, trains=settings.general.iterations > 0)
    return [*doubts, f"{path.name}: {BLENDS}"] if is_linear(path) else doubts


def start_from(backbone: Backbone[Any], gaussians: Gaussians, name: str) -> None:
    """Replace a backbone's primitives by Gaussians; raise ConfigError if it does not support that."""
    if not isinstance(backbone, FromGaussians):
        raise ConfigError(f"backbone={name} cannot start from a splat file: choose backbone=gs3d, or leave out init")
    backbone.start_from(gaussians)


def in_front_of(camera: Camera) -> Gaussians:
    """Return one splat on the camera's axis as a placeholder until a checkpoint is read."""
    ahead = camera.centre + camera.rotation[2].to(camera.centre)
    return Gaussians(
        means=ahead[None].float(),
        log_scales=torch.zeros(1, 3),
        quats=torch.tensor([[1.0, 0, 0, 0]]),
        opacity_logits=torch.zeros(1),
        sh_dc=constant_from_colour(torch.full((1, 3), 0.5)),
        sh_rest=torch.zeros(1, 0, 3),
    )


def one_point(gaussians: Gaussians) -> PointCloud:
    """Return the first Gaussian as a point: a backbone is built from points before its splats are replaced."""
    return PointCloud(positions=gaussians.means[:1], colours=torch.full((1, 3), 128, dtype=torch.uint8))


def rules_of(path: Path) -> RasterSettings:
    """Return the rasterizer settings that a splat file states."""
    return RasterSettings(dilation=MIP_KERNEL, compensate=True) if compensated(path) else RasterSettings()


def composition_of(path: Path, overrides: Sequence[str]) -> list[str]:
    """Return the overrides that evaluate a splat file; raise ConfigError for keys of training or without a scene."""
    for word in overrides:
        if key_of(word) in OWN_KEYS:
            raise ConfigError(f"gsx eval {path} renders the file as it is: leave out '{word}', or train: init={path}")
    if not any(word.startswith(("scene=", "dataset=")) for word in overrides):
        raise ConfigError(f"{path} needs photos to compare with: give scene=... scene.path=FOLDER")
    if not path.is_file():
        raise InputError(f"'{path}' does not exist: give a run folder or a splat file")
    words = ["backbone=gs3d", f"init={quoted(str(path))}", "iterations=0"]
    filters = ("rasterizer.dilation=", "rasterizer.compensate=")
    if compensated(path) and not any(word.lstrip("+").startswith(filters) for word in overrides):
        words += [f"rasterizer.dilation={MIP_KERNEL}", "rasterizer.compensate=true"]
        logger.info("%s states compensated opacities: rendering with %s", path, " ".join(words[3:]))
    return [*words, *overrides]


MOST_SPLATS, MOST_POINTS, MOST_VIEWS = 50_000, 1000, 50
"""Numbers to compare, evenly spread over all."""
LEAST_IN_VIEW = 0.05
"""Share of splats in view of some camera below which they are doubted (fox: 97 % in two test views; in other axes
0.2 %)."""
LEAST_POINTS = 10
"""Points of a scene that are enough to locate it."""
FAR = 0.25
"""Median distance of points from the nearest splat, in sizes of the point cloud, above which splats are doubted (fox:
0.01; a tenth off its scale 0.11; in other axes or scales 0.7 and more)."""
SIGMAS = 3.0
"""Standard deviations up to which a splat is drawn."""


def doubts_about(gaussians: Gaussians, scene: Scene, path: Path, trains: bool) -> list[str]:
    """Return and log doubts that a splat file belongs to a scene.

    trains: compare with all views, because the file is trained on; otherwise with test views if there are any.

    Raises:
        InputError: no splat is in view of any of these views.
    """
    views, kind = [*scene.test], "test view"
    if trains or not views:
        views, kind = [*scene.train, *scene.test], "training or test view" if scene.test else "training view"
    cameras = [view.camera for view in views]
    refuse_nothing_in_view(gaussians, cameras, kind, path, scene.origin)
    doubts = [*in_view_doubts(gaussians, cameras, kind), *distance_doubts(gaussians, scene.points)]
    for doubt in doubts:
        logger.warning("%s: %s", path, doubt)
    return [f"{path.name}: {doubt}" for doubt in [*doubts, *activated_words(gaussians)]]


def refuse_nothing_in_view(
    gaussians: Gaussians, cameras: Sequence[Camera], kind: str, path: Path, origin: Origin = NO_ORIGIN
) -> None:
    """Raise InputError if no splat reaches the picture of any camera; `kind`: name of the cameras."""
    if any(bool(reaching(gaussians, camera, SIGMAS).any()) for camera in cameras):
        return
    centres = torch.stack([camera.centre.double() for camera in cameras])
    raise InputError(
        f"{path}: no splat is in view of any {kind} ({len(cameras)}). Splats lie around "
        f"{middle(gaussians.means, origin)}, cameras around {middle(centres, origin)}: "
        "export the file in the coordinates of the cameras"
    )


def reaching(gaussians: Gaussians, camera: Camera, sigmas: float) -> Bool[Tensor, "N"]:
    """Return which splats are in front of a camera and at most so many deviations outside its picture."""
    x, y, z = camera.to_camera(gaussians.means).unbind(1)
    radius = sigmas * camera.focal * gaussians.log_scales.double().amax(1).exp() / z.clamp_min(1e-12)
    if camera.lens is None:
        u, v = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
    else:
        u, v = camera.project(gaussians.means.double())[0].unbind(1)
    across = (u >= -radius) & (u <= camera.width + radius)
    return (z > camera.near) & across & (v >= -radius) & (v <= camera.height + radius)


def in_view_doubts(gaussians: Gaussians, cameras: Sequence[Camera], kind: str) -> Iterator[str]:
    """Yield a doubt if hardly any splat has its mean in view of some camera."""
    some = thinned(gaussians)
    in_view = torch.zeros(len(some.means), dtype=torch.bool, device=some.means.device)
    for camera in spread(cameras, MOST_VIEWS):
        in_view |= reaching(some, camera, 0)
    share = float(in_view.double().mean())
    if share < LEAST_IN_VIEW:
        yield (
            f"only {share:.2%} of the splats are in view of any {kind}, the file may be in other coordinates: compare "
            "its renders with the photos"
        )


def distance_doubts(gaussians: Gaussians, points: PointCloud) -> Iterator[str]:
    """Yield a doubt if the scene's points are far from all splats; random points, which are grey, do not count."""
    places = evident_points(points)
    if not len(places):
        return
    size = float((places - places.median(0).values).norm(dim=1).median())
    distance = distance_from_points(spread(gaussians.means, MOST_SPLATS).cpu(), places)
    if size > 0 and distance > FAR * size:
        yield (
            f"half of the scene's points are more than {distance:.3g} from the nearest splat, in a point cloud of size "
            f"{size:.3g}: the file holds a part of the scene, or is in other coordinates"
        )


def evident_points(points: PointCloud) -> Float[Tensor, "n 3"]:
    """Return some of the measured points (random ones are grey), float64; none if there are few."""
    measured = points.positions[(points.colours != GREY).any(1)]
    return spread(measured, MOST_POINTS).double() if len(measured) >= LEAST_POINTS else measured[:0].double()


def distance_from_points(means: Float[Tensor, "N 3"], places: Float[Tensor, "n 3"]) -> float:
    """Return the median distance of a scene's points from the nearest of some means, scene units."""
    return float(torch.cat([torch.cdist(part, means.double()).amin(1) for part in places.split(100)]).median())


def middle(places: Float[Tensor, "N 3"], origin: Origin) -> str:
    """Format the median of places relative to an origin."""
    values = [value + by for value, by in zip(places.double().median(0).values.tolist(), origin, strict=True)]
    return "({:.8g}, {:.8g}, {:.8g})".format(*values)


def spread(rows: Rows, most: int) -> Rows:
    """Return at most so many rows, evenly spread."""
    return rows[:: max(1, -(-len(rows) // most))]


def thinned(gaussians: Gaussians) -> Gaussians:
    """Return at most MOST_SPLATS Gaussians, evenly spread."""
    return Gaussians(**{name: spread(value, MOST_SPLATS) for name, value in vars(gaussians).items()})
