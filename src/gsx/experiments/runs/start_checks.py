"""Signs that a splat file does not belong to a scene: nothing in view, far from the points, activated values."""

import logging
from collections.abc import Iterator, Sequence
from pathlib import Path

import torch
from torch import Tensor

from gsx.core.data.camera import Camera
from gsx.core.data.scene import PointCloud, Scene
from gsx.core.errors import InputError
from gsx.core.gaussians.splats import Gaussians
from gsx.core.shapes import Bool, Float
from gsx.formats.activated import activated_words
from gsx.formats.origin import NO_ORIGIN, Origin
from gsx.scenes.points import GREY

logger = logging.getLogger(__name__)

MOST_SPLATS, MOST_POINTS, MOST_VIEWS = 50_000, 1000, 50
"""Evenly spread ones that are looked at where there are more."""
LEAST_IN_VIEW = 0.05
"""Share of splats in view of some camera below which they are doubted: splats of a scene have most of theirs (fox: 97 %
in two test views), in other axes 0.2 % were left."""
LEAST_POINTS = 10
"""Points of a scene that say something about where it is."""
FAR = 0.25
"""Median distance of points from the nearest splat, in sizes of the point cloud, above which splats are doubted: splats
of a scene have 0.01 (fox), a tenth off its scale 0.11, in other axes or scales 0.7 and more."""
SIGMAS = 3.0
"""Standard deviations up to which a splat is drawn."""


def doubts_about(gaussians: Gaussians, scene: Scene, path: Path, trains: bool) -> list[str]:
    """Returns sentences on why a splat file may not belong to a scene, which also go to the log.

    trains: the file is trained on, so that all views count; otherwise test views do, where there are any.

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
    """Raises InputError if no splat reaches the picture of any camera. kind: of the cameras, in words; origin: added to
    coordinates in words."""
    if any(bool(reaching(gaussians, camera, SIGMAS).any()) for camera in cameras):
        return
    centres = torch.stack([camera.centre.double() for camera in cameras])
    raise InputError(
        f"{path}: no splat is in view of any {kind} ({len(cameras)}). Splats lie around "
        f"{middle(gaussians.means, origin)}, cameras around {middle(centres, origin)}: "
        "export the file in the coordinates of the cameras"
    )


def reaching(gaussians: Gaussians, camera: Camera, sigmas: float) -> Bool[Tensor, "N"]:
    """Returns which splats are in front of a camera and at most so many of their deviations outside its picture."""
    x, y, z = camera.to_camera(gaussians.means).unbind(1)
    radius = sigmas * camera.focal * gaussians.log_scales.double().amax(1).exp() / z.clamp_min(1e-12)
    u, v = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
    across = (u >= -radius) & (u <= camera.width + radius)
    return (z > camera.near) & across & (v >= -radius) & (v <= camera.height + radius)


def in_view_doubts(gaussians: Gaussians, cameras: Sequence[Camera], kind: str) -> Iterator[str]:
    """Yields a sentence if hardly any splat has its middle in view of some camera."""
    some = Gaussians(**{name: spread(value, MOST_SPLATS) for name, value in vars(gaussians).items()})
    in_view = torch.zeros(len(some.means), dtype=torch.bool, device=some.means.device)
    for camera in cameras[:: max(1, -(-len(cameras) // MOST_VIEWS))]:
        in_view |= reaching(some, camera, 0)
    share = float(in_view.double().mean())
    if share < LEAST_IN_VIEW:
        yield (
            f"only {share:.2%} of its splats are in view of any {kind}, it may be in other coordinates: compare its "
            "pictures with the photos"
        )


def distance_doubts(gaussians: Gaussians, points: PointCloud) -> Iterator[str]:
    """Yields a sentence if the scene's points are far from all splats; random points, which are grey, say nothing."""
    places = evident_points(points)
    if not len(places):
        return
    size = float((places - places.median(0).values).norm(dim=1).median())
    distance = distance_from_points(spread(gaussians.means, MOST_SPLATS).cpu(), places)
    if size > 0 and distance > FAR * size:
        yield (
            f"half of the scene's points are more than {distance:.3g} from its nearest splat, and the points have a "
            f"size of {size:.3g}: it holds a part of the scene, or is in other coordinates"
        )


def evident_points(points: PointCloud) -> Float[Tensor, "n 3"]:
    """Returns some of the points that were measured, float64; none of scenes that have few, as random ones are grey."""
    measured = points.positions[(points.colours != GREY).any(1)]
    return spread(measured, MOST_POINTS).double() if len(measured) >= LEAST_POINTS else measured[:0].double()


def distance_from_points(means: Float[Tensor, "N 3"], places: Float[Tensor, "n 3"]) -> float:
    """Returns the median distance of a scene's points from the nearest of some means, scene units."""
    return float(torch.cat([torch.cdist(part, means.double()).amin(1) for part in places.split(100)]).median())


def middle(places: Float[Tensor, "N 3"], origin: Origin) -> str:
    """Returns the median of places that count from an origin, in words."""
    values = [value + by for value, by in zip(places.double().median(0).values.tolist(), origin, strict=True)]
    return "({:.8g}, {:.8g}, {:.8g})".format(*values)


def spread(rows: Float[Tensor, "N ..."], most: int) -> Float[Tensor, "n ..."]:
    """Returns every so many rows, at most so many of them."""
    return rows[:: max(1, -(-len(rows) // most))]
