"""Lenses that fold: beyond the maximum of a lens's polynomial, pixels mirror what others show already.

`r (1 + k r^2)` with k < 0 grows up to r = 1 / sqrt(-3 k). Farther rays return towards the middle, pixels beyond the
turning point have no ray, and a picture that reaches past it is mirrored there. Training uses the part around the
principal axis in which the Jacobian determinant of the map from rays to pixels is positive, for every lens model.
"""

import math
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import max_pool2d

from gsx.core.errors import InputError
from gsx.core.shapes import Bool, Float

STEPS = 129  # places along each side of an undistorted picture at which its orientation is checked
FINE_STEPS = 257  # places along each side at which a cut may be
RAY_STEPS = 257  # places along each side of a photo at which rays are computed
DIFFERENCE = 1e-6  # step of a ray's slope for derivatives
LARGEST_SCALE = 2.0  # of an undistorted side by the photo's, as COLMAP's (UndistortCameraOptions.max_scale)
LEAST_AREA = 0.01  # of the photo in a pixel of a cut picture, by that of its middle: at the fold it is 0
REACH = 2.0  # px of the photo, along each axis, from which a pixel is interpolated
LEAST_SHARE = 0.2  # of a photo in its cut picture: at less, the lens is wrong


@dataclass(frozen=True)
class Cut:
    """The part of a photo that is left in its undistorted picture where the lens folds."""

    pixels: int
    """Pixels of the photo in the picture."""
    radius: float
    """Distance from the principal point to the nearest pixel without a ray, px; infinite: none is without."""


@dataclass(frozen=True, eq=False)
class Lattice:
    """Rays on a rectangular grid and their pixels through a lens."""

    x: Float[Tensor, "X"]
    """Slopes x/z, increasing."""
    y: Float[Tensor, "Y"]
    pixels: Float[Tensor, "Y X 2"]
    """Positions of the rays on the photo, px; NaN where the lens has none."""
    areas: Float[Tensor, "Y X"]
    """Jacobian determinant, px^2 per unit of slopes; negative where the picture is mirrored, along one axis or both."""


def lattice_of(camera: Any, x: Float[Tensor, "X"], y: Float[Tensor, "Y"]) -> Lattice:
    """Return the lattice of the rays with these slopes through a pycolmap camera."""
    pixels = project(camera, x, y)
    across = (project(camera, x + DIFFERENCE, y) - pixels) / DIFFERENCE
    down = (project(camera, x, y + DIFFERENCE) - pixels) / DIFFERENCE
    areas = across[..., 0] * down[..., 1] - across[..., 1] * down[..., 0]
    return Lattice(x, y, pixels, torch.where(across[..., 0] > 0, areas, -areas.abs()))  # mirrored twice is turned over


def project(camera: Any, x: Float[Tensor, "X"], y: Float[Tensor, "Y"]) -> Float[Tensor, "Y X 2"]:
    """Return the pixels of a grid of slopes, not finite where a lens has none."""
    grid_y, grid_x = torch.meshgrid(y, x, indexing="ij")
    rays = torch.stack([grid_x, grid_y, torch.ones_like(grid_x)], dim=-1).reshape(-1, 3)
    return torch.from_numpy(camera.img_from_cam(rays.numpy())).reshape(len(y), len(x), 2)


def shows_truly(camera: Any, pinhole: Any) -> bool:
    """Return whether no pixel of `pinhole` is mirrored or beyond the photo; both are pycolmap cameras."""
    x = slopes(0.5, pinhole.width - 0.5, pinhole.principal_point_x, pinhole.focal_length_x, STEPS)
    y = slopes(0.5, pinhole.height - 0.5, pinhole.principal_point_y, pinhole.focal_length_y, STEPS)
    lattice = lattice_of(camera, x, y)
    if not bool((lattice.areas > 0).all()):
        return False
    # COLMAP finds its picture from rays of the photo's border: where some are missing, it may reach past the photo
    x, y = (torch.linspace(0.5, side - 0.5, STEPS, dtype=torch.float64) for side in (camera.width, camera.height))
    border = torch.cat([torch.cartesian_prod(x, y[[0, -1]]), torch.cartesian_prod(x[[0, -1]], y)])
    rays = torch.from_numpy(camera.cam_from_img(border.numpy()))
    return bool(rays.isfinite().all()) or bool(inside(camera, lattice.pixels, 1.0).all())


