"""Lens distortion out of the photos: the pinhole camera that sees (almost) the same, and the resampling to it.

The pinhole is COLMAP's (`undistort_camera` with its defaults: no blank pixels, so borders are trimmed), cut where the
lens folds (gsx.scenes.lens_folds). Pixel centres are at +0.5 on both rasters. Sampling is cubic where COLMAP's own
undistorter is bilinear: it keeps more detail.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from gsx.core.data.camera import Camera
from gsx.core.data.resize import to_uint8
from gsx.core.errors import InputError
from gsx.core.shapes import Float, UInt8
from gsx.engine.cache import cache_folder, content_key, file_stamp, make_folder
from gsx.engine.cached_images import cache_image, read_cached_image
from gsx.scenes.lens_folds import Cut, cut_where_folded, project, shows_truly

ROWS_PER_BAND = 256  # rows sampled at a time: bounds the memory of the grid, whatever the photo's height
OUTSIDE = 1.0
"""An undistorted picture that would show what lies farther outside its photo, in sides of it, comes of no real lens."""
STEPS = 9  # along each side of the picture, at which that is looked at
SAME_PIXEL = 0.1
"""Largest distance of a keypoint from the projection of its ray, px; beyond it the ray is another pixel's."""
LEAST_FOCAL, LARGEST_FOCAL = 1e-6, 1e12
"""Px; beyond them is no lens, and numbers overflow."""
METHOD = "keys-cubic/1"  # part of the cache key: raise the number when the resampling changes


def is_pinhole(camera: Any) -> bool:
    """Return whether a pycolmap camera is a pinhole: by its model, or because all its distortion is zero."""
    return bool(camera.is_perspective_pinhole() and camera.is_undistorted())


@dataclass(frozen=True)
class Undistorted:
    """Result of undistorting a distorted camera."""

    pinhole: Any
    """A pycolmap PINHOLE camera."""
    cut: Cut | None
    """Part of its photos that is kept; None: all but the borders that COLMAP trims."""


def pinhole_of(camera: Any) -> Any:
    """Return the pycolmap PINHOLE camera that a photo of `camera` is undistorted to; `camera` itself if it is one.

    Raises:
        InputError: the camera sees all round (EQUIRECTANGULAR), which no pinhole can, has a senseless distortion, or
            has rays for too little of its photo.
    """
    if is_pinhole(camera) and np.isfinite(camera.params).all():  # to pycolmap distortion by no number is none
        return camera
    return _undistorted(*_numbers(camera)).pinhole


def cut_of(camera: Any) -> Cut | None:
    """Return what is cut off a pycolmap camera's photos where its lens folds; None: nothing."""
    return None if is_pinhole(camera) else _undistorted(*_numbers(camera)).cut


@lru_cache(maxsize=1024)  # a lens is needed for each of its photos
def _undistorted(model: str, width: int, height: int, params: tuple[float, ...]) -> Undistorted:
    import pycolmap

    camera = pycolmap.Camera(model=model, width=width, height=height, params=params)
    if not camera.is_perspective():
        raise InputError(
            f"Camera model {camera.model_name} of a {camera.width}x{camera.height} photo has no pinhole equivalent: "
            "cut the photos into perspective views and reconstruct those."
        )
    pinhole = pycolmap.undistort_camera(pycolmap.UndistortCameraOptions(), camera)
    found = Undistorted(pinhole, None)
    focal = camera.focal_length_x, camera.focal_length_y
    sensible = np.isfinite(params).all() and min(focal) > LEAST_FOCAL and max(focal) < LARGEST_FOCAL
    if sensible and not shows_truly(camera, pinhole):
        found = Undistorted(*cut_where_folded(camera, pinhole))
    refuse_nonsense(camera, found.pinhole)
    return found


