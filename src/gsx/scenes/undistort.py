"""Undistortion of photos: the pinhole camera with (almost) the same field of view, and the resampling to it.

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
OUTSIDE = 1.0  # largest distance of an undistorted pixel from its photo, in sides of that: beyond, the lens is wrong
STEPS = 9  # places along each side of the picture at which that is checked
SAME_PIXEL = 0.1  # largest distance of a keypoint from the projection of its ray, px: beyond, it is another pixel's
LEAST_FOCAL, LARGEST_FOCAL = 1e-6, 1e12  # px: beyond them numbers overflow
METHOD = "keys-cubic/1"  # part of the cache key: raise the number when the resampling changes


def is_pinhole(camera: Any) -> bool:
    """Return whether a pycolmap camera is a pinhole: by its model, or because all its distortion is zero."""
    return bool(camera.is_perspective_pinhole() and camera.is_undistorted())


def pinhole_of(camera: Any) -> Any:
    """Return the pycolmap PINHOLE camera to which photos of `camera` are undistorted, itself if it is one.

    Raises:
        InputError: it covers all directions (EQUIRECTANGULAR), or its distortion is impossible or leaves too little.
    """
    if is_pinhole(camera) and np.isfinite(camera.params).all():  # pycolmap takes NaN for no distortion
        return camera
    return _undistorted(*_numbers(camera))[0]


def cut_of(camera: Any) -> Cut | None:
    """Return the cut of a pycolmap camera's photos where its lens folds; None: none."""
    return None if is_pinhole(camera) else _undistorted(*_numbers(camera))[1]


@lru_cache(maxsize=1024)  # a lens is needed for each of its photos
def _undistorted(model: str, width: int, height: int, params: tuple[float, ...]) -> tuple[Any, Cut | None]:
    """Return the pycolmap PINHOLE camera of a lens, and the part of its photos that is kept, if it folds."""
    import pycolmap

    camera = pycolmap.Camera(model=model, width=width, height=height, params=params)
    if not camera.is_perspective():
        raise InputError(
            f"Camera model {camera.model_name} of a {camera.width}x{camera.height} photo has no pinhole equivalent: "
            "cut the photos into perspective views and reconstruct those."
        )
    pinhole = pycolmap.undistort_camera(pycolmap.UndistortCameraOptions(), camera)
    cut: Cut | None = None
    focal = camera.focal_length_x, camera.focal_length_y
    valid = np.isfinite(params).all() and min(focal) > LEAST_FOCAL and max(focal) < LARGEST_FOCAL
    if valid and not shows_truly(camera, pinhole):
        pinhole, cut = cut_where_folded(camera, pinhole)
    size = torch.tensor([camera.width, camera.height], dtype=torch.float64)
    pixels = torch.cat(list(_distorted_pixels(camera, pinhole, (STEPS, STEPS)))) / size
    if not (pixels - 0.5).abs().max() <= 0.5 + OUTSIDE:  # true for NaN as well
        raise InputError(
            f"The {camera.model_name} camera of a {camera.width}x{camera.height} photo distorts it beyond recognition "
            f"({camera.params_to_string()}): correct its intrinsics."
        )
    return pinhole, cut


def camera_of(pinhole: Any, rotation: Float[Tensor, "3 3"], translation: Float[Tensor, "3"]) -> Camera:
    """Return the gsx camera of a pycolmap pinhole camera with a pose camera_from_world."""
    focal = {"fx": pinhole.focal_length_x, "fy": pinhole.focal_length_y}
    centre = {"cx": pinhole.principal_point_x, "cy": pinhole.principal_point_y}
    size = {"width": pinhole.width, "height": pinhole.height}
    return Camera(rotation=rotation, translation=translation, **focal, **centre, **size)


def undistorted_size(intrinsics: Any, pinhole: Any, size: tuple[int, int]) -> tuple[int, int]:
    """Return the undistorted size of a photo of `size`, perhaps a reduction of the camera `intrinsics`."""
    width, height = size
    return round(pinhole.width * width / intrinsics.width), round(pinhole.height * height / intrinsics.height)


def undistort_points(intrinsics: Any, pinhole: Any, positions: Float[Tensor, "K 2"]) -> Float[Tensor, "K 2"]:
    """Map pixels of `intrinsics` to `pinhole`, float64; NaN where the lens has no ray. Both are pycolmap cameras."""
    if intrinsics is pinhole or not len(positions):
        return positions
    rays = rays_of(intrinsics, positions)
    focal = torch.tensor([pinhole.focal_length_x, pinhole.focal_length_y], dtype=torch.float64)
    centre = torch.tensor([pinhole.principal_point_x, pinhole.principal_point_y], dtype=torch.float64)
    return rays * focal + centre