def slopes(first: float, last: float, principal: float, focal: float, count: int) -> Float[Tensor, "N"]:
    """Return slopes of `count` pixel positions from `first` to `last`, float64."""
    return (torch.linspace(first, last, count, dtype=torch.float64) - principal) / focal


def inside(camera: Any, pixels: Float[Tensor, "*N 2"], margin: float = 0.0) -> Bool[Tensor, "*N"]:
    """Return which pixel positions lie on the photo of a camera, or within a margin around it, px."""
    size = pixels.new_tensor([camera.width, camera.height])
    return ((pixels >= -margin) & (pixels <= size + margin)).all(-1)


def cut_where_folded(camera: Any, pinhole: Any) -> tuple[Any, Cut]:
    """Return the largest pinhole camera without mirrored pixels, and the part of the photo in it.

    It has the focal lengths of `pinhole`, to which COLMAP would undistort; all are pycolmap cameras.

    Raises:
        InputError: it has less than `LEAST_SHARE` of the photo.
    """
    x = around_axis(camera.width, camera.principal_point_x, camera.focal_length_x)
    y = around_axis(camera.height, camera.principal_point_y, camera.focal_length_y)
    lattice = lattice_of(camera, x, y)
    usable = usable_rays(camera, lattice)
    place = nearest_to_axis(camera, lattice, usable)
    if place is None:
        raise refusal(camera, 0)
    top, bottom, left, right = largest_rectangle(usable, *place)
    part = lattice.areas[top : bottom + 1, left : right + 1]
    cut = with_window(pinhole, *(float(slope) for slope in (x[left], x[right], y[top], y[bottom])))
    area = float((x[right] - x[left]) * (y[bottom] - y[top]))  # in slopes
    pixels = 0 if cut is None else round(float(part.mean()) * area)
    if cut is None or pixels < LEAST_SHARE * camera.width * camera.height:
        raise refusal(camera, pixels)
    columns, rows, lost = pixels_without_rays(camera)
    distances = torch.hypot(columns - camera.principal_point_x, (rows - camera.principal_point_y)[:, None])
    radius = float(distances[lost].min()) if bool(lost.any()) else math.inf
    return cut, Cut(min(pixels, camera.width * camera.height), radius)


def usable_rays(camera: Any, lattice: Lattice) -> Bool[Tensor, "Y X"]:
    """Return which rays of a lattice are in the photo, unmirrored and not too small; false for NaN."""
    middle = lattice.areas[lattice.y.abs().argmin(), lattice.x.abs().argmin()]
    visible = inside(camera, lattice.pixels) & (lattice.areas > 0) & (lattice.areas > LEAST_AREA * middle)
    return visible & surrounded(camera, lattice.pixels.nan_to_num())


def surrounded(camera: Any, pixels: Float[Tensor, "*N 2"]) -> Bool[Tensor, "*N"]:
    """Return which positions on a photo are interpolated from pixels that all have a ray."""
    x, y, lost = pixels_without_rays(camera)
    step_x, step_y = (float(places[1] - places[0]) if len(places) > 1 else 1.0 for places in (x, y))
    reach = [math.ceil(REACH / step) for step in (step_y, step_x)]
    near = max_pool2d(lost.float()[None], [2 * n + 1 for n in reach], 1, reach)[0] > 0
    column = ((pixels[..., 0] - x[0]) / step_x).round().long().clamp(0, len(x) - 1)
    row = ((pixels[..., 1] - y[0]) / step_y).round().long().clamp(0, len(y) - 1)
    return ~near[row, column]


