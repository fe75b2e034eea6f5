"""Cameras of the built-in still life: all at similar distances, or most of them far and a few near."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from gsx.core.data.camera import Camera, look_at
from gsx.core.errors import ConfigError

TARGET = (0.0, 0.05, 0.50)
"""Point that cameras look at, scene units; those of near photos look at NEAR_TARGET."""
FIELD_OF_VIEW = math.radians(50.0)
"""Horizontal."""
TURNS = 3.0
"""Turns of the spiral."""
ELEVATION = (math.radians(8.0), math.radians(46.0))
"""Elevation at the beginning and the end of the spiral."""
DISTANCE, SWAY, SWAYS = 3.3, 0.65, 5.0
"""Mean distance from the target, its variation, and the number of its periods."""
FAR_DISTANCE = 3 * DISTANCE
"""One distance for all far photos: where they differ by more than a tenth, SplatSuRe's ratio counts them as nearer."""
NEAR_DISTANCE = 1.9
"""Distance of near photos from NEAR_TARGET: 5.2 times as many pixels per unit as far ones."""
NEAR_TARGET = (0.50, -0.10, 0.55)
"""Point between chart, crate and beach ball: the tree and the left half of the wall are in far photos alone."""
NEAR_ARC = (math.radians(-145.0), math.radians(-70.0))
"""Azimuth at the beginning and the end of the arc around NEAR_TARGET where near photos stand; the chart faces -90."""
NEAR_ELEVATION = (math.radians(14.0), math.radians(34.0))
"""Elevation at the beginning and the end of that arc."""
NEAR_SHARE, NEAR_TEST_SHARE = 8, 5
"""One of so many training views is near, and one of so many test views."""
DISTANCES = ("even", "mixed")
"""Values of `scene.distances`."""

Point = tuple[float, float, float]
CameraAt = Callable[[float, int, int], Camera]
"""(place in [0, 1) of a path, width, height) -> the camera there."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Cameras:
    """Cameras of a scene by the group of their views, and how they stand, for the protocol."""

    train: Mapping[str, Sequence[Camera]]
    test: Mapping[str, Sequence[Camera]]
    split: str


def camera_around(target: Point, azimuth: float, elevation: float, distance: float, width: int, height: int) -> Camera:
    """Return a camera at angles and a distance from the point that it looks at."""
    flat = distance * math.cos(elevation)
    eye = (flat * math.cos(azimuth), flat * math.sin(azimuth), distance * math.sin(elevation))
    eye = (target[0] + eye[0], target[1] + eye[1], target[2] + eye[2])
    return look_at(eye, target, fov_x=FIELD_OF_VIEW, width=width, height=height)


def spiral_camera(place: float, width: int, height: int) -> Camera:
    """Return the camera at `place` in [0, 1) of a rising spiral around the scene at varying distance."""
    distance = DISTANCE - SWAY * math.cos(2 * math.pi * SWAYS * place)
    return camera_around(TARGET, *spiral_angles(place), distance, width, height)


def far_camera(place: float, width: int, height: int) -> Camera:
    """Return the camera at `place` in [0, 1) of the same spiral, three times as far away."""
    return camera_around(TARGET, *spiral_angles(place), FAR_DISTANCE, width, height)


def spiral_angles(place: float) -> tuple[float, float]:
    """Return azimuth and elevation at `place` in [0, 1) of the spiral."""
    azimuth = 2 * math.pi * TURNS * place - math.pi / 2
    return azimuth, ELEVATION[0] + (ELEVATION[1] - ELEVATION[0]) * place


def near_camera(place: float, width: int, height: int) -> Camera:
    """Return the camera at `place` in [0, 1) of an arc in front of the chart, so near that it shows a part."""
    azimuth = NEAR_ARC[0] + (NEAR_ARC[1] - NEAR_ARC[0]) * place
    elevation = NEAR_ELEVATION[0] + (NEAR_ELEVATION[1] - NEAR_ELEVATION[0]) * place
    return camera_around(NEAR_TARGET, azimuth, elevation, NEAR_DISTANCE, width, height)


def along(path: CameraAt, train: int, test: int, size: tuple[int, int]) -> tuple[list[Camera], list[Camera]]:
    """Return `train` cameras evenly along a path, and `test` cameras half-way between neighbours."""
    places = [(index * train // test + 0.5) / train for index in range(test)]
    return [path(index / train, *size) for index in range(train)], [path(place, *size) for place in places]


def even_cameras(path: CameraAt, name: str, train: int, test: int, size: tuple[int, int]) -> Cameras:
    """Place all cameras along one path of that name."""
    own, between = along(path, train, test, size)
    return Cameras(train={"": own}, test={"": between}, split=f"{train} on {name}, {test} between them")


def mixed_cameras(train: int, test: int, size: tuple[int, int]) -> Cameras:
    """Place most cameras far away and a few near; ConfigError: too few training views for one near camera."""
    if train < NEAR_SHARE:
        raise ConfigError(
            f"scene.distances=mixed needs {NEAR_SHARE} training views, as one in {NEAR_SHARE} is near, but "
            f"scene.train_views={train}: set at least scene.train_views={NEAR_SHARE}."
        )
    near = train // NEAR_SHARE
    near_test = min(near, test // NEAR_TEST_SHARE)
    far, far_between = along(far_camera, train - near, test - near_test, size)
    close, close_between = along(near_camera, near, near_test, size)
    return Cameras(
        train={"far": far, "near": close},
        test={"far": far_between, "near": close_between},
        split=f"{len(far)} far on a spiral, {near} near on an arc, {len(far_between)} and {near_test} between them",
    )
