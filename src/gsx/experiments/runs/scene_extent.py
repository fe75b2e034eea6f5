"""The extent of a scene whose cameras stand in one place, as on a tripod.

The extent scales learning rates of positions and sizes of splats, and 3D-GS takes it from distances between cameras.
Where these are rounding, the points alone say how large the scene is.
"""

from collections.abc import Sequence
from dataclasses import replace

from gsx.core.data.camera import Camera, offsets_from
from gsx.core.data.scene import PointCloud, Scene, extent_of
from gsx.scenes.posed import SAME_PLACE

ONE_PLACE = 3e-5
"""Extent of cameras, as a share of the points' median distance, that is rounding: at a focal length of 3,000 px they
see points move by 0.1 px, which no reconstruction measures. Rounded poses are at 1e-6, close-ups above 1e-3."""


def point_distance(cameras: Sequence[Camera], points: PointCloud) -> float:
    """Returns the median distance of the points from the first camera, scene units; 0 without points."""
    if len(points) == 0:
        return 0.0
    return float(offsets_from(points.positions, cameras[0].centre).norm(dim=1).median())


def rounding_extent(cameras: Sequence[Camera], points: PointCloud) -> float:
    """Returns the largest extent that is rounding: by the points' distances, or without points in scene units."""
    return ONE_PLACE * point_distance(cameras, points) if len(points) else SAME_PLACE


def in_one_place(cameras: Sequence[Camera], points: PointCloud) -> bool:
    """Returns whether distances between cameras are rounding."""
    return extent_of(cameras) <= rounding_extent(cameras, points)


def measured(scene: Scene) -> Scene:
    """Returns the scene; if its training cameras stand in one place, its extent is 1.1 x the points' median distance.

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