def pixels_without_rays(camera: Any) -> tuple[Float[Tensor, "X"], Float[Tensor, "Y"], Bool[Tensor, "Y X"]]:
    """Return columns and rows of pixels spread over a camera's photo, and which pixels have no ray."""
    sides = camera.width, camera.height
    x, y = (torch.linspace(0.5, side - 0.5, min(side, RAY_STEPS), dtype=torch.float64) for side in sides)
    pixels = torch.stack(torch.meshgrid(x, y, indexing="xy"), -1).reshape(-1, 2)
    rays = torch.from_numpy(camera.cam_from_img(pixels.numpy()))
    return x, y, ~rays.isfinite().all(1).reshape(len(y), len(x))


def nearest_to_axis(camera: Any, lattice: Lattice, usable: Bool[Tensor, "Y X"]) -> tuple[int, int] | None:
    """Return (row, column) of the usable ray nearest to the principal axis; None: a fold is between them."""
    distances = torch.where(usable, lattice.x.square() + lattice.y.square()[:, None], torch.inf)
    row, column = divmod(int(distances.argmin()), len(lattice.x))
    if not usable[row, column]:
        return None
    way = torch.linspace(0, 1, STEPS, dtype=torch.float64)[:, None] * torch.stack([lattice.x[column], lattice.y[row]])
    unfolded = all(bool((lattice_of(camera, x[None], y[None]).areas > 0).all()) for x, y in way)
    return (row, column) if unfolded else None


def around_axis(side: int, principal: float, focal: float) -> Float[Tensor, "N"]:
    """Return slopes across `LARGEST_SCALE` times a side, from the principal axis outwards in equal steps, with 0."""
    before, after = (min(max(reach, 0.0), LARGEST_SCALE * side) for reach in (principal, side - principal))
    step = LARGEST_SCALE * side / (FINE_STEPS - 1) / focal
    first, last = (round(LARGEST_SCALE * reach / focal / step) for reach in (before, after))
    return torch.arange(-first, last + 1, dtype=torch.float64) * step


def largest_rectangle(usable: Bool[Tensor, "Y X"], row: int, column: int) -> tuple[int, int, int, int]:
    """Return (top, bottom, left, right), inclusive, of the usable rectangle of the largest area around one place."""
    # number of places of each column, from the row upwards and downwards, that are usable without a gap
    reaches = [part.long().cumprod(0).sum(0) for part in (usable[: row + 1].flip(0), usable[row:])]
    left_up, left_down = (reach[: column + 1].flip(0).cummin(0).values for reach in reaches)  # least of all between
    right_up, right_down = (reach[column:].cummin(0).values for reach in reaches)
    heights = torch.minimum(left_up[:, None], right_up) + torch.minimum(left_down[:, None], right_down) - 2
    widths = torch.arange(len(left_up))[:, None] + torch.arange(len(right_up))
    areas = torch.where(torch.minimum(left_up[:, None], right_up) > 0, heights * widths, -1)
    before, after = divmod(int(areas.argmax()), areas.shape[1])
    above, below = min(left_up[before], right_up[after]), min(left_down[before], right_down[after])
    return row - max(int(above) - 1, 0), row + max(int(below) - 1, 0), column - before, column + after


def with_window(pinhole: Any, left: float, right: float, top: float, bottom: float) -> Any | None:
    """Return the pycolmap PINHOLE camera of these slopes with the focal lengths of `pinhole`; None: no pixel."""
    import pycolmap

    fx, fy = pinhole.focal_length_x, pinhole.focal_length_y
    width, height = int((right - left) * fx), int((bottom - top) * fy)
    if min(width, height) < 1:
        return None
    return pycolmap.Camera(model="PINHOLE", width=width, height=height, params=[fx, fy, -left * fx, -top * fy])


def refusal(camera: Any, pixels: int) -> InputError:
    """Return the error for a lens that leaves too little of its photo."""
    whole = camera.width * camera.height
    return InputError(
        f"The {camera.model_name} camera of a {camera.width}x{camera.height} photo ({camera.params_to_string()}) "
        f"folds: a picture without mirrored parts would show {pixels} of its {whole} px (at least {LEAST_SHARE:.0%} "
        "are needed): correct its intrinsics, or reconstruct the photos with a lens model that fits."
    )
