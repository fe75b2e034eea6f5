"""The built-in scenes through a fisheye: its exact photos, or those resampled to a pinhole's as scenes on disk are."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from torch import Tensor

from gsx.core.data.camera import Camera
from gsx.core.data.images import ImageCache
from gsx.core.data.scene import DerivedSource, View
from gsx.core.data.window import Window
from gsx.core.shapes import UInt8
from gsx.lenses import lens_of
from gsx.scenes.demo.cameras import Cameras
from gsx.scenes.undistort import camera_of, pinhole_of, undistort

COEFFICIENTS = (0.03, -0.02, 0.004, -0.001)
"""k1 to k4 of OPENCV_FISHEYE: some percent off an equidistant lens, as of action cameras."""


def fisheye(degrees: float, width: int, height: int) -> Any:
    """Return the pycolmap camera of this horizontal angle of view, with square pixels."""
    half = math.radians(degrees / 2)
    focal = width / 2 / (half * (1 + sum(k * half ** (2 * n + 2) for n, k in enumerate(COEFFICIENTS))))
    return model_of((width, height), focal, focal, width / 2, height / 2)


def model_of(size: tuple[int, int], *intrinsics: float) -> Any:
    """Return the pycolmap camera of this lens; intrinsics: fx, fy, cx, cy."""
    import pycolmap

    params = [*intrinsics, *COEFFICIENTS]
    return pycolmap.Camera(model="OPENCV_FISHEYE", width=size[0], height=size[1], params=params)


def through_fisheye(cameras: Cameras, degrees: float) -> Cameras:
    """Return the cameras with the fisheye."""

    def changed(groups: Mapping[str, Sequence[Camera]]) -> dict[str, list[Camera]]:
        return {name: [with_fisheye(camera, degrees) for camera in members] for name, members in groups.items()}

    return Cameras(train=changed(cameras.train), test=changed(cameras.test), split=cameras.split)


def with_fisheye(camera: Camera, degrees: float) -> Camera:
    """Return the camera with the fisheye in place of its pinhole."""
    model = fisheye(degrees, *camera.size)
    return replace(camera_of(model, camera.rotation, camera.translation), near=camera.near, lens=lens_of(model))


@dataclass(frozen=True, eq=False, kw_only=True)
class StraightenedSource(DerivedSource):
    """Photos of a fisheye resampled to a pinhole."""

    photo: Camera
    """Camera of the photo."""
    intrinsics: Any
    pinhole: Any
    """pycolmap cameras of the photo and of the result."""
    cache: ImageCache

    def image(self, camera: Camera) -> UInt8[Tensor, "3 H W"]:
        """Return the undistorted photo at the camera's zoom, or a crop of it."""
        across, down = camera.fx / self.pinhole.focal_length_x, camera.fy / self.pinhole.focal_length_y
        size = round(self.pinhole.width * across), round(self.pinhole.height * down)
        left = round(self.pinhole.principal_point_x * across - camera.cx)
        top = round(self.pinhole.principal_point_y * down - camera.cy)
        window = Window(left=left, top=top, width=camera.width, height=camera.height)
        return window.cut(self.cache.get((id(self), size), lambda: self._whole(across, size)))

    def _whole(self, zoom: float, size: tuple[int, int]) -> UInt8[Tensor, "3 height width"]:
        return undistort(self.source.image(self.photo.zoom(zoom)), self.intrinsics, self.pinhole, size)


def straightened(views: Sequence[View], cache: ImageCache) -> list[View]:
    """Return views of a fisheye with undistorted photos and pinhole cameras."""
    return [_straightened(view, cache) for view in views]


def _straightened(view: View, cache: ImageCache) -> View:
    photo = view.camera
    intrinsics = model_of(photo.size, photo.fx, photo.fy, photo.cx, photo.cy)
    pinhole = pinhole_of(intrinsics)
    camera = replace(camera_of(pinhole, photo.rotation, photo.translation), near=photo.near)
    source = StraightenedSource(source=view.source, photo=photo, intrinsics=intrinsics, pinhole=pinhole, cache=cache)
    return replace(view, camera=camera, source=source)