def rays_of(intrinsics: Any, positions: Float[Tensor, "K 2"]) -> Float[Tensor, "K 2"]:
    """Return rays (x/z, y/z) of pixels of a pycolmap camera; NaN where no ray in front of the camera has that pixel.

    A ray must project to its pixel again: fisheye models mirror what lies behind the camera to the front.
    """
    rays = torch.from_numpy(intrinsics.cam_from_img(positions.numpy()))
    again = torch.from_numpy(intrinsics.img_from_cam(nn.functional.pad(rays, (0, 1), value=1.0).numpy()))
    same = (again - positions).abs().amax(1, keepdim=True) <= SAME_PIXEL
    return torch.where(same, rays, torch.nan)


def undistort(
    image: UInt8[Tensor, "C H W"], intrinsics: Any, pinhole: Any, size: tuple[int, int]
) -> UInt8[Tensor, "C h w"]:
    """Resample the photo `image` of the camera `intrinsics` to `pinhole`, on a raster of `size`.

    Both pycolmap cameras may have another resolution than the photo and the result: only their fields of view count.
    """
    photo, sides = premultiplied(image.float() / 255), (image.shape[2], image.shape[1])
    to_photo = torch.tensor([sides[0] / intrinsics.width, sides[1] / intrinsics.height], dtype=torch.float64)
    bands = (sample(photo, pixels * to_photo) for pixels in _distorted_pixels(intrinsics, pinhole, size))
    return torch.cat([to_uint8(straight(band)) for band in bands], dim=1)


def premultiplied(photo: Float[Tensor, "C H W"]) -> Float[Tensor, "C H W"]:
    """Multiply colours by alpha, if any: transparent pixels have no colour to interpolate."""
    return photo if len(photo) < 4 else torch.cat([photo[:3] * photo[3:], photo[3:]])


def straight(photo: Float[Tensor, "C H W"]) -> Float[Tensor, "C H W"]:
    """Divide premultiplied colours by alpha, which may exceed [0, 1]; black at alpha 0."""
    colours, alpha = photo[:3], photo[3:]
    return photo if len(photo) < 4 else torch.cat([torch.where(alpha > 0, colours / alpha, 0.0), alpha])


def _distorted_pixels(intrinsics: Any, pinhole: Any, size: tuple[int, int]) -> Iterator[Float[Tensor, "h w 2"]]:
    """Yield the pixels of `intrinsics` for each pixel of the result, band by band."""
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
    """Undistortion of one photo, with its result kept as PNG between runs."""

    photo: Path
    intrinsics: Any
    pinhole: Any
    size: tuple[int, int]
    """(width, height) of the result."""
    turned: int = 1
    """EXIF orientation applied to the stored photo beforehand."""

    def __call__(self, image: UInt8[Tensor, "C H W"]) -> UInt8[Tensor, "C h w"]:
        stored = self.stored()
        kept = read_cached_image(stored)
        if kept is not None:
            return kept
        make_folder(stored.parent)  # without it every photo would be undistorted many times
        result = undistort(image, self.intrinsics, self.pinhole, self.size)
        cache_image(stored, result)
        return result

    def nearest(self, values: Float[Tensor, "C H W"]) -> Float[Tensor, "C h w"]:
        """Resample a map of the photo by its nearest values, on a raster of its own resolution; 0 outside."""
        intrinsics, pinhole, (height, width) = self.intrinsics, self.pinhole, values.shape[1:]
        to_map = torch.tensor([width / intrinsics.width, height / intrinsics.height], dtype=torch.float64)
        bands = _distorted_pixels(intrinsics, pinhole, undistorted_size(intrinsics, pinhole, (width, height)))
        column, row = (torch.cat(list(bands)) * to_map).floor().long().unbind(-1)
        inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
        return torch.where(inside, values[:, row.clamp(0, height - 1), column.clamp(0, width - 1)], 0.0)

    def stored(self) -> Path:
        """Return the place of the result in the cache, by photo, cameras and method."""
        lenses = ((*_numbers(lens)[:3], lens.params.tolist()) for lens in (self.intrinsics, self.pinhole))
        key = content_key(METHOD, "premultiplied", *lenses, self.size)
        turned = [self.turned] if self.turned != 1 else []
        name = content_key(str(self.photo.resolve().parent), *file_stamp(self.photo), *turned)
        return cache_folder("undistorted", key) / f"{self.photo.stem}_{name}.png"


def _numbers(camera: Any) -> tuple[str, int, int, tuple[float, ...]]:
    return camera.model_name, camera.width, camera.height, tuple(camera.params.tolist())