def refuse_nonsense(camera: Any, pinhole: Any) -> None:
    """Raise InputError if what `pinhole` sees lies nowhere near the photo of `camera`; both are pycolmap cameras."""
    size = torch.tensor([camera.width, camera.height], dtype=torch.float64)
    seen = torch.cat(list(_distorted_pixels(camera, pinhole, (STEPS, STEPS)))) / size
    if not (seen - 0.5).abs().max() <= 0.5 + OUTSIDE:  # neither for numbers that are none
        raise InputError(
            f"The {camera.model_name} camera of a {camera.width}x{camera.height} photo bends it beyond recognition "
            f"({camera.params_to_string()}): correct its intrinsics."
        )


def camera_of(pinhole: Any, rotation: Float[Tensor, "3 3"], translation: Float[Tensor, "3"]) -> Camera:
    """Return a pycolmap pinhole camera with a pose camera_from_world as gsx has it, at the same resolution."""
    focal = {"fx": pinhole.focal_length_x, "fy": pinhole.focal_length_y}
    centre = {"cx": pinhole.principal_point_x, "cy": pinhole.principal_point_y}
    size = {"width": pinhole.width, "height": pinhole.height}
    return Camera(rotation=rotation, translation=translation, **focal, **centre, **size)


def undistorted_size(intrinsics: Any, pinhole: Any, size: tuple[int, int]) -> tuple[int, int]:
    """Return the size of the result for a photo of `size`, which may be reduced against the camera `intrinsics`."""
    width, height = size
    return round(pinhole.width * width / intrinsics.width), round(pinhole.height * height / intrinsics.height)


def undistort_points(intrinsics: Any, pinhole: Any, positions: Float[Tensor, "K 2"]) -> Float[Tensor, "K 2"]:
    """Return where pixels of `intrinsics` lie in `pinhole`; NaN where the lens has no ray for a pixel.

    Both are pycolmap cameras, positions are in pixels, float64.
    """
    if intrinsics is pinhole or not len(positions):
        return positions
    rays = rays_of(intrinsics, positions)
    focal = torch.tensor([pinhole.focal_length_x, pinhole.focal_length_y], dtype=torch.float64)
    centre = torch.tensor([pinhole.principal_point_x, pinhole.principal_point_y], dtype=torch.float64)
    return rays * focal + centre


def rays_of(intrinsics: Any, positions: Float[Tensor, "K 2"]) -> Float[Tensor, "K 2"]:
    """Return rays (x/z, y/z) of pixels of a pycolmap camera; NaN where no ray before the camera has that pixel.

    A ray counts if it projects to its pixel again: fisheye models mirror what lies behind the camera to the front.
    """
    rays = torch.from_numpy(intrinsics.cam_from_img(positions.numpy()))
    again = torch.from_numpy(intrinsics.img_from_cam(nn.functional.pad(rays, (0, 1), value=1.0).numpy()))
    same = (again - positions).abs().amax(1, keepdim=True) <= SAME_PIXEL
    return torch.where(same, rays, torch.nan)


def undistort(
    image: UInt8[Tensor, "C H W"], intrinsics: Any, pinhole: Any, size: tuple[int, int]
) -> UInt8[Tensor, "C h w"]:
    """Return the photo `image` of the camera `intrinsics` as `pinhole` would have taken it, on a raster of `size`.

    Both pycolmap cameras may be of another resolution than the photo and the result: only their fields of view count.
    """
    photo = premultiplied(image.float() / 255)
    to_photo = torch.tensor(
        [image.shape[2] / intrinsics.width, image.shape[1] / intrinsics.height], dtype=torch.float64
    )
    bands = (sample(photo, pixels * to_photo) for pixels in _distorted_pixels(intrinsics, pinhole, size))
    return torch.cat([to_uint8(straight(band)) for band in bands], dim=1)


def premultiplied(photo: Float[Tensor, "C H W"]) -> Float[Tensor, "C H W"]:
    """Multiply colours by alpha, if there is one: what is transparent has no colour to interpolate."""
    return photo if len(photo) < 4 else torch.cat([photo[:3] * photo[3:], photo[3:]])


def straight(photo: Float[Tensor, "C H W"]) -> Float[Tensor, "C H W"]:
    """Divide premultiplied colours by alpha, which may be beyond [0, 1]; black where nothing is opaque."""
    colours, alpha = photo[:3], photo[3:]
    return photo if len(photo) < 4 else torch.cat([torch.where(alpha > 0, colours / alpha, 0.0), alpha])


def _distorted_pixels(intrinsics: Any, pinhole: Any, size: tuple[int, int]) -> Iterator[Float[Tensor, "h w 2"]]:
    """Yield, band by band, where `intrinsics` sees what each pixel of the result shows, in its pixels."""
    width, height = size
    columns = (torch.arange(width, dtype=torch.float64) + 0.5) * (pinhole.width / width)
    rows = (torch.arange(height, dtype=torch.float64) + 0.5) * (pinhole.height / height)
    x = (columns - pinhole.principal_point_x) / pinhole.focal_length_x
    for y in ((rows - pinhole.principal_point_y) / pinhole.focal_length_y).split(ROWS_PER_BAND):
        yield project(intrinsics, x, y)


def sample(photo: Float[Tensor, "C H W"], pixels: Float[Tensor, "h w 2"]) -> Float[Tensor, "C h w"]:
    """Interpolate with Keys' cubic, a = -1/2, which leaves ramps exact; borders are repeated outwards.

    torch's own bicubic `grid_sample` has a = -3/4, which shifts detail by up to 0.05 px.
    """
    height, width = photo.shape[1:]
    first = (pixels - 0.5).floor()
    across, down = _keys((pixels - 0.5 - first).float()).unbind(dim=-1)
    column, row = first.long().unbind(dim=-1)
    result = photo.new_zeros(photo.shape[0], *pixels.shape[:2])
    for j in range(4):
        line = (row + j - 1).clamp(0, height - 1) * width
        for i in range(4):
            index = line + (column + i - 1).clamp(0, width - 1)
            result.addcmul_(photo.flatten(1)[:, index], across[i] * down[j])
    return result


def _keys(t: Float[Tensor, "*shape"]) -> Float[Tensor, "4 *shape"]:
    """Return weights of the samples at -1, 0, 1, 2 for a position t in [0, 1) (Keys 1981)."""
    near = ((3 * t - 5) * t * t + 2) / 2, ((4 - 3 * t) * t + 1) * t / 2
    return torch.stack([((2 - t) * t - 1) * t / 2, *near, (t - 1) * t * t / 2])


@dataclass(frozen=True, eq=False)
class StoredUndistortion:
    """Undistortion of one photo, its result kept as PNG between runs."""

    photo: Path
    intrinsics: Any
    pinhole: Any
    size: tuple[int, int]
    """(width, height) of the result."""
    turned: int = 1
    """EXIF orientation that was applied to the stored photo beforehand."""

    def __call__(self, image: UInt8[Tensor, "C H W"]) -> UInt8[Tensor, "C h w"]:
        stored = self.stored()
        kept = read_cached_image(stored)
        if kept is not None:
            return kept
        make_folder(stored.parent)  # without it every photo would be undistorted many times
        result = undistort(image, self.intrinsics, self.pinhole, self.size)
        cache_image(stored, result)
        return result

    def stored(self) -> Path:
        """Return the place of the result; another photo, camera or method has another one."""
        lenses = ((*_numbers(lens)[:3], lens.params.tolist()) for lens in (self.intrinsics, self.pinhole))
        key = content_key(METHOD, "premultiplied", *lenses, self.size)
        turned = [self.turned] if self.turned != 1 else []
        name = content_key(str(self.photo.resolve().parent), *file_stamp(self.photo), *turned)
        return cache_folder("undistorted", key) / f"{self.photo.stem}_{name}.png"


def _numbers(camera: Any) -> tuple[str, int, int, tuple[float, ...]]:
    return camera.model_name, camera.width, camera.height, tuple(camera.params.tolist())
